"""Selection by free run: systems are refined, and compared with the cycle of the data."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ep2sindy.data.coerce import Task
from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.model.comparison import (
    FreeRunBounds,
    Status,
    columns_of,
    compare_cycles,
    densities_of,
    deviation,
    turns_negative,
)
from ep2sindy.model.inputs import curve_through
from ep2sindy.model.many import WindowSteps, run_many
from ep2sindy.model.model import SparseModel
from ep2sindy.model.stability import LEAST_WAIT, limit_cycle, share_reaching
from ep2sindy.model.vector_field import VectorField
from ep2sindy.refinement.refine import refine_batch
from ep2sindy.regression.front import Fronts
from ep2sindy.runtime.progress import SILENT, Progress, count_pieces
from ep2sindy.runtime.values import check_kind, check_list, set_counts
from ep2sindy.selection.criteria import MAX_ERROR, Basis, Decision
from ep2sindy.selection.refined import RefinedScore
from ep2sindy.selection.systems import (
    Fold,
    Records,
    Stretch,
    Systems,
    Trial,
    TrialSystem,
    combine,
    cut_stretches,
    describe_demands,
    find_living,
    folds,
    list_others,
    order_equals,
    plan_refinement,
    smooth_records,
)
from ep2sindy.signals.attractor import Cycle, find_cycle
from ep2sindy.signals.spectrum import samples_in_periods, steps_in

MIN_WINDOWS = 30  # fewest windows to refine the winner on

# Integration steps per sample. One step suffices for the true model of every noise-free system of
# `systems`: its error stays below 1e-9 variances. The second step is for sparser samples.
N_SUBSTEPS = 2

# A state that is farther from its mean than this many standard deviations has diverged.
BLOW_UP = 20.0

# A system on an attracting cycle replaces a smaller one on a neutral cycle only if its window loss
# is below this share of the other's: if only noise is left, extra terms attract by chance.
GAIN = 0.95

# Largest modulus of the Floquet multipliers, after the first, of an attracting cycle: a departure
# halves within 14 periods. Data of a few periods cannot tell weaker attraction from none.
PULL = 0.95

# Share of starts from which a cycle counts as attracting everything around it, and their number.
GLOBAL, N_REACHING = 0.9, 64

# Free coefficients more than the smallest attracting system has, for one that attracts everything.
DEARER = 1

# Largest ratio of the waveform errors of two systems that count as equals.
ALIKE = 1.5

# Smallest modulus of a repelling cycle's multipliers; a neutral cycle's is one but for errors.
PUSH = 1.003

# Fewest periods of a record, so that its folds leave windows of two periods: six, less a margin
# for noise.
MIN_PERIODS = 5.5

# A record spirals if the amplitude of every state changes by more than this factor, in the same
# direction, from each third to the next: no single cycle then fits all folds within 10 %.
MAX_DRIFT = 1.1

# Periods of a trial run: enough for a transient to die out. A model without inputs continues
# beyond the end of a short stretch.
MIN_RUN, MAX_RUN = 16.0, 30.0


@dataclass(frozen=True, eq=False)
class Confirmed:
    """A system refined on all data, and its free run over the longest record.

    number: among the systems. share: of starts around the cycle that reach it; zero if the model
    does not live, or if departures from its cycle do not die out. broken: demands that the
    coefficients do not meet. repels: True if departures grow.
    """

    number: int
    trial: Trial
    run: Evaluation
    share: float
    broken: Sequence[str]
    repels: bool = False

    @property
    def is_global(self) -> bool:
        return self.share >= GLOBAL

    def outdoes(self, resting: Confirmed) -> bool:
        """Whether an attracting system is preferred to one that is no larger, on a neutral cycle.

        It is if it follows the windows better, or as an equal: of one size, and as close to the
        waveform of the folds that neither was fitted to.
        """
        ours, theirs = self.trial, resting.trial
        is_equal = ours.system.n_free <= theirs.system.n_free
        is_close = ours.waveform <= ALIKE * theirs.waveform
        return ours.loss < GAIN * theirs.loss or (is_equal and is_close)

    def rank(self) -> tuple[bool, bool, int, bool, bool, bool, int, float]:
        """Sorts the best first; the first of equals wins."""
        size = self.trial.system.n_free
        return (
            bool(self.broken),
            *self.run.rank,
            self.repels,
            not self.share,
            not self.is_global,
            size,
            -min(self.share, GLOBAL),
        )

    def text(self, n_living: int, n_systems: int) -> str:
        """How the system was confirmed, in words."""
        how = self.run.text if n_living else f"{self.run.text} where fitted"
        if self.run.status is Status.SUSTAINED and not self.share:
            how = f"{how}, on a cycle that {'repels' if self.repels else 'does not attract'}"
        elif self.share and not self.run.model.inputs:
            how = f"{how}, {100.0 * self.share:.0f} % of starts reach it"
        found = f"{how}; {n_living or 'none'} of {n_systems} systems live where not fitted"
        return describe_demands(found, self.broken)


@dataclass(frozen=True)
class FreeRunScore:
    """Judge systems of equations by running them freely; the smallest system that lives wins.

    The records are split into `n_folds`. Every combination of candidates, one per equation, is
    refined on windows of `window_periods` in all folds but one, then run freely over the fold held
    out, in turn for every fold. A run starts on the data's cycle at the phase where the held-out
    part begins, not at its first sample, whose noise is not the model's fault. A model with inputs
    starts at the smoothed sample instead. A system lives if frequency, amplitudes and waveform stay
    within `bounds` of the data's cycle in every run.
    Living systems within `margin` come first; among these the smallest, and among equals the one
    with the best waveform, is refined on windows of all data and run over the longest record. It
    wins if it lives there too, on a cycle that nine of ten starts around it reach; if fewer do, one
    that they reach wins with the same number of coefficients or one more, else that of least size
    and most such starts. A system on a neutral cycle wins only if no equal or larger system on an
    attracting cycle follows the data as well. Size is the number of free coefficients. If no system
    lives, the one that deviates least wins, and the note says so. Neither R2 nor the loss of the
    windows decides which systems live: they are blind to where a trajectory ends. Only if some
    systems follow the samples to rounding, because the truth is in the library, these compete
    alone.

    RefinedScore decides instead if a record has no period, holds fewer than six, or spirals outward
    or inward throughout: then there is no cycle to compare with.
    score = the largest deviation from the cycle, in units of its bound; at most 10.
    margin: systems that deviate by no more than this share of the bounds come first, even if others
    are smaller: a system that barely stays within the bounds here will leave them in another
    record.
    judged: states whose cycle counts, for example the one that was measured if the others are
    derived from it; None takes all. n_starts: number of runs over every held-out part for models
    without inputs, at phases spread over the period; all must end on the cycle.
    max_combinations: of more, the most promising are tried, those whose candidates rank best in
    their own fronts; the note says so. n_confirmed: most systems to refine on all data. seed: of
    the random windows.
    """

    bounds: FreeRunBounds = field(default_factory=FreeRunBounds)
    n_folds: int = 3
    n_windows: int = 20
    window_periods: float = 2.0
    margin: float = 0.6
    n_confirmed: int = 8
    seed: int = 0
    max_combinations: int = 4096
    judged: Sequence[str] | None = None
    n_starts: int = 1
    label: ClassVar[str] = "free-run error"
    basis: ClassVar[Basis] = "runs"

    def __post_init__(self) -> None:
        check_kind("bounds", self.bounds, FreeRunBounds, "ep.model.FreeRunBounds()")
        least = dict.fromkeys(("n_windows", "n_confirmed", "max_combinations", "n_starts"), 1)
        set_counts(self, {"n_folds": 2} | least)
        if not self.window_periods > 0.0:
            raise ValueError(f"window_periods must be positive: {self.window_periods} came")
        if not 0.0 < self.margin <= 1.0:
            raise ValueError(f"margin must lie between 0 and 1: {self.margin} came")
        check_list("judged", self.judged)

    def decide(self, fronts: Fronts, task: Task, *, progress: Progress = SILENT) -> Decision:
        """Score candidates by the deviations of their combinations, and refine the winner.

        Raises ValueError for a state without a front, or relations that
        no combination has the terms for.
        """
        systems = combine(fronts, task, most=self.max_combinations)
        return self.judge(systems, task.runs, progress=progress)

    def judge(
        self, found: Systems, runs: Sequence[Trajectory], *, progress: Progress = SILENT
    ) -> Decision:
        """Decide among given systems, as `decide` does among the combinations of candidates."""
        records = smooth_records(found.fronts, runs)
        cycles = find_cycles(records, [front.equation for front in found.fronts])
        if isinstance(cycles, str):
            rule = RefinedScore(max_combinations=self.max_combinations)
            decision = rule.judge(found, runs, progress=progress)
            return replace(
                decision, note=f"{cycles}: chosen by windows held out instead{found.left_out}"
            )
        records = replace(records, cycles=cycles)
        trials = self._trials(records, found.systems, progress)
        errors = np.array([trial.error for trial in trials])
        living = find_living(trials)
        winner, model, note = self._winner(records, trials, living, progress)
        limit = max(1.0, float(errors[winner]))
        scores = found.score(errors, limit=limit, winner=winner)
        note, held = f"{note}{found.left_out}", found.systems[winner].constraint
        return Decision(scores, model, note, held, list_others(trials, living, winner))

    def _window(self, records: Records) -> int:
        """Number of samples in a window."""
        frequency_Hz = [cycle.frequency_Hz for cycle in records.cycles]
        dt_s = [run.dt_s for run in records.runs]
        return samples_in_periods(self.window_periods, frequency_Hz=frequency_Hz, dt_s=dt_s)

    def _trials(
        self, records: Records, systems: Sequence[TrialSystem], progress: Progress
    ) -> list[Trial]:
        """Refine and run every system, fold by fold; one that lacks an equation cannot live."""
        whole = [k for k, system in enumerate(systems) if system.model.coef.any(axis=0).all()]
        whole.sort(key=lambda k: systems[k].n_free)  # systems in a batch then cost about the same
        trials = [Trial(system, MAX_ERROR, *[np.inf] * 4) for system in systems]
        if not whole:
            return trials
        some = [systems[k] for k in whole]
        tried = [
            self._try_fold(records, some, fold, progress)
            for fold in folds(records.runs, self.n_folds)
        ]
        for k, worst in zip(whole, np.max(tried, axis=0), strict=True):
            trials[k] = Trial(systems[k], *worst.tolist())
        return trials

    def _try_fold(
        self, records: Records, systems: Sequence[TrialSystem], fold: Fold, progress: Progress
    ) -> Float[np.ndarray, "systems 5"]:
        """The figures of a `Trial` of every system in one fold."""
        first = systems[0].model
        batch = cut_stretches(
            records.runs,
            fold.fitted,
            first,
            window=self._window(records),
            n_windows=self.n_windows,
            seed=self.seed,
        )
        method, together = plan_refinement(batch, first.library)
        with progress.stage(len(systems), "system", "refined without a fold") as advance:
            refined = refine_batch(
                [system.model for system in systems],
                batch,
                method=method,
                constraints=[system.constraint for system in systems],
                n_reweights=0,  # scale states by their standard deviation, as in the judging
                points_per_batch=together,
                advance=advance,
            )
        variables = [*first.states, *first.inputs]
        coefs = np.stack([model.coef for model in refined.models])
        fields = VectorField.of(first.library, variables, coefs)
        judged, densities = [], densities_of(records.runs[0], first.states)
        with progress.stage(None, "run", "free runs over the fold") as advance:
            for t, paths, cycle in run_over(fields, fold.held, records, self.n_starts):
                judged.append(self._judge(t, paths, cycle, first.states, densities))
                advance(len(paths))
        worst = np.column_stack([np.max(judged, axis=0), refined.loss])
        pairs = zip(systems, refined.models, strict=True)
        worst[[bool(system.broken(model)) for system, model in pairs], 0] = MAX_ERROR
        return worst

    def _judge(
        self,
        t: Float[np.ndarray, " samples"],
        paths: Float[np.ndarray, "systems samples n_states"],
        cycle: Cycle,
        states: Sequence[str],
        densities: Sequence[int],
    ) -> Float[np.ndarray, "systems 4"]:
        """The figures of a `Trial` but the loss, over one stretch, its first half left out."""
        half, columns = len(t) // 2, columns_of(states, self.judged)
        std = zero_to_one(cycle.std)
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

    def _winner(
        self, records: Records, trials: Sequence[Trial], living: Sequence[int], progress: Progress
    ) -> tuple[int, SparseModel, str]:
        """Index of the winning system, the system refined on all data, and how it won."""

        def rank(k: int) -> tuple[bool, int, float]:
            """The smallest system first, and of one size the one with the best waveform."""
            return trials[k].error > self.margin, trials[k].system.n_free, trials[k].waveform

        ranked = order_equals(sorted(living, key=rank), trials)
        by_error = sorted(range(len(trials)), key=lambda k: (trials[k].error, trials[k].loss))
        window = self._window(records)
        found: list[Confirmed] = []
        best = (ranked or by_error)[: self.n_confirmed]
        for k in count_pieces(progress, best, "system", "refined on all data"):
            attracting = [each for each in found if each.share]
            if attracting and trials[k].system.n_free > attracting[0].trial.system.n_free + DEARER:
                break
            model = trials[k].system.refine_on_all(
                records.runs,
                window=window,
                n_windows=max(MIN_WINDOWS, self.n_windows),
                n_reweights=0,
                seed=self.seed,
            )
            own = self._confirm(k, trials[k], model, records)
            living_on = [each for each in found if each.run.status is Status.SUSTAINED]
            resting = [each for each in living_on if not each.share and not each.repels]
            if own.share and resting and not own.outdoes(resting[0]):
                own = replace(own, share=0.0)  # it attracts by chance
            found.append(own)
            if own.is_global and not own.broken:
                break
        won = min(found, key=Confirmed.rank)
        return won.number, won.run.model, won.text(len(living), len(trials))

    def _confirm(
        self, number: int, trial: Trial, model: SparseModel, records: Records
    ) -> Confirmed:
        """Free run of a refined system over the longest record, from the start of its cycle."""
        pairs = zip(records.runs, records.cycles, strict=True)
        longest, cycle = max(pairs, key=lambda pair: np.ptp(pair[0].t))
        start = cycle.waveform(cycle.phase[:1])[0]
        run = evaluate(model, longest, initial=start, bounds=self.bounds, judged=self.judged)
        lives, period_s = run.status is Status.SUSTAINED, 1.0 / records.cycles[0].frequency_Hz
        share, repels = _attraction(run, period_s) if lives else (0.0, False)
        return Confirmed(number, trial, run, share, trial.system.broken(model), repels)


def _attraction(run: Evaluation, period_s: float) -> tuple[float, bool]:
    """Share of starts that reach the model's cycle, and whether departures from it grow.

    The share is zero if departures do not die out. A model with inputs is followed from its start
    alone: its share is one.
    """
    if run.model.inputs:
        return 1.0, False
    cycle = limit_cycle(run.model, run.rollout.states[-1], period_s=period_s)
    if cycle is None:
        return 0.0, False
    largest = cycle.largest_multiplier
    if largest > PULL:
        return 0.0, largest > PUSH
    # Within forty periods: of cycles that are reached, one that is reached sooner is better.
    share = share_reaching(run.model, cycle, n_starts=N_REACHING, n_periods=LEAST_WAIT)
    return max(share, 0.5 / N_REACHING), False


def find_cycles(records: Records, states: Sequence[str]) -> list[Cycle] | str:
    """The cycle of every record, or the reason why a record has none."""
    found = []
    for run in records.runs:
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


def run_over(
    systems: VectorField, held: Sequence[Stretch], records: Records, n_starts: int
) -> Iterator[tuple[np.ndarray, np.ndarray, Cycle]]:
    """Times and paths of every system over every held-out stretch, one start after the other."""
    joined = np.concatenate(records.smoothed)
    centre, reach = joined.mean(axis=0), BLOW_UP * joined.std(axis=0)
    inputs = systems.library.variables[systems.n_states :]
    for part in held:
        run, x = records.runs[part.run], records.smoothed[part.run]
        cycle = records.cycles[part.run]
        per_period = steps_in(1.0, frequency_Hz=cycle.frequency_Hz, dt_s=run.dt_s)
        first, n_samples = part.start, part.stop - part.start
        no_courses = [None] * len(inputs)
        curve = curve_through(run.t, run.columns(inputs), no_courses) if inputs else None
        if curve is None:
            n_samples = round(np.clip(n_samples, MIN_RUN * per_period, MAX_RUN * per_period))
            # Starts spread over as many periods, no two at the same phase.
            later = np.arange(n_starts) * (1.0 + 1.0 / n_starts) * per_period
            starts = np.minimum(first + later.round().astype(np.int64), part.stop - 1)
            t, begin = run.dt_s * np.arange(n_samples), cycle.waveform(cycle.phase[starts])
            times, begins = t, np.zeros(n_starts, dtype=np.int64)
        else:
            if n_samples < MIN_RUN * per_period:  # inputs end with the record
                first, n_samples = 0, run.n_samples
            t, begin = run.t[first : first + n_samples], x[[first]]
            times, begins = run.t, np.array([first])
        steps = WindowSteps.along(times, curve, begins, n_samples, N_SUBSTEPS)
        paths = run_many(systems, begin, steps, centre=centre, reach=reach)
        for k in range(paths.shape[1]):
            yield t, paths[:, k], cycle
