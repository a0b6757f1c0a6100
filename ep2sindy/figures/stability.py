"""Figures of a scan: the discharge over one parameter, or over two."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from textwrap import fill
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle

from ep2sindy.figures.style import (
    COLOURS,
    DATA,
    GREY,
    TITLE,
    WIDTH,
    legend_above,
    make_grid,
    make_panels,
    write_in_cell,
)

BREATHES = "oscillating"
HATCHES = {
    "steady": "//", "decaying": "\\\\", "transit": "..", "out": "--", "diverged": "xx",
    "failed": "++",
}  # fmt: skip
STATUS_MARKERS = {BREATHES: "o", "steady": "s", "decaying": "v", "transit": "D", "out": "_"}
WORTHLESS = ("diverged", "failed")  # statuses whose current is meaningless
CURVES = {  # column -> title, factor
    "I_d_mean": ("discharge current (A)", 1.0),
    "f_kHz": ("frequency (kHz)", 1.0),
    "thrust_N": ("thrust (mN)", 1e3),
    "anode_efficiency": ("anode efficiency (%)", 100.0),
}
DARK = 0.6  # on the colour scale: text is black below, white above


def stability_figure(
    points: pd.DataFrame, axes: Sequence[str], labels: Mapping[str, str]
) -> Figure:
    """Standard deviation of the current over two parameters; one panel per value of the others.

    points: texts in the columns `axes`, the first along x, and status, cycle, I_d_std and f_kHz.
    labels: names of the parameters.
    """
    along, up, *others = axes
    groups = list(points.groupby(others, sort=False)) if others else [((), points)]
    x, y = (list(dict.fromkeys(points[name])) for name in (along, up))
    figure, panels = make_grid(
        len(groups), width=0.95 * len(x) + 0.7, height=0.62 * len(y) + 0.9, extra=0.7,
        sharex=True, sharey=True,
    )  # fmt: skip
    figure.set_figwidth(max(figure.get_figwidth() + 1.8, 5.5))
    known = points.loc[~points["status"].isin(WORTHLESS), "I_d_std"]
    scale = Normalize(0.0, float(known.max()) if len(known) and known.max() > 0 else 1.0)
    for ax, (held, group) in zip(panels, groups, strict=True):
        for row in group.to_dict("records"):
            _draw_cell(ax, x.index(row[along]), y.index(row[up]), row, scale)
        title = [f"{labels[name]}: {value}" for name, value in zip(others, held, strict=True)]
        ax.set_title(", ".join(title), fontsize=TITLE)
        ax.set(xlim=(0, len(x)), ylim=(0, len(y)))
        ax.set_xticks(np.arange(len(x)) + 0.5, x)
        ax.set_yticks(np.arange(len(y)) + 0.5, y)
        ax.tick_params(length=0)
    figure.supxlabel(labels[along], fontsize=TITLE)
    figure.supylabel(fill(labels[up], 26), fontsize=TITLE, multialignment="center")
    bar = figure.colorbar(ScalarMappable(scale, colormaps["Blues"]), ax=panels, pad=0.02)
    bar.set_label("standard deviation of the\ndischarge current (A)")
    seen = [name for name in HATCHES if (points["status"] == name).any()]
    if seen:
        style: dict[str, Any] = {"facecolor": "white", "edgecolor": DATA}
        legend_above(figure, [Patch(hatch=2 * HATCHES[n], label=n, **style) for n in seen])
    return figure


def _draw_cell(ax: Axes, column: int, row: int, point: Mapping[Any, Any], scale: Normalize) -> None:
    """Draw one point: amplitude as colour, hatched and labelled if it does not breathe."""
    status, std = point["status"], float(point["I_d_std"])
    known = status not in WORTHLESS and np.isfinite(std)
    colour = colormaps["Blues"](scale(std)) if known else "white"
    hatch = HATCHES.get(status)
    style: dict[str, Any] = {"facecolor": colour, "edgecolor": GREY, "lw": 0.8, "hatch": hatch}
    ax.add_patch(Rectangle((column, row), 1, 1, **style))
    lines = [f"{std:.2f} A"] if known else []
    if np.isfinite(point["f_kHz"]) and known:
        lines += [f"{point['f_kHz']:.1f} kHz"]
    lines += [str(point["cycle"]) if status == BREATHES else status]
    dark = known and hatch is None and scale(std) > DARK
    text = write_in_cell(ax, column, row, "\n".join(lines), colour="white" if dark else "black")
    if hatch:
        text.set_bbox({"facecolor": "white", "alpha": 0.85, "lw": 0, "pad": 1.5})


def curves_figure(points: pd.DataFrame, along: str, label: str) -> Figure:
    """Current with its standard deviation, frequency, thrust and efficiency over one parameter.

    points: values or texts in the column `along`, and the columns of CURVES; markers show statuses.
    """
    figure, panels = make_panels(2, 2, (WIDTH, 5.2), sharex=True)
    numbers = pd.api.types.is_numeric_dtype(points[along])
    x = points[along].to_numpy(float) if numbers else np.arange(len(points), dtype=float)
    for ax, (name, (title, factor)) in zip(panels.flat, CURVES.items(), strict=True):
        kept = (~points["status"].isin(WORTHLESS)).to_numpy()
        order = np.argsort(x[kept])
        values = factor * points[name].to_numpy(float)
        if numbers:
            ax.plot(x[kept][order], values[kept][order], color=GREY, lw=1.0, zorder=1)
        for status in STATUS_MARKERS:
            here = (points["status"] == status).to_numpy()
            reach = points["I_d_std"][here] if name == "I_d_mean" else None
            ax.errorbar(x[here], values[here], reach, capsize=3, ms=5, **_status_style(status))
        for place, status in zip(x[~kept], points["status"][~kept], strict=True):
            ax.axvline(place, lw=1.0, **_status_style(status))
        ax.set_title(title, fontsize=TITLE)
        ax.grid(alpha=0.3)
        ax.margins(x=0.08)
        if not numbers:
            ax.set_xticks(x, points[along])
    for ax in panels[-1]:
        ax.set_xlabel(label)
    seen = [name for name in (BREATHES, *HATCHES) if (points["status"] == name).any()]
    legend_above(figure, [Line2D([], [], label=name, **_status_style(name)) for name in seen])
    return figure


def _status_style(status: str) -> dict[str, Any]:
    """A marker for a status, or an upright line if the current is meaningless."""
    if status in STATUS_MARKERS:
        colour = COLOURS[0] if status == BREATHES else COLOURS[1]
        return {"ls": "none", "marker": STATUS_MARKERS[status], "color": colour}
    return {"ls": ":" if status == "diverged" else "--", "color": COLOURS[3]}
