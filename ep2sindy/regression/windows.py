"""Windows of weak rows: test functions on segments of neighbouring samples, as weighted sums.

Samples at unequal steps are first brought to an even grid.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import block_diag, csr_array

from ep2sindy.data.numbers import rounding_s
from ep2sindy.runtime.values import set_counts

Signal = Float[np.ndarray, " samples"]


@dataclass(frozen=True, eq=False)
class Windows:
    """Test functions phi on segments of neighbouring samples, one for every row.

    mean, slope: (rows, samples), weights that are stored for all samples of each row's segment and
    for no others. mean @ values is the integral of phi * values divided by that of phi. slope @ x
    is the integral of phi * x' divided by that of phi, computed by parts without differencing x.
    """

    mean: csr_array
    slope: csr_array

    def __len__(self) -> int:
        return int(self.mean.shape[0])

    @property
    def first(self) -> Int[np.ndarray, " rows"]:
        """Number of the first sample of each row."""
        return self.mean.indices[self.mean.indptr[:-1]].astype(np.int64)

    @property
    def last(self) -> Int[np.ndarray, " rows"]:
        return self.mean.indices[self.mean.indptr[1:] - 1].astype(np.int64)

    @cached_property
    def width(self) -> int:
        """Largest distance between two rows whose windows overlap, plus one."""
        rows, first, last = np.arange(len(self)), self.first, self.last
        if (np.diff(first) >= 0).all():
            return int((np.searchsorted(first, last, side="right") - rows).max(initial=1))
        pairs = enumerate(zip(first, last, strict=True))
        apart = [rows[(first <= b) & (last >= a)].max() - k for k, (a, b) in pairs]
        return int(max(apart)) + 1

    def taken(self, rows: Bool[np.ndarray, " rows"] | Int[np.ndarray, " taken"]) -> Windows:
        """Some rows, by mask or by number."""
        if rows.dtype == np.bool_ and rows.all():
            return self
        return Windows(self.mean[rows], self.slope[rows])

    @staticmethod
    def joined(parts: Sequence[Windows]) -> Windows:
        """Windows over the samples of several records, one after the other."""
        if len(parts) == 1:
            return parts[0]
        means, slopes = [part.mean for part in parts], [part.slope for part in parts]
        return Windows(block_diag(means, format="csr"), block_diag(slopes, format="csr"))

    @staticmethod
    def even(
        first: Int[np.ndarray, " rows"],
        mean: Float[np.ndarray, "*rows samples"],
        slope: Float[np.ndarray, "*rows samples"],
        n_samples: int,
    ) -> Windows:
        """Windows of one length, with weights for each row, or the same for all."""
        n, length = len(first), mean.shape[-1]
        mean, slope = (np.broadcast_to(each, (n, length)).reshape(-1) for each in (mean, slope))
        return _windows(first, np.full(n, length), (mean, slope), n_samples)

    @staticmethod
    def of_matrices(mean: csr_array, slope: csr_array) -> Windows:
        """The same sums as these products, (rows, samples); columns must be sorted."""
        both = mean, slope
        first = np.minimum(*(m.indices[m.indptr[:-1]] for m in both)).astype(np.int64)
        last = np.maximum(*(m.indices[m.indptr[1:] - 1] for m in both)).astype(np.int64)
        starts = np.append(0, np.cumsum(last + 1 - first))
        weights = np.zeros((2, starts[-1]))  # zeros where a matrix has no entry
        for matrix, filled in zip(both, weights, strict=True):
            row = np.repeat(np.arange(len(first)), np.diff(matrix.indptr))
            filled[starts[row] + matrix.indices - first[row]] = matrix.data
        return _windows(first, last + 1 - first, weights, mean.shape[1])


def _windows(
    first: Int[np.ndarray, " rows"],
    lengths: Int[np.ndarray, " rows"],
    weights: Iterable[Float[np.ndarray, " weights"]],
    n_samples: int,
) -> Windows:
    """Windows from the first sample and the length of each row, and weights row after row."""
    starts = np.append(0, np.cumsum(lengths))
    places = np.arange(starts[-1]) + np.repeat(first - starts[:-1], lengths)
    shape = len(first), n_samples
    mean, slope = (csr_array((each, places, starts), shape=shape) for each in weights)
    return Windows(mean, slope)


# Value of a bump, relative to its centre, at the first sample inside its edge.
EDGE = 1e-10

# Largest deviation from an even grid, in steps, that is attributed to rounding of the recorded
# times. The error of such a sample is a twentieth of the signal's change in a step.
ROUNDED = 0.05


@runtime_checkable
class WindowFunctions(Protocol):
    """Interface of the test functions: windows for one sampled signal."""

    def windows(self, t: Signal, x: Signal, *, rng: np.random.Generator) -> Windows: ...


@dataclass(frozen=True)
class Boxes:
    """Test functions of the thesis: 1 over random windows.

    Integrals use the trapezoidal rule; that of the derivative is the difference of x at the ends.
    Two points give the difference quotient and the mean of two samples: the differential form.
    Steps may be unequal.

    Parameters
    ----------
    n_windows : int, default 3000
        Number of windows.
    n_points : int, default 100
        Number of samples in a window.

    Raises
    ------
    ValueError
        If there is no window, or one of fewer than two points.

    Notes
    -----
    Source: the thesis, Eqs. 10 and 11.
    """

    n_windows: int = 3000
    n_points: int = 100

    def __post_init__(self) -> None:
        set_counts(self, {"n_windows": 1, "n_points": 2})

    def windows(self, t: Signal, x: Signal, *, rng: np.random.Generator) -> Windows:
        """Raises ValueError for windows longer than the trajectory."""
        _check_width(self.n_points, len(t), "n_points")
        first = np.sort(rng.integers(len(t) - self.n_points + 1, size=self.n_windows))
        last = first + self.n_points - 1
        half_steps = 0.5 * np.diff(t)
        weights = np.append(half_steps, 0.0) + np.insert(half_steps, 0, 0.0)
        inside = first[:, None] + np.arange(self.n_points)
        mean = weights[inside]
        mean[:, 0] = half_steps[first]
        mean[:, -1] = half_steps[last - 1]
        length_s = (t[last] - t[first])[:, None]
        slope = np.zeros(mean.shape)
        slope[:, 0], slope[:, -1] = -1.0, 1.0
        return Windows.even(first, mean / length_s, slope / length_s, len(t))


@dataclass(frozen=True)
class Bumps:
    """Smooth test functions on windows that overlap.

    Parameters
    ----------
    half_width_s : float, optional
        Half the length of a window, in s. None takes it from the spectrum of each state.
    tau_hat : float, default 0.7
        Number of standard deviations at which the change point between signal and noise lies in the
        tail of the bump's own spectrum, if half_width_s is None (`spectral_half_width`). The source
        takes 2. Narrower bumps keep more of the fast components and admit more noise, which
        smoothed states and the covariance of the rows can handle.
    overlap : int, default 4
        Successive windows are half_width / overlap apart.

    Raises
    ------
    ValueError
        If the half-width or tau_hat is not positive, or overlap is below 1.

    Notes
    -----
    The test function is

        phi(s) = (1 - s^2)^p,   s = (t - center) / half_width from -1 to 1

    where the power p makes phi fall to 1e-10 at the edge, so that the trapezoidal rule is
    practically exact.

    Source: Messenger & Bortz 2021, doi:10.1137/20M1343166.
    """

    half_width_s: float | None = None
    tau_hat: float = 0.7
    overlap: int = 4

    def __post_init__(self) -> None:
        if self.half_width_s is not None and not self.half_width_s > 0.0:
            raise ValueError(
                f"half_width_s must be positive, got {self.half_width_s}; leave it out to "
                "have it chosen from the spectrum"
            )
        if not self.tau_hat > 0.0 or self.overlap < 1:
            raise ValueError(
                "tau_hat must be positive and overlap at least 1, got "
                f"tau_hat={self.tau_hat}, overlap={self.overlap}"
            )

    def windows(self, t: Signal, x: Signal, *, rng: np.random.Generator) -> Windows:
        """Weights of all windows over one signal.

        Samples at unequal steps are interpolated onto an even grid; the interpolation weights
        become part of the rows. Then at most one window is centred about each sample, since more
        would depend on each other.
        Raises ValueError for windows that do not fit the trajectory.
        """
        if is_even(t):
            return self._even_windows(x, (t[-1] - t[0]) / (len(t) - 1))
        grid, lines = even_grid(t)
        windows = self._even_windows(lines @ x, grid[1] - grid[0])
        middle = grid[(windows.first + windows.last) // 2]
        kept = windows.taken(keep_one_per_sample(t, middle))
        mean, slope = kept.mean @ lines, kept.slope @ lines
        mean.sort_indices()
        slope.sort_indices()
        return Windows.of_matrices(mean, slope)

    def _even_windows(self, x: np.ndarray, dt_s: float) -> Windows:
        half_width = self._half_width(x, dt_s)
        _check_width(2 * half_width + 1, len(x), "half_width_s")
        power = bump_power(half_width)
        s = np.arange(-half_width, half_width + 1) / half_width
        phi = (1.0 - s**2) ** power
        fall = s * (1.0 - s**2) ** (power - 1.0)
        # Scaled so that the slope of a straight line is exact however few samples a bump spans.
        fall /= fall @ s * half_width * dt_s
        first = np.arange(0, len(x) - 2 * half_width, max(1, half_width // self.overlap))
        return Windows.even(first, phi / phi.sum(), fall, len(x))

    def _half_width(self, x: np.ndarray, dt_s: float) -> int:
        if self.half_width_s is None:
            return spectral_half_width(x, tau_hat=self.tau_hat)
        half_width = round(self.half_width_s / dt_s)
        if half_width < 2:
            raise ValueError(
                f"half_width_s must span two steps or more, got {self.half_width_s:g} s with "
                f"steps of {dt_s:g} s"
            )
        return half_width


def bump_power(half_width: Any) -> Any:
    """Power p for which (1 - s^2)^p falls to EDGE one sample inside the edge; two or more."""
    edge = 1.0 - (1.0 - 1.0 / np.asarray(half_width)) ** 2
    return np.maximum(2.0, np.ceil(np.log(EDGE) / np.log(edge)))


def spectral_half_width(x: Signal, *, tau_hat: float) -> int:
    """Half-width in samples of the narrowest bump whose spectrum lies below the change point.

    The spectrum of (1 - s^2)^p is close to a Gaussian of standard deviation
    n sqrt(2p + 3) / (2 pi half_width) bins; `tau_hat` standard deviations must lie below the
    change point between signal and noise.
    """
    n, widths = len(x), np.arange(2, max(3, (len(x) - 1) // 4))
    deviation = n * np.sqrt(2.0 * bump_power(widths) + 3.0) / (2.0 * np.pi * widths)
    fits = tau_hat * deviation <= spectral_change_point(x)
    return int(widths[np.argmax(fits)] if fits.any() else widths[-1])


def spectral_change_point(x: Signal) -> int:
    """Frequency bin that separates signal from noise, where the cumulated spectrum bends most.

    The cumulated amplitude spectrum is approximated by two chords that meet at the bend; the bend
    with the least sum of squares is chosen.
    """
    total = np.cumsum(np.abs(np.fft.rfft(x - x.mean())))
    last = len(total) - 1
    if last < 2:
        return 1
    # Two hundred trial corners, denser at low bins, locate a bend well enough.
    corners = np.unique(np.geomspace(1, last - 1, 200).astype(int))
    bins = np.arange(last + 1.0)
    until = np.concatenate([[0], corners, [last]])
    at = until.astype(float)
    sums = np.array([
        at, at * (at + 1.0) / 2.0, at * (at + 1.0) * (2.0 * at + 1.0) / 6.0,
        *(np.cumsum(each)[until] for each in (total, bins * total, total**2)),
    ])  # fmt: skip
    cost = np.zeros(len(corners))
    for first, end in ((np.s_[:1], np.s_[1:-1]), (np.s_[1:-1], np.s_[-1:])):
        low = total[until[first]]
        rise = (total[until[end]] - low) / (at[end] - at[first])
        start = low - rise * at[first]
        # Squares of the bins after the first one; at both ends of a chord the fit is exact.
        n, k, kk, y, ky, yy = sums[:, end] - sums[:, first]
        cost += yy + n * start**2 + kk * rise**2
        cost += 2.0 * (k * start * rise - y * start - ky * rise)
    return int(corners[np.argmin(cost)])


def _check_width(n_points: int, n_samples: int, name: str) -> None:
    if n_points > n_samples:
        raise ValueError(
            f"a window must fit the trajectory: {n_points} samples were asked of {n_samples}; "
            f"lower {name} or use more data"
        )


def is_even(t: Signal) -> bool:
    """Return true if the times lie on an even grid, apart from rounding."""
    step = (t[-1] - t[0]) / (len(t) - 1)
    off = np.abs(t - t[0] - step * np.arange(len(t))).max()
    return bool(off <= max(ROUNDED * step, rounding_s(t)))


def even_grid(t: Signal) -> tuple[Float[np.ndarray, " points"], csr_array]:
    """Even grid with about the median step, and the matrix (points, samples) that interpolates.

    Interpolation is linear: weights are not negative, so noise is never amplified.
    """
    n_steps = max(1, round(float((t[-1] - t[0]) / np.median(np.diff(t)))))
    grid = np.linspace(t[0], t[-1], n_steps + 1)
    left = np.clip(np.searchsorted(t, grid, side="right") - 1, 0, len(t) - 2)
    fraction = (grid - t[left]) / (t[left + 1] - t[left])
    weights = np.stack([1.0 - fraction, fraction], axis=1)
    columns = np.stack([left, left + 1], axis=1)
    starts = np.arange(0, 2 * len(grid) + 1, 2)
    lines = csr_array((weights.ravel(), columns.ravel(), starts), shape=(len(grid), len(t)))
    lines.eliminate_zeros()
    return grid, lines


def keep_one_per_sample(
    t: Signal, middle: Float[np.ndarray, " windows"]
) -> Int[np.ndarray, " kept"]:
    """Indices of windows to keep: the first of all windows nearest to the same sample.

    middle: increasing times of the middles of the windows.
    """
    nearest = np.searchsorted(0.5 * (t[1:] + t[:-1]), middle)
    return np.flatnonzero(np.diff(nearest, prepend=-1) > 0)
