"""What a panel shows of curves that may leave it, and where they do."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

Limits = tuple[float, float]

# Tips at the edge that a curve crosses: left, right, below, above.
CARETS = {(0, 0): 4, (0, 1): 5, (1, 0): 7, (1, 1): 6}

OFF_SCALE, STOPS = "off scale", "diverged"

SIGN = "#555555"  # of marks in a legend, which stand for those of every colour


def framing(
    data: Float[np.ndarray, " samples"],
    models: Float[np.ndarray, " values"],
    *,
    rare: float = 0.0,
) -> Limits:
    """Limits around data and models, within twice the data's range.

    A model that runs away must not shrink the rest. Nor may rare values of the data: that share
    of them, the lowest and the highest, does not count for the range, as at a derivative's ends.
    """
    values = np.sort(data)
    n = min(int(np.ceil(rare * len(values))), (len(values) - 1) // 2)
    low, high = float(values[n]), float(values[len(values) - 1 - n])
    if low == high:
        low, high = float(values[0]), float(values[-1])
    reach = 0.5 * (high - low)
    everything = np.concatenate([values, models[np.isfinite(models)]])
    bottom = max(low - reach, float(everything.min()))
    top = min(high + reach, float(everything.max()))
    margin = 0.05 * (top - bottom) or 0.05 * abs(top) or 1.0
    return bottom - margin, top + margin


def exits(
    x: Float[np.ndarray, " points"],
    y: Float[np.ndarray, " points"],
    x_limits: Limits,
    y_limits: Limits,
) -> list[tuple[float, float, int]]:
    """Where a curve leaves a panel: (x, y, marker) on the edge that it crosses first.

    A curve that begins outside leaves at the point of the edge that is nearest to its first.
    """
    points, limits = np.column_stack([x, y]), np.array([x_limits, y_limits])
    points = points[np.isfinite(points).all(axis=1)]
    inside = ((points >= limits[:, 0]) & (points <= limits[:, 1])).all(axis=1)
    found = []
    if len(points) and not inside[0]:
        found.append(_crossing(limits.mean(axis=1), points[0], limits, nearest=True))
    for k in np.flatnonzero(inside[:-1] & ~inside[1:]):
        found.append(_crossing(points[k], points[k + 1], limits))
    return found


def _crossing(
    start: np.ndarray, end: np.ndarray, limits: np.ndarray, *, nearest: bool = False
) -> tuple[float, float, int]:
    """Of the line from a point inside to one outside, and the caret of that edge."""
    shares = {
        (axis, side): (limits[axis, side] - start[axis]) / (end[axis] - start[axis])
        for axis in (0, 1)
        for side, beyond in enumerate((end < limits[:, 0], end > limits[:, 1]))
        if beyond[axis]
    }
    axis, side = min(shares, key=lambda edge: shares[edge])
    place = end if nearest else start + shares[axis, side] * (end - start)
    place = np.clip(place, limits[:, 0], limits[:, 1])
    place[axis] = limits[axis, side]
    return float(place[0]), float(place[1]), CARETS[axis, side]


def mark_exits(
    ax: Axes,
    x: Float[np.ndarray, " points"],
    y: Float[np.ndarray, " points"],
    *,
    colour: str,
    limits: tuple[Limits, Limits],
    diverged: bool = False,
) -> None:
    """Carets where a curve leaves the panel; a cross where a run that diverged stops inside."""
    for at_x, at_y, marker in exits(x, y, *limits):
        ax.plot(
            at_x, at_y, marker=marker, ls="none", color=colour, ms=7.0, clip_on=False, zorder=5,
            label=f"_{OFF_SCALE}",
        )  # fmt: skip
    within = len(x) and all(
        low <= end <= high for end, (low, high) in zip((x[-1], y[-1]), limits, strict=True)
    )
    if diverged and within:
        ax.plot(x[-1], y[-1], "x", color=colour, ms=6, mew=1.6, zorder=5, label=f"_{STOPS}")


def legend_marks(panels: Iterable[Axes]) -> Sequence[Line2D]:
    """Entries for the marks that there are in any of the panels."""
    there = {str(line.get_label()) for ax in panels for line in ax.lines}
    signs: dict[str, Any] = {OFF_SCALE: 6, STOPS: "x"}
    return [
        Line2D([], [], ls="none", marker=marker, color=SIGN, label=label)
        for label, marker in signs.items()
        if f"_{label}" in there
    ]
