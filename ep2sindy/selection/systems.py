"""Candidates as systems of equations, the records that they are judged by, and folds of these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, Relation, binding, constraint
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.refine import refine, with_coef
from ep2sindy.refinement.windows import MIN_SAMPLES, WindowBatch, cut_windows
from ep2sindy.regression.front import ParetoFront
from ep2sindy.selection.rule import support_of
from ep2sindy.signals.kalman import KalmanSmoother

# Steps of all windows of all systems that are refined together: more leave the cache.
BATCH_STEPS = 6000


@dataclass(frozen=True, eq=False)
class TrialSystem:
    """One candidate per equation as a model whose coefficients obey the constraint."""

    model: SparseModel
    constraint: Constraint

    @property
    def n_terms(self) -> int:
        return int(np.count_nonzero(self.model.coef))

    def refined_on_all(
        self,
        runs: Sequence[Trajectory],
        *,
        window: int | None = None,
        n_windows: int = 30,
        n_reweights: int = 1,
        seed: int = 0,
    ) -> SparseModel:
        """Refined on windows spread over all the data, with the covariance of its coefficients.

        window: None takes one and a half periods. n_windows, n_reweights, and seed for its rng,
        as for `refine`. A system without terms, or one whose refinement does not stay finite,
        comes back as it is, without covariance.
        """
        if not len(self.constraint.free):
            return self.model
        found = refine(
            self.model,
            runs,
            n_windows=n_windows,
            window=window,
            constraint=self.constraint,
            n_reweights=n_reweights,
            rng=seed,
        )
        return found.model


def systems_of(
    fronts: Sequence[ParetoFront],
    places: Int[np.ndarray, "combinations fronts"],
    library: Library,
    runs: Sequence[Trajectory],
    relations: Sequence[Relation] = (),
) -> list[TrialSystem]:
    """Every combination as a system, in the units of the runs."""
    units = runs[0].units if runs else {}
    return [_system(fronts, choice, library, units, relations) for choice in places]


def _system(
    fronts: Sequence[ParetoFront],
    choice: Int[np.ndarray, " fronts"],
    library: Library,
    units: Mapping[str, str],
    relations: Sequence[Relation],
) -> TrialSystem:
    """A combination: free coefficients from the candidates, the others as the relations say."""
    states = [front.equation for front in fronts]
    chosen = [front.candidates[k] for front, k in zip(fronts, choice, strict=True)]
    coef = coef_matrix(library, [candidate.coef_by_term for candidate in chosen])
    model = SparseModel(library, states, coef, units)
    support = support_of(fronts, choice)
    held = constraint(library, support, binding(relations, support) or ())
    places = [(model.library.index(term), states.index(state)) for state, term in held.coefficients]
    free = np.array([coef[places[k]] for k in held.free])
    return TrialSystem(with_coef(model, held, held.coef(free))[0], held)


def budget(batch: WindowBatch) -> tuple[MultipleShooting, int]:
    """How long to refine systems that are to be judged, and how many together.

    The regression's coefficients are close: whole windows at once, and few iterations. Those
    that need more are the wrong ones.
    """
    method = MultipleShooting(first_block=batch.data.shape[1], tolerance=1e-3, max_iter=10)
    return method, max(1, BATCH_STEPS // batch.steps.size)


@dataclass(frozen=True, eq=False)
class Records:
    """The trajectories that equations are judged by, and their states smoothed."""

    runs: Sequence[Trajectory]
    smoothed: Sequence[Float[np.ndarray, "_ n_states"]]


def records_of(fronts: Sequence[ParetoFront], runs: Sequence[Trajectory]) -> Records:
    """The runs that systems are judged by, states in the order of the fronts.

    Raises ValueError for no runs, or a state without a front.
    """
    if not runs:
        raise ValueError("to integrate, trajectories are needed: none came; pass them as runs")
    equations = [front.equation for front in fronts]
    if sorted(equations) != sorted(runs[0].state_names):
        raise ValueError(
            f"to integrate, every state needs one front: {equations} came for the states "
            f"{list(runs[0].state_names)}"
        )
    return Records(runs, [KalmanSmoother().smooth(run.t, run.columns(equations)) for run in runs])


@dataclass(frozen=True)
class Stretch:
    """Samples start to stop (exclusive) of one of the runs."""

    run: int
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class Fold:
    """What is held out of the runs, and the pieces of them that are left."""

    held: Sequence[Stretch]
    fitted: Sequence[Stretch]

    def windows(
        self,
        runs: Sequence[Trajectory],
        states: Sequence[str],
        inputs: Sequence[str],
        *,
        window: int,
        n_windows: int,
        rng: np.random.Generator,
    ) -> WindowBatch:
        """Windows of the pieces that are left, no longer than the longest piece."""
        pieces = [runs[part.run].window(part.start, part.stop) for part in self.fitted]
        longest = max(piece.n_samples for piece in pieces)
        return cut_windows(
            pieces,
            states=states,
            inputs=inputs,
            n_windows=n_windows,
            window=min(window, longest),
            rng=rng,
        )


def folds_of(runs: Sequence[Trajectory], n_folds: int) -> list[Fold]:
    """Every run in turn where there are enough, else every run cut in blocks.

    Raises ValueError for runs too short to be cut.
    """
    lengths = [run.n_samples for run in runs]
    if len(runs) >= n_folds:
        whole = [Stretch(k, 0, length) for k, length in enumerate(lengths)]
        return [
            Fold(whole[k::n_folds], [part for part in whole if part.run % n_folds != k])
            for k in range(n_folds)
        ]
    if max(lengths) < 2 * MIN_SAMPLES * n_folds:
        raise ValueError(
            f"runs must hold {2 * MIN_SAMPLES * n_folds} samples to be parted in {n_folds}: at "
            f"most {max(lengths)} came; use longer records"
        )
    found = []
    for k in range(n_folds):
        held, fitted = [], []
        for run, length in enumerate(lengths):
            first, last = k * length // n_folds, (k + 1) * length // n_folds
            held.append(Stretch(run, first, last))
            fitted += [Stretch(run, 0, first), Stretch(run, last, length)]
        found.append(Fold(held, [part for part in fitted if part.stop - part.start >= MIN_SAMPLES]))
    return found
