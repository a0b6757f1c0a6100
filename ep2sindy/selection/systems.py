"""Systems of equations made of candidates, the records to judge them on, and folds of these."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, Process, Relation, binding, constraint
from ep2sindy.library.roles import process_amounts
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.refine import refine, with_coef
from ep2sindy.refinement.steps import fastest_step
from ep2sindy.refinement.windows import MIN_SAMPLES, WindowBatch, cut_windows
from ep2sindy.regression.front import ParetoFront
from ep2sindy.selection.criteria import FLOOR
from ep2sindy.selection.rule import OtherSystem, combinations, left_out, support_of
from ep2sindy.signals.kalman import KalmanSmoother

# Most time steps, over windows and systems, of one refinement batch: more would not fit the cache.
BATCH_STEPS = 6000

# Largest ratio of the waveform errors of two systems of which the one of lower order comes first.
SAME = 1.1


@dataclass(frozen=True, eq=False)
class TrialSystem:
    """A model of one candidate per equation, with the constraint that its coefficients obey.

    means: of the term of every process over the records, if roles must go forward in the mean.
    """

    model: SparseModel
    constraint: Constraint
    means: Float[np.ndarray, " processes"] | None = None

    @property
    def n_free(self) -> int:
        """Number of coefficients that are fitted."""
        return len(self.constraint.free)

    @property
    def order(self) -> int:
        """Number of factors of the terms of all processes; zero without processes."""
        library = self.model.library
        return sum(int(library.degrees[library.index(p.term)]) for p in self.constraint.processes)

    @property
    def parts(self) -> dict[str, tuple[str, ...]]:
        """The terms of every role to be found; of every equation, if there are no processes.

        Two systems with the same terms in every equation may differ in what becomes of them.
        """
        if not self.constraint.processes:
            return {f"{s}'": tuple(self.model.terms(s)) for s in self.model.states}
        found: dict[str, tuple[str, ...]] = {}
        for process in self.constraint.processes:
            found[process.role] = (*found.get(process.role, ()), process.term)
        return found

    def broken(self, model: SparseModel) -> list[str]:
        """The demands on processes that a refined model does not meet."""
        processes = self.constraint.processes
        if self.means is None and not any(process.one_sign for process in processes):
            return []
        amounts = process_amounts(self.constraint, {s: model.terms(s) for s in model.states})
        values = np.array([amount for _, amount in amounts[: len(processes)]])
        return broken_demands(processes, values, self.means)

    def refined_on_all(
        self,
        runs: Sequence[Trajectory],
        *,
        window: int | None = None,
        n_windows: int = 30,
        n_reweights: int = 1,
        seed: int = 0,
    ) -> SparseModel:
        """Refine on windows spread over all the data, with the covariance of the coefficients.

        window: in samples; None takes one and a half periods. n_windows, n_reweights and seed: as
        for `refine`. A system without terms, or one whose refinement does not stay finite, is
        returned unchanged, without covariance.
        """
        if not len(self.constraint.free):
            return self.model
        found = refine(
            self.model,
            runs,
            n_windows=n_windows,
            window=window,
            method=MultipleShooting(step=fastest_step(self.model.library)),
            constraint=self.constraint,
            n_reweights=n_reweights,
            seed=seed,
        )
        return found.model


@dataclass(frozen=True, eq=False)
class Trial:
    """Results of a system on the folds that it was not fitted to, the worst over all folds.

    error: largest deviation from the data's cycle, in units of its bound; a system with one or less
    lives. f_error, amplitude: largest relative errors of the frequency and of an amplitude.
    waveform: largest error of the waveform. loss: on the windows that the system was refined on.
    """

    system: TrialSystem
    error: float
    f_error: float
    amplitude: float
    waveform: float
    loss: float


@dataclass(frozen=True, eq=False)
class Systems:
    """Systems to be judged, and for each the candidates of the fronts that its equations are.

    places: index of the candidate in every front. left_out: how many of how many combinations these
    are, as the end of a note; empty if they are all.
    """

    fronts: Sequence[ParetoFront]
    places: Int[np.ndarray, "systems fronts"]
    systems: Sequence[TrialSystem]
    left_out: str = ""


def combined(
    fronts: Sequence[ParetoFront],
    library: Library,
    runs: Sequence[Trajectory],
    relations: Sequence[Relation],
    *,
    most: int,
) -> Systems:
    """The combinations of candidates as systems, the most promising if there are more than `most`.

    Raises ValueError for relations that no combination has the terms for.
    """
    places = combinations(fronts, most, relations)
    systems = systems_of(fronts, places, library, runs, relations)
    return Systems(fronts, places, systems, left_out(fronts, len(places), most))


def broken_demands(
    processes: Sequence[Process],
    values: Float[np.ndarray, " processes"],
    means: Float[np.ndarray, " processes"] | None,
) -> list[str]:
    """What is not positive of these processes, though it must be; see `TrialSystem`."""
    pairs = list(zip(processes, values.tolist(), strict=True))
    found = [f"{p.role} by {p.term} > 0" for p, value in pairs if p.one_sign and value <= 0.0]
    if means is None:
        return found
    rates: dict[str, float] = {}
    for (process, value), mean in zip(pairs, means.tolist(), strict=True):
        rates[process.role] = rates.get(process.role, 0.0) + value * mean
    back = [role for role, rate in rates.items() if rate <= 0.0 and not role.endswith(" free")]
    return found + [f"{role} > 0 in the mean" for role in back]


def demands_note(note: str, broken: Sequence[str]) -> str:
    """A rule's note, with the demands that its winner does not meet."""
    return f"{note}; no system meets all demands: {', '.join(broken)}" if broken else note


