"""Systems of equations made of candidates, their trials in folds of the records, and their rank."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Unpack

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.evaluation import Evaluation
from ep2sindy.library.relations import Constraint, Process, binding, constraint
from ep2sindy.library.roles import process_amounts
from ep2sindy.model.model import SparseModel, model_of
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.problem import RefinementChanges, RefinementProblem
from ep2sindy.refinement.refine import refine, with_coef
from ep2sindy.refinement.steps import fastest_step
from ep2sindy.refinement.windows import MIN_SAMPLES, WindowBatch, cut_windows
from ep2sindy.regression.front import Fronts
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.runtime.threads import one_thread
from ep2sindy.selection.criteria import (
    FLOOR,
    MAX_ERROR,
    OtherSystem,
    combinations,
    describe_left_out,
    support_of,
)

# Most time steps, over windows and systems, of one refinement batch: more would not fit the cache.
BATCH_STEPS = 6000

# Largest ratio of the waveform errors of two systems of which the one of lower order comes first.
SAME = 1.1

# A system on an attracting cycle replaces a smaller one on a neutral cycle only if its window loss
# is below this fraction of the other's: if only noise is left, extra terms attract by chance.
GAIN = 0.95

# Largest ratio of the waveform errors of two systems that count as equals.
ALIKE = 1.5

# Fraction of starts from which a cycle counts as attracting everything around it.
GLOBAL = 0.9


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
        task: DiscoveryProblem,
        held: Constraint,
        free: Float[np.ndarray, " free"],
        means: Float[np.ndarray, " processes"] | None = None,
    ) -> TrialSystem:
        """The system with these values of the free coefficients."""
        model = model_of(task.library, held.equations(free), units=task.runs[0].units)
        return TrialSystem(model, held, means)

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
        self, runs: Sequence[Trajectory], seed: int, **settings: Unpack[RefinementChanges]
    ) -> SparseModel:
        """Refine on windows spread over all the data, by torchdiffeq, with the covariance.

        seed and settings: as for `refine`. A system without free coefficients, or one whose
        refinement does not stay finite, is returned unchanged, without covariance.
        """
        if not len(self.constraint.free):
            return self.model
        settings["constraint"] = self.constraint
        return refine(self.model, runs, seed=seed, **settings).model


@dataclass(frozen=True, eq=False)
class Systems:
    """Systems to be assessed, and for each the candidates of the fronts that its equations are.

    places: index of the candidate in every front. left_out: how many of how many combinations these
    are, as the end of a note; empty if they are all.
    """

    fronts: Fronts
    places: Int[np.ndarray, "systems fronts"]
    systems: Sequence[TrialSystem]
    left_out: str = ""

    def score(
        self, errors: Float[np.ndarray, " systems"], winner: int
    ) -> list[Float[np.ndarray, " _candidates"]]:
        """Scores of candidates from the errors of their systems, in units of the bound.

        winner: index of the system that is selected. A candidate's score is the least error of all
        systems with it, no less than one and the winner's, or MAX_ERROR if there are none. The
        winner's candidates score marginally below that.
        """
        limit = max(1.0, float(errors[winner]))
        scores = np.maximum(errors, limit)
        scores[winner] = np.nextafter(limit, 0.0)
        return [
            np.array([scores[at == k].min(initial=MAX_ERROR) for k in range(len(front.candidates))])
            for front, at in zip(self.fronts, self.places.T, strict=True)
        ]


def combine(fronts: Fronts, task: DiscoveryProblem, *, most: int) -> Systems:
    """The combinations of candidates as systems, the most promising if there are more than `most`.

    Raises ValueError for relations that no combination has the terms for.
    """
    places = combinations(fronts, most, task.relations)
    systems = [_combine_one(fronts, choice, task) for choice in places]
    return Systems(fronts, places, systems, describe_left_out(fronts, len(places), most))


def _combine_one(
    fronts: Fronts, choice: Int[np.ndarray, " fronts"], task: DiscoveryProblem
) -> TrialSystem:
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


@dataclass(frozen=True)
class Segment:
    """The samples from start to stop (exclusive) of one run."""

    run: int
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class Fold:
    """The held-out segments of the runs, and the others, which are fitted."""

    held: Sequence[Segment]
    fitted: Sequence[Segment]


def deal(segments: Sequence[Segment], n_folds: int) -> list[Fold]:
    """Deal segments out in turn, so that each is held out in one fold and fitted in the others."""
    n_folds = min(n_folds, len(segments))
    return [
        Fold(segments[k::n_folds], [s for i, s in enumerate(segments) if i % n_folds != k])
        for k in range(n_folds)
    ]


def folds(runs: Sequence[Trajectory], n_folds: int) -> list[Fold]:
    """Fold by whole runs if there are enough; otherwise cut every run into blocks.

    Blocks on either side of a held-out one are fitted as one segment each.
    Raises ValueError for runs too short to be cut.
    """
    lengths = [run.n_samples for run in runs]
    if len(runs) >= n_folds:
        return deal([Segment(k, 0, length) for k, length in enumerate(lengths)], n_folds)
    if max(lengths) < 2 * MIN_SAMPLES * n_folds:
        raise ValueError(
            f"runs must hold {2 * MIN_SAMPLES * n_folds} samples to be parted in {n_folds}, got at "
            f"most {max(lengths)}; use longer records"
        )
    found = []
    for k in range(n_folds):
        held = [
            Segment(run, k * n // n_folds, (k + 1) * n // n_folds) for run, n in enumerate(lengths)
        ]
        sides = [(s.run, *ends) for s in held for ends in ((0, s.start), (s.stop, lengths[s.run]))]
        fitted = [Segment(run, a, b) for run, a, b in sides if b - a >= MIN_SAMPLES]
        found.append(Fold(held, fitted))
    return found


def cut_segments(
    runs: Sequence[Trajectory],
    segments: Sequence[Segment],
    model: SparseModel,
    *,
    window: int,
    n_windows: int,
    seed: int = 0,
) -> WindowBatch:
    """Windows of segments of the runs, no longer than the longest segment."""
    pieces = [runs[part.run].window(part.start, part.stop) for part in segments]
    length = min(window, max(piece.n_samples for piece in pieces))
    return cut_windows(pieces, model, n_windows=n_windows, window=length, rng=seed)


@dataclass(frozen=True, eq=False)
class BatchRefinement:
    """Models of systems that were refined on the same windows, without assessment.

    loss: mean square of (trajectory - data) in the batch's scale. If a refinement did not stay
    finite, the loss is infinite and the model is that of the system.
    """

    models: Sequence[SparseModel]
    loss: Float[np.ndarray, " systems"]


@one_thread()
def refine_systems(
    systems: Sequence[TrialSystem],
    batch: WindowBatch,
    *,
    n_reweights: int = 1,
    progress: Progress = SILENT,
) -> BatchRefinement:
    """Every system refined on the same windows. Raises ValueError for one without terms.

    The regression's coefficients are close, so whole windows are fitted at once in few iterations.
    Systems that need more are the wrong ones.
    """
    step, n_samples = fastest_step(systems[0].model.library), batch.data.shape[1]
    method = MultipleShooting(step=step, first_memory=n_samples, tolerance=1e-3, max_iter=10)
    together = max(1, BATCH_STEPS // batch.steps.size)
    models, losses = [], []
    with progress.stage(len(systems), "system", "refined without a fold") as advance:
        for k in range(0, len(systems), together):
            some = systems[k : k + together]
            own, relations = [s.model for s in some], [s.constraint for s in some]
            batches = [batch] * len(own)
            problem = RefinementProblem.of(own, batches, relations, n_reweights=n_reweights)
            fit = method.fit(problem)
            with np.errstate(over="ignore", invalid="ignore"):
                loss = np.square(fit.nodes - problem.data).mean(axis=(1, 2, 3))
            losses.append(np.where(fit.finite, loss, np.inf))
            for p, (model, equations) in enumerate(zip(own, problem.equations, strict=True)):
                values = equations.coef(fit.scaling[p, : equations.n_free])
                moved, _ = with_coef(model, equations.relations, values)
                models.append(moved if fit.finite[p] else model)
            advance(len(own))
    return BatchRefinement(models, np.concatenate(losses))


@dataclass(frozen=True, eq=False)
class Trial:
    """How a system does where it was not fitted: the worst over all folds.

    error: in units of its bound; a system with one or less is sustained. f_error, amplitude:
    largest relative errors of the frequency and of an amplitude; NaN if windows are assessed.
    waveform: largest error of the waveform, or the mean square error over windows left out. loss:
    on the windows that the system was refined on, or, if windows are assessed, on those left out.
    """

    system: TrialSystem
    error: float = MAX_ERROR
    f_error: float = np.inf
    amplitude: float = np.inf
    waveform: float = np.inf
    loss: float = np.inf

    def rank(self, margin: float) -> tuple[bool, int, float]:
        """Sorts the best sustained systems first: those with room, the smallest, the closest."""
        return self.error > margin, self.system.n_free, self.waveform


def find_sustained(trials: Sequence[Trial]) -> list[Trial]:
    """The systems that are sustained in every fold.

    If some follow the windows to rounding, because the truth is in the library, these alone.
    """
    exact = min(trial.loss for trial in trials) < FLOOR
    return [t for t in trials if t.error <= 1.0 and (t.loss < FLOOR or not exact)]


def best_together(points: Sequence[Sequence[Trial]], margin: float, n_alike: int) -> list[int]:
    """Indices of the systems that do best at several points, `n_alike` of each size.

    points: the trials of each point, in one order of the systems. Those are taken that are
    sustained, and have room (error up to `margin`), at most points; of a size those of least error
    in the geometric mean.
    """
    errors = np.array([[trial.error for trial in trials] for trials in points])
    sizes = np.array([trial.system.n_free for trial in points[0]])
    failed = [(own > 1.0).sum() * len(own) + (own > margin).sum() for own in errors.T]
    mean = np.log(np.maximum(errors, FLOOR)).mean(axis=0)
    best = [k for k in np.argsort(mean).tolist() if failed[k] == min(failed)]
    return [
        k
        for size in np.unique(sizes[best]).tolist()
        for k in [k for k in best if sizes[k] == size][:n_alike]
    ]


def list_others(sustained: Sequence[Trial], winner: Trial) -> list[OtherSystem]:
    """The other self-sustained systems of the winner's size, the best waveform first."""
    size = winner.system.n_free
    alike = [t for t in sustained if t is not winner and t.system.n_free == size]
    return [
        OtherSystem(t.system.parts, t.error, t.f_error, t.amplitude, t.waveform)
        for t in sorted(alike, key=lambda t: t.waveform)
    ]


