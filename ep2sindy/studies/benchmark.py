"""The thesis's synthetic benchmark: how often each variant of the method finds known equations.

Source: the thesis, appendix, II-E and III-C.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol, runtime_checkable

import numpy as np
import pandas as pd

from ep2sindy.bootstraps import Bootstraps, pooled_supports
from ep2sindy.library import Library
from ep2sindy.parallel import ONE_BY_ONE, Workers
from ep2sindy.pareto import pareto_front
from ep2sindy.regression import Formulation
from ep2sindy.search import Search
from ep2sindy.selection import Selection, selected
from ep2sindy.systems import System, damped_oscillator, lorenz, lotka_volterra, van_der_pol
from ep2sindy.trajectory import Trajectory


@dataclass(frozen=True)
class Finding:
    """What a variant makes of one realization.

    kept: state -> the supports on its front. selected: state -> the support of its equation, or
    None where the variant offers candidates and leaves the choice to the user.
    """

    kept: Mapping[str, Sequence[frozenset[str]]]
    selected: Mapping[str, frozenset[str]] | None


@runtime_checkable
class Variant(Protocol):
    """A complete method: trajectories and a library in, supports out."""

    def find(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Finding: ...


@dataclass(frozen=True)
class SearchVariant:
    """This package's path from rows to a selected support, without the last fit."""

    formulation: Formulation
    search: Search
    bootstraps: Bootstraps
    selection: Selection
    depth: int = 1

    def find(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Finding:
        fronts = [
            pareto_front(problem, found, depth=self.depth)
            for problem in self.formulation.assemble(runs, library, rng=rng)
            for found in pooled_supports(problem, self.search, self.bootstraps, rng=rng)
        ]
        scores = self.selection.scores(fronts)
        return Finding(
            kept={f.equation: [frozenset(c.terms) for c in f.candidates] for f in fronts},
            selected={
                f.equation: frozenset(selected(f, score).terms)
                for f, score in zip(fronts, scores, strict=True)
            },
        )


@dataclass(frozen=True)
class Draw:
    """A system with a parameter or a starting point drawn at random."""

    system: System
    initial: np.ndarray


def _oscillator(rng: np.random.Generator) -> Draw:
    return Draw(damped_oscillator(), rng.uniform(-2.0, 2.0, 2))


def _lotka_volterra(rng: np.random.Generator) -> Draw:
    return Draw(lotka_volterra(), rng.uniform(0.1, 1.5, 2))


def _van_der_pol(rng: np.random.Generator) -> Draw:
    return Draw(van_der_pol(mu=rng.uniform(0.1, 10.0)), np.ones(2))


def _lorenz(rng: np.random.Generator) -> Draw:
    return Draw(lorenz(), rng.uniform([-15.0, -15.0, 10.0], [15.0, 15.0, 40.0]))


# The thesis draws the Van der Pol oscillator's mu and starts it at (1, 1); it does not say where
# it starts the others: these ranges are ours.
DRAWS: Mapping[str, Callable[[np.random.Generator], Draw]] = {
    "oscillator": _oscillator,
    "lotka_volterra": _lotka_volterra,
    "van_der_pol": _van_der_pol,
    "lorenz": _lorenz,
}


def realization(
    name: str, noise: float, number: int, *, n_trajectories: int = 1, seed: int = 0
) -> tuple[System, list[Trajectory]]:
    """One draw of a system and noisy trajectories of it; every noise level sees the same draw.

    noise: standard deviation of the white noise, in RMS of each state. n_trajectories: beyond
    the first they start where other draws would; the Van der Pol oscillator in [-2, 2]^2.
    """
    _check_names([name])
    rng = np.random.default_rng([seed, list(DRAWS).index(name), number])
    draw = DRAWS[name](rng)
    starts = [draw.initial]
    for _ in range(n_trajectories - 1):
        other = rng.uniform(-2.0, 2.0, 2) if name == "van_der_pol" else DRAWS[name](rng).initial
        starts.append(other)
    return draw.system, [
        draw.system.trajectory(initial=start, noise=noise, rng=stream)
        for start, stream in zip(starts, rng.spawn(n_trajectories), strict=True)
    ]


def run_benchmark(
    variants: Mapping[str, Variant],
    *,
    systems: Sequence[str],
    noises: Sequence[float],
    n_realizations: int,
    n_trajectories: int = 1,
    workers: Workers = ONE_BY_ONE,
    seed: int = 0,
    progress: Callable[[int], None] = lambda n_done: None,
) -> pd.DataFrame:
    """Every variant on every realization, realizations being the workers' pieces.

    One row per system, noise, number and variant: on_front and selected (is the whole system
    right), correct_terms (true terms among those selected), cpu_s. A variant that selects nothing
    has NaN there. Raises ValueError for an unknown system, or nothing to run.
    """
    _check_names(systems)
    if n_realizations < 1 or not (variants and systems and len(noises)):
        raise ValueError(
            "a benchmark needs a realization, a system, a noise level and a variant at least: "
            f"n_realizations={n_realizations}, systems={list(systems)}, noises={list(noises)}, "
            f"variants={list(variants)}"
        )
    tasks = [(s, noise, k) for s in systems for noise in noises for k in range(n_realizations)]
    judge = partial(_outcomes, variants, n_trajectories=n_trajectories, seed=seed)
    rows = []
    for n_done, (_, found) in enumerate(workers.run(judge, tasks), start=1):
        rows += found
        progress(n_done)
    order = ["system", "noise", "number", "variant"]
    table = pd.DataFrame(rows)
    for column, names in (("system", systems), ("variant", variants)):
        table[column] = pd.Categorical(table[column], categories=list(names), ordered=True)
    return table.sort_values(order, ignore_index=True).astype({"system": str, "variant": str})


def _outcomes(
    variants: Mapping[str, Variant],
    task: tuple[str, float, int],
    *,
    n_trajectories: int,
    seed: int,
) -> list[dict[str, object]]:
    name, noise, number = task
    system, runs = realization(name, noise, number, n_trajectories=n_trajectories, seed=seed)
    truth = {state: frozenset(system.model.terms(state)) for state in system.model.states}
    rows: list[dict[str, object]] = []
    for label, variant in variants.items():
        # A stream of its own, so that leaving a variant out changes no other.
        rng = np.random.default_rng([seed, number, *label.encode()])
        start = time.process_time()
        finding = variant.find(runs, system.model.library, rng=rng)
        cpu_s = time.process_time() - start
        rows.append(
            {"system": name, "noise": noise, "number": number, "variant": label}
            | judged(finding, truth)
            | {"cpu_s": cpu_s}
        )
    return rows


def judged(finding: Finding, truth: Mapping[str, frozenset[str]]) -> dict[str, float]:
    """The three figures of merit for one realization, as numbers; NaN where none was selected."""
    found = {"on_front": float(all(truth[state] in finding.kept[state] for state in truth))}
    if finding.selected is None:
        return found | {"selected": np.nan, "correct_terms": np.nan}
    chosen = finding.selected
    return found | {
        "selected": float(all(chosen[state] == truth[state] for state in truth)),
        "correct_terms": float(sum(len(chosen[state] & truth[state]) for state in truth)),
    }


def cells(outcomes: pd.DataFrame) -> pd.DataFrame:
    """Counts over all realizations, one row per system, noise and variant.

    on_front, selected: number of realizations; mean_correct_terms; n; cpu_s_per_search: median,
    so that compiling during the first search does not count.
    """
    grouped = outcomes.groupby(["system", "noise", "variant"], sort=False)
    return grouped.agg(
        on_front=("on_front", "sum"),
        selected=("selected", lambda s: s.sum(min_count=1)),
        mean_correct_terms=("correct_terms", "mean"),
        n=("number", "count"),
        cpu_s_per_search=("cpu_s", "median"),
    ).reset_index()


COUNTS = ("on_front", "selected")
MERITS = (*COUNTS, "mean_correct_terms")


def merit_table(cells: pd.DataFrame, published: pd.DataFrame, merit: str) -> pd.DataFrame:
    """One figure of merit of every variant, with its published row below it where there is one.

    published: as `cells`, without the time. Index (variant, is it published), columns (system,
    noise), in the order of `cells`; counts become percentages of n.
    """
    place, shown = ["system", "noise"], ["variant", "system", "noise", merit, "n"]
    known = published.merge(cells[[*place, "variant"]])
    both = pd.concat(
        [cells[shown].assign(published=False), known[shown].assign(published=True)]
        if len(known)
        else [cells[shown].assign(published=False)]
    )
    if merit in COUNTS:
        both[merit] *= 100.0 / both["n"]
    table = both.set_index(["variant", "published", *place])[merit].unstack(place)
    rows = [(name, old) for name in cells["variant"].unique() for old in (False, True)]
    return table.reindex(
        index=pd.MultiIndex.from_tuples([row for row in rows if row in table.index]),
        columns=pd.MultiIndex.from_frame(cells[place].drop_duplicates()),
    )


def _check_names(systems: Sequence[str]) -> None:
    unknown = [name for name in systems if name not in DRAWS]
    if unknown:
        raise ValueError(f"unknown systems {unknown}; there are {list(DRAWS)}")
