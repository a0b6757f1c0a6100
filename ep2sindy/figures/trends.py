"""Figures of the parametric study from tables of estimates and laws."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ep2sindy.figures.style import (
    COLOURS,
    TITLE,
    WIDTH,
    held_label,
    legend_above,
    make_panels,
    name_label,
    sample_line,
)
from ep2sindy.operating.quantity_law import ControlLaw

PUBLISHED = "published"  # the kind of estimate that comes from a publication

APART = 0.022  # offset of fits at one point, as share of the axis: error bars stay visible


def trends_figure(
    estimates: pd.DataFrame,
    laws: Mapping[str, ControlLaw],
    *,
    trends: Sequence[tuple[str, Mapping[str, float]]],
    labels: Mapping[str, str],
) -> Figure:
    """Quantities of one fit against one parameter at a time, the others held, with 95 % intervals.

    estimates: a column per parameter, then kind, quantity, value, low, high; a column of panels per
    quantity, a colour per kind. Those of kind `PUBLISHED` are drawn as open marks. laws: by
    quantity, drawn as lines in the first kind's colour. trends: one row of panels each, (parameter,
    values of the others). labels: names of parameters, quantities and kinds on axes and in the
    legend; by default their own.
    """
    quantities = list(dict.fromkeys(estimates["quantity"]))
    colours = dict(zip(dict.fromkeys(estimates["kind"]), cycle(COLOURS), strict=False))
    size = (WIDTH, 2.1 * len(trends) + 0.5)
    figure, axes = make_panels(len(trends), len(quantities), size, sharex="row", sharey="col")
    for row, (along, at) in zip(axes, trends, strict=True):
        here = rows_at(estimates, at)
        for ax, quantity in zip(row, quantities, strict=True):
            x = here[along].astype(float)
            _draw_kinds(ax, rows_at(here, {"quantity": quantity}), along, colours, np.ptp(x))
            if quantity in laws and np.ptp(x):
                line, points = sample_line(x, along, at, laws[quantity].library.variables)
                colour = next(iter(colours.values()))
                ax.plot(line, laws[quantity].predict(points), color=colour, lw=1.2, zorder=1)
            ax.set_xticks(np.unique(x), [f"{value:g}" for value in np.unique(x)])
            ax.set_xlabel(name_label(along, labels))
            ax.margins(x=0.1)
            ax.grid(alpha=0.3)
        row[0].set_ylabel(f"at {held_label(at, labels)}" if at else "")
    for ax, quantity in zip(axes[0], quantities, strict=True):
        title = name_label(quantity, labels)
        ax.set_title(title, fontsize=TITLE, y=1.0, pad=14.0)  # above the ordinate's factor
    legend_above(figure, _list_entries(colours, labels, laws=bool(laws)))
    return figure


def rows_at(table: pd.DataFrame, held: Mapping[str, Any]) -> pd.DataFrame:
    """The rows with these values."""
    for name, value in held.items():
        table = table[table[name] == value]
    return table


def _draw_kinds(
    ax: Axes, rows: pd.DataFrame, along: str, colours: Mapping[str, str], width: float
) -> None:
    """Draw estimates of one quantity with their intervals, the kinds a little beside each other."""
    for k, (kind, colour) in enumerate(colours.items()):
        of = rows_at(rows, {"kind": kind})
        reach = np.abs(of[["low", "high"]].sub(of["value"], axis=0).to_numpy().T)
        x = of[along] + APART * width * (k - 0.5 * (len(colours) - 1))
        ax.errorbar(x, of["value"], reach, capsize=3, lw=1, zorder=3, **_mark(kind, colour))


def _mark(kind: str, colour: str) -> dict[str, Any]:
    face = "none" if kind == PUBLISHED else colour
    return {"color": colour, "ls": "none", "marker": "o", "ms": 5, "mfc": face}


def _list_entries(
    colours: Mapping[str, str], labels: Mapping[str, str], *, laws: bool
) -> list[Line2D]:
    """Legend entries: a mark for each kind, and the line of the laws in the first one's colour."""
    marks = [
        Line2D([], [], label=labels.get(kind, kind), **_mark(kind, colour))
        for kind, colour in colours.items()
    ]
    colour = next(iter(colours.values()))
    return marks + ([Line2D([], [], color=colour, lw=1.2, label="control law")] if laws else [])
