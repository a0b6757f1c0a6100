"""The thesis's synthetic benchmark: how often each variant of the method finds known equations.

The experiment is `+exp=benchmark`. Source: the thesis, appendix, II-E and III-C. The experiment
`+exp=frontier` uses the same variants and figures of merit. With `systems=dysts` it runs on a
collection of chaotic systems, which are counted together.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any, Protocol, runtime_checkable

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import Finding
from ep2sindy.discovery.result import DiscoveryMethod
from ep2sindy.figures.identified import (
    COUNTS,
    MERITS,
    Identified,
    attractor_figure,
    benchmark_figure,
    merit_table,
)
from ep2sindy.library.library import Library
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import (
    Block,
    Captioned,
    Picture,
    Result,
    Section,
    Table,
    Text,
    pictures,
    places,
)
from ep2sindy.report.results import json_rows
from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Workers, rows_in_order
from ep2sindy.runtime.progress import SILENT, Progress, count_pieces
from ep2sindy.studies.resume import resumed
from ep2sindy.studies.study import Count, CountOrNone, Deferred, Levels, Names, NamesOrOne
from ep2sindy.systems.draws import COLLECTION, DRAWS, realization, system_names
from ep2sindy.systems.systems import System

FIGURE = (
    "Realizations in which all true equations are among the candidates (left), and are the ones "
    "selected (right), in %. A dash: the variant selects nothing, or N/A in the thesis."
)
EXAMPLE_FIGURES = {"attractors": False, "trajectories": True}  # name -> drawn over time
EXAMPLES = (
    "The first realization of every system and noise level: samples, truth, and the model that "
    "{variant} selects, integrated from where the truth starts. True terms need not follow a "
    "chaotic trajectory for long."
)
INTRODUCTION = (
    "Each realization draws an initial state, or for the Van der Pol oscillator its parameter, at "
    "random; white noise of the given share of each state's RMS is added; the library holds all "
    "products of the states up to a degree. A realization counts only if the equations of all "
    "states are right at once. Every variant sees the same realizations. Italic rows: the "
    "thesis's own numbers, for 100 realizations. CPU: time of one search (all equations of one "
    "realization), on one thread."
)
COLLECTED = (
    "The systems of dysts are chaotic, with polynomial equations; a record of ten periods, of 100 "
    "samples each, starts anywhere on the attractor, and the library holds all products of the "
    "states up to the degree of the equations. They are counted together."
)
MAX_EXAMPLES = 4  # systems of the collection whose first realizations are drawn
TITLES = {
    "on_front": "True equations on the front, % of realizations",
    "selected": "True equations selected, % of realizations",
    "mean_correct_terms": "True terms among the selected, mean (all of them in brackets)",
}


@runtime_checkable
class Variant(Protocol):
    """A complete method: it maps trajectories and a library to supports. `Regression` is one."""

    def find(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Finding: ...


def build_variants(names: Sequence[str], definitions: Mapping[str, Deferred]) -> dict[str, Variant]:
    """Build the named methods from `definitions`; the others are not built.

    Raises ValueError for an unknown name, or for an object without a `find` method.
    """
    unknown = [name for name in names if name not in definitions]
    if unknown:
        raise ValueError(f"unknown variants {unknown}; there are {list(definitions)}")
    variants = {}
    for name in names:
        variant = definitions[name].build()
        if not isinstance(variant, Variant):
            raise ValueError(
                f"definitions.{name} must name a _target_ that has `find`: {variant} came"
            )
        variants[name] = variant
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


@dataclass(frozen=True)
class Study:
    """Run every variant on the same realizations of all systems and noises; count successes.

    systems: names of systems, or `dysts` for all of that collection, which needs the package.
    noises: standard deviations of the white noise, in RMS of each state. n_trajectories: number of
    trajectories in each realization. degree: of the library; None takes each system's own.
    variants: names among the definitions. thesis: the thesis's tables, shown beside ours. keep:
    whether a run goes on with the finished realizations of one that was broken off.
    """

    systems: NamesOrOne
    noises: Levels
    n_realizations: Count
    n_trajectories: Count
    degree: CountOrNone
    variants: Names
    definitions: Mapping[str, Deferred]
    thesis: Mapping[str, Any]
    parallel: Workers
    keep: bool = True

    def compute(self, run: Run) -> Outcome:
        published = published_cells(self.thesis)
        variants = build_variants(self.variants, self.definitions)
        names = self._names
        n_pieces = len(names) * len(self.noises) * self.n_realizations
        with resumed(self.keep, run, self.parallel) as workers:
            with run.progress(n_pieces, "realization") as progress:
                outcomes = replace(self, parallel=workers).outcomes(
                    variants, seed=run.seed, progress=progress
                )
            first = first_realizations(
                variants,
                [name for name in names if name in DRAWS] or names[:MAX_EXAMPLES],
                self.noises,
                n_trajectories=self.n_trajectories,
                degree=self.degree,
                seed=run.seed,
                progress=run.watch,
            )
        return Outcome(variants, outcomes, cells(outcomes), published, first)

    def outcomes(
        self,
        variants: Mapping[str, Variant],
        *,
        seed: int = 0,
        progress: Callable[[int], None] = lambda n_more: None,
    ) -> pd.DataFrame:
        """Figures of merit of every variant on every realization; workers share the realizations.

        One row per system, noise, number and variant. group: the name under which a system is
        counted: its own, or that of the collection. on_front and selected: 1 if the equations of
        all states are right, else 0. correct_terms: number of true terms among the selected ones.
        cpu_s: time of the search. selected and correct_terms are NaN for a variant that selects
        nothing. Raises ValueError for an unknown system, or if there is nothing to run.
        """
        tasks = list(product(self._names, sorted(self.noises), range(self.n_realizations)))
        judge = partial(
            _outcomes,
            variants,
            n_trajectories=self.n_trajectories,
            degree=self.degree,
            seed=seed,
        )
        return pd.DataFrame(rows_in_order(self.parallel, judge, tasks, progress))

    @property
    def _names(self) -> tuple[str, ...]:
        return system_names([self.systems] if isinstance(self.systems, str) else self.systems)


def _outcomes(
    variants: Mapping[str, Variant],
    task: tuple[str, float, int],
    *,
    n_trajectories: int,
    degree: int | None,
    seed: int,
) -> list[dict[str, object]]:
    name, noise, number = task
    system, runs = realization(
        name, noise, number, n_trajectories=n_trajectories, degree=degree, seed=seed
    )
    rows: list[dict[str, object]] = []
    for label, variant in variants.items():
        # Each variant has its own random stream, so that leaving one out changes no other.
        rng = np.random.default_rng([seed, number, *label.encode()])
        start = time.process_time()
        finding = variant.find(runs, system.model.library, rng=rng)
        cpu_s = time.process_time() - start
        rows.append(
            {"group": name if name in DRAWS else COLLECTION, "system": name}
            | {"noise": noise, "number": number, "variant": label}
            | merits(finding, system)
            | {"cpu_s": cpu_s}
        )
    return rows


def cells(outcomes: pd.DataFrame) -> pd.DataFrame:
    """Counts over all realizations, one row per system or collection, noise and variant.

    on_front, selected: numbers of realizations. mean_correct_terms: mean over the realizations.
    n: number of realizations. cpu_s_per_search: the median, so that compilation during the first
    search does not count.
    """
    grouped = outcomes.groupby(["group", "noise", "variant"], sort=False)
    counts = grouped.agg(
        on_front=("on_front", "sum"),
        selected=("selected", lambda s: s.sum(min_count=1)),
        mean_correct_terms=("correct_terms", "mean"),
        n=("number", "count"),
        cpu_s_per_search=("cpu_s", "median"),
    ).reset_index()
    return counts.rename(columns={"group": "system"})


@dataclass(frozen=True, eq=False)
class FirstRealizations:
    """First realizations of every system and noise level, with the models a variant found."""

    variant: str
    found: Sequence[Identified]


def first_realizations(
    variants: Mapping[str, Variant],
    systems: Sequence[str],
    noises: Sequence[float],
    *,
    n_trajectories: int,
    degree: int | None = None,
    seed: int,
    progress: Progress = SILENT,
) -> FirstRealizations | None:
    """Models found in the first realizations by the last variant that makes models.

    The search is the same as in the benchmark. Other variants give supports only; the result is
    None if no variant makes models.
    """
    methods = [(name, each) for name, each in variants.items() if isinstance(each, DiscoveryMethod)]
    if not methods:
        return None
    name, method = methods[-1]
    found = []
    pairs = list(product(systems, sorted(noises)))
    for label, noise in count_pieces(progress, pairs, "model", "first realizations"):
        (system, runs), (_, (truth, *_)) = (
            realization(label, level, 0, n_trajectories=n_trajectories, degree=degree, seed=seed)
            for level in (noise, 0.0)
        )
        rng = np.random.default_rng([seed, 0, *name.encode()])
        model = discover(runs, system.model.library, method, seed=rng, progress=progress).model
        right = np.array_equal(model.coef != 0.0, system.model.coef != 0.0)
        found.append(Identified(label, noise, runs[0], truth, model.rollout(truth), right))
    return FirstRealizations(name, found)


def published_cells(thesis: Mapping[str, Any]) -> pd.DataFrame:
    """The thesis's tables in the format of `cells`, with `selected` as a number of realizations."""
    columns = ["on_front", "selected_percent_of_those", "mean_correct_terms"]
    rows = [
        (variant, system, *values)
        for variant, systems in thesis["on_front"].items()
        for system in systems
        for values in zip(
            thesis["noises"], *(thesis[column][variant][system] for column in columns), strict=True
        )
    ]
    table = pd.DataFrame(rows, columns=["variant", "system", "noise", *columns])
    table = table.astype(dict.fromkeys(["noise", *columns], float))
    percent = table.pop("selected_percent_of_those")
    table["selected"] = (table["on_front"] * percent / 100.0).round(1)
    return table.assign(n=thesis["n"])


