"""What samples say of a state: values, or limits that a sensor put in their place.

Of a value all is plain: the square of its distance in units of the noise. Of limits, -2 log of the
normal probability between them takes its place, and one step of Fisher's scoring reads as a value
at some distance with a noise of its own, so that the same filter serves both.
"""

from __future__ import annotations

from math import log, pi
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ep2sindy.estimation.problem import Record

FAR_OUT = 1e3  # noise beyond a limit, where it is a value to all digits
TELLS = 1e-3  # share of a value's weight, below which limits say nothing of a state between them
LOG_ROOT_2PI = 0.5 * log(2.0 * pi)


class Seen(NamedTuple):
    """A record beside a path, all (samples, d).

    residuals: NaN where a sample says nothing; variance: that of the noise that they stand for.
    squares: what is least, zero where a sample is met.
    """

    residuals: Float[np.ndarray, "samples d"]
    variance: Float[np.ndarray, "samples d"]
    squares: Float[np.ndarray, "samples d"]


def seen(
    record: Record, path: Float[np.ndarray, "samples d"], variance: Float[np.ndarray, "samples d"]
) -> Seen:
    """How samples of a noise see a path."""
    residuals = record.samples - path
    squares = np.square(residuals) / variance
    if record.limits is None:
        return Seen(residuals, variance, squares)
    residuals, variance = residuals.copy(), variance.copy()
    at = record.limits.at
    noise = np.sqrt(variance[at])
    lower = (record.limits.lower - path)[at] / noise
    upper = (record.limits.upper - path)[at] / noise
    pull, weight, squares[at] = between(lower, upper)
    residuals[at] = np.where(weight > TELLS, noise * pull / np.maximum(weight, TELLS), np.nan)
    variance[at] = np.square(noise) / np.maximum(weight, TELLS)
    return Seen(residuals, variance, squares)


def between(
    lower: Float[np.ndarray, " n"], upper: Float[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Of a unit normal variable known to lie between limits: its mean, what knowing them tells
    (one minus its variance), and -2 log of their probability."""
    from scipy.special import log_ndtr  # for those alone whose sensors have limits

    turned = lower > -upper  # the lower tail keeps its digits
    low, high = np.where(turned, -upper, lower), np.where(turned, -lower, upper)
    log_high = log_ndtr(high)
    log_p = log_high + np.log1p(-np.exp(log_ndtr(low) - log_high))
    at_low, at_high = (np.exp(-0.5 * np.square(x) - LOG_ROOT_2PI - log_p) for x in (low, high))
    mean = at_low - at_high
    # Of an infinite limit the density is zero. Far out digits are lost: there it is a value.
    slope = np.where(np.isfinite(low), low, 0.0) * at_low
    slope -= np.where(np.isfinite(high), high, 0.0) * at_high
    tells = np.where(high < -FAR_OUT, 1.0, np.clip(np.square(mean) - slope, 0.0, 1.0))
    return np.where(turned, -mean, mean), tells, -2.0 * log_p
