"""Systems of equations made of candidates, the records to judge them on, and folds of these."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.coerce import Task
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, Process, binding, constraint
from ep2sindy.library.roles import process_amounts
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.refine import refine, with_coef
from ep2sindy.refinement.steps import fastest_step
from ep2sindy.refinement.windows import MIN_SAMPLES, WindowBatch, cut_windows
from ep2sindy.regression.front import Fronts
from ep2sindy.selection.criteria import (
    FLOOR,
    MAX_ERROR,
    OtherSystem,
    combinations,
    describe_left_out,
    support_of,
)
from ep2sindy.signals.attractor import Cycle
from ep2sindy.signals.smoothers import KalmanSmoother

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

    @staticmethod
    def of(
        task: Task,
        held: Constraint,
        free: Float[np.ndarray, " free"],
        means: Float[np.ndarray, " processes"] | None = None,
    ) -> TrialSystem:
        """The system with these values of the free coefficients."""
        empty = np.zeros((len(task.library), len(held.states)))
        model = SparseModel(task.library, held.states, empty, task.runs[0].units)
        return TrialSystem(with_coef(model, held, held.coef(free))[0], held, means)

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
        return find_broken_demands(processes, values, self.means)

    def refine_on_all(
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

    fronts: Fronts
    places: Int[np.ndarray, "systems fronts"]
    systems: Sequence[TrialSystem]
    left_out: str = ""

    def score(
        self, errors: Float[np.ndarray, " systems"], *, limit: float, winner: int
    ) -> list[Float[np.ndarray, " _candidates"]]:
        """Scores of candidates from the errors of their systems.

        limit: errors up to this value cannot be told from the least. winner: index of the system
        that is selected among them. A candidate's score is the least error of all systems with it,
        no less than the limit, or MAX_ERROR if there are none. The winner's candidates score
        marginally below the limit.
        """
        scores = np.maximum(errors, limit)
        scores[winner] = np.nextafter(limit, 0.0)
        return [
            np.array([scores[at == k].min(initial=MAX_ERROR) for k in range(len(front.candidates))])
            for front, at in zip(self.fronts, self.places.T, strict=True)
        ]

    def find_smallest(self, errors: Float[np.ndarray, " systems"], *, limit: float) -> int:
        """Index of the system of fewest terms, then least error, among errors up to the limit."""
        n_terms = sum(f.sizes[k] for f, k in zip(self.fronts, self.places.T, strict=True))
        return int(np.lexsort((errors, n_terms, errors > limit))[0])


def combine(fronts: Fronts, task: Task, *, most: int) -> Systems:
    """The combinations of candidates as systems, the most promising if there are more than `most`.

    Raises ValueError for relations that no combination has the terms for.
    """
    places = combinations(fronts, most, task.relations)
    systems = [_combine_one(fronts, choice, task) for choice in places]
    return Systems(fronts, places, systems, describe_left_out(fronts, len(places), most))


def _combine_one(fronts: Fronts, choice: Int[np.ndarray, " fronts"], task: Task) -> TrialSystem:
    """System of one combination: free coefficients as found, the others by the relations."""
    support = support_of(fronts, choice)
    held = constraint(task.library, support, binding(task.relations, support) or ())
    pairs = zip(fronts, choice, strict=True)
    coef = {front.equation: front.candidates[k].coef_by_term for front, k in pairs}
    places = [held.coefficients[k] for k in held.free]
    return TrialSystem.of(task, held, np.array([coef[state][term] for state, term in places]))


def find_broken_demands(
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


def describe_demands(note: str, broken: Sequence[str]) -> str:
    """A rule's note, with the demands that its winner does not meet."""
    return f"{note}; no system meets all demands: {', '.join(broken)}" if broken else note


def plan_refinement(batch: WindowBatch, library: Library) -> tuple[MultipleShooting, int]:
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
    """The trajectories to judge equations on, with smoothed states, and the cycles of each."""

    runs: Sequence[Trajectory]
    smoothed: Sequence[Float[np.ndarray, "_ n_states"]]
    cycles: Sequence[Cycle] = ()


def smooth_records(fronts: Fronts, runs: Sequence[Trajectory]) -> Records:
    """The runs with smoothed states, the states in the order of the fronts.

    Raises ValueError for a state without a front.
    """
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
    """The held-out stretches of the runs, and the others, which are fitted."""

    held: Sequence[Stretch]
    fitted: Sequence[Stretch]


def deal(stretches: Sequence[Stretch], n_folds: int) -> list[Fold]:
    """Deal stretches out in turn, so that each is held out in one fold and fitted in the others."""
    n_folds = min(n_folds, len(stretches))
    return [
        Fold(stretches[k::n_folds], [s for i, s in enumerate(stretches) if i % n_folds != k])
        for k in range(n_folds)
    ]


def folds(runs: Sequence[Trajectory], n_folds: int) -> list[Fold]:
    """Fold by whole runs if there are enough; otherwise cut every run into blocks.

    Blocks on either side of a held-out one are fitted as one stretch each.
    Raises ValueError for runs too short to be cut.
    """
    lengths = [run.n_samples for run in runs]
    if len(runs) >= n_folds:
        return deal([Stretch(k, 0, length) for k, length in enumerate(lengths)], n_folds)
    if max(lengths) < 2 * MIN_SAMPLES * n_folds:
        raise ValueError(
            f"runs must hold {2 * MIN_SAMPLES * n_folds} samples to be parted in {n_folds}: at "
            f"most {max(lengths)} came; use longer records"
        )
    found = []
    for k in range(n_folds):
        held = [
            Stretch(run, k * n // n_folds, (k + 1) * n // n_folds) for run, n in enumerate(lengths)
        ]
        sides = [(s.run, *ends) for s in held for ends in ((0, s.start), (s.stop, lengths[s.run]))]
        fitted = [Stretch(run, a, b) for run, a, b in sides if b - a >= MIN_SAMPLES]
        found.append(Fold(held, fitted))
    return found


def cut_stretches(
    runs: Sequence[Trajectory],
    stretches: Sequence[Stretch],
    model: SparseModel,
    *,
    window: int,
    n_windows: int,
    seed: int = 0,
) -> WindowBatch:
    """Windows of stretches of the runs, no longer than the longest stretch."""
    pieces = [runs[part.run].window(part.start, part.stop) for part in stretches]
    return cut_windows(
        pieces,
        states=model.states,
        inputs=model.inputs,
        n_windows=n_windows,
        window=min(window, max(piece.n_samples for piece in pieces)),
        rng=np.random.default_rng(seed),
    )


def find_living(trials: Sequence[Trial]) -> list[int]:
    """The systems that live in every fold.

    If some follow the windows to rounding, because the truth is in the library, these alone.
    """
    exact = min(trial.loss for trial in trials) < FLOOR
    return [k for k, t in enumerate(trials) if t.error <= 1.0 and (t.loss < FLOOR or not exact)]


def list_others(trials: Sequence[Trial], living: Sequence[int], winner: int) -> list[OtherSystem]:
    """The other living systems of the winner's size, the best waveform first."""
    size = trials[winner].system.n_free
    alike = [trials[k] for k in living if k != winner and trials[k].system.n_free == size]
    return [
        OtherSystem(t.system.parts, t.error, t.f_error, t.amplitude, t.waveform)
        for t in sorted(alike, key=lambda t: t.waveform)
    ]


def order_equals(ranked: Sequence[int], trials: Sequence[Trial]) -> list[int]:
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
