"""Figures of the parametric study: tables of estimates and laws in, a matplotlib Figure out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ep2sindy.discovery.control_law import ControlLaw
from ep2sindy.figures.style import COLOURS, legend_above
from ep2sindy.library.equations import latex_name

# Of the quantities that share a panel: their points, and the lines of their laws.
MARKERS = ("o", "^", "v", "D", "P", "X")

LINES = ("-", "--", ":", "-.", (0, (5, 1)), (0, (1, 3)))

APART = 0.016  # between fits at one point, of the axis: error bars must not hide each other


def trends_figure(
    estimates: pd.DataFrame,
    published: pd.DataFrame,
    laws: Mapping[str, Mapping[str, ControlLaw]],
    *,
    panels: Sequence[Sequence[str]],
    trends: Sequence[tuple[str, Mapping[str, float]]],
    labels: Mapping[str, str],
) -> Figure:
    """Quantities against one parameter at a time, the others held, with 95 % intervals.

    estimates: a column per parameter, then fit, quantity, value, low, high. published: the same,
    without ends, as open markers. laws: fit -> quantity -> law, as lines.
    panels: a row each, of one or more quantities. trends: a column each, (parameter, those held).
    labels: what axes and the legend call parameters, quantities and fits; else their names.
    """
    size = (4.4 * len(trends) + 0.8, 2.3 * len(panels) + 1.1)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(panels), len(trends), squeeze=False, sharex="col", sharey="row")
    fits = list(dict.fromkeys([*estimates["fit"], *published["fit"]]))
    for row, panel in zip(axes, panels, strict=True):
        for ax, (along, at) in zip(row, trends, strict=True):
            here = [rows_at(table, at) for table in (estimates, published)]
            for k, fit in enumerate(fits):
                offset = APART * (k - 0.5 * (len(fits) - 1))
                _series(
                    ax,
                    here,
                    laws.get(fit, {}),
                    along,
                    at,
                    panel,
                    fit,
                    COLOURS[k % len(COLOURS)],
                    offset,
                )
            _ticks(ax, here, along)
        row[0].set_ylabel(", ".join(_label(name, labels) for name in panel))
    for column, (along, at) in zip(axes.T, trends, strict=True):
        column[-1].set_xlabel(_label(along, labels))
        held = ", ".join(_equals(_label(name, labels), value) for name, value in at.items())
        column[0].set_title(held, fontsize=10)
    entries = _legend(fits, panels, labels, published=len(published) > 0, lines=bool(laws))
    legend_above(figure, entries, n_columns=5, size=9.0)
    return figure


def rows_at(table: pd.DataFrame, held: Mapping[str, Any]) -> pd.DataFrame:
    """The rows that have these values."""
    for name, value in held.items():
        table = table[table[name] == value]
    return table


def _series(
    ax: Axes,
    tables: Sequence[pd.DataFrame],
    laws: Mapping[str, ControlLaw],
    along: str,
    at: Mapping[str, float],
    panel: Sequence[str],
    fit: str,
    colour: str,
    offset: float,
) -> None:
    """One fit in one panel: estimates, what was published, and the law's line."""
    x = pd.concat([table[along] for table in tables])
    width = float(np.ptp(x)) if len(x) else 0.0
    for marker, style, name in zip(MARKERS, LINES, panel, strict=False):
        ours, theirs = (
            table[(table["fit"] == fit) & (table["quantity"] == name)] for table in tables
        )
        if len(ours):
            reach = np.abs(ours[["low", "high"]].sub(ours["value"], axis=0).to_numpy().T)
            at_x = ours[along] + offset * width
            ax.errorbar(at_x, ours["value"], reach, fmt=marker, color=colour, ms=5, capsize=3, lw=1)
        at_x = theirs[along] + offset * width
        ax.plot(at_x, theirs["value"], ls="none", marker=marker, color=colour, ms=6.5, mfc="none")
        if name in laws and width:
            line = np.linspace(x.min(), x.max(), 60)
            parameters = [
                line if variable == along else np.full(60, at[variable])
                for variable in laws[name].library.variables
            ]
            predicted = laws[name].predict(np.column_stack(parameters))
            ax.plot(line, predicted, color=colour, ls=style, lw=1.1, alpha=0.7)


def _ticks(ax: Axes, tables: Sequence[pd.DataFrame], along: str) -> None:
    values = np.unique(np.concatenate([table[along].to_numpy(dtype=float) for table in tables]))
    ax.set_xticks(values, [f"{value:g}" for value in values])
    ax.margins(x=0.08)
    ax.grid(alpha=0.3)


def _equals(label: str, value: float) -> str:
    """`$V_D$ (V)` at 300 -> `$V_D$ = 300 V`."""
    symbol, _, unit = label.removesuffix(")").rpartition(" (")
    return f"{symbol} = {value:g} {unit}" if symbol else f"{label} = {value:g}"


def _label(name: str, labels: Mapping[str, str]) -> str:
    return labels.get(name, f"${latex_name(name)}$")


def _legend(
    fits: Sequence[str],
    panels: Sequence[Sequence[str]],
    labels: Mapping[str, str],
    *,
    published: bool,
    lines: bool,
) -> list[Line2D]:
    """Colours are fits; where quantities share a panel, markers and lines tell them apart."""

    def entry(label: str, **style: object) -> Line2D:
        return Line2D([], [], **({"color": "#555555", "ls": "none"} | style), label=label)  # type: ignore[arg-type]

    entries = [
        entry(labels.get(fit, fit.replace("_", ", ")), color=colour, marker="o")
        for fit, colour in zip(fits, COLOURS, strict=False)
    ]
    for panel in panels:
        if len(panel) > 1:
            entries += [
                entry(_label(name, labels), marker=marker, ls=style if lines else "none")
                for name, marker, style in zip(panel, MARKERS, LINES, strict=False)
            ]
    entries += (
        [entry(labels.get("published", "published"), marker="o", mfc="none")] if published else []
    )
    return entries + ([entry("control law", ls="-")] if lines else [])