@dataclass(frozen=True, eq=False)
class Outcome:
    """All outcomes of the benchmark, and counts of them.

    published: the thesis's cells, in the format of `cells` without the time. first: the first
    realizations, which are drawn; None if no variant makes models.
    """

    variants: Mapping[str, Variant]
    outcomes: pd.DataFrame
    cells: pd.DataFrame
    published: pd.DataFrame
    first: FirstRealizations | None

    def models(self) -> dict[str, SparseModel]:
        return {}

    def tables(self) -> dict[str, pd.DataFrame]:
        """All outcomes, and our cells beside the thesis's values for the same cells."""
        columns = {merit: f"thesis_{merit}" for merit in MERITS}
        keys = ["system", "noise", "variant"]
        beside = self.published.rename(columns=columns)[[*keys, *columns.values()]]
        return {"outcomes": self.outcomes, "cells": self.cells.merge(beside, how="left", on=keys)}

    def figures(self) -> dict[str, Captioned]:
        draw = partial(benchmark_figure, self.cells, thesis=self.published)
        found = {"benchmark": Captioned(draw, FIGURE)}
        if self.first:
            caption = EXAMPLES.format(variant=self.first.variant)
            for name, over_time in EXAMPLE_FIGURES.items():
                draw = partial(attractor_figure, self.first.found, over_time=over_time)
                found[name] = Captioned(draw, caption)
        return found

    def in_short(self) -> Result:
        """The variant that selects, or has on its front, the right equations most often."""
        cells = self.cells
        merit = "selected" if cells["selected"].notna().any() else "on_front"
        counts = cells.dropna(subset=[merit]).groupby("variant", sort=False)[[merit, "n"]].sum()
        share = counts[merit] / counts["n"]
        words = {"selected": "selected exactly right", "on_front": "right on the front"}[merit]
        lines = "; ".join(f"{name} {100 * value:.0f} %" for name, value in share.items())
        best = str(share.idxmax())
        return Result(
            f"Found: {best}, {words} in {100 * share[best]:.0f} % of {int(counts['n'][best])} "
            "realizations",
            [Text(f"{words}: {lines}")],
            load='pandas.read_csv("{}/tables/cells.csv")',
            picture="benchmark",
        )

    def sections(self) -> list[Section]:
        collected = (self.outcomes["group"] == COLLECTION).any()
        n = int(self.outcomes["number"].nunique())
        levels = "/".join(f"{100 * noise:g}" for noise in self.cells["noise"].unique())
        counted = f"{n} realizations of every system and noise level."
        about: list[Block] = [Text(counted), Text(INTRODUCTION, page_only=True)]
        if collected:
            about.append(Text(COLLECTED, page_only=True))
        drawn = []
        if self.first:
            drawn = [
                Section(f"Identified by {self.first.variant}", pictures(list(EXAMPLE_FIGURES)))
            ]
        tables = [
            Section(f"{TITLES[m]}; noise {levels} %", [_readable(self.cells, self.published, m)])
            for m in MERITS
        ]
        if collected:
            tables.append(Section("Systems that are not selected", [_not_selected(self.outcomes)]))
        variants = [Text(f"{n}: {v}", page_only=True) for n, v in self.variants.items()]
        return [
            Section("Realizations", [*about, Picture("benchmark")]),
            *drawn,
            *tables,
            Section("Variants", variants),
        ]

    def summary(self) -> dict[str, Any]:
        """The counts as whole numbers; `selected` is null for a variant that selects nothing."""
        return {"cells": json_rows(self.cells.astype(dict.fromkeys(COUNTS, "Int64")))}

    def headline(self) -> dict[str, float]:
        """Means over systems and noises; a variant that selects nothing has 0 %, and NaN terms."""
        scalars = {}
        for name, rows in self.cells.groupby("variant", sort=False):
            for merit in COUNTS:
                percent = 100.0 * rows[merit].sum() / rows["n"].sum()
                scalars[f"{name}/{merit}_percent"] = float(percent)
            scalars[f"{name}/mean_correct_terms"] = float(rows["mean_correct_terms"].mean())
            scalars[f"{name}/cpu_ms"] = float(1e3 * rows["cpu_s_per_search"].mean())
        return scalars


