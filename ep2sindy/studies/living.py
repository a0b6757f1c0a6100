"""A closed model that lives: found by free runs in a part of a record, judged on the rest."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import Discovery, discover
from ep2sindy.discovery.recipe import Recipe
from ep2sindy.library.library import Library
from ep2sindy.machine.progress import SILENT, Progress
from ep2sindy.model.free_run import FreeRun, free_run
from ep2sindy.model.likeness import Bounds, Verdict
from ep2sindy.model.model import SparseModel
from ep2sindy.model.stability import LimitCycle, limit_cycle, share_reaching
from ep2sindy.search.searches import Search
from ep2sindy.selection.rule import SystemSelection
from ep2sindy.signals.attractor import find_cycle
from ep2sindy.signals.kalman import KalmanSmoother
from ep2sindy.signals.spectrum import samples_in
from ep2sindy.studies.kinds import Count


@dataclass(frozen=True)
class LivingSearch:
    """How a library without inputs is searched for a model that lives.

    depth: candidates per size and equation.
    """

    search: Search
    depth: Count
    selection: SystemSelection

    def found(
        self,
        train: Trajectory,
        library: Library,
        recipe: Recipe,
        *,
        rng: np.random.Generator,
        progress: Progress = SILENT,
    ) -> Discovery:
        """What it finds in a record, with the recipe's formulation and bootstraps."""
        own = replace(recipe, search=self.search, depth=self.depth, selection=self.selection)
        return discover(train, library, own, seed=rng, progress=progress)

    @property
    def bounds(self) -> Bounds:
        """What its rule calls living."""
        return getattr(self.selection, "bounds", Bounds())


@dataclass(frozen=True, eq=False)
class Refined:
    """A model selected by its derivatives, refined as it is: how that ended, and how it runs."""

    status: str
    run: FreeRun


@dataclass(frozen=True, eq=False)
class Living:
    """A closed model and what it does over held-out time, from the first sample there.

    run: from that sample as a Kalman smoother has it: noise in it is not the model's. cycle: that
    it oscillates on, and the share of starts around that reach it; None where none was found.
    by_derivatives: the equations selected by their derivatives, refined as they are.
    """

    discovery: Discovery
    held: Trajectory
    run: FreeRun
    cycle: LimitCycle | None
    share: float | None
    by_derivatives: Refined

    @property
    def model(self) -> SparseModel:
        return self.discovery.model


def living_model(
    train: Trajectory,
    held: Trajectory,
    library: Library,
    recipe: Recipe,
    settings: LivingSearch,
    selected: SparseModel,
    *,
    rng: np.random.Generator,
    progress: Progress = SILENT,
) -> Living:
    """Find it in one part of a record, and run it over the other.

    selected: the model that was selected by derivatives, to be refined for comparison.
    """
    found = settings.found(train, library, recipe, rng=rng, progress=progress)
    with progress.stage(None, "", "free run and limit cycle"):
        start = start_of(held, found.model)
        run = free_run(found.model, held, initial=start, bounds=settings.bounds)
        cycle = cycle_of(run)
        share = None if cycle is None else share_reaching(found.model, cycle)
    return Living(found, held, run, cycle, share, _refined(selected, train, held, progress))


def start_of(run: Trajectory, model: SparseModel) -> np.ndarray:
    """The first sample, smoothed."""
    first = run.window(0, min(run.n_samples, 200))
    smoothed: np.ndarray = KalmanSmoother().smooth(first.t, first.columns(model.states))
    return smoothed[0]


def cycle_of(run: FreeRun) -> LimitCycle | None:
    """The closed orbit that a free run ends on."""
    if run.model.inputs or run.rollout.diverged or run.verdict is Verdict.DIES_OUT:
        return None
    frequency_Hz = np.nanmax(list(run.frequency_Hz.values()), initial=0.0)
    if not frequency_Hz > 0.0:
        return None
    return limit_cycle(run.model, run.rollout.states[-1], period_s=1.0 / frequency_Hz)


def two_periods(run: Trajectory) -> int | None:
    """Samples in two periods; None where there is no period, or not two windows of them."""
    cycle = find_cycle(run.t, run.states)
    if cycle is None or cycle.n_periods < 4.0:
        return None
    return samples_in(2.0, frequency_Hz=cycle.frequency_Hz, dt_s=run.dt_s)


def _refined(
    model: SparseModel, train: Trajectory, held: Trajectory, progress: Progress
) -> Refined:
    """On windows of two periods, where there are periods."""
    from ep2sindy.refinement.refine import refine  # torch, for those alone who refine

    found = refine(model, [train], window=two_periods(train), rng=0, progress=progress)
    return Refined(found.status, free_run(found.model, held, initial=start_of(held, model)))
