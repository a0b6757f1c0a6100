"""Smoothers that smooth sampled states and differentiate them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float
from numpy.lib.stride_tricks import sliding_window_view

from ep2sindy.signals.spectrum import is_uniform

BLOCK = 262_144  # samples that are differentiated at once


@runtime_checkable
class Smoother(Protocol):
    """Interface of the smoothers: smoothed samples, and their time derivative."""

    def smooth(
        self, t: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples columns"]
    ) -> Float[np.ndarray, "samples columns"]: ...

    def derivative(
        self, t: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples columns"]
    ) -> Float[np.ndarray, "samples columns"]: ...


def difference(
    t: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples columns"]
) -> Float[np.ndarray, "samples columns"]:
    """Second-order finite differences, exact for parabolas, also at unequal steps and the ends."""
    if len(t) < 3:
        raise ValueError(f"second-order differences need three samples or more: {len(t)} came")
    found = np.empty(values.shape)
    for start in range(0, len(t), BLOCK):  # differences hold several copies
        first = max(start - 2, 0)
        some, own = slice(first, start + BLOCK + 1), slice(start, start + BLOCK)
        part = np.gradient(values[some], t[some], axis=0, edge_order=2)
        found[own] = part[start - first :][:BLOCK]
    return found


@dataclass(frozen=True)
class NoSmoothing:
    """Use the samples unchanged, for data without noise."""

    def smooth(
        self, t: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples columns"]
    ) -> Float[np.ndarray, "samples columns"]:
        return values

    def derivative(
        self, t: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples columns"]
    ) -> Float[np.ndarray, "samples columns"]:
        return difference(t, values)


@dataclass(frozen=True)
class SavitzkyGolay:
    """Fit a least-squares polynomial of `order` over `window` samples around every sample.

    The derivative is the second-order difference of the smoothed samples (the thesis's
    "smoothed finite difference"). Near the ends the first and the last full window are used, so
    nothing wraps around. With unequal steps the polynomial is fitted to the actual times.
    Raises ValueError unless window is odd and above order.
    Source: Savitzky & Golay 1964, doi:10.1021/ac60214a047.
    """

    window: int = 11
    order: int = 3

    def __post_init__(self) -> None:
        if self.window % 2 == 0 or not 0 <= self.order < self.window:
            raise ValueError(
                "a Savitzky-Golay window must be odd and longer than its order: "
                f"window={self.window}, order={self.order} came"
            )

    def smooth(
        self, t: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples columns"]
    ) -> Float[np.ndarray, "samples columns"]:
        """Raises ValueError when the trajectory is shorter than the window."""
        if len(t) < self.window:
            raise ValueError(
                f"smoothing needs at least {self.window} samples (its window): {len(t)} came; "
                "shorten the window or join more data"
            )
        if is_uniform(t):
            return self._smooth_equal(values)
        return self._smooth_unequal(t, values)

    def derivative(
        self, t: Float[np.ndarray, " samples"], values: Float[np.ndarray, "samples columns"]
    ) -> Float[np.ndarray, "samples columns"]:
        return difference(t, self.smooth(t, values))

    def _smooth_equal(self, values: np.ndarray) -> np.ndarray:
        """Weighted sums over windows: each sample takes its own, those at the ends the nearest."""
        half, weights = self.window // 2, self._weights
        smoothed = np.empty(values.shape)
        for column, target in zip(values.T, smoothed.T, strict=True):
            target[half : len(values) - half] = np.correlate(column, weights[half])
        smoothed[:half] = weights[:half] @ values[: self.window]
        smoothed[len(values) - half :] = weights[half + 1 :] @ values[len(values) - self.window :]
        return smoothed

    @cached_property
    def _weights(self) -> Float[np.ndarray, "window window"]:
        """Weights of a window's samples; row k gives the polynomial at sample k."""
        powers = np.linspace(-1.0, 1.0, self.window)[:, None] ** np.arange(self.order + 1)
        return powers @ np.linalg.pinv(powers)

    def _smooth_unequal(self, t: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Fit the window around each sample in scaled time; the nearest full one at the ends."""
        first = np.clip(np.arange(len(t)) - self.window // 2, 0, len(t) - self.window)
        window_t = sliding_window_view(t, self.window)[first] - t[:, None]
        window_t = window_t / np.abs(window_t).max(axis=1, keepdims=True)
        powers = window_t[:, :, None] ** np.arange(self.order + 1)
        # Row 0 of the pseudo-inverse gives the constant: the polynomial at the sample itself.
        weights = np.linalg.pinv(powers)[:, 0]
        windows = sliding_window_view(values, self.window, axis=0)[first]
        return np.einsum("sw,scw->sc", weights, windows)
