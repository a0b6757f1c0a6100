"""Which of several laws to take: tested over windows of records left out, and run freely there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import isfinite

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory, point_label
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.library.library import Library
from ep2sindy.model.comparison import FreeRunBounds, Status
from ep2sindy.model.model import SparseModel
from ep2sindy.model.restarts import Restarts
from ep2sindy.model.rollout import simulate
from ep2sindy.model.stability import ATTRACTING_BELOW
from ep2sindy.operating.interpolation import Interpolation
from ep2sindy.operating.law import LawFunctions, OperatingLaw, read_law
from ep2sindy.operating.law_fit import ACCURATE, follow_windows
from ep2sindy.operating.point_fits import PointFits, usual_functions
from ep2sindy.operating.quiet import SMALL, QuietPoint
from ep2sindy.operating.records import OperatingRecord
from ep2sindy.refinement.windows import dominant_window
from ep2sindy.regression.pooled import fewest_of_least
from ep2sindy.runtime.parallel import SURROUNDING, Workers, collect
from ep2sindy.runtime.progress import SILENT, Progress

N_WINDOWS = 20  # of every record that is left out

# Part of the points inside that the laws of the others must sustain, for a law to be trusted
# between the records: else their frequencies and amplitudes are better interpolated.
TRUSTED = 0.75

MOST = 0.9  # part of its own records at which a law must hold, to be preferred to one that fails

LONG, N_SAMPLES = 100.0, 2000  # periods and samples of a run at a quiet point

ALIKE = 0.1  # laws whose runs deviate by less, in units of their bounds, count as equally good

WORST = 5.0  # deviation, in units of its bound, of a run that does not hold

UNKNOWN = {"frequency": float("nan"), "amplitude": float("nan")}  # errors of no interpolation


@dataclass(frozen=True, eq=False)
class LeftOutRun:
    """A free run of one point with the law fitted to the other points.

    inside: True if the other points enclose this one. interpolated: its errors of `Interpolation`,
    or NaN where the others do not enclose it, or do not repeat cycles.
    """

    record: OperatingRecord
    run: Evaluation
    inside: bool
    interpolated: Mapping[str, float] = field(default_factory=UNKNOWN.copy)

    @property
    def amplitude_error(self) -> float:
        """Relative error of the amplitude of the worst state that is assessed."""
        ratios = np.array([*self.run.amplitude_ratio.values()])[list(self.run.assessed)]
        return float(np.abs(ratios - 1.0).max())

    @property
    def waveform_error(self) -> float:
        """Error of the waveform of the worst state that is assessed."""
        return float(np.array([*self.run.waveform_error.values()])[list(self.run.assessed)].max())

    @property
    def deviation(self) -> float:
        """Largest error in units of its bound; zero of a run that follows the samples.

        At most it is WORST, that of a run that fails: a cycle has to attract, since a neutral one
        keeps the amplitude of its start.
        """
        run, bounds = self.run, self.run.bounds
        if run.status is Status.FOLLOWS:
            return 0.0
        errors = (
            abs(run.f_error) / bounds.frequency,
            self.amplitude_error / bounds.amplitude,
            self.waveform_error / bounds.waveform,
        )
        if not np.isfinite(errors).all() or not (run.multiplier < ATTRACTING_BELOW or run.holds):
            return WORST
        return min(max(errors), WORST)


@dataclass(frozen=True, eq=False)
class LawTrial:
    """One fit of all points, and its law of some functions, tested by leaving out each in turn.

    name: of the fit. errors: for each point, the root mean square over windows of its record, in
    standard deviations of the states, of what the law of the others leaves; see `window_errors`.
    Fits of any kind can be compared by it, whatever bias their coefficients have. Empty if the
    points do not suffice for a law without each of them. assessed: states that runs are judged by;
    None for all.
    """

    name: str
    fits: PointFits
    functions: Library
    records: Sequence[OperatingRecord]
    assessed: Sequence[str] | None = None
    errors: Float[np.ndarray, " _"] = field(default_factory=lambda: np.zeros(0))

    @property
    def n_numbers(self) -> int:
        """Number of fitted numbers: those of the law of the free coefficients."""
        return self.fits.n_free * len(self.functions)

    @property
    def error(self) -> float:
        """Mean error over the points left out; NaN if it is not known."""
        return float(self.errors.mean()) if len(self.errors) else float("nan")

    @cached_property
    def law(self) -> OperatingLaw:
        return self.fits.law(self.functions)

    @cached_property
    def fitted(self) -> list[Evaluation]:
        """The law of all points over each of its records."""
        models = [read_law(self.law, record.parameters) for record in self.records]
        return self.run_with(models)

    @property
    def is_driven(self) -> bool:
        """Whether inputs drive the model, which is then judged by windows and not by free runs."""
        return bool(self.fits.models[0].inputs)

    @cached_property
    def share_on_cycle(self) -> float:
        """Part of the records that the law was fitted to on which it stays, no more than MOST."""
        if self.is_driven:
            return MOST
        return min(MOST, sum(map(_stays, self.fitted)) / len(self.records))

    @property
    def attracts(self) -> bool:
        """Whether the law holds at MOST of its records, where its cycles have to attract, too."""
        return sum(run.holds for run in self.fitted) >= MOST * len(self.records)

    @cached_property
    def left_out(self) -> list[LeftOutRun]:
        """Every record run freely with the law of the others."""
        points = [record.parameters for record in self.records]
        laws = [self.fits.law_without(k, self.functions) for k in range(len(points))]
        runs = self.run_with(list(map(read_law, laws, points)))
        inside = map(OperatingLaw.is_inside, laws, points)
        return list(map(LeftOutRun, self.records, runs, inside))

    def run_with(self, models: Sequence[SparseModel]) -> list[Evaluation]:
        """Every record run freely with a model of its own."""
        pairs = zip(models, self.records, strict=True)
        return [run_freely(model, record, self.assessed) for model, record in pairs]

    @cached_property
    def rests(self) -> list[bool]:
        """Whether the law rests, at each of the points whose record is quiet."""
        return [_rests(self.law, point) for point in self.fits.quiet]

    @property
    def score(self) -> float:
        """Mean `deviation` of the runs left out between others, and at quiet points."""
        between = [run.deviation for run in self.left_out if run.inside]
        own = between or [run.deviation for run in self.left_out]
        return float(np.mean([*own, *(0.0 if rests else WORST for rests in self.rests)]))


def follow_together(
    start: LawTrial,
    law: LawFunctions | Sequence[LawFunctions],
    *,
    n_windows: int,
    periods: float,
) -> list[LawTrial]:
    """Laws of one structure, each fitted to windows of all records at once.

    Of the functions that may be taken, those of more numbers are tried only while the law does not
    hold at the records that it was fitted to. start: with the fits of each point alone, which is
    returned as it is unless these hold at more than half of the points.
    Raises ValueError if the points do not suffice for any law.
    """
    trials, runs = [], [record.run for record in start.records]
    if not start.is_driven:
        alone = [_stays(run) for run in start.run_with(start.fits.models)]
        if 2 * sum(alone) <= len(alone):
            return [start]
    for functions in start.fits.candidates(law):
        together = follow_windows(start.fits, functions, runs, n_windows=n_windows, periods=periods)
        trials.append(replace(start, fits=together, functions=functions))
        if trials[-1].share_on_cycle == MOST:
            break
    return trials


def leave_out(
    trials: Sequence[LawTrial],
    *,
    periods: float = 1.0,
    workers: Workers = SURROUNDING,
    progress: Progress = SILENT,
) -> list[LawTrial]:
    """The trials with their errors at points left out, of those whose points suffice for it."""
    tested = []
    for trial in trials:
        with suppress(ValueError):  # too few points, or one that is indispensable
            trial.fits.rate_errors(trial.functions)
            tested.append(trial)
    if not tested:
        return list(trials)
    records = tested[0].records
    stage = progress.stage(len(records), "point", "laws at points left out")
    one = partial(_leave_out, trials=tested, periods=periods)
    errors = np.array(collect(workers, one, list(enumerate(records)), stage))
    return [replace(trial, errors=own) for trial, own in zip(tested, errors.T, strict=True)]


def _leave_out(
    numbered: tuple[int, OperatingRecord], *, trials: Sequence[LawTrial], periods: float
) -> Float[np.ndarray, " trials"]:
    """Errors of the laws of all fits at one point, each of the other points."""
    number, record = numbered
    laws = [trial.fits.law_without(number, trial.functions) for trial in trials]
    models = [read_law(law, record.parameters) for law in laws]
    return window_errors(models, record.run, periods=periods)


def window_errors(
    models: Sequence[SparseModel], run: Trajectory, *, periods: float = 1.0
) -> Float[np.ndarray, " models"]:
    """Error of each model in windows of some periods, over which only its starts are fitted.

    It is the root mean square over windows, samples and states, each in its standard deviations; a
    constant errs by about one, and so does by convention a model that blows up.
    """
    n_ahead = dominant_window([run], models[0].states, periods=periods) - 1
    found = []
    for model in models:
        along = Restarts(model, run, ACCURATE)
        first = along.starts(n_ahead, N_WINDOWS, measured=False)
        paths = along.paths(along.fitted(first, n_ahead), first, n_ahead)
        squares = np.nanmean(np.square(along.off(paths, first)), axis=(1, 2))
        found.append(np.sqrt(np.minimum(squares, 1.0).mean()))
    return np.array(found)


def run_freely(
    model: SparseModel, record: OperatingRecord, assessed: Sequence[str] | None
) -> Evaluation:
    """Run from the record's slowest sample, or from the place on its mean cycle next to it.

    During a pulse, a small error of the model is a large one in phase; and states that were made of
    others are poor at the ends of a record.
    """
    if not record.repeats or model.inputs:
        return evaluate(model, record.run, assessed=assessed)
    cycle, k = record.cycle, record.slowest
    columns = [record.run.state_names.index(state) for state in model.states]
    start = cycle.waveform(cycle.phase[[k]])[0][columns]
    return evaluate(model, record.from_slowest, initial=start, assessed=assessed)


def _stays(run: Evaluation) -> bool:
    """Whether a run follows the record, or stays on its cycle for as long as it was recorded.

    Whether that cycle attracts as well is asked by `LawTrial.attracts`.
    """
    return run.comparison.stays or run.status is Status.FOLLOWS


def _rests(law: OperatingLaw, point: QuietPoint) -> bool:
    """Whether the law's model decays from a disturbance as large as a quiet record may vary."""
    t = np.linspace(0.0, LONG * point.period_s, N_SAMPLES)
    start = point.rest + SMALL * point.scale
    reach = np.abs(start) + point.scale
    model = read_law(law, point.parameters)
    run = simulate(model, t, start, None, blow_up=1e3, reach=reach)
    if run.diverged or not np.isfinite(run.states).all():
        return False
    return bool((run.states[N_SAMPLES // 2 :].std(axis=0) < SMALL * point.scale).all())


@dataclass(frozen=True, eq=False, repr=False)
class LawChoice:
    """The law of the records on one cycle, and what was tried for it.

    trials: all that was tried. choice: the one whose law is taken. cycle: name of the records'
    cycle; "all" if there is only one. runs: of the points left out, each with the law of the
    others; empty if there are too few points, or if inputs drive the model. interpolation: of the
    records, without a model; None if there is none.
    """

    trials: Sequence[LawTrial]
    choice: LawTrial
    runs: Sequence[LeftOutRun]
    interpolation: Interpolation | None = None
    cycle: str = "all"

    def __repr__(self) -> str:
        return "\n".join([f"{self.choice.name}: {self.heading}", self.text])

    @property
    def law(self) -> OperatingLaw:
        return self.choice.law

    @property
    def records(self) -> Sequence[OperatingRecord]:
        return self.choice.records

    @property
    def fitted(self) -> list[Evaluation]:
        """The law of all points over each of its records."""
        return self.choice.fitted

    @property
    def quiet(self) -> dict[str, bool]:
        """Whether the law rests, by the label of each point whose record is quiet."""
        labels = [point_label(point.parameters) for point in self.choice.fits.quiet]
        return dict(zip(labels, self.choice.rests, strict=True))

    @property
    def inside(self) -> list[LeftOutRun]:
        """The runs at points that the others enclose; all runs, if no point is enclosed."""
        return [run for run in self.runs if run.inside] or list(self.runs)

    @property
    def n_held(self) -> int:
        """Number of the runs `inside` at which the law of the others holds."""
        return sum(run.run.holds for run in self.inside)

    @property
    def is_trusted(self) -> bool:
        """Whether the laws of the other points hold at most points left out between these."""
        return bool(self.inside) and self.n_held >= TRUSTED * len(self.inside)

    @cached_property
    def statistics(self) -> dict[str, float | int]:
        """Of the points left out: of their windows, and of their free runs if there are any."""
        windows = {"n": len(self.choice.errors), "window_error": self.choice.error}
        return windows | (error_statistics(self.runs) if self.runs else {})

    @property
    def heading(self) -> str:
        """Whether the law holds between the records, or these are better interpolated."""
        if not self.runs:
            return ""
        n, n_held = len(self.inside), self.n_held
        where = "points left out" if self.inside[0].inside else "points beyond the others"
        if self.is_trusted:
            return f"holds at {n_held} of {n} {where}"
        if self.interpolation is None or not self.inside[0].inside:
            return f"no law holds at {where}: {n_held} of {n}"
        return f"interpolate: the law holds at {n_held} of {n} {where}"

    @property
    def text(self) -> str:
        """How the law does at the points left out, and next to it interpolation."""
        once = "Left out one at a time, "
        if not self.runs:
            return f"{once}{self._windows_text}." if len(self.choice.errors) else ""
        found, where = self.statistics, " that the others enclose" if self.inside[0].inside else ""
        n, n_held = len(self.inside), self.n_held
        said = f"{once}the law of the others holds at {n_held} of {n} points{where}"
        if isfinite(found["f_enclosed"]):
            said += f" and errs there by {_percent(found, 'enclosed')} in the median"
        said = f"{said}; {self._windows_text}. "
        for name, values in zip(
            self.choice.fits.parameters, self.choice.fits.points.T, strict=True
        ):
            if len(set(values)) == 2:
                said += f"{name} takes two values, and nothing between them was tested. "
        if not isfinite(found["f_interpolated"]):
            return f"{said}No point is enclosed by others whose records repeat cycles."
        between = _percent(found, "interpolated")
        said += f"Interpolation between the other records, without a model, errs by {between}"
        if self.is_trusted:
            return f"{said}."
        bounds = FreeRunBounds()
        is_near = found["f_interpolated"] <= bounds.frequency
        if is_near and found["amplitude_interpolated"] <= bounds.amplitude:
            return f"{said}: take it, and not the law, for a point that nobody measured."
        return f"{said}: expect no less at a point that nobody measured, or record one nearby."

    @property
    def _windows_text(self) -> str:
        return f"windows of the records are followed to {self.choice.error:.3g} standard deviations"


def choose_law(trials: Sequence[LawTrial]) -> LawChoice:
    """The law whose runs deviate least at points left out between others.

    Of those that deviate by less than ALIKE there the one of fewest numbers is taken. Laws that
    hold at the records that they were fitted to come before others. Of models that inputs drive, it
    is the law of fewest numbers among those that err least over windows left out.
    trials: as `leave_out` returns them; without errors, the first law that stays on most records
    is taken, of refined fits before others.
    """
    one, tested = trials[0], [trial for trial in trials if len(trial.errors)]
    states = one.assessed or one.fits.models[0].states
    between = Interpolation.best(usual_functions(one.fits.parameters), one.records, states)
    if not tested:
        best = max(trials, key=lambda trial: (trial.share_on_cycle, bool(trial.fits.statuses)))
        return LawChoice(trials, best, [], between)
    if one.is_driven:
        place = fewest_of_least([(trial.errors, trial.n_numbers) for trial in tested])
        return LawChoice(trials, tested[place], [], between)
    most = max(trial.share_on_cycle for trial in tested)
    stay = [trial for trial in tested if trial.share_on_cycle == most]

    def rank(trial: LawTrial) -> tuple[float, ...]:
        score, error = max(trial.score, ALIKE), max(trial.error, ACCURATE)
        return (not trial.attracts, score, trial.n_numbers, error)

    best = min(stay, key=rank)
    return LawChoice(trials, best, _beside(best.left_out, between), between)


def _beside(runs: Sequence[LeftOutRun], between: Interpolation | None) -> list[LeftOutRun]:
    """The runs with the errors of interpolation, where the other points enclose theirs."""
    if between is None:
        return list(runs)
    return [
        replace(run, interpolated=dict(zip(UNKNOWN, own, strict=True))) if run.inside else run
        for run, own in zip(runs, between.errors.tolist(), strict=True)
    ]


def error_statistics(left_out: Sequence[LeftOutRun]) -> dict[str, float | int]:
    """Statistics of the runs at points left out: counts, medians, and the 90 % quantile.

    A point without a frequency counts as an infinite frequency error, and does not enter the
    medians of amplitude and waveform. These are taken over each point's worst state. Over the
    points that the others enclose, the medians of the law stand next to those of `Interpolation`.
    """
    f = np.array([abs(each.run.f_error) for each in left_out])
    f[np.isnan(f)] = np.inf
    amplitude = np.array([each.amplitude_error for each in left_out])
    waveform = np.array([each.waveform_error for each in left_out])
    inside = np.array([each.inside for each in left_out])
    between = np.array([[*each.interpolated.values()] for each in left_out])
    return {
        "n": len(left_out),
        "n_cycles": int(np.isfinite(f).sum()),
        "n_sustained": sum(each.run.holds for each in left_out),
        "diverging": sum(each.run.rollout.diverged for each in left_out),
        "f_median": float(np.median(f)),
        "f_90": float(np.quantile(f, 0.9, method="higher")),
        "amplitude_median": _median(amplitude),
        "waveform_median": _median(waveform),
        "n_enclosed": int(inside.sum()),
        "n_enclosed_sustained": sum(each.run.holds for each in left_out if each.inside),
        "f_enclosed": _median(f[inside]),
        "f_interpolated": _median(between[:, 0]),
        "amplitude_enclosed": _median(np.nan_to_num(amplitude, nan=np.inf)[inside]),
        "amplitude_interpolated": _median(between[:, 1]),
    }


def _median(values: Float[np.ndarray, " points"]) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if known.size else float("nan")


def _percent(found: Mapping[str, float], kind: str) -> str:
    frequency, amplitude = (100.0 * found[f"{key}_{kind}"] for key in ("f", "amplitude"))
    return f"{frequency:.2g} % in frequency and {amplitude:.2g} % in amplitude"
