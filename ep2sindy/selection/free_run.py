"""Selection by free run: systems are refined, and compared with the cycle of the data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.model.comparison import (
    FreeRunBounds,
    columns_of,
    compare_cycles,
    densities_of,
    deviation,
    turns_negative,
)
from ep2sindy.model.inputs import curve_through
from ep2sindy.model.many import WindowSteps, run_many
from ep2sindy.model.model import SparseModel
from ep2sindy.model.stability import ATTRACTING_BELOW, LEAST_WAIT, REPELLING_ABOVE, basin_stability
from ep2sindy.model.vector_field import VectorField
from ep2sindy.refinement.windows import MIN_SAMPLES
from ep2sindy.regression.front import Fronts
from ep2sindy.runtime.progress import SILENT, Progress, count_pieces
from ep2sindy.runtime.values import check_kind, check_list, set_counts
from ep2sindy.selection.by_windows import WindowsLeftOut
from ep2sindy.selection.criteria import MAX_ERROR, Basis, Decision
from ep2sindy.selection.systems import (
    BatchRefinement,
    ConfirmedSystem,
    Fold,
    Segment,
    Systems,
    Trial,
    TrialSystem,
    combine,
    cut_segments,
    describe_shared,
    find_sustained,
    folds,
    list_others,
    order_equals,
    refine_systems,
)
from ep2sindy.signals.attractor import Cycle, find_cycle
from ep2sindy.signals.smoothers import KalmanSmoother
from ep2sindy.signals.spectrum import samples_in_periods, steps_in

MIN_WINDOWS = 30  # fewest windows to refine the winner on

# Free coefficients more than the smallest attracting system has, for one that attracts everything.
DEARER = 1

# Integration steps per sample. One step suffices for the true model of every noise-free system of
# `systems`: its error stays below 1e-9 variances. The second step is for sparser samples.
N_SUBSTEPS = 2

# A state that is farther from its mean than this many standard deviations has diverged.
BLOW_UP = 20.0

N_REACHING = 64  # starts around a cycle that are run, for the fraction that reaches it

# Fewest periods of a record, so that its folds leave windows of two periods: six, less a margin
# for noise.
MIN_PERIODS = 5.5

# A record spirals if the amplitude of every state changes by more than this factor, in the same
# direction, from each third to the next: no single cycle then fits all folds within 10 %.
MAX_DRIFT = 1.1

# Periods of a trial run: enough for a transient to decay. A model without inputs continues
# beyond the end of a short segment.
MIN_RUN, MAX_RUN = 16.0, 30.0


@dataclass(frozen=True)
class FreeRunScore:
    """Test systems by free runs; the smallest that sustains its oscillation on held-out data wins.

    The records are split into folds. Every combination of candidates, one per equation, is refined
    on windows in all folds but one, and then integrated freely over the held-out fold, in turn for
    every fold. A system is sustained if frequency, amplitudes and waveform stay within `bounds` of
    the data's cycle in every run.

    The sustained systems that deviate by at most `margin` come first, the smallest of them before
    the others; size is the number of free coefficients, and of equal sizes the best waveform comes
    first. The first one is refined on windows of all data and run over the longest record. It wins
    if it is sustained there too, on a cycle that nine of ten starts around it reach. If fewer
    starts reach it, a system whose cycle they reach wins if it has the same number of coefficients
    or one more; otherwise that of least size and most such starts wins. A system on a neutral cycle
    wins only if no equal or larger system on an attracting cycle follows the data as well. If no
    system is sustained, the one that deviates least wins, and the note says so.

    Parameters
    ----------
    bounds : FreeRunBounds or None, default FreeRunBounds()
        Largest deviations at which a run counts as sustained. None tests windows of every record,
        for cycles that do not repeat, such as chaos.
    n_folds : int, default 3
        Number of folds, two or more.
    n_windows : int, default 20
        Number of windows on which a system is refined.
    window_periods : float, default 2.0
        Length of a window, in periods.
    margin : float, default 0.6
        Systems that deviate by no more than this fraction of the bounds come first, even if others
        are smaller: a system that barely stays within the bounds here will leave them in another
        record.
    n_confirmed : int, default 8
        Most systems to refine on all data.
    seed : int, default 0
        Of the random windows.
    max_combinations : int, default 4096
        If there are more combinations, the most promising are tested, those whose candidates rank
        best in their own fronts; the note says so.
    assessed : sequence of str, optional
        States whose cycle counts, for example the measured one if the others are derived from it.
        None takes all.
    n_starts : int, default 1
        Number of runs over every held-out part for models without inputs, at phases spread over the
        period. All must end on the cycle.

    Raises
    ------
    ValueError
        If a number is too small, or the margin does not lie between 0 and 1.

    Notes
    -----
    The score of a combination is

        score = max over runs and states s of
                |f / f_data - 1| / b_f, |A_s / A_s,data - 1| / b_A, w_s / b_w

    with frequency f, standard deviation A_s, waveform error w_s in standard deviations, and the
    bounds b; or the error over windows in units of the largest that cannot be distinguished from
    the least; at most 10. A run starts on the data's cycle at the phase where the held-out part
    begins, not at its first sample, whose noise is not the model's error; a model with inputs
    starts at the smoothed sample. If a record has no period, holds fewer than six, or spirals
    outward or inward throughout, windows of the held-out fold are tested instead
    (`WindowsLeftOut`), and the smallest of the systems that follow them as well as any wins. If
    some systems follow the samples to rounding, because the truth is in the library, only these
    compete.

    Examples
    --------
    >>> run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    >>> library = ep.polynomial(["x", "y"]).only({"x": ["x", "x*y"], "y": ["y", "x*y"]})
    >>> rule = ep.Regression(selection=ep.FreeRunScore(n_folds=2))
    >>> ep.discover(run, library, rule).chosen["x"].terms
    ('x', 'x*y')
    """

    bounds: FreeRunBounds | None = field(default_factory=FreeRunBounds)
    n_folds: int = 3
    n_windows: int = 20
    window_periods: float = 2.0
    margin: float = 0.6
    n_confirmed: int = 8
    seed: int = 0
    max_combinations: int = 4096
    assessed: Sequence[str] | None = None
    n_starts: int = 1
    label: ClassVar[str] = "free-run error"
    basis: ClassVar[Basis] = "runs"

    def __post_init__(self) -> None:
        if self.bounds is not None:
            check_kind("bounds", self.bounds, FreeRunBounds, "ep.model.FreeRunBounds()")
        least = dict.fromkeys(("n_windows", "n_confirmed", "max_combinations", "n_starts"), 1)
        set_counts(self, {"n_folds": 2} | least)
        if not self.window_periods > 0.0:
            raise ValueError(f"window_periods must be positive, got {self.window_periods}")
        if not 0.0 < self.margin <= 1.0:
            raise ValueError(f"margin must lie between 0 and 1, got {self.margin}")
        check_list("assessed", self.assessed)

    def decide(
        self, fronts: Fronts, task: DiscoveryProblem, *, progress: Progress = SILENT
    ) -> Decision:
        """Score candidates by the deviations of their combinations, and refine the winner.

        Raises ValueError for a state without a front, records that are too short, or relations
        that no combination has the terms for.
        """
        systems = combine(fronts, task, most=self.max_combinations)
        return self.assess(systems, task.runs, progress=progress)

    def assess(
        self, found: Systems, runs: Sequence[Trajectory], *, progress: Progress = SILENT
    ) -> Decision:
        """Decide among given systems, as `decide` does among the combinations of candidates.

        Each is refined without a fold and run over that fold, in turn for every fold. Those that
        are sustained are ranked, and refined on all data in this order until one is confirmed.
        """
        measure, reason = self._measure(found.fronts, runs)
        trials = self._try(found.systems, measure, progress)
        sustained = find_sustained(trials)
        ranked = order_equals(sorted(sustained, key=lambda trial: trial.rank(self.margin)))
        by_error = sorted(trials, key=lambda trial: (trial.error, trial.loss))
        confirmed = self._confirm(ranked or by_error, measure, runs, progress)
        won = min(confirmed, key=lambda each: each.rank)
        scores = found.score(np.array([t.error for t in trials]), trials.index(won.trial))
        shared = describe_shared(sustained) if won.run else ""
        note = f"{reason}{won.text(len(sustained), len(trials))}{shared}{found.left_out}"
        others = list_others(sustained, won.trial) if won.run else ()
        return Decision(scores, won.model, note, won.trial.system.constraint, others)

    def trials(
        self, found: Systems, runs: Sequence[Trajectory], *, progress: Progress = SILENT
    ) -> list[Trial]:
        """How every given system does where it was not fitted, in their order."""
        measure, _ = self._measure(found.fronts, runs)
        return self._try(found.systems, measure, progress)

    def _measure(self, fronts: Fronts, runs: Sequence[Trajectory]) -> tuple[Measure, str]:
        """What systems are assessed by; and why not by their cycles, if these were asked for.

        Raises ValueError for a state without a front.
        """
        states = [front.equation for front in fronts]
        if sorted(states) != sorted(runs[0].state_names):
            raise ValueError(
                f"to integrate, every state needs one front, got {states} for the states "
                f"{list(runs[0].state_names)}"
            )
        smoothed = [KalmanSmoother().smooth(run.t, run.columns(states)) for run in runs]
        cycles = "" if self.bounds is None else find_cycles(runs, states)
        if self.bounds is not None and not isinstance(cycles, str):
            parts = folds(runs, self.n_folds)
            return CycleRuns(self, runs, parts, smoothed, cycles, self.bounds), ""
        pieces = [piece for run in runs for piece in run.segments(2 * MIN_SAMPLES)]
        spread, reason = np.concatenate(smoothed).std(axis=0), f"{cycles}: " if cycles else ""
        return WindowsLeftOut(pieces, spread, states, self.n_windows, self.n_folds), reason

    def _try(
        self, systems: Sequence[TrialSystem], measure: Measure, progress: Progress
    ) -> list[Trial]:
        """Refine every system without a fold, and assess it there, in turn for every fold."""
        some = [k for k, system in enumerate(systems) if measure.admits(system)]
        some.sort(key=lambda k: systems[k].n_free)  # systems in a batch then cost about the same
        trials = [Trial(system) for system in systems]
        if not some:
            return trials
        tried, found = [systems[k] for k in some], []
        for fold in measure.folds:
            fitted = cut_segments(
                measure.runs, fold.fitted, tried[0].model, window=measure.window,
                n_windows=measure.count(fold.fitted), seed=self.seed,
            )  # fmt: skip
            refined = refine_systems(
                tried, fitted, n_reweights=measure.n_reweights, progress=progress
            )
            found.append(measure.assess(tried, refined, fold, progress))
        for k, figures in zip(some, measure.figures(found), strict=True):
            trials[k] = Trial(systems[k], *figures.tolist())
        return trials

    def _confirm(
        self,
        ranked: Sequence[Trial],
        measure: Measure,
        runs: Sequence[Trajectory],
        progress: Progress,
    ) -> list[ConfirmedSystem]:
        """The systems, refined on all data in order, up to one that nothing after it can outdo."""
        found: list[ConfirmedSystem] = []
        best = ranked[: self.n_confirmed]
        for trial in count_pieces(progress, best, "system", "refined on all data"):
            attracting = [each for each in found if each.fraction]
            if attracting and trial.system.n_free > attracting[0].trial.system.n_free + DEARER:
                break
            model = trial.system.refine_on_all(
                runs, self.seed, window=measure.window_on_all,
                n_windows=max(MIN_WINDOWS, self.n_windows), n_reweights=measure.n_reweights,
            )  # fmt: skip
            own = measure.confirm(trial, model)
            resting = [each for each in found if each.rests]
            if own.fraction and resting and not own.outdoes(resting[0]):
                own = replace(own, fraction=0.0)  # it attracts by chance
            found.append(own)
            if own.is_global and not own.broken:
                break
        return found


@dataclass(frozen=True, eq=False)
class CycleRuns:
    """Runs of systems over the folds left out, compared with the cycle of each record.

    rule: with its settings. smoothed: states of every run.
    """

    rule: FreeRunScore
    runs: Sequence[Trajectory]
    folds: Sequence[Fold]
    smoothed: Sequence[Float[np.ndarray, "_ n_states"]]
    cycles: Sequence[Cycle]
    bounds: FreeRunBounds
    n_reweights = 0  # scale states by their standard deviation, as in the assessment

    @cached_property
    def window(self) -> int:
        """Number of samples in a window."""
        frequency_Hz = [cycle.frequency_Hz for cycle in self.cycles]
        dt_s = [run.dt_s for run in self.runs]
        return samples_in_periods(self.rule.window_periods, frequency_Hz=frequency_Hz, dt_s=dt_s)

    @property
    def window_on_all(self) -> int:
        return self.window

    def count(self, segments: Sequence[Segment]) -> int:
        """Number of windows to refine on."""
        return self.rule.n_windows

    def admits(self, system: TrialSystem) -> bool:
        """Whether it has all equations; one without an equation cannot oscillate."""
        return bool(system.model.coef.any(axis=0).all())

    def assess(
        self,
        systems: Sequence[TrialSystem],
        refined: BatchRefinement,
        fold: Fold,
        progress: Progress,
    ) -> Float[np.ndarray, "systems 5"]:
        """The figures of a `Trial` of every system in one fold."""
        first, assessed = systems[0].model, []
        coefs = np.stack([model.coef for model in refined.models])
        field = VectorField.of(first.library, [*first.states, *first.inputs], coefs)
        with progress.stage(None, "run", "free runs over the fold") as advance:
            for t, paths, cycle in self._run(field, fold.held):
                assessed.append(self._compare(t, paths, cycle, first.states))
                advance(len(paths))
        worst = np.column_stack([np.max(assessed, axis=0), refined.loss])
        pairs = zip(systems, refined.models, strict=True)
        worst[[bool(system.broken(model)) for system, model in pairs], 0] = MAX_ERROR
        return worst

    def _run(
        self, field: VectorField, held: Sequence[Segment]
    ) -> Iterator[tuple[np.ndarray, np.ndarray, Cycle]]:
        """Times and paths of every system over every held-out segment, one start after another."""
        joined = np.concatenate(self.smoothed)
        centre, reach = joined.mean(axis=0), BLOW_UP * joined.std(axis=0)
        inputs = field.library.variables[field.n_states :]
        for part in held:
            run, cycle = self.runs[part.run], self.cycles[part.run]
            per_period = steps_in(1.0, frequency_Hz=cycle.frequency_Hz, dt_s=run.dt_s)
            first, n_samples = part.start, part.stop - part.start
            no_courses = [None] * len(inputs)
            curve = curve_through(run.t, run.columns(inputs), no_courses) if inputs else None
            if curve is None:
                n_samples = round(np.clip(n_samples, MIN_RUN * per_period, MAX_RUN * per_period))
                # Starts spread over as many periods, no two at the same phase.
                later = (
                    np.arange(self.rule.n_starts) * (1.0 + 1.0 / self.rule.n_starts) * per_period
                )
                starts = np.minimum(first + later.round().astype(np.int64), part.stop - 1)
                t, begin = run.dt_s * np.arange(n_samples), cycle.waveform(cycle.phase[starts])
                times, begins = t, np.zeros(self.rule.n_starts, dtype=np.int64)
            else:
                if n_samples < MIN_RUN * per_period:  # inputs end with the record
                    first, n_samples = 0, run.n_samples
                t, begin = run.t[first : first + n_samples], self.smoothed[part.run][[first]]
                times, begins = run.t, np.array([first])
            steps = WindowSteps.along(times, curve, begins, n_samples, N_SUBSTEPS)
            paths = run_many(field, begin, steps, centre=centre, reach=reach)
            for k in range(paths.shape[1]):
                yield t, paths[:, k], cycle

    def _compare(
        self,
        t: Float[np.ndarray, " samples"],
        paths: Float[np.ndarray, "systems samples n_states"],
        cycle: Cycle,
        states: Sequence[str],
    ) -> Float[np.ndarray, "systems 4"]:
        """The figures of a `Trial` but the loss, over one segment, its first half left out."""
        half, columns = len(t) // 2, columns_of(states, self.rule.assessed)
        densities, std = densities_of(self.runs[0], states), zero_to_one(cycle.std)
        ours = replace(cycle, mean=cycle.mean[columns], harmonics=cycle.harmonics[:, columns])
        found = np.full((len(paths), 4), [MAX_ERROR, np.inf, np.inf, np.inf])
        for row, path in zip(found, paths, strict=True):
            if np.isfinite(path).all() and not turns_negative(path[half:], densities, std):
                f_error, ratio, waveform = compare_cycles(ours, t[half:], path[half:, columns])
                error = deviation(f_error, ratio, waveform, self.bounds)
                if not np.isnan(error):
                    amplitude = np.abs(ratio - 1.0).max()
                    row[:] = min(error, MAX_ERROR), abs(f_error), amplitude, waveform.max()
        return found

    def figures(self, tried: Sequence[np.ndarray]) -> Float[np.ndarray, "systems 5"]:
        """The worst over the folds."""
        worst: np.ndarray = np.max(tried, axis=0)
        return worst

    def confirm(self, trial: Trial, model: SparseModel) -> ConfirmedSystem:
        """Free run of a refined system over the longest record, from the start of its cycle."""
        pairs = zip(self.runs, self.cycles, strict=True)
        longest, cycle = max(pairs, key=lambda pair: np.ptp(pair[0].t))
        start = cycle.waveform(cycle.phase[:1])[0]
        run = evaluate(
            model, longest, initial=start, bounds=self.bounds, assessed=self.rule.assessed
        )
        fraction, repels = _attraction(run) if run.comparison.stays else (0.0, False)
        return ConfirmedSystem(trial, model, trial.system.broken(model), fraction, run, repels)


def _attraction(run: Evaluation) -> tuple[float, bool]:
    """Fraction of starts that reach the model's cycle, and whether perturbations from it grow.

    The fraction is zero if perturbations do not decay. A model with inputs is followed from its
    start alone: its fraction is one.
    """
    if run.model.inputs:
        return 1.0, False
    if run.cycle is None or run.multiplier > ATTRACTING_BELOW:
        return 0.0, run.multiplier > REPELLING_ABOVE
    # Within forty periods: of cycles that are reached, one that is reached sooner is better.
    fraction = basin_stability(run.model, run.cycle, n_starts=N_REACHING, n_periods=LEAST_WAIT)
    return max(fraction, 0.5 / N_REACHING), False


def find_cycles(runs: Sequence[Trajectory], states: Sequence[str]) -> list[Cycle] | str:
    """The cycle of every record, or the reason why a record has none."""
    found = []
    for run in runs:
        # Unsmoothed samples: the waveform averages noise over all periods; smoothing clips peaks.
        cycle = find_cycle(run.t, run.columns(states))
        name = f"record {run.label!r}" if run.label else "the record"
        if cycle is None:
            return f"{name} has no period"
        if cycle.n_periods < MIN_PERIODS:
            return f"{name} holds {cycle.n_periods:.1f} periods, not six"
        if _spirals(cycle, run.columns(states)):
            return f"{name} spirals"
        found.append(cycle)
    return found


def _spirals(cycle: Cycle, states: Float[np.ndarray, "samples n_states"]) -> bool:
    """True if the fundamental of every state grows, or of every state decays, throughout."""
    amplitude = []
    for phase, part in zip(np.array_split(cycle.phase, 3), np.array_split(states, 3), strict=True):
        basis = np.column_stack([np.ones_like(phase), np.cos(phase), np.sin(phase)])
        amplitude.append(np.hypot(*np.linalg.lstsq(basis, part, rcond=None)[0][1:]))
    before, after = np.array(amplitude[:2]), np.array(amplitude[1:])
    grows, decays = after > MAX_DRIFT * before, before > MAX_DRIFT * after
    return bool(grows.all() or decays.all())


Measure = CycleRuns | WindowsLeftOut
