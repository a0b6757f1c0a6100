"""Period and waveform of a record that repeats itself, and distances between two records."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Complex, Float
from scipy import fft

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.runtime.values import Samples, read_only
from ep2sindy.signals.spectrum import (
    Bins,
    ByState,
    States,
    is_uniform,
    noise_floor,
    peak,
    power_spectrum,
)

MIN_PERIODS = 3.0  # fewest periods in a record that counts as repeating

# Least fraction of the variance of some state, noise included, that the waveform must explain:
# noise alone has spectral lines, too.
MIN_VISIBLE = 0.1

MIN_FRACTION = 0.5  # least fraction of the variance that the waveform explains if there is a period

# Least fraction from which a record repeats itself: that of chaos is 0.5 to 0.75, of some nearly
# this.
REPEATS = 0.9

MAX_HARMONICS = 16

SAMPLES_PER_HARMONIC = 2.5  # fewest samples per period of a harmonic; the Nyquist limit is two

# Length of the window from which the phase at one instant is estimated, in periods. The phase of
# the breathing mode wanders over tens of periods.
PERIODS_TRACKED = 8.0

N_SHIFTS = 720  # trial shifts of one waveform over another, before the best one is refined

# Order of the differences that show white noise, the fewest samples for it, and the median of the
# square of a normal number.
N_DIFFERENCES, LEAST_FOR_NOISE, CHI_MEDIAN = 5, 12, 0.4549

# Least ratio of the diagonal elements of a triangular factor that products of columns give to
# twelve digits or more.
WELL_CONDITIONED = 0.1


@dataclass(frozen=True, eq=False)
class Cycle:
    """A record that repeats: states = mean + Re sum_k harmonics[k - 1] exp(i k phase).

    phase: (samples,) in rad, phase of the fundamental, followed along the record.
    mean: (n_states,). harmonics: (n_harmonics, n_states), in the states' units.
    fraction: fraction of the pooled variance of the states, without white noise, that the waveform
    explains.
    """

    frequency_Hz: float
    phase: Samples
    mean: ByState
    harmonics: Complex[np.ndarray, "n_harmonics n_states"]
    fraction: float

    @property
    def std(self) -> ByState:
        """Standard deviation of the waveform of each state, so without noise."""
        return np.sqrt(0.5 * np.square(np.abs(self.harmonics)).sum(axis=0))

    @property
    def n_periods(self) -> float:
        return float((self.phase[-1] - self.phase[0]) / (2.0 * np.pi))

    @property
    def repeats(self) -> bool:
        """Whether the waveform is all there is; otherwise it is what chaos has on average."""
        return self.fraction >= REPEATS

    def waveform(self, phase: Float[np.ndarray, " points"]) -> Float[np.ndarray, "points n_states"]:
        """States of the periodic waveform at the given phases, in rad."""
        order = np.arange(1, len(self.harmonics) + 1)
        return self.mean + (np.exp(1j * np.outer(phase, order)) @ self.harmonics).real


def find_cycle(t: Samples, states: States, *, n_harmonics: int | None = None) -> Cycle | None:
    """Period and waveform of a record; None if the record is not periodic.

    The period is that of the state whose spectrum has the sharpest line. The phase of this state is
    followed by demodulation. The slope of the phase is then adjusted until the waveform, a Fourier
    series in the phase, fits all samples best; white noise averages out.

    Parameters
    ----------
    t : (samples,) array
        Times in s.
    states : (samples, n_states) array
        Samples of the states.
    n_harmonics : int, optional
        Number of harmonics of the waveform. None chooses as many as the samples support (BIC).

    Returns
    -------
    Cycle or None
        The cycle. None for fewer than three periods, or if the waveform explains less than half of
        the variance, as for chaos, noise or a transient.

    Notes
    -----
    Over the slope of the phase and the coefficients a_m of the waveform,

        minimise sum_k |x(t_k) - sum_m a_m exp(i m phase(t_k))|^2
    """
    spread = states.std(axis=0)
    # Rounding errors of a constant state are no oscillation.
    if not (spread > 1e-9 * np.abs(states).max(axis=0)).any():
        return None
    scaled = (states - states.mean(axis=0)) / zero_to_one(spread)
    spectra = [power_spectrum(t, column) for column in scaled.T]
    lines = [_find_line(*spectrum) for spectrum in spectra]
    leader = int(np.argmax([sharpness for _, sharpness in lines]))
    rough_Hz = lines[leader][0]
    n_periods = rough_Hz * (t[-1] - t[0])
    if not n_periods >= MIN_PERIODS:
        return None
    most = _most_harmonics(len(t), n_periods) if n_harmonics is None else n_harmonics
    phase = _estimate_phase(t, scaled, leader, rough_Hz, most)
    frequency_Hz = float(np.polynomial.Polynomial.fit(t, phase, 1).convert().coef[1]) / (2 * np.pi)
    series, rest = _fit_series(phase, scaled, most, chosen=n_harmonics is None)
    whole = np.square(scaled).sum(axis=0)
    if not (whole - rest >= MIN_VISIBLE * whole).any():
        return None
    noise = len(t) * np.array([white_variance(*spectrum) for spectrum in spectra])
    known = np.maximum(whole - noise, 1e-12)
    fraction = 1.0 - float(np.maximum(rest - noise, 0.0).sum() / known.sum())
    if not (fraction >= MIN_FRACTION and frequency_Hz > 0.0):
        return None
    return Cycle(
        frequency_Hz=frequency_Hz,
        phase=read_only(phase),
        mean=read_only(states.mean(axis=0) + series[0] * spread),
        harmonics=(series[1::2] - 1j * series[2::2]) * spread,
        fraction=fraction,
    )


def _estimate_phase(
    t: np.ndarray, scaled: np.ndarray, leader: int, rough_Hz: float, most: int
) -> np.ndarray:
    """Phase at every sample, from a rough frequency of the leading state, with `most` harmonics."""
    phase = 2.0 * np.pi * rough_Hz * (t - t[0])
    for _ in range(3):
        phase = _sharpen(t, phase, scaled, 1)
    tried = [phase]
    n_periods = rough_Hz * (t[-1] - t[0])
    if n_periods >= 2.0 * PERIODS_TRACKED:
        tried.append(follow_phase(t, scaled[:, leader], phase))
    for _ in range(2):
        tried = [_sharpen(t, each, scaled, most) for each in tried]
    if len(tried) == 1:
        return tried[0]
    # What is followed in noise is noise, too: a phase that wanders must be worth its freedom (BIC),
    # a number for every half of the window, in which a Hann window's weight lies.
    varying = scaled[:, scaled.any(axis=0)]
    left = [_fit_series(each, varying, most, chosen=False)[1] for each in tried]
    straight, wandering = (len(t) * np.log(squares).sum() for squares in left)
    penalty = np.log(len(t)) * n_periods / (0.5 * PERIODS_TRACKED)
    return tried[1] if straight - wandering > penalty else tried[0]


def _find_line(frequency: np.ndarray, power: np.ndarray) -> tuple[float, float]:
    """Dominant frequency in Hz of a spectrum, and the fraction of power within two bins."""
    rough_Hz = peak(frequency, power)
    if rough_Hz <= 0.0:
        return 0.0, 0.0
    near = np.abs(frequency - rough_Hz) <= 2.5 * frequency[1]
    return rough_Hz, float(power[near].sum() / power.sum())


def white_variance(frequency: Bins, power: Bins) -> float:
    """Variance of the white noise in a signal, from the upper half of its spectrum."""
    return float(noise_floor(power) * frequency[-1]) if len(power) else 0.0


def noise_std(t: Samples, x: Samples) -> float:
    """Standard deviation of the white noise in a signal, in its unit; zero for under 12 samples.

    It is what fifth differences show, in the median, scaled so that they leave the size of white
    noise as it is: at ten samples in a period, a sine leaves 0.6 % of its amplitude. At equal steps
    it is at most what the upper half of the spectrum holds, whose median lines hardly change.
    """
    if len(t) < LEAST_FOR_NOISE:
        return 0.0
    n = len(t) - N_DIFFERENCES
    places = np.arange(n)[:, None] + np.arange(N_DIFFERENCES + 1)
    apart = t[places][:, :, None] - t[places][:, None]
    apart /= t[places[:, -1:, None]] - t[places[:, :1, None]]
    weights = 1.0 / np.prod(np.where(apart == 0.0, 1.0, apart), axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    shown = float(np.sqrt(np.median(np.square((weights * x[places]).sum(axis=1))) / CHI_MEDIAN))
    if not is_uniform(t):
        return shown
    return min(shown, float(np.sqrt(white_variance(*power_spectrum(t, x)))))


def mean_cycle(run: Trajectory) -> Trajectory:
    """The run with its states on their mean waveform, at the phase of every sample.

    White noise averages out over the periods, and so does all that does not repeat, such as a
    transient. Inputs stay as they are.

    Parameters
    ----------
    run : Trajectory
        A record that oscillates.

    Returns
    -------
    Trajectory
        The run with the mean waveform as states.

    Raises
    ------
    ValueError
        If `find_cycle` finds no cycle in the run.

    Examples
    --------
    >>> t = np.linspace(0.0, 300.0, 3001)
    >>> noise = np.random.default_rng(0).normal(size=3001)
    >>> quiet = ep.signals.mean_cycle(ep.Trajectory(t, (np.sin(t) + noise)[:, None], ["x"]))
    >>> bool(np.abs(quiet.states[:, 0] - np.sin(t)).max() < 0.2)
    True
    """
    cycle = find_cycle(run.t, run.states)
    if cycle is None:
        raise ValueError(
            f"a mean cycle needs a record that repeats itself, three periods or more: "
            f"{run.label or 'this run'} does not"
        )
    return replace(run, states=cycle.waveform(cycle.phase))


def follow_phase(t: Samples, x: Samples, straight: Samples) -> Samples:
    """Unwrapped phase in rad, at every sample, of the component of x near a phase linear in time.

    x is demodulated and averaged under a Hann window of eight periods, or of half the record if
    that is shorter. Where the window reaches beyond an end of the record, the phase continues as
    the linear one.
    """
    slow = (x - x.mean()) * np.exp(-1j * straight)
    even = t if is_uniform(t) else np.linspace(t[0], t[-1], len(t))
    slow = np.interp(even, t, slow)
    per_period = len(t) * 2.0 * np.pi / (straight[-1] - straight[0])
    n = max(3, round(min(PERIODS_TRACKED * per_period, 0.5 * len(t))))
    drift = np.unwrap(np.angle(_moving_average(slow, np.hanning(n + 2)[1:-1])))
    whole = slice(n // 2, len(t) - n // 2)
    return straight + np.interp(t, even[whole], drift[whole])


def _moving_average(x: np.ndarray, window: np.ndarray) -> np.ndarray:
    """Same as `scipy.signal.fftconvolve(x, window, "same")`, whose import takes half a second."""
    length = len(x) + len(window) - 1
    fast = fft.next_fast_len(length)
    whole = fft.ifft(fft.fft(x, fast) * fft.fft(window, fast), fast)
    first = (length - len(x)) // 2
    return whole[first : first + len(x)]


def _sharpen(t: np.ndarray, phase: np.ndarray, scaled: np.ndarray, order: int) -> np.ndarray:
    """Change the slope of the phase in time so that the Fourier series of this order fits best.

    One Gauss-Newton step: the residual of the series is regressed on the change of slope.
    """
    columns, triangle = _fourier_columns(phase, order)

    def fit(values: np.ndarray) -> np.ndarray:
        return np.linalg.solve(triangle, np.linalg.solve(triangle.T, columns.T @ values))

    series = fit(scaled)
    orders = np.arange(1, order + 1)
    slope = np.zeros_like(series)  # derivative of the series by the phase
    slope[1::2] = orders[:, None] * series[2::2]
    slope[2::2] = -orders[:, None] * series[1::2]
    since = (t - t.mean()) / (t[-1] - t[0])
    direction = (columns @ slope) * since[:, None]
    direction -= columns @ fit(direction)
    size = float(np.square(direction).sum())
    change = float((direction * (scaled - columns @ series)).sum()) / size if size > 0.0 else 0.0
    # At most half a period over the record: a larger change would reach another spectral line.
    return phase + float(np.clip(change, -np.pi, np.pi)) * since


def _fourier_columns(phase: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Constant, then cosine and sine of each harmonic, (samples, 1 + 2 order); and their factor R.

    columns = Q R but for signs; the basis Q, which takes long to form, is not needed.
    """
    # Powers of one exponential: each costs a product instead of a sine and a cosine.
    turns = np.multiply.accumulate(np.tile(np.exp(1j * phase), (order, 1)))
    columns = np.empty((len(phase), 1 + 2 * order))
    columns[:, 0], columns[:, 1::2], columns[:, 2::2] = 1.0, turns.real.T, turns.imag.T
    return columns, _factorise(columns, turns)


