"""Which of several laws to take: tested over windows of records left out, and run freely there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from math import isfinite

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory, point_label
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.library.library import Library
from ep2sindy.model.model import SparseModel
from ep2sindy.model.restarts import Restarts
from ep2sindy.model.rollout import simulate
from ep2sindy.model.stability import ATTRACTING_BELOW
from ep2sindy.operating.interpolation import Interpolation
from ep2sindy.operating.law import LawFunctions, OperatingLaw, in_hull, read_law
from ep2sindy.operating.law_fit import follow_windows
from ep2sindy.operating.point_fits import PointFits, usual_functions
from ep2sindy.operating.quiet import SMALL, QuietPoint
from ep2sindy.operating.records import OperatingRecord
from ep2sindy.refinement.windows import dominant_window
from ep2sindy.regression.pooled import fewest_of_least
from ep2sindy.runtime.parallel import SURROUNDING, Workers, collect
from ep2sindy.runtime.progress import SILENT, Progress

Runs = Mapping[str, Sequence[Trajectory]]  # by the label of their operating point

N_WINDOWS = 20  # of every record that is left out

# Part of the points inside that the laws of the others must sustain, for a law to be trusted
# between the records: else their frequencies and amplitudes are better interpolated.
TRUSTED = 0.75

HOLDS = 0.9  # part of its own records at which a law must hold, to be preferred to one that fails

# Runs at quiet points: periods, samples, and those of the record's end that a run begins with.
LONG, N_SAMPLES, N_LAST = 100.0, 2000, 5


@dataclass(frozen=True, eq=False)
class LeftOutRun:
    """A free run of one point with the law fitted to the other points.

    The run starts at one sample of the point's record. inside: True if the other points enclose
    this one. interpolated: its errors of `Interpolation`, or NaN where the others do not enclose
    it, or do not repeat cycles.
    """

    record: OperatingRecord
    run: Evaluation
    inside: bool
    interpolated: Mapping[str, float]

    @property
    def attracts(self) -> bool:
        """True if the run ends on a cycle that attracts, and so sets the amplitude by itself."""
        return self.run.multiplier < ATTRACTING_BELOW

    @property
    def amplitude_error(self) -> float:
        """Relative error of the amplitude of the worst state that is assessed."""
        ratios = np.array([*self.run.amplitude_ratio.values()])[list(self.run.assessed)]
        return float(np.abs(ratios - 1.0).max())


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
        pairs = zip(models, self.records, strict=True)
        return [evaluate(model, r.from_slowest, assessed=self.assessed) for model, r in pairs]

    @cached_property
    def holds(self) -> bool:
        """Whether the law holds at most of the records that it was fitted to."""
        if self.fits.models[0].inputs:
            return True  # which is not asked of a model that inputs drive
        return sum(run.holds for run in self.fitted) >= HOLDS * len(self.records)

    @property
    def between(self) -> Float[np.ndarray, " _"]:
        """The errors at points that the others enclose, where laws are read; else all of them."""
        points = self.fits.columns(self.functions)
        inside = [in_hull(np.delete(points, k, axis=0), p) for k, p in enumerate(points)]
        return self.errors[inside] if any(inside) else self.errors


def follow_together(
    start: LawTrial, law: LawFunctions | Sequence[LawFunctions], *, periods: float
) -> list[LawTrial]:
    """Laws of one structure, each fitted to windows of all records at once.

    Of the functions that may be taken, those of more numbers are tried only while the law does not
    hold at the records that it was fitted to. start: with the fits of each point alone.
    Raises ValueError if the points do not suffice for any law.
    """
    trials, runs = [], [record.run for record in start.records]
    for functions in start.fits.candidates(law):
        together = follow_windows(start.fits, functions, runs, periods=periods)
        trials.append(replace(start, fits=together, functions=functions))
        if trials[-1].holds:
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
        try:
            trial.fits.rate_errors(trial.functions)
            tested.append(trial)
        except ValueError:  # too few points, or one that is indispensable
            continue
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
        along = Restarts(model, run)
        first = along.starts(n_ahead, N_WINDOWS, measured=False)
        paths = along.paths(along.fitted(first, n_ahead), first, n_ahead)
        squares = np.nanmean(np.square(along.off(paths, first)), axis=(1, 2))
        found.append(np.sqrt(np.minimum(squares, 1.0).mean()))
    return np.array(found)


def run_left_out(trial: LawTrial, between: Interpolation | None = None) -> list[LeftOutRun]:
    """Run every record freely with the law of the others; beside it their interpolation."""
    runs, errors = [], None if between is None else between.errors
    for k, record in enumerate(trial.records):
        law = trial.fits.law_without(k, trial.functions)
        model = read_law(law, record.parameters)
        run = evaluate(model, record.from_slowest, assessed=trial.assessed)
        inside = law.is_inside(record.parameters)
        off = np.full(2, np.nan) if errors is None or not inside else errors[k]
        interpolated = dict(zip(("frequency", "amplitude"), off.tolist(), strict=True))
        runs.append(LeftOutRun(record, run, inside, interpolated))
    return runs


@dataclass(frozen=True, eq=False)
class QuietRun:
    """The law of all points at one whose record is quiet, from the record's last state.

    rests: whether the run stays as quiet as the record is.
    """

    record: Trajectory
    rests: bool


def run_quiet(law: OperatingLaw, points: Sequence[QuietPoint], runs: Runs) -> list[QuietRun]:
    """Run the law at quiet points, for as long as the record or a hundred periods."""
    found = []
    for point in points:
        for run in runs[point_label(point.parameters)]:
            t = np.linspace(0.0, max(run.t[-1] - run.t[0], LONG * point.period_s), N_SAMPLES)
            model = read_law(law, point.parameters)
            end = np.nanmean(run.columns(model.states)[-N_LAST:], axis=0)
            reach = np.abs(end) + point.scale
            path = simulate(model, t, end, None, blow_up=1e3, reach=reach).states
            late = path[N_SAMPLES // 2 :]
            rests = np.isfinite(late).all() and (late.std(axis=0) < SMALL * point.scale).all()
            found.append(QuietRun(run, bool(rests)))
    return found


@dataclass(frozen=True, eq=False)
class LawChoice:
    """The law of the records on one cycle, and what was tried for it.

    trials: all that was tried. choice: the one whose law is taken. cycle: name of the records'
    cycle; "all" if there is only one. runs: of the points left out, each with the law of the
    others; empty if there are too few points, or if inputs drive the model. quiet: of the points
    whose records are quiet. interpolation: of the records, without a model; None if there is none.
    """

    trials: Sequence[LawTrial]
    choice: LawTrial
    runs: Sequence[LeftOutRun]
    quiet: Sequence[QuietRun] = ()
    interpolation: Interpolation | None = None
    cycle: str = "all"

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
    def inside(self) -> list[LeftOutRun]:
        """The runs at points that the others enclose; all runs, if no point is enclosed."""
        return [run for run in self.runs if run.inside] or list(self.runs)

    @property
    def is_trusted(self) -> bool:
        """Whether the laws of the other points hold at most points left out between these."""
        n_held = sum(run.run.holds for run in self.inside)
        return bool(self.inside) and n_held >= TRUSTED * len(self.inside)

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
        n, n_held = len(self.inside), sum(run.run.holds for run in self.inside)
        where = "points left out" if self.inside[0].inside else "points beyond the others"
        if self.is_trusted:
            return f"it holds at {n_held} of {n} {where}"
        if self.interpolation is None or not self.inside[0].inside:
            return f"no law holds at {where}: {n_held} of {n}"
        return f"interpolate: the law holds at {n_held} of {n} {where}"

    @property
    def text(self) -> str:
        """How the law does at the points left out, and next to it interpolation."""
        once = "Left out one at a time, "
        if not self.runs:
            return f"{once}{self._windows_text}." if len(self.choice.errors) else ""
        found, n, n_held = self.statistics, len(self.inside), sum(r.run.holds for r in self.inside)
        where = " that the others enclose" if self.inside[0].inside else ""
        said = f"{once}the law of the others holds at {n_held} of {n} points{where}"
        if isfinite(found["f_enclosed"]):
            said += f" and errs there by {_percent(found, 'enclosed')} in the median"
        said = f"{said}; {self._windows_text}. "
        if not isfinite(found["f_interpolated"]):
            return f"{said}No point is enclosed by others whose records repeat cycles."
        between = _percent(found, "interpolated")
        said += f"Interpolation between the other records, without a model, errs by {between}"
        if self.is_trusted:
            return f"{said}."
        return f"{said}: take it, and not the law, for a point that nobody measured."

    @property
    def _windows_text(self) -> str:
        return f"windows of the records are followed to {self.choice.error:.3g} standard deviations"


def choose_law(trials: Sequence[LawTrial]) -> LawChoice:
    """The trial of fewest numbers among those that err least at points left out between others.

    Laws that hold at the records that they were fitted to come before others. Of models that run
    freely, it is the best of those that hold or attract at more than half of the points left out,
    if there are any: a neutral cycle keeps the amplitude of its start.
    trials: as `leave_out` returns them; without errors the last one is taken.
    """
    tested, first = [trial for trial in trials if len(trial.errors)], None
    left = [trial for trial in tested if trial.holds] or tested
    one = trials[0]
    states = one.assessed or one.fits.models[0].states
    between = Interpolation.best(usual_functions(one.fits.parameters), one.records, states)
    while left:
        best = left.pop(fewest_of_least([(trial.between, trial.n_numbers) for trial in left]))
        if best.fits.models[0].inputs:
            return LawChoice(trials, best, [])
        found = LawChoice(trials, best, run_left_out(best, between), interpolation=between)
        first = first or found
        if 2 * sum(run.run.holds or run.attracts for run in found.runs) > len(found.runs):
            return found
    return first or LawChoice(trials, trials[-1], [], interpolation=between)


def error_statistics(left_out: Sequence[LeftOutRun]) -> dict[str, float | int]:
    """Statistics of the runs at points left out: counts, medians, and the 90 % quantile.

    A point without a frequency counts as an infinite frequency error, and does not enter the
    medians of amplitude and waveform. These are taken over each point's worst state. Over the
    points that the others enclose, the medians of the law stand next to those of `Interpolation`.
    """
    f = np.array([abs(each.run.f_error) for each in left_out])
    f[np.isnan(f)] = np.inf
    amplitude = np.array([each.amplitude_error for each in left_out])
    waveform = np.array([max(each.run.waveform_error.values()) for each in left_out])
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
