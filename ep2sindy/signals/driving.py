"""Whether something outside drives a signal: signs in its record, and a drive of known period.

A record of a driven signal alone looks like that of a self-sustained oscillation, and equations are
found for either. Three signs tell them apart: a column next to it that looks set, a frequency that
somebody chose, and a phase that moves from period to period and returns, as to a clock.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view
from scipy.interpolate import make_interp_spline

from ep2sindy.data.gaps import between_gaps
from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.library.units import Clock, seconds_in
from ep2sindy.runtime.values import Samples, check_positive
from ep2sindy.signals.attractor import Cycle, find_cycle
from ep2sindy.signals.signal import Signal

DRIVE = ("cos_drive", "sin_drive")  # inputs that stand for a drive of known period

BY_CHANCE = 0.01  # most probability that a frequency which nobody chose is round to its error
CLOCK = 2e-5  # relative error of a quartz clock, in the record's times or in the drive's
N_ERRORS = 2.0  # standard errors of a frequency within which it counts as another
# A grid wanders by 1e-3. Larger errors than three times that would meet one frequency in a hundred.
MAINS_Hz, MAINS_ERROR, MAINS_MOST = (50.0, 60.0, 100.0, 120.0), 1e-3, 3e-3
# A year has 365 to 365.25 days. Two decades hold three periods: an error of 0.02 is rarely met.
CALENDAR, CALENDAR_ERROR, CALENDAR_MOST = ("day", "year"), 1e-3, 0.02

# Fewest periods in which a phase that returns is distinguished from one that walks.
MIN_PERIODS_OF_PHASE = 20
# Mean square of a random walk of n unit steps about its best line, over n: one in a hundred walks
# of twenty steps is below this, and fewer of longer ones (simulated).
LEAST_WALK = 0.0147
# Least square of a phase's moves over that of noise, of twenty moves: five errors.
LEAST_MOVES = 4.0
MISSED = 1.64  # of white noise: its variance, and that between the other samples, of 0.64
N_POINTS = 64  # in a period, between samples by cubic splines
SETTLED = 3  # a phase is looked at after the first of so many parts of a record, a transient

HELD, SWEPT, SINE = "held between steps", "a triangle or a sweep", "a sine"
RESTING = 0.5  # least fraction of steps in which a held column rests
LEAP = 0.1  # least median move of a held column, as a fraction of its range: no coarse scale
EVEN = 0.05  # most distance of a sweep's values from an even spread; a sine's is 0.1
# Largest fraction that is no sine in one, and least ratio to the others'.
PURE, PURER = 2.5e-3, 20.0
FORETOLD = 0.1  # least fraction of the error of a forecast that a drive takes away
N_AHEAD, N_LAGS = 12, 3  # steps in a period, and how many of them, by which a signal is foretold


def add_drive(run: Run, period_s: float) -> Trajectory:
    """The run with a drive of known period as inputs `cos_drive` and `sin_drive`.

    Both are needed since the phase of the drive is not known. Products of the two give its
    harmonics.

    Parameters
    ----------
    run : run
        A run as `discover` takes it.
    period_s : float
        Period of the drive in s.

    Returns
    -------
    Trajectory
        The run with the two further inputs.

    Raises
    ------
    ValueError
        If the period is not positive, or the run has these inputs already.

    Examples
    --------
    >>> t = np.linspace(0.0, 9.0, 181)
    >>> run = ep.signals.add_drive(ep.Trajectory(t, np.sin(t)[:, None], ["x"]), period_s=3.0)
    >>> run.input_names, run.inputs[0].tolist()
    (('cos_drive', 'sin_drive'), [1.0, 0.0])
    """
    check_positive("period_s", period_s)
    own = trajectory_of(run)
    phase = 2.0 * np.pi * own.t / period_s
    return replace(
        own,
        inputs=np.column_stack([own.inputs, np.cos(phase), np.sin(phase)]),
        input_names=(*own.input_names, *DRIVE),
    )


def drop_repeats(library: Library) -> Library:
    """The library without powers of `sin_drive`, which those of `cos_drive` say: s^2 = 1 - c^2.

    What is known of equations is left out. Other libraries come back as they are.
    """
    if not set(DRIVE) <= set(library.variables):
        return library
    return library.take(library.exponents[:, library.variables.index(DRIVE[1])] < 2)


@dataclass(frozen=True, eq=False)
class PhaseRecord:
    """How the phase of a signal's fundamental goes from period to period.

    phase: (periods,) in rad, about its best line. noise: variance of it by noise in the samples and
    by what falls between them. frequency_Hz: by the slope of the phase.
    """

    phase: Float[np.ndarray, " periods"]
    noise: float
    frequency_Hz: float

    @staticmethod
    def of(t: np.ndarray, x: np.ndarray, cycle: Cycle) -> PhaseRecord:
        """From samples at any steps, which are interpolated.

        Noise, and what falls between samples, is what a spline through every second one misses.
        """
        t, x = t[len(t) // SETTLED :], x[len(x) // SETTLED :]
        missed = (make_interp_spline(t[::2], x[::2], k=3)(t[1:-1:2]) - x[1:-1:2]).var() / MISSED
        n = int((t[-1] - t[0]) * cycle.frequency_Hz + 1e-6)
        even = t[0] + np.arange(N_POINTS * n) / (N_POINTS * cycle.frequency_Hz)
        turns = np.exp(-2j * np.pi * np.arange(N_POINTS) / N_POINTS) * (2.0 / N_POINTS)
        lines = make_interp_spline(t, x, k=3)(even).reshape(n, N_POINTS) @ turns
        phase = np.unwrap(np.angle(lines))
        line = np.polynomial.Polynomial.fit(np.arange(n), phase, 1)
        return PhaseRecord(
            phase=phase - line(np.arange(n)),
            noise=2.0 * float(missed) * n / len(t) / float(np.abs(lines).mean()) ** 2,
            frequency_Hz=cycle.frequency_Hz * (1.0 + line.convert().coef[1] / (2.0 * np.pi)),
        )

    @property
    def moved(self) -> float:
        """Mean square of the phase's moves from period to period, noise included."""
        return float(np.square(np.diff(self.phase)).mean())

    @property
    def error(self) -> float:
        """Relative standard error of the frequency: by scatter, and by a walk if there is one.

        The slope of a line through n values of variance v has the variance 12 v / n^3. That of a
        walk of n steps of variance s has 6 s / (5 n), and its squares about the line are n s / 15.
        """
        n, squares = len(self.phase), float(np.square(self.phase).mean())
        lasts = max(squares - 0.5 * self.moved, 0.0)
        return float(np.sqrt(12.0 * squares / n**3 + 18.0 * lasts / n**2)) / (2.0 * np.pi)

    @property
    def has_moving_phase(self) -> bool:
        """Whether the phase moves from period to period by more than noise explains."""
        least = 2.0 * LEAST_MOVES * self.noise
        return len(self.phase) >= MIN_PERIODS_OF_PHASE and self.moved > least

    @property
    def returns(self) -> bool:
        """Whether the phase is moved and returns, as to a clock.

        Nothing brings back the phase of a self-sustained oscillation under random perturbations: it
        walks, and its squares about the best line grow with the record. They lie below the bound in
        one of a hundred such records, at most.
        """
        steps = self.moved - 2.0 * self.noise
        least = LEAST_WALK * len(self.phase) * steps
        return self.has_moving_phase and bool(np.square(self.phase).mean() < least)