def _factorise(columns: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """R of Fourier columns; turns: exp(i m phase) of each harmonic m, (order, samples).

    Harmonics over some periods are nearly orthogonal, so that R follows from the columns' products
    (Cholesky). Where it does not, because samples cluster in the phase, it is found by reflections.
    """
    try:
        triangle: np.ndarray = np.linalg.cholesky(_fourier_products(turns)).T
    except np.linalg.LinAlgError:
        triangle = np.zeros((1, 1))
    size = np.diagonal(triangle)
    if size.min() > WELL_CONDITIONED * size.max():
        return triangle
    return np.asarray(np.linalg.qr(columns, mode="r"))


def _fourier_products(turns: np.ndarray) -> np.ndarray:
    """Products of all Fourier columns, by the sums of exp(i m phase) for m up to twice the order.

    cos m cos n = (cos(m-n) + cos(m+n)) / 2, and so on: no column is multiplied with another.
    """
    order, n = turns.shape
    sums = np.concatenate([[n], turns.sum(axis=1), turns @ turns[-1]])
    m = np.arange(order + 1)
    apart = sums[np.abs(m[:, None] - m)]
    apart = np.where(m[:, None] < m, apart.conj(), apart)
    beside = sums[m[:, None] + m]
    products = np.empty((1 + 2 * order, 1 + 2 * order))
    cosine, sine = np.append(0, 1 + 2 * m[:-1]), 2 + 2 * m[:-1]
    products[np.ix_(cosine, cosine)] = 0.5 * (apart + beside).real
    products[np.ix_(sine, sine)] = 0.5 * (apart - beside).real[1:, 1:]
    products[np.ix_(cosine, sine)] = 0.5 * (beside - apart).imag[:, 1:]
    products[np.ix_(sine, cosine)] = products[np.ix_(cosine, sine)].T
    return products


def _most_harmonics(n_samples: int, n_periods: float) -> int:
    """Largest number of harmonics that the samples per period and their total number allow."""
    by_period = n_samples / n_periods / SAMPLES_PER_HARMONIC
    return int(np.clip(min(by_period, (n_samples - 1) // 4), 1, MAX_HARMONICS))


def _fit_series(
    phase: np.ndarray, scaled: np.ndarray, most: int, *, chosen: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Fourier coefficients of the states, and the residual sum of squares of each state.

    Coefficients: constant, then cosine and sine of each harmonic, (1 + 2 n, n_states).
    chosen: if true, BIC chooses the number of harmonics, up to `most`.
    """
    # The columns are ordered, so one factorisation gives the fits of every number of harmonics.
    columns, triangle = _fourier_columns(phase, most)
    known = np.linalg.solve(triangle.T, columns.T @ scaled)
    whole = np.square(scaled).sum(axis=0)
    left = np.maximum(whole - np.cumsum(np.square(known), axis=0)[::2], 1e-12 * whole)
    order = most
    if chosen:
        penalty = np.log(len(phase)) * (1 + 2 * np.arange(most + 1)) * scaled.shape[1]
        order = max(1, int(np.argmin(len(phase) * np.log(left).sum(axis=1) + penalty)))
    kept = slice(0, 1 + 2 * order)
    return np.linalg.solve(triangle[kept, kept], known[kept]), left[order]


def best_shift(data: Cycle, other: Cycle) -> float:
    """Phase in rad to add to `other` so that its waveform best overlaps the data's.

    One shift serves all states.
    """
    ours, theirs, order = _pad_harmonics(data, other)
    overlap = ((np.conj(ours) * theirs) / np.square(zero_to_one(data.std))).sum(axis=1)
    shifts = 2.0 * np.pi * np.arange(N_SHIFTS) / N_SHIFTS
    best = float(shifts[np.argmax((np.exp(1j * np.outer(shifts, order)) @ overlap).real)])
    for _ in range(3):  # Newton's method on the overlap, from within half a degree
        turned = np.exp(1j * order * best) * overlap
        curvature = float((order**2 @ turned).real)
        best -= float((order @ turned).imag) / curvature if curvature > 0.0 else 0.0
    return best


def waveform_errors(data: Cycle, other: Cycle) -> ByState:
    """RMS difference of two waveforms at the best shift, in standard deviations of the data.

    All states share one shift, so a wrong lag between states counts as an error.
    """
    ours, theirs, order = _pad_harmonics(data, other)
    turned = theirs * np.exp(1j * order * best_shift(data, other))[:, None]
    off = np.square(np.abs(turned - ours)).sum(axis=0)
    return np.sqrt(np.square(other.mean - data.mean) + 0.5 * off) / zero_to_one(data.std)


def _pad_harmonics(data: Cycle, other: Cycle) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Harmonics of both cycles, zero-padded to the same number, and their orders."""
    n = max(len(data.harmonics), len(other.harmonics))
    ours, theirs = (np.pad(c.harmonics, ((0, n - len(c.harmonics)), (0, 0))) for c in (data, other))
    return ours, theirs, np.arange(1, n + 1)
