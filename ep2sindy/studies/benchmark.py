"""How well methods find known equations: `+exp=benchmark`, `frontier` and `weak_windows`.

Realizations of known systems, over levels of noise, sampling rates and durations, go through named
methods. Methods that choose terms are counted; of forms of the regression, which are given the
terms, the error of the coefficients is measured. Source: the thesis, appendix, II-E and III.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Protocol, TypeAlias, runtime_checkable

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.method import Finding
from ep2sindy.figures.identified import COUNTS, MERITS, benchmark_figure, frontier_figure
from ep2sindy.library.library import Library, named_terms
from ep2sindy.library.relations import constraint
from ep2sindy.regression.constrained import constrained_fit
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.document import Result, Text
from ep2sindy.report.report import Report
from ep2sindy.runtime.parallel import Workers, rows_in_order
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.studies.resume import resumed
from ep2sindy.studies.study import A_LIST, Count, Deferred, Levels, Names, Positives
from ep2sindy.systems.draws import check_systems, realization
from ep2sindy.systems.systems import System
from ep2sindy.trust.user_code import nodes_of

CAPTIONS = {
    "benchmark": "Realizations in which all true equations are among the candidates, and are the "
    "ones selected, in %; a dash: the variant selects nothing, or N/A in the thesis. Of forms of "
    "the regression: ||beta - beta_true|| / ||beta_true|| over all equations, in %.",
    "frontier": "Filled: the true equations of all states are on the variant's fronts. Hollow: "
    "they are not. Cross: too few samples for the variant to run, which counts as not identified.",
}
INTRODUCTION = (
    "A system that is named draws an initial state, or for the Van der Pol oscillator its "
    "parameter, at random; one that is given stays as it is. White noise of the given fraction of "
    "each state's RMS is added; the library holds all products of the states up to a degree. A "
    "realization counts only if the equations of all states are right at once. Every variant sees "
    "the same realizations."
)
NOTE = (
    "on_front, selected: numbers of realizations, of n, whose true equations are on the front, and "
    "are the ones selected; mean_correct_terms: true terms among the selected, in the mean; "
    "cpu_s_per_search: of all equations of one realization, on one thread. thesis: its own "
    "numbers, of 100 realizations. error_mean: of forms of the regression, in %; the terms are "
    "known, and without noise the error is that of the integrals and derivatives."
)
CELL = ("system", "noise", "variant")
SAMPLING = ("variant", "rate_Hz", "duration_s", "reason")
MEANS = ("mean_correct_terms", "error_mean", "cpu_s_per_search")
# Headline of a variant, in % -> its words, and whether the largest is the best.
VERDICTS = {
    "selected_percent": ("selected exactly right", True),
    "on_front_percent": ("right on the front", True),
    "error_mean": ("mean error of the coefficients", False),
}
# Columns of `cells`: each from a column of the outcomes, if they have it.
AGGREGATES: Mapping[str, tuple[str, Any]] = {
    "on_front": ("on_front", "sum"),
    "selected": ("selected", lambda s: s.sum(min_count=1)),
    "mean_correct_terms": ("correct_terms", "mean"),
    "error_mean": ("error", lambda s: 100.0 * s.mean()),
    "n": ("cpu_s", "size"),
    "cpu_s_per_search": ("cpu_s", "median"),
}
Systems = Annotated[Sequence[str | System], A_LIST]
Draw = Callable[..., tuple[System, list[Trajectory]]]  # `realization`, with settings


@runtime_checkable
class Variant(Protocol):
    """A complete method: it maps trajectories and a library to supports. `Regression` is one."""

    def find(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Finding: ...


Ways: TypeAlias = Mapping[str, Variant | Formulation]


def build_variants(
    names: Sequence[str],
    definitions: Mapping[str, Deferred],
    grids: Mapping[str, Mapping[str, Any]],
) -> Ways:
    """Build the named methods from `definitions`; the others are not built.

    grids: lists of values in place of some settings of a method, each combination of which is a
    method of its own, `n_windows_100_n_points_10`.
    Raises ValueError for an unknown name or two equal ones, for what is neither a method with
    `find` nor a form of the regression, or for both kinds together.
    """
    if unknown := [name for name in (*names, *grids) if name not in definitions]:
        raise ValueError(f"unknown variants {unknown}; there are {list(definitions)}")
    variants: dict[str, Variant | Formulation] = {}
    for name in names:
        nodes = {at: node for at, node in nodes_of(grids.get(name)) if "[" not in at}
        lists = {at: node for at, node in nodes.items() if isinstance(node, list) and node}
        for values in product(*lists.values()):
            places = dict(zip(lists, values, strict=True))
            label = "_".join(f"{at.rpartition('.')[2]}_{value}" for at, value in places.items())
            if (label or name) in variants:
                raise ValueError(f"each variant needs a name of its own, got {label!r} twice")
            variants[label or name] = variant = definitions[name].changed(places).build()
            if not isinstance(variant, Variant | Formulation):
                raise ValueError(
                    f"definitions.{name} must name a _target_ that has `find`, or a form of the "
                    f"regression, got {variant}"
                )
    if len({isinstance(each, Variant) for each in variants.values()}) > 1:
        raise ValueError(f"variants must all choose terms, or none of them, got {[*variants]}")
    return variants


def merits(finding: Finding, system: System) -> dict[str, float]:
    """The three figures of merit of one realization, as numbers; NaN if no support was selected."""
    truth = {state: frozenset(system.model.terms(state)) for state in system.model.states}
    found = {"on_front": float(all(truth[state] in finding.kept[state] for state in truth))}
    if finding.selected is None:
        return found | {"selected": np.nan, "correct_terms": np.nan}
    chosen = finding.selected
    return found | {
        "selected": float(all(chosen[state] == truth[state] for state in truth)),
        "correct_terms": float(sum(len(chosen[state] & truth[state]) for state in truth)),
    }


def coefficient_error(
    form: Formulation, system: System, runs: Sequence[Trajectory], *, rng: np.random.Generator
) -> float:
    """||beta - beta_true|| / ||beta_true||; beta holds the coefficients of all equations."""
    truth = {state: system.model.terms(state) for state in system.model.states}
    names = list(dict.fromkeys(name for terms in truth.values() for name in terms))
    library = named_terms(system.model.library.variables, names)
    held = constraint(library, {state: list(terms) for state, terms in truth.items()})
    found = constrained_fit(form.assemble(runs, library, rng=rng), held)
    beta = np.array([found.terms(state).get(term, 0.0) for state, term in held.coefficients])
    beta_true = np.array([truth[state][term] for state, term in held.coefficients])
    return float(np.linalg.norm(beta - beta_true) / np.linalg.norm(beta_true))


@dataclass(frozen=True)
class Study:
    """Run every variant on the same realizations of known systems, and see how right it is.

    systems: names in `systems.draws.DRAWS`, or systems. noises: standard deviations of the white
    noise, in RMS of each state. rates_Hz, durations_s: sampling; None takes each system's own.
    n_realizations: None for one, of a system that draws nothing. n_trajectories: number of
    trajectories in each realization. degree: of the library; None takes each system's own.
    variants: names among the definitions. grids: see `build_variants`. keep: whether a run
    continues with the finished realizations of one that was interrupted.
    """

    systems: Systems
    noises: Levels
    n_realizations: Count | None
    variants: Names
    definitions: Mapping[str, Deferred]
    parallel: Workers
    n_trajectories: Count = 1
    degree: Count | None = None
    rates_Hz: Positives | None = None
    durations_s: Positives | None = None
    grids: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    keep: bool = True

    def run(self, report: Report) -> None:
        variants = build_variants(self.variants, self.definitions, self.grids)
        with resumed(self.keep, report, self.parallel) as workers:
            outcomes = replace(self, parallel=workers).outcomes(
                variants, seed=report.seed, progress=report.watch
            )
            report.section(
                "Realizations",
                "Realizations of every system, noise level, sampling rate and duration: "
                f"{self.n_realizations or 1}.",
                Text(INTRODUCTION, page_only=True),
            )
            add_cells(report, outcomes)
        report.section("Variants")
        report.add(*(Text(f"{name}: {each}", page_only=True) for name, each in variants.items()))

    def outcomes(
        self, variants: Ways, *, seed: int = 0, progress: Progress = SILENT
    ) -> pd.DataFrame:
        """How right every variant is on every realization; workers share the realizations.

        One row per system, noise, rate, duration, number and variant, with the axes that are set.
        on_front and selected: 1 if the equations of all states are right, else 0. correct_terms:
        number of true terms among the selected ones. error: see `coefficient_error`. cpu_s: time of
        the search. selected and correct_terms are NaN for a variant that selects nothing. reason:
        why a variant could not run on so few samples, or an empty string. Raises ValueError for an
        unknown system, if there is nothing to run, or if a variant cannot run on the longest and
        fastest trajectory of all: the cause is then not the number of samples.
        """
        check_systems([name for name in self.systems if isinstance(name, str)])
        # The largest comes first: a variant that cannot run at all fails before the work is done.
        sampling = {"rate_Hz": self.rates_Hz, "duration_s": self.durations_s}
        sampled = {name: sorted(each, reverse=True) for name, each in sampling.items() if each}
        axes = {"system": self.systems, "noise": sorted(self.noises), **sampled}
        axes |= {"number": range(self.n_realizations)} if self.n_realizations else {}
        tasks = [dict(zip(axes, place, strict=True)) for place in product(*axes.values())]
        count, largest = self.n_trajectories, {(name, each[0]) for name, each in sampled.items()}
        draw = partial(realization, n_trajectories=count, degree=self.degree, seed=seed)
        assess = partial(assessed, variants, draw, seed=seed, largest=largest)
        rows = rows_in_order(self.parallel, assess, tasks, "realization", progress)
        return pd.DataFrame(rows)


def assessed(
    variants: Ways,
    draw: Draw,
    task: Mapping[str, Any],
    *,
    seed: int,
    largest: Set[tuple[str, float]] = frozenset(),
) -> list[dict[str, object]]:
    """Rows of `Study.outcomes` of one realization. largest: rate and duration of the largest."""
    name, rows = task["system"], list[dict[str, object]]()
    place = {**task, "system": name.name if isinstance(name, System) else name}
    for label, variant in variants.items():
        # Each variant has its own random stream, so that leaving one out changes no other.
        numbers = [task["number"]] if "number" in task else []
        rng = np.random.default_rng([seed, *numbers, *label.encode()])
        found: dict[str, float] = {}
        reason = ""
        try:
            system, runs = draw(**task)
            start = time.process_time()
            if isinstance(variant, Variant):
                found = merits(variant.find(runs, system.model.library, rng=rng), system)
            else:
                found = {"error": coefficient_error(variant, system, runs, rng=rng)}
            found["cpu_s"] = time.process_time() - start
        except ValueError as error:
            if largest <= task.items():
                raise
            reason = str(error)
        rows.append({**place, "variant": label, **found, "reason": reason})
    return rows


def cells(outcomes: pd.DataFrame, by: Sequence[str] = CELL) -> pd.DataFrame:
    """Counts and means over all realizations, one row for each value of the columns `by`.

    on_front, selected: numbers of realizations. mean_correct_terms, error_mean (in %): over the
    realizations. n: number of realizations. cpu_s_per_search: the median, so that compilation
    during the first search does not count.
    """
    there = {name: how for name, how in AGGREGATES.items() if how[0] in outcomes}
    return outcomes.groupby([*by], sort=False).agg(**there).reset_index()


def published_cells() -> pd.DataFrame:
    """The thesis's tables in the format of `cells`, with `selected` as a number of realizations.

    Source: the thesis, appendix, Tables II, III and IV. BALASSO's 0.11 % on the oscillator is as
    printed; perhaps 11 is meant.
    """
    table = pd.read_csv(Path(__file__).parent / "thesis_benchmark.csv")
    percent = table.pop("selected_percent_of_those")  # absent: N/A
    table["on_front"] = table["on_front"].astype(float)
    table["selected"] = (table["on_front"] * percent / 100.0).round(1)
    return table.assign(n=100)


def add_cells(report: Report, outcomes: pd.DataFrame) -> None:
    """Add how right every variant is, by system and noise, or by sampling rate and duration."""
    is_map = {"rate_Hz", "duration_s"} <= {*outcomes}
    found = cells(outcomes, SAMPLING if is_map else CELL)
    name = "frontier" if is_map else "benchmark"
    published = published_cells()
    draw = partial(benchmark_figure, found, thesis=published)
    report.figure(name, partial(frontier_figure, found) if is_map else draw, CAPTIONS[name])
    report.samples("outcomes", outcomes)
    report.section("Every cell")
    rows = found if is_map else beside_thesis(found, published)
    report.table("cells", rows, note=NOTE, shown=not is_map, page_only=True)
    numbers = {str(n): headline_of(rows) for n, rows in found.groupby("variant", sort=False)}
    report.headline |= {f"{n}/{key}": v for n, each in numbers.items() for key, v in each.items()}
    conclude(report, pd.DataFrame(numbers).T, picture=name)
    if is_map:
        few = found[found["reason"] != ""].groupby("variant", sort=False).size()
        counts = ", ".join(f"{variant} {n}" for variant, n in few.items()) or "none"
        report.add(f"Cells with too few samples to run: {counts}; tables/cells.csv says why.")


def beside_thesis(found: pd.DataFrame, published: pd.DataFrame) -> pd.DataFrame:
    """The cells with the thesis's numbers, where it has the variants, in further columns."""
    if "on_front" not in found:
        return found
    columns = {merit: f"thesis_{merit}" for merit in MERITS}
    beside = published.rename(columns=columns)[[*CELL, *columns.values()]]
    return found.astype(dict.fromkeys(COUNTS, "Int64")).merge(beside, how="left", on=[*CELL])