def order_equals(ranked: Sequence[Trial]) -> list[Trial]:
    """The ranked systems; of those as good as the best one left, the lowest order comes first."""
    left, found = list(ranked), []
    while left:
        size, reach = left[0].system.n_free, SAME * left[0].waveform
        equals = [t for t in left if t.system.n_free == size and t.waveform <= reach]
        found.append(min(equals, key=lambda t: t.system.order))
        left.remove(found[-1])
    return found


def describe_shared(sustained: Sequence[Trial]) -> str:
    """What all self-sustained systems share, as the end of a note; empty for a single one.

    What they do not share, the records do not determine.
    """
    if len(sustained) < 2:
        return ""
    first, *others = (trial.system.parts for trial in sustained)
    shared = {
        part: [term for term in terms if all(term in each.get(part, ()) for each in others)]
        for part, terms in first.items()
    }
    known = [f"{part}: {', '.join(terms)}" for part, terms in shared.items() if terms]
    return f"; all of these have {'; '.join(known)}" if known else "; these have no term in common"


@dataclass(frozen=True, eq=False)
class ConfirmedSystem:
    """A system refined on all data, and its free run over the longest record.

    broken: demands that the coefficients do not meet. fraction: of starts around the cycle that
    reach it; zero if the model does not sustain its oscillation, or if perturbations from its cycle
    do not decay. run: None if windows are assessed; fraction is then one, or zero if demands are
    broken. repels: True if perturbations grow.
    """

    trial: Trial
    model: SparseModel
    broken: Sequence[str]
    fraction: float
    run: Evaluation | None = None
    repels: bool = False

    @property
    def is_global(self) -> bool:
        return self.fraction >= GLOBAL

    @property
    def rests(self) -> bool:
        """Whether it is sustained on a neutral cycle."""
        stays = self.run is not None and self.run.comparison.stays
        return stays and not self.fraction and not self.repels

    def outdoes(self, resting: ConfirmedSystem) -> bool:
        """Whether an attracting system is preferred to one that is no larger, on a neutral cycle.

        It is if it follows the windows better, or as an equal: of one size, and as close to the
        waveform of the folds that neither was fitted to.
        """
        ours, theirs = self.trial, resting.trial
        is_equal = ours.system.n_free <= theirs.system.n_free
        is_close = ours.waveform <= ALIKE * theirs.waveform
        return ours.loss < GAIN * theirs.loss or (is_equal and is_close)

    @property
    def rank(self) -> tuple[float, ...]:
        """Sorts the best first; the first of equals wins."""
        goes = (False, 0) if self.run is None else self.run.comparison.rank
        size, fraction = self.trial.system.n_free, min(self.fraction, GLOBAL)
        attracts = (self.repels, not self.fraction, not self.is_global)
        return (bool(self.broken), *goes, *attracts, size, -fraction)

    def text(self, n_sustained: int, n_systems: int) -> str:
        """How the system was confirmed, in words."""
        if self.run is None:
            found = "chosen by windows held out"
        else:
            how = self.run.run_text + ("" if n_sustained else " where fitted")
            if self.run.comparison.stays and not self.fraction:
                how = f"{how}, on a cycle that {'repels' if self.repels else 'does not attract'}"
            elif self.fraction and not self.model.inputs:
                how = f"{how}, on a cycle that attracts"
            found = (
                f"{how}; {n_sustained or 'none'} of {n_systems} systems are sustained "
                "where not fitted"
            )
        demands = f"; no system meets all demands: {', '.join(self.broken)}" if self.broken else ""
        return found + demands