def systems_of(
    fronts: Sequence[ParetoFront],
    places: Int[np.ndarray, "combinations fronts"],
    library: Library,
    runs: Sequence[Trajectory],
    relations: Sequence[Relation] = (),
) -> list[TrialSystem]:
    """Every combination as a system, with the units of the runs."""
    units = runs[0].units if runs else {}
    return [_system(fronts, choice, library, units, relations) for choice in places]


def _system(
    fronts: Sequence[ParetoFront],
    choice: Int[np.ndarray, " fronts"],
    library: Library,
    units: Mapping[str, str],
    relations: Sequence[Relation],
) -> TrialSystem:
    """System of one combination: free coefficients as found, the others by the relations."""
    states = [front.equation for front in fronts]
    chosen = [front.candidates[k] for front, k in zip(fronts, choice, strict=True)]
    coef = coef_matrix(library, [candidate.coef_by_term for candidate in chosen])
    model = SparseModel(library, states, coef, units)
    support = support_of(fronts, choice)
    held = constraint(library, support, binding(relations, support) or ())
    places = [(model.library.index(term), states.index(state)) for state, term in held.coefficients]
    free = np.array([coef[places[k]] for k in held.free])
    return TrialSystem(with_coef(model, held, held.coef(free))[0], held)


def budget(batch: WindowBatch, library: Library) -> tuple[MultipleShooting, int]:
    """Refinement method for systems to be judged, and how many to refine together.

    The regression's coefficients are close, so whole windows are fitted at once in few iterations.
    Systems that need more are the wrong ones.
    """
    method = MultipleShooting(
        step=fastest_step(library), first_memory=batch.data.shape[1], tolerance=1e-3, max_iter=10
    )
    return method, max(1, BATCH_STEPS // batch.steps.size)


@dataclass(frozen=True, eq=False)
class Records:
    """The trajectories to judge equations on, with smoothed states."""

    runs: Sequence[Trajectory]
    smoothed: Sequence[Float[np.ndarray, "_ n_states"]]


def records_of(fronts: Sequence[ParetoFront], runs: Sequence[Trajectory]) -> Records:
    """The runs with smoothed states, the states in the order of the fronts.

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
    """The samples from start to stop (exclusive) of one run."""

    run: int
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class Fold:
    """The held-out parts of the runs, and the remaining pieces, which are fitted."""

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
        """Windows of the pieces that are fitted, no longer than the longest piece."""
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
    """Fold by whole runs if there are enough; otherwise cut every run into blocks.

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


def living_among(trials: Sequence[Trial]) -> list[int]:
    """The systems that live in every fold.

    If some follow the windows to rounding, because the truth is in the library, these alone.
    """
    exact = min(trial.loss for trial in trials) < FLOOR
    return [k for k, t in enumerate(trials) if t.error <= 1.0 and (t.loss < FLOOR or not exact)]


def others_of(trials: Sequence[Trial], living: Sequence[int], winner: int) -> list[OtherSystem]:
    """The other living systems of the winner's size, the best waveform first."""
    size = trials[winner].system.n_free
    alike = [trials[k] for k in living if k != winner and trials[k].system.n_free == size]
    return [
        OtherSystem(t.system.parts, t.error, t.f_error, t.amplitude, t.waveform)
        for t in sorted(alike, key=lambda t: t.waveform)
    ]


def simplest_of_equals(ranked: Sequence[int], trials: Sequence[Trial]) -> list[int]:
    """The ranked systems; of those as good as the best one left, the lowest order comes first."""
    left, found = list(ranked), []
    while left:
        best = trials[left[0]]
        size, reach = best.system.n_free, SAME * best.waveform
        equals = [
            k for k in left if trials[k].system.n_free == size and trials[k].waveform <= reach
        ]
        simplest = min(equals, key=lambda k: trials[k].system.order)
        found.append(simplest)
        left.remove(simplest)
    return found