def ask_whether_driven(
    signal: Signal, beside: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> str | None:
    """The question, in one sentence, for a signal without inputs that looks driven; else None.

    next to: other columns of its file, name -> (times in s, samples). Of self-sustained
    oscillations that are moved at random, one in a hundred has a phase that returns, at most, and
    two have a round frequency.
    """
    if signal.run.input_names:
        return None
    gains = {name: _gain(signal, *column) for name, column in beside.items()}
    gains = {name: gain for name, gain in gains.items() if gain > FORETOLD}
    for name in sorted(gains, key=lambda name: -gains[name]):
        t, u = beside[name]
        if how := describe_set(t, u, [np.interp(t, signal.t, signal.x)]):
            why, way = f"{name} next to it looks set ({how})", f"inputs=[{name}]"
            break
    else:
        if (own := _looks_driven(signal)) is None:
            return None
        column = max(gains, key=lambda name: gains[name], default="COLUMN")
        why, period_s = own
        way = f"inputs=[{column}] if a column is the drive, or period_s={period_s:.6g}"
    return (
        f"is {signal.name} driven? It may be: {why}. Equations without the drive would be wrong "
        f"then, and their cycle not self-sustained: name it, {way}"
    )


def report_unknown_drive(signal: Signal) -> str | None:
    """A warning if the record shows neither a phase that walks nor one that returns; else None."""
    if signal.cycle is None or signal.run.input_names:
        return None
    if PhaseRecord.of(signal.t, signal.x, signal.cycle).has_moving_phase:
        return None
    return (
        f"from this record alone one cannot tell whether {signal.name} sustains its oscillation by "
        "itself or is driven at this frequency, as by a clock"
    )


def _looks_driven(signal: Signal) -> tuple[str, float] | None:
    """Why a signal by itself looks driven, and the period in s; None if it does not."""
    if signal.cycle is None:
        return None
    record = PhaseRecord.of(signal.t, signal.x, signal.cycle)
    if found := _round_number(record.frequency_Hz, N_ERRORS * record.error, signal.clock):
        words, f_Hz = found
        return f"its frequency is {words} to its resolution", 1.0 / f_Hz
    repeats = signal.cycle.repeats and len(between_gaps(signal.t)) == 1
    if not (repeats and record.returns):
        return None
    return (
        f"its phase moves by {np.sqrt(record.moved):.2g} rad from period to period, and "
        f"returns over {len(record.phase)} periods, as to a clock"
    ), 1.0 / record.frequency_Hz


def _round_number(f_Hz: float, error: float, clock: Clock) -> tuple[str, float] | None:
    """The round frequency that one of this relative error is, in words and Hz; None for none."""
    known = [(f"one per {unit}", 1.0 / seconds_in(unit)) for unit in CALENDAR]
    limits = [(CALENDAR_ERROR, CALENDAR_MOST)] * len(known)
    if clock.unit == "s":
        known += [(f"{own_Hz:g} Hz, as of the mains,", own_Hz) for own_Hz in MAINS_Hz]
        limits += [(MAINS_ERROR, MAINS_MOST)] * len(MAINS_Hz)
    for (words, own_Hz), (least, most) in zip(known, limits, strict=True):
        if abs(f_Hz / own_Hz - 1.0) < error + least < most:
            return words, own_Hz
    width_Hz = (error + CLOCK) * f_Hz
    for digits in (1, 2) if clock.unit == "s" else ():
        spacing = 10.0 ** (np.floor(np.log10(f_Hz + width_Hz)) - digits + 1)
        nearest = float(spacing * round(f_Hz / spacing))
        if abs(f_Hz - nearest) < width_Hz and 2.0 * width_Hz < BY_CHANCE * spacing:
            return f"a round {nearest:g} Hz", nearest
    return None


def _gain(signal: Signal, t: np.ndarray, u: np.ndarray) -> float:
    """Fraction of the squared error of a signal's linear forecasts that a column takes away.

    It enters with its square, for a signal that does not mind its sign.
    """
    even = np.arange(signal.t[0], signal.t[-1], signal.period_s / N_AHEAD)
    x, beside = np.interp(even, signal.t, signal.x), np.interp(even, t, u)
    if not (np.isfinite(beside).all() and np.ptp(beside) > 0.0):
        return 0.0
    beside = (beside - beside.mean()) / beside.std()
    windows = [sliding_window_view(w, N_LAGS + 1) for w in (x, beside, beside**2)]
    past, after = windows[0][:, :-1], windows[0][:, -1]
    past = np.column_stack([np.ones(len(past)), past])
    left = [
        float(np.square(after - rows @ np.linalg.lstsq(rows, after, rcond=None)[0]).sum())
        for rows in (past, np.column_stack([past, *windows[1:]]))
    ]
    return 1.0 - left[1] / left[0] if left[0] > 0.0 else 0.0


def describe_set(t: Samples, u: Samples, others: Sequence[Samples]) -> str:
    """How a column looks as if somebody sets it: held, a sweep or a sine; empty if it does not.

    Held: it rests over most steps, and leaps. A sweep: periodic, and as long at any value as at any
    other. A sine: purer by far than all others, which it leads by up to half its period: every
    state of an oscillator near a rest is a sine, and what follows a wave is smoother than it.
    """
    if not np.isfinite(u).all() or np.ptp(u) == 0.0:
        return ""
    moves = np.abs(np.diff(u))
    if (moves == 0.0).mean() >= RESTING:
        return HELD if np.median(moves[moves > 0.0]) >= LEAP * np.ptp(u) else ""
    if (cycle := find_cycle(t, u[:, None])) is None:
        return ""
    fraction = np.linspace(0.0, 1.0, len(u))
    if np.abs((np.sort(u) - u.min()) / np.ptp(u) - fraction).max() < EVEN:
        return SWEPT
    wave = np.column_stack([np.ones(len(t)), np.cos(cycle.phase), np.sin(cycle.phase)])
    columns = np.column_stack([u, *others])
    coef = np.linalg.lstsq(wave, columns, rcond=None)[0]
    impure = (columns - wave @ coef).var(axis=0) / columns.var(axis=0)
    lines = coef[1] - 1j * coef[2]
    leads = ((lines[1:] * lines[0].conj()).imag < 0.0).all()
    return SINE if impure[0] < PURE and leads and (PURER * impure[0] < impure[1:]).all() else ""


def propose_inputs(t: Samples, columns: Mapping[str, Samples]) -> dict[str, str]:
    """Columns of a file that look set, name -> how; none if no other column is left."""
    looks = [name for name, u in columns.items() if describe_set(t, u, [])]
    others = [u for name, u in columns.items() if name not in looks]
    found = {name: describe_set(t, columns[name], others) for name in looks if others}
    return {name: how for name, how in found.items() if how}
