"""Checks and preparation of one measured signal: oscillation, sampling, drift."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.runtime.values import read_only
from ep2sindy.signals.attractor import Cycle, find_cycle, white_variance
from ep2sindy.signals.spectrum import dominant_frequency

MIN_PERIODS = 6.0  # fewest periods in a record on which a free run can be judged

# Samples per period that resolve a breathing mode; more samples cost time and follow the noise.
ENOUGH_SAMPLES = 100

DRIFT = 1.0  # in standard deviations over the record; a larger drift is reported

# Least standard deviation of the waveform, as a share of the signal's. A cycle found in white noise
# also has some.
MIN_VISIBLE = 0.5

# Limits for a signal that is positive apart from noise: how far a sample may lie below zero, in
# standard deviations of the noise, and the share of samples that may.
NOISE_BELOW, SHARE_BELOW = 6.0, 0.05


@dataclass(frozen=True, eq=False)
class Trace:
    """An oscillating signal of at least six periods.

    x: (samples,) in `unit`. done: processing already applied to the samples, in words. advice:
    processing that is recommended.
    """

    t: Float[np.ndarray, " samples"]
    x: Float[np.ndarray, " samples"]
    name: str
    unit: str
    cycle: Cycle
    done: tuple[str, ...] = ()
    advice: tuple[str, ...] = ()
    clock: Clock = SECONDS

    def __post_init__(self) -> None:
        object.__setattr__(self, "t", read_only(self.t))
        object.__setattr__(self, "x", read_only(self.x))

    @property
    def period_s(self) -> float:
        return 1.0 / self.cycle.frequency_Hz

    @property
    def is_positive(self) -> bool:
        return is_positive(self.t, self.x)


def from_one_signal(
    run: Trajectory,
    signal: str | None = None,
    *,
    decimate: int | str | None = None,
    detrend: bool = False,
) -> Trace:
    """Make a trace of one variable of a run.

    signal: None takes the only state. decimate: number of samples that are replaced by their
    mean; "auto" leaves a hundred per period. detrend: remove a straight line and keep the mean; a
    positive signal is divided by the line, from any other signal the line is subtracted.
    Raises ValueError for a signal that does not oscillate, under six periods, or a wrong setting.

    >>> t = np.linspace(0.0, 1e-3, 2001)
    >>> ep.signals.from_one_signal(ep.Trajectory(t, 3 + np.sin(6e4*t)[:, None], ["I"])).is_positive
    True
    """
    name = run.state_names[0] if signal is None and len(run.state_names) == 1 else signal
    if name is None:
        raise ValueError(f"one signal must be named: this run has {list(run.names)}")
    if not (decimate is None or decimate == "auto" or (type(decimate) is int and decimate >= 1)):
        raise ValueError(
            f"decimate must be auto, null or a whole number, one or more: {decimate!r} came"
        )
    t, x, done = run.t, run.columns([name])[:, 0], []
    if detrend:
        x = _without_line(t, x, name)
        done.append("a straight line taken out")
    cycle = _cycle(t, x, name)
    per_period = len(t) / cycle.n_periods
    spare = max(1, int(per_period // ENOUGH_SAMPLES))
    factor = spare if decimate == "auto" else int(decimate or 1)
    if factor > 1:
        t, x = _means(t, factor), _means(x, factor)
        cycle = _cycle(t, x, name)
        done.append(
            f"means over {factor} samples: {len(t)} are left, {per_period / factor:.0f} to a period"
        )
    advice = [] if factor > 1 or spare < 2 else [
        f"{per_period:.0f} samples to a period are more than the dynamics need: decimate={spare}, "
        "or decimate=auto, takes means over them, and costs less"
    ]  # fmt: skip
    drift = _drift(t, x)
    if abs(drift) > DRIFT and not detrend:
        advice.append(
            f"{name} drifts by {drift:.1f} standard deviations over the record: detrend=true takes "
            "a straight line out"
        )
    return Trace(t, x, name, run.units[name], cycle, tuple(done), tuple(advice), run.clock)


def is_positive(t: Float[np.ndarray, " samples"], x: Float[np.ndarray, " samples"]) -> bool:
    """Return true if the signal is positive at all times, apart from white noise in its samples."""
    lowest = float(x.min())
    if lowest > 0.0:
        return True
    noise = float(np.sqrt(white_variance(t, x)))
    explained = noise > 1e-3 * x.std() and lowest > -NOISE_BELOW * noise
    return bool(explained and x.mean() > 0.0 and (x <= 0.0).mean() <= SHARE_BELOW)


def _cycle(t: np.ndarray, x: np.ndarray, name: str) -> Cycle:
    """Cycle of a signal; ValueError if there is none or fewer than six periods."""
    cycle = find_cycle(t, x[:, None])
    if cycle is not None and cycle.std[0] < MIN_VISIBLE * x.std():
        cycle = None
    duration_s = float(t[-1] - t[0])
    rough = dominant_frequency(t, x) * duration_s if np.ptp(x) > 0.0 else 0.0
    n_periods = rough if cycle is None else cycle.n_periods
    remedy = "; or take out its drift (detrend=true)" if abs(_drift(t, x)) > DRIFT else ""
    if 0.5 < n_periods < MIN_PERIODS:
        doubt = " if it oscillates at all" if cycle is None else ""
        raise ValueError(
            f"a trace must hold {MIN_PERIODS:g} periods or more: {name} holds about "
            f"{n_periods:.1f} in {duration_s:.4g} s{doubt}; record longer, or crop less{remedy}"
        )
    if cycle is None:
        raise ValueError(
            f"a trace must oscillate: no period explains a quarter of the variance of {name} over "
            f"its {duration_s:.4g} s (strongest line: {rough / duration_s:.4g} Hz); crop "
            f"transients, prepare it with ep2sindy.prepare.low_pass, or take another signal{remedy}"
        )
    return cycle


def _means(values: np.ndarray, factor: int) -> np.ndarray:
    """Means over `factor` consecutive samples; an incomplete group at the end is dropped."""
    n = len(values) // factor
    return values[: n * factor].reshape(n, factor).mean(axis=1)


def _line(t: np.ndarray, x: np.ndarray) -> np.ndarray:
    return np.polynomial.Polynomial.fit(t, x, 1)(t)


def _drift(t: np.ndarray, x: np.ndarray) -> float:
    """Rise of the fitted straight line over the record, in standard deviations."""
    line = _line(t, x)
    return float((line[-1] - line[0]) / x.std())


def _without_line(t: np.ndarray, x: np.ndarray, name: str) -> np.ndarray:
    line = _line(t, x)
    if not is_positive(t, x):
        return x - line + x.mean()
    if not line.min() > 0.0:
        raise ValueError(
            f"a positive signal is divided by the line through it, which must be positive: that of "
            f"{name} falls to {line.min():.4g}; crop the record, or leave detrend out"
        )
    return x * x.mean() / line
