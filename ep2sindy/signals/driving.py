"""Whether something outside drives a signal: signs in its record, and a drive of known period.

A record of a driven signal alone looks like that of a self-sustained oscillation, and equations are
found for either. Three signs tell them apart: a column beside it that looks set, a frequency that
somebody chose, and a phase that keeps time although the amplitude does not.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float
from scipy.interpolate import make_interp_spline

from ep2sindy.data.gaps import between_gaps
from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.library.units import Clock, seconds_in
from ep2sindy.runtime.values import check_positive
from ep2sindy.signals.attractor import Cycle, find_cycle, white_variance
from ep2sindy.signals.spectrum import power_spectrum
from ep2sindy.signals.trace import Trace

DRIVE = ("cos_drive", "sin_drive")  # inputs that stand for a drive of known period

# Probability, at most, that a frequency which nobody chose is round by chance.
BY_CHANCE = 0.01
CLOCK = 2e-5  # relative error of a quartz clock, in the record's times or in the drive's
N_ERRORS = 2.0  # standard errors of a frequency within which it counts as another
# Frequencies of the mains, their wander, harmonics, and the largest error at which they are told.
MAINS_Hz, MAINS_ERROR, N_MAINS, MAINS_TOLD = (50.0, 60.0), 1e-3, 4, 3e-3
# A year has 365 to 365.25 days. Two decades hold three periods: an error of 0.02 is rarely met.
CALENDAR, CALENDAR_ERROR, CALENDAR_TOLD = ("day", "week", "year"), 1e-3, 0.02

REPEATS = (
    0.9  # least share of the variance that the waveform explains where a phase is told from it
)
MIN_TOLD = 20  # fewest periods in which a phase that keeps time is told from one that walks
# Mean square of a random walk of n unit steps about its best line, over n: one in a hundred walks
# of twenty steps is below this, and fewer of longer ones (simulated).
LEAST_WALK = 0.0147
# Standard deviations in a median absolute deviation of normal values, and the standard error of its
# square, as a share, times the root of their number; errors beyond which moves are sure.
MADS, MAD_ERROR, N_SURE = 1.4826, 2.33, 4.0
LEAST_MOVE = 0.005  # of an amplitude, as a share: less may come from where samples fall in a period

RESTING, LONG_HELD, FEW_LEVELS = 0.5, 5.0, 3  # share of steps, samples, and levels of a held value
CLEAN = 0.05  # most noise of a wave that somebody sets, in its standard deviations
SAME = 0.999  # least correlation with a pure wave of the waveform of one that is set
STRONGLY = 0.5  # least correlation of a column that is named
PURER = 20.0  # least ratio of what is no sine in a signal to that in one that drives it
SAME_LINE = 0.5  # most difference of two frequencies that are one, in units of 1 / duration
FOLLOWS = 0.1  # least share of a signal's variance at the frequency of a wave that it goes with
MOST_SUBHARMONIC = 3  # periods of a drive in one of the signal, at most
CUBIC = 3  # degree of the splines between samples
SETTLED = 3  # a drive is looked for after the first of so many parts of a record, a transient


def add_drive(run: Run, period_s: float) -> Trajectory:
    """The run with a drive of known period as inputs `cos_drive` and `sin_drive`.

    Both are needed since the phase of the drive is not known; what is a sum of harmonics is reached
    by products of them. run: as `discover` takes it. period_s: in s, of any unit of time's run.
    Raises ValueError for a period that is not positive, or a run that has these inputs already.

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
    """How amplitude and phase of a signal's fundamental go from period to period.

    amplitude: (periods,), less its mean, as a share of it. phase: (periods,) in rad, about its best
    line. noise: variance of either that white noise in the samples explains. frequency_Hz: by the
    slope of the phase. error_Hz: its standard error.
    """

    amplitude: Float[np.ndarray, " periods"]
    phase: Float[np.ndarray, " periods"]
    noise: float
    frequency_Hz: float
    error_Hz: float

    @staticmethod
    def of(t: np.ndarray, x: np.ndarray, cycle: Cycle) -> PhaseRecord:
        """From samples at any steps, which are interpolated at a whole number to a period."""
        n, (t, x) = (
            max(8, round(len(t) / cycle.n_periods)),
            (e[len(e) // SETTLED :] for e in (t, x)),
        )
        n_periods = int((t[-1] - t[0]) * cycle.frequency_Hz + 1e-6)
        even = t[0] + np.arange(n * n_periods) / (n * cycle.frequency_Hz)
        pieces = make_interp_spline(t, x, k=CUBIC)(even).reshape(n_periods, n)
        line = pieces @ np.exp(-2j * np.pi * np.arange(n) / n) * (2.0 / n)
        size, phase, k = np.abs(line), np.unwrap(np.angle(line)), np.arange(n_periods)
        slope, start = np.polyfit(k, phase, 1)
        rest, mean = phase - start - slope * k, size.mean()
        # Of a line through n values of variance v: 12 v / n^3, and more if they last.
        lasting = np.clip((rest[1:] * rest[:-1]).sum() / max((rest**2).sum(), 1e-300), 0.0, 0.95)
        scatter = (rest @ rest) / max(n_periods - 2, 1)
        variance = 12.0 * scatter / n_periods**3 * (1.0 + lasting) / (1.0 - lasting)
        return PhaseRecord(
            amplitude=size / mean - 1.0,
            phase=rest,
            noise=2.0 * white_variance(*power_spectrum(t, x)) / n / mean**2,
            frequency_Hz=cycle.frequency_Hz * (1.0 + slope / (2.0 * np.pi)),
            error_Hz=cycle.frequency_Hz * float(np.sqrt(variance)) / (2.0 * np.pi),
        )

    @property
    def moves(self) -> float:
        """Variance of the amplitude's moves from period to period, less noise; 0 if it is not sure.

        They are the residuals of an autoregression, by their median, so that a transient does not
        count.
        """
        n, a = len(self.phase), self.amplitude
        if n < MIN_TOLD:
            return 0.0
        past = np.column_stack([a[1:-1], a[:-2]])
        coef = np.linalg.lstsq(past, a[2:], rcond=None)[0]
        size = MADS * float(np.median(np.abs(a[2:] - past @ coef)))
        white = self.noise * (1.0 + float(coef @ coef))
        moves = size**2 - white
        return (
            float(moves) if moves > max(N_SURE * MAD_ERROR / n**0.5 * white, LEAST_MOVE**2) else 0.0
        )

    @property
    def keeps_time(self) -> bool:
        """Whether the phase returns, as to a drive, although the amplitude has moves of its own.

        What moves the amplitude of a self-sustained oscillation moves its phase by as much (in rad,
        as a share) at least, and nothing brings that back: its squares about the best line grow
        with the record. They lie below the bound in one of a hundred such records, at most.
        """
        least = LEAST_WALK * len(self.phase) * self.moves
        return bool(np.square(self.phase).mean() < least)


def ask_whether_driven(
    signal: Trace, beside: Mapping[str, tuple[np.ndarray, np.ndarray]]
) -> str | None:
    """The question, in one sentence, for a signal without inputs that looks driven; else None.

    beside: other columns of its file, name -> (times in s, samples). A self-sustained oscillation
    is asked about in two of a hundred records, at most: in one for a round frequency, in one for a
    phase that keeps time (`PhaseRecord.keeps_time`).
    """
    if signal.run.input_names:
        return None
    strength = {name: _correlation(signal, *column) for name, column in beside.items()}
    set_ones = {n: how for n, (t, u) in beside.items() if (how := _sets(signal, t, u))}
    if set_ones:
        named = max(set_ones, key=lambda name: strength[name])
        why, way = f"{named} beside it looks set ({set_ones[named]})", f"inputs=[{named}]"
    elif (own := _looks_driven(signal)) is not None:
        why, period_s = own
        named = max(strength, key=lambda name: strength[name], default="")
        column = named if named and strength[named] >= STRONGLY else "COLUMN"
        way = f"inputs=[{column}] if a column is the drive, or period_s={period_s:.6g}"
    else:
        return None
    return (
        f"is {signal.name} driven? It may be: {why}. Equations without the drive would be wrong "
        f"then, and their cycle not self-sustained: name it, {way}"
    )


def say_what_is_not_told(signal: Trace) -> str | None:
    """A remark if the record shows neither a walking phase nor one that keeps time; else None."""
    if signal.cycle is None or signal.run.input_names:
        return None
    if PhaseRecord.of(signal.t, signal.x, signal.cycle).moves > 0.0:
        return None
    return (
        f"this record does not tell whether {signal.name} sustains itself or is driven: neither "
        "its amplitude nor its phase moves from period to period by more than its noise"
    )


def _looks_driven(signal: Trace) -> tuple[str, float] | None:
    """Why a signal by itself looks driven, and the period in s; None if it does not."""
    if signal.cycle is None:
        return None
    record = PhaseRecord.of(signal.t, signal.x, signal.cycle)
    error = N_ERRORS * record.error_Hz / record.frequency_Hz
    found = [
        (order, *own)
        for order in range(1, MOST_SUBHARMONIC + 1)
        for own in _round_numbers(order * record.frequency_Hz, error, signal.clock)
    ]
    # If one of them is hardly met by chance, the drive is what is met first.
    if any(chance <= BY_CHANCE / MOST_SUBHARMONIC for *_, chance in found):
        order, words, f_Hz, _ = found[0]
        what = f"{order} times its frequency" if order > 1 else "its frequency"
        return f"{what} is {words} to its resolution", 1.0 / f_Hz
    # A phase that hardly diffuses while the amplitude varies much is also that of some chaos.
    repeats = signal.cycle.share >= REPEATS
    if not (repeats and len(between_gaps(signal.t)) == 1 and record.keeps_time):
        return None
    varies = 100.0 * float(record.amplitude.std())
    return (
        f"over {len(record.phase)} periods its phase keeps time, although its amplitude varies by "
        f"{varies:.2g} %"
    ), 1.0 / record.frequency_Hz


def _round_numbers(f_Hz: float, error: float, clock: Clock) -> Iterator[tuple[str, float, float]]:
    """Round frequencies that one of this relative error may be: words, Hz, and chance to be met."""
    for unit in CALENDAR:
        own_Hz = 1.0 / seconds_in(unit)
        if abs(f_Hz / own_Hz - 1.0) < error + CALENDAR_ERROR < CALENDAR_TOLD:
            yield f"one per {unit}", own_Hz, 0.0
    if clock.unit != "s":
        return
    for own_Hz in (k * each for each in MAINS_Hz for k in range(1, N_MAINS + 1)):
        if abs(f_Hz / own_Hz - 1.0) < error + MAINS_ERROR < MAINS_TOLD:
            yield f"{own_Hz:g} Hz, as of the mains,", own_Hz, 0.0
    error += CLOCK
    for power in (1.0, 0.1):  # numbers of one digit, then of two
        spacing = power * 10.0 ** np.floor(np.log10(f_Hz * (1.0 + error)))
        nearest = float(spacing * round(f_Hz / spacing))
        if abs(f_Hz - nearest) < error * f_Hz:
            # Those within the error of a round one, among all, for either number of digits.
            yield f"a round {nearest:g} Hz", nearest, 4.0 * error * f_Hz / spacing


def _correlation(signal: Trace, t: np.ndarray, u: np.ndarray) -> float:
    """Largest correlation of a column with the signal, shifted by up to half a period."""
    beside = np.interp(signal.t, t, u)
    if not (beside.std() > 0.0 and np.isfinite(beside).all()):
        return 0.0
    a, b = (each - each.mean() for each in (beside, signal.x))
    most = min(round(0.5 * signal.per_period), len(a) // 2)
    length = 2 * len(a)
    products = np.fft.irfft(np.fft.rfft(a, length).conj() * np.fft.rfft(b, length), length)
    near = np.concatenate([products[: most + 1], products[length - most :]])
    return float(np.abs(near).max() / np.sqrt((a @ a) * (b @ b)))


def _sets(signal: Trace, t: np.ndarray, u: np.ndarray) -> str:
    """How a column looks set that goes with a signal; empty if it does not."""
    how = describe_set(t, u)
    if how in ("", HELD):
        return how if how and _correlation(signal, t, u) >= STRONGLY else ""
    own = find_cycle(t, u[:, None])
    assert own is not None
    turns = 2.0 * np.pi * own.frequency_Hz * signal.t
    line = np.exp(-1j * turns) @ (signal.x - signal.x.mean()) * (2.0 / len(turns))
    goes = 0.5 * float(np.abs(line)) ** 2 > FOLLOWS * signal.x.var()
    if signal.cycle is not None:
        ratio = own.frequency_Hz / signal.cycle.frequency_Hz
        apart = abs(ratio - max(1, round(ratio))) * signal.n_periods
        goes |= round(ratio) <= MOST_SUBHARMONIC and apart < SAME_LINE
        # Near a rest, every state of an oscillator is a sine: that of a drive is purer by far.
        if how == WAVES[0]:
            goes &= PURER * _impurity(own, u) < _impurity(signal.cycle, signal.x)
    return how if goes else ""


def _impurity(cycle: Cycle, x: np.ndarray) -> float:
    """Share of the variance that is not the fundamental's."""
    rest = x - (cycle.harmonics[0, 0] * np.exp(1j * cycle.phase)).real
    return float(rest.var() / x.var())


HELD = "held between steps"
WAVES = ("a sine", "a triangle or a sweep")


def describe_set(t: Float[np.ndarray, " samples"], u: Float[np.ndarray, " samples"]) -> str:
    """How a column looks as if somebody sets it: held, or a clean wave; empty if it does not.

    Held: it rests over most steps, in long pieces, and does not merely creep from one number of a
    coarse scale to the next. A wave: of one pure form, with little noise.
    """
    if not np.isfinite(u).all() or np.ptp(u) == 0.0:
        return ""
    moves = np.abs(np.diff(u))
    moved = moves[moves > 0.0]
    if len(moved) < RESTING * len(moves):
        lasts = len(moves) / len(moved) >= LONG_HELD
        leaps = np.median(moved) > 1.5 * moved.min() or len(np.unique(u)) <= FEW_LEVELS
        return HELD if lasts and leaps else ""
    cycle = find_cycle(t, u[:, None])
    if cycle is None:
        return ""
    left = float((u - cycle.waveform(cycle.phase)[:, 0]).var() / u.var())
    if _is_wave(cycle, np.cos, left):
        return WAVES[0]
    first, second = np.abs(np.append(cycle.harmonics[:, 0], 0.0))[:2]
    rise = np.arccos(min(2.0 * second / first, 1.0 - 1e-6)) / np.pi  # share of the period

    def sweep(phase: np.ndarray) -> np.ndarray:
        share = phase / (2.0 * np.pi) % 1.0
        return np.where(share < rise, share / rise, (1.0 - share) / (1.0 - rise))

    found = _is_wave(cycle, sweep, left) or _is_wave(cycle, lambda p: sweep(-p), left)
    return WAVES[1] if found else ""


def _is_wave(cycle: Cycle, wave: Callable[[np.ndarray], np.ndarray], left: float) -> bool:
    """Whether a waveform is a given one, at some phase and of any size.

    left: share of the variance that the waveform leaves; that of harmonics beyond it may be more.
    """
    n, n_points = len(cycle.harmonics), 720
    ideal = np.fft.rfft(wave(2.0 * np.pi * np.arange(n_points) / n_points))[1:]
    beyond = float(np.square(np.abs(ideal[n:])).sum() / np.square(np.abs(ideal)).sum())
    own, same = np.zeros((2, n_points // 2 + 1), dtype=np.complex128)
    own[1 : n + 1], same[1 : n + 1] = cycle.harmonics[:, 0], ideal[:n]
    size = np.sqrt(np.square(np.abs(own)).sum() * np.square(np.abs(same)).sum())
    shifted = 0.5 * n_points * np.fft.irfft(own.conj() * same, n_points)
    return bool(left < CLEAN**2 + beyond and np.abs(shifted).max() > SAME * size)


def propose_inputs(
    t: Float[np.ndarray, " samples"], columns: Mapping[str, Float[np.ndarray, " samples"]]
) -> dict[str, str]:
    """Columns of a file that look set, name -> how; none if no other column is left.

    A sine counts only if it leads all others by up to half its period, and is purer by far: near a
    rest, every state of an oscillator is a sine.
    """
    looks = {name: how for name, u in columns.items() if (how := describe_set(t, u))}
    for name in [name for name, how in looks.items() if how == WAVES[0]]:
        own, others = columns[name], [x for other, x in columns.items() if other not in looks]
        cycle = find_cycle(t, own[:, None])
        assert cycle is not None
        turn = np.exp(-2j * np.pi * cycle.frequency_Hz * t)
        lines = np.array([turn @ (x - x.mean()) for x in (own, *others)])
        leads = ((lines[1:] * lines[0].conj()).imag < 0.0).all()
        cycles = [find_cycle(t, x[:, None]) for x in others]
        rest = [1.0 if c is None else _impurity(c, x) for c, x in zip(cycles, others, strict=True)]
        if not (leads and PURER * _impurity(cycle, own) < min(rest, default=0.0)):
            del looks[name]
    return looks if len(looks) < len(columns) else {}