def _readable(cells: pd.DataFrame, published: pd.DataFrame, merit: str) -> Table:
    """One row per variant or published one, one column per system; noise levels share a cell."""
    table = merit_table(cells, published, merit)
    digits = 2 if merit == "mean_correct_terms" else 0
    cpu_ms = 1e3 * cells.groupby("variant")["cpu_s_per_search"].mean()
    rows: list[dict[str, str]] = []
    italic: list[int] = []
    for name, is_published in table.index:
        values = table.loc[(name, is_published)]
        if is_published:
            italic.append(len(rows))
        elif values.isna().all():
            continue  # this variant leaves the selection to the user
        row = {"variant": f"{name}, thesis" if is_published else name}
        for system in cells["system"].unique():
            row[_heading(system, merit)] = "/".join(places(v, digits) for v in values[system])
        rows.append(row | {"CPU (ms)": "" if is_published else f"{cpu_ms[name]:.1f}"})
    return Table(pd.DataFrame(rows), italic=italic)


def _not_selected(outcomes: pd.DataFrame) -> Table:
    """Systems of the collection that the variant with most successes does not select, by noise."""
    collected = outcomes[outcomes["group"] == COLLECTION]
    best = str(collected.groupby("variant", sort=False)["selected"].sum().idxmax())
    missed = collected[(collected["variant"] == best) & (collected["selected"] != 1.0)]
    rows = []
    for noise in collected["noise"].unique():
        counts = Counter(missed[missed["noise"] == noise]["system"])
        words = [f"{name} ({n} times)" if n > 1 else name for name, n in counts.items()]
        rows.append({"noise": f"{100 * noise:g} %", f"not by {best}": ", ".join(words)})
    return Table(pd.DataFrame(rows))


def _heading(system: str, merit: str) -> str:
    if merit != "mean_correct_terms" or system not in DRAWS:
        return system
    model = DRAWS[system](np.random.default_rng(0)).system.model
    return f"{system} ({np.count_nonzero(model.coef)})"
