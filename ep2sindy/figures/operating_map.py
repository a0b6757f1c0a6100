"""Figures of what a law says over its parameters: frequency and amplitude of the cycle."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from scipy.spatial import ConvexHull, QhullError

from ep2sindy.figures.operating import frequency_scale, parameter_label
from ep2sindy.figures.style import COLOURS, DATA, GREY, legend_above

QUANTITIES = ("f_kHz", "relative_amplitude")
_MARK = {"ls": "none", "color": COLOURS[1], "zorder": 4}
CROSS: dict[str, Any] = {**_MARK, "marker": "x", "mew": 1.8, "ms": 6.5}
DIAMOND: dict[str, Any] = {**_MARK, "marker": "D", "mfc": "white", "mew": 1.5, "ms": 6.0}


def map_figure(
    rows: pd.DataFrame,
    points: pd.DataFrame,
    fitted: np.ndarray,
    *,
    branch: str,
    parameters: Sequence[str],
    labels: Mapping[str, str],
) -> Figure:
    """Frequency and amplitude of a law's cycle over two parameters, over those of the records.

    rows: a grid, its second parameter varying fastest. points: branch (none: it does not
    oscillate), f_kHz and relative_amplitude of the records. fitted: those of the law.
    """
    x, y = (np.unique(rows[name].to_numpy(float)) for name in parameters)
    own, quiet, other = _parted(points, branch)
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    for ax, quantity in zip(axes, QUANTITIES, strict=True):
        factor, title = _scaled(quantity, own)
        values = factor * rows[quantity].to_numpy(float).reshape(len(x), len(y))
        seen = factor * own[quantity].to_numpy(float)
        scale, colours = _colour_range(values, seen), colormaps["viridis"]
        ax.pcolormesh(x, y, values.T, norm=scale, cmap=colours, shading="nearest", rasterized=True)
        _boundaries(ax, x, y, rows, fitted)
        at = own[list(parameters)].to_numpy(float)
        ax.scatter(*at.T, c=colours(scale(seen)), s=52, edgecolor="white", lw=1.2, zorder=4)
        for which, style in ((quiet, CROSS), (other, DIAMOND)):
            ax.plot(*which[list(parameters)].to_numpy(float).T, **style)
        xlabel, ylabel = (parameter_label(name, labels) for name in parameters)
        ax.set(xlabel=xlabel, ylabel=ylabel)
        bar = figure.colorbar(ScalarMappable(scale, colours), ax=ax, pad=0.02, extend="both")
        bar.set_label(title)
    entries = _entries(Line2D([], [], ls="none", marker="o", color=GREY, mec=DATA), quiet, other)
    entries += [
        Line2D([], [], color="black", lw=1.8, label="the model's cycle ends"),
        Line2D([], [], color="black", lw=1.3, ls="--", label="its fixed point turns stable"),
        Line2D([], [], color=GREY, lw=1.5, label="points fitted"),
    ]
    legend_above(figure, entries, size=9.0)
    return figure


def line_figure(
    rows: pd.DataFrame,
    points: pd.DataFrame,
    fitted: np.ndarray,
    *,
    branch: str,
    parameters: Sequence[str],
    labels: Mapping[str, str],
) -> Figure:
    """The same as `map_figure` over the one parameter that there is."""
    (name,) = parameters
    own, quiet, other = _parted(points, branch)
    figure = Figure(figsize=(8.4, 3.6), layout="constrained")
    for ax, quantity in zip(figure.subplots(1, 2), QUANTITIES, strict=True):
        factor, title = _scaled(quantity, own)
        ax.axvspan(fitted.min(), fitted.max(), color=GREY, alpha=0.2, lw=0)
        ax.plot(rows[name], factor * rows[quantity], color=COLOURS[0], lw=1.8)
        ax.plot(own[name], factor * own[quantity], "o", color=DATA, mfc="white", zorder=3)
        ax.plot(other[name], factor * other[quantity], **DIAMOND)
        bottom = ax.get_xaxis_transform()
        ax.plot(quiet[name], np.full(len(quiet), 0.05), transform=bottom, **CROSS)
        ax.set(xlabel=parameter_label(name, labels), ylabel=title)
        ax.grid(alpha=0.3)
    entries = _entries(Line2D([], [], ls="none", marker="o", color=DATA, mfc="white"), quiet, other)
    law = Line2D([], [], color=COLOURS[0], lw=1.8, label="the model's cycle")
    legend_above(
        figure, [law, *entries, Patch(color=GREY, alpha=0.2, label="points fitted")], size=9.0
    )
    return figure


def _parted(points: pd.DataFrame, branch: str) -> tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]:
    """Records of this cycle, points that do not oscillate, and records of another cycle."""
    own, quiet = points["branch"] == branch, points["branch"] == ""
    return points[own], points[quiet], points[~own & ~quiet]


def _entries(record: Line2D, quiet: pd.DataFrame, other: pd.DataFrame) -> list[Artist]:
    """Of a legend: records, and what else there is among the points."""
    record.set_label("record")
    found: list[Artist] = [record]
    for which, style, label in (
        (quiet, CROSS, "not oscillating"),
        (other, DIAMOND, "record of another cycle"),
    ):
        if len(which):
            found.append(Line2D([], [], **style, label=label))
    return found


def _scaled(quantity: str, records: pd.DataFrame) -> tuple[float, str]:
    """Factor on a quantity, and what its axis says."""
    if quantity != "f_kHz":
        return 1.0, "relative amplitude"
    factor, unit = frequency_scale(records["f_kHz"])
    return factor, f"frequency ({unit})"


def _colour_range(values: np.ndarray, seen: np.ndarray) -> Normalize:
    """That of the records and of nearly all of the map, but not far beyond the records."""
    low, high = seen.min(), seen.max()
    reach = (high - low) or abs(high)
    if np.isfinite(values).any():
        ends = np.nanquantile(values, [0.02, 0.98])
        low = min(low, max(ends[0], low - reach, 0.0))
        high = max(high, min(ends[1], high + reach))
    return Normalize(low, high)


def _boundaries(
    ax: Axes, x: np.ndarray, y: np.ndarray, rows: pd.DataFrame, fitted: np.ndarray
) -> None:
    """Where cycles end, where the fixed point turns stable, and the hull of what was fitted."""
    shape = (len(x), len(y))
    alive = (rows["fate"] == "oscillates").to_numpy().reshape(shape).astype(float)
    if min(shape) > 1 and 0.0 < alive.mean() < 1.0:
        ax.contour(x, y, alive.T, levels=[0.5], colors="black", linewidths=1.8)
    growth = rows["growth_per_s"].to_numpy(float).reshape(shape)
    if min(shape) > 1 and (growth < 0.0).any() and (growth > 0.0).any():
        ax.contour(
            x, y, np.ma.masked_invalid(growth.T), levels=[0.0], colors="black", linewidths=1.3,
            linestyles="--",
        )  # fmt: skip
    ax.plot(*_outline(fitted).T, color=GREY, lw=1.5)


def _outline(points: np.ndarray) -> np.ndarray:
    """Closed convex outline; the ends of a line where all lie on one."""
    scaled = (points - points.min(axis=0)) / np.ptp(points, axis=0)
    try:
        around = ConvexHull(scaled).vertices
    except QhullError:
        around = np.argsort(scaled[:, 0])[[0, -1]]
    return points[[*around, around[0]]]
