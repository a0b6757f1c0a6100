"""The thesis's synthetic benchmark: how often each variant of the method finds known equations.

`+exp=benchmark`. Source: the thesis, appendix, II-E and III-C.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.machine.parallel import Workers, rows_in_order
from ep2sindy.report.run import Run
from ep2sindy.studies.benchmark_view import Outcome, published_cells
from ep2sindy.studies.identified import first_realizations
from ep2sindy.studies.kinds import Count, Deferred, Levels, Names
from ep2sindy.studies.variants import Variant, built_variants, merits
from ep2sindy.systems.draws import check_systems, realization


@dataclass(frozen=True)
class Study:
    """Draw, search, count: every variant on the same realizations of every system and noise.

    noises: standard deviations of the white noise, in RMS of each state. n_trajectories: of each
    realization. variants: names among the definitions. thesis: its tables, to stand beside ours.
    """

    systems: Names
    noises: Levels
    n_realizations: Count
    n_trajectories: Count
    variants: Names
    definitions: Mapping[str, Deferred]
    thesis: Mapping[str, Any]
    parallel: Workers

    def compute(self, run: Run) -> Outcome:
        published = published_cells(self.thesis)
        variants = built_variants(self.variants, self.definitions)
        n_pieces = len(self.systems) * len(self.noises) * self.n_realizations
        with run.progress(n_pieces, "realization") as progress:
            outcomes = self.outcomes(variants, seed=run.seed, progress=progress)
        first = first_realizations(
            variants,
            self.systems,
            self.noises,
            n_trajectories=self.n_trajectories,
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
        """Every variant on every realization, realizations being the workers' pieces.

        One row per system, noise, number and variant: on_front and selected (is the whole system
        right), correct_terms (true terms among those selected), cpu_s. A variant that selects
        nothing has NaN there. Raises ValueError for an unknown system, or nothing to run.
        """
        check_systems(self.systems)
        tasks = list(product(self.systems, sorted(self.noises), range(self.n_realizations)))
        judge = partial(_outcomes, variants, n_trajectories=self.n_trajectories, seed=seed)
        return pd.DataFrame(rows_in_order(self.parallel, judge, tasks, progress))


def _outcomes(
    variants: Mapping[str, Variant],
    task: tuple[str, float, int],
    *,
    n_trajectories: int,
    seed: int,
) -> list[dict[str, object]]:
    name, noise, number = task
    system, runs = realization(name, noise, number, n_trajectories=n_trajectories, seed=seed)
    rows: list[dict[str, object]] = []
    for label, variant in variants.items():
        # A stream of its own, so that leaving a variant out changes no other.
        rng = np.random.default_rng([seed, number, *label.encode()])
        start = time.process_time()
        finding = variant.find(runs, system.model.library, rng=rng)
        cpu_s = time.process_time() - start
        rows.append(
            {"system": name, "noise": noise, "number": number, "variant": label}
            | merits(finding, system)
            | {"cpu_s": cpu_s}
        )
    return rows


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
