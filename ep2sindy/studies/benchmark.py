"""The thesis's synthetic benchmark: how often each variant of the method finds known equations.

Source: the thesis, appendix, II-E and III-C.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Protocol, runtime_checkable

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.recipe import Finding
from ep2sindy.library.library import Library
from ep2sindy.machine.parallel import ONE_BY_ONE, Workers
from ep2sindy.synthetic.draws import check_systems, realization


@runtime_checkable
class Variant(Protocol):
    """A complete method: trajectories and a library in, supports out; a `Recipe` is one."""

    def find(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Finding: ...


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
    check_systems(systems)
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