def headline_of(rows: pd.DataFrame) -> dict[str, float]:
    """Numbers of one variant over all its cells; NaN for what it does not do, such as to select."""
    n, counted = rows["n"].sum(), [merit for merit in COUNTS if merit in rows]
    percent = {f"{merit}_percent": 100.0 * rows[merit].sum(min_count=1) / n for merit in counted}
    means = {key: rows[key].mean() for key in MEANS if key in rows}
    return {key: float(value) for key, value in (percent | means).items()}


def conclude(report: Report, numbers: pd.DataFrame, *, picture: str) -> None:
    """Say which variant is best. numbers: of `headline_of`, a row per variant."""
    there = [key for key in VERDICTS if key in numbers and numbers[key].notna().any()]
    words, largest = VERDICTS[there[0]]
    known = numbers[there[0]].dropna()
    best = str(known.idxmax() if largest else known.idxmin())
    lines = [
        f"{VERDICTS[key][0]}: "
        + "; ".join(f"{name} {value:.3g} %" for name, value in numbers[key].dropna().items())
        for key in there
    ]
    report.found(
        Result(
            f"{best}, {words}: {known[best]:.3g} %",
            [Text(line) for line in lines],
            load='pandas.read_csv("{}/tables/cells.csv")',
            picture=picture,
        )
    )
