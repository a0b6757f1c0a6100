"""Figures of the parametric study: tables of estimates and laws in, a matplotlib Figure out.

Also of a sweep: what its jobs found, by what they were given.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from ep2sindy.figures.style import COLOURS, equals_label, hover, legend_above, panel_grid
from ep2sindy.library.equations import latex_name
from ep2sindy.operating.quantity_law import ControlLaw

Style = str | tuple[int, tuple[int, ...]]

# Of quantities that share panels; one alone has the first.
MARKERS = ("o", "^", "v", "D", "P", "X")

# Of the fits' laws, then of a second quantity of one fit in one panel.
LINES: tuple[Style, ...] = ("-", "--", ":", "-.", (0, (5, 1)), (0, (1, 3)))

APART = 0.022  # between fits at one point, of the axis: error bars must not hide each other


@dataclass(frozen=True)
class Signs:
    """What tells fits and quantities apart: colours and lines are fits', markers quantities'.

    lines: by fit and quantity, of the laws: all of one fit's alike, but where it has several in
    one panel.
    """

    colours: Mapping[str, str]
    markers: Mapping[str, str]
    lines: Mapping[tuple[str, str], Style]

    def of_fit(self, fit: str) -> Style:
        """Of its laws, apart from those of further quantities in one panel."""
        return next((style for (name, _), style in self.lines.items() if name == fit), "none")


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
    signs = _signs(fits, panels, laws)
    for row, panel in zip(axes, panels, strict=True):
        for ax, (along, at) in zip(row, trends, strict=True):
            here = [rows_at(table, at) for table in (estimates, published)]
            for k, fit in enumerate(fits):
                offset = APART * (k - 0.5 * (len(fits) - 1))
                of_fit = [table[table["fit"] == fit] for table in here]
                _points(ax, of_fit, along, panel, signs, offset=offset * _width(here, along))
                _laws(ax, laws.get(fit, {}), here, (along, at), panel, fit, signs)
            _ticks(ax, here, along)
        row[0].set_ylabel(", ".join(_label(name, labels) for name in panel))
    for column, (along, at) in zip(axes.T, trends, strict=True):
        column[-1].set_xlabel(_label(along, labels))
        held = ", ".join(equals_label(_label(name, labels), value) for name, value in at.items())
        column[0].set_title(held, fontsize=10)
    entries = _legend(signs, labels, published=len(published) > 0)
    legend_above(figure, entries, n_columns=5, size=9.0)
    return figure


def rows_at(table: pd.DataFrame, held: Mapping[str, Any]) -> pd.DataFrame:
    """The rows that have these values."""
    for name, value in held.items():
        table = table[table[name] == value]
    return table


def _signs(
    fits: Sequence[str],
    panels: Sequence[Sequence[str]],
    laws: Mapping[str, Mapping[str, ControlLaw]],
) -> Signs:
    together = dict.fromkeys(name for panel in panels if len(panel) > 1 for name in panel)
    of_fit = dict(zip((fit for fit in fits if laws.get(fit)), cycle(LINES), strict=False))
    lines: dict[tuple[str, str], Style] = {}
    for fit, style in of_fit.items():
        for panel in panels:
            further = cycle(LINES[len(of_fit) % len(LINES) :])
            for k, name in enumerate(name for name in panel if name in laws[fit]):
                lines[fit, name] = next(further) if k else style
    return Signs(
        colours=dict(zip(fits, cycle(COLOURS), strict=False)),
        markers=dict(zip(together, cycle(MARKERS), strict=False)),
        lines=lines,
    )


def _points(
    ax: Axes,
    tables: Sequence[pd.DataFrame],
    along: str,
    panel: Sequence[str],
    signs: Signs,
    *,
    offset: float,
) -> None:
    """One fit in one panel: estimates with their intervals, and, open, what was published."""
    for name in panel:
        ours, theirs = (table[table["quantity"] == name] for table in tables)
        marker = signs.markers.get(name, MARKERS[0])
        for fit, rows in ours.groupby("fit"):
            reach = np.abs(rows[["low", "high"]].sub(rows["value"], axis=0).to_numpy().T)
            ax.errorbar(
                rows[along] + offset, rows["value"], reach, fmt=marker, ms=5, capsize=3, lw=1,
                color=signs.colours[str(fit)], zorder=3,
            )  # fmt: skip
        for fit, rows in theirs.groupby("fit"):
            ax.plot(
                rows[along] + offset, rows["value"], ls="none", marker=marker, ms=7, mfc="none",
                color=signs.colours[str(fit)], zorder=2,
            )  # fmt: skip


def _laws(
    ax: Axes,
    laws: Mapping[str, ControlLaw],
    tables: Sequence[pd.DataFrame],
    trend: tuple[str, Mapping[str, float]],
    panel: Sequence[str],
    fit: str,
    signs: Signs,
) -> None:
    """Lines of one fit's laws from the least to the largest value of the parameter."""
    along, at = trend
    x = pd.concat([table[along] for table in tables])
    for name in panel:
        if name in laws and _width(tables, along):
            line = np.linspace(x.min(), x.max(), 60)
            parameters = [
                line if variable == along else np.full(60, at[variable])
                for variable in laws[name].library.variables
            ]
            predicted = laws[name].predict(np.column_stack(parameters))
            ax.plot(
                line, predicted, color=signs.colours[fit], ls=signs.lines[fit, name], lw=1.2,
                alpha=0.8, zorder=1,
            )  # fmt: skip


def _width(tables: Sequence[pd.DataFrame], along: str) -> float:
    x = pd.concat([table[along] for table in tables])
    return float(np.ptp(x)) if len(x) else 0.0


def _ticks(ax: Axes, tables: Sequence[pd.DataFrame], along: str) -> None:
    values = np.unique(np.concatenate([table[along].to_numpy(dtype=float) for table in tables]))
    ax.set_xticks(values, [f"{value:g}" for value in values])
    ax.margins(x=0.08)
    ax.grid(alpha=0.3)


def _label(name: str, labels: Mapping[str, str]) -> str:
    return labels.get(name, f"${latex_name(name)}$")


def _legend(signs: Signs, labels: Mapping[str, str], *, published: bool) -> list[Line2D]:
    """A fit's entry bears the line of its laws; a quantity's its marker, and a line of its own."""

    def entry(label: str, **style: object) -> Line2D:
        return Line2D([], [], **({"color": "#555555", "ls": "none"} | style), label=label)  # type: ignore[arg-type]

    entries = [
        entry(
            labels.get(fit, fit.replace("_", ", ")), color=colour, marker="o", ls=signs.of_fit(fit)
        )
        for fit, colour in signs.colours.items()
    ]
    for name, marker in signs.markers.items():
        own = [s for (fit, q), s in signs.lines.items() if q == name and s != signs.of_fit(fit)]
        entries.append(entry(_label(name, labels), marker=marker, ls=own[0] if own else "none"))
    if published:
        entries.append(entry(labels.get("published", "published"), marker="o", mfc="none", ms=7))
    return entries + ([entry("lines: control laws")] if signs.lines else [])


def sweep_figure(
    x: Float[np.ndarray, " jobs"],
    values: Mapping[str, Float[np.ndarray, " jobs"]],
    *,
    x_label: str,
    jobs: Sequence[str],
) -> Figure:
    """A panel per headline figure: a dot per job that has it, which says under the mouse which.

    x: what the jobs were given, or their numbers. values: NaN where a job has none.
    """
    figure, axes = panel_grid(len(values), width=3.4, height=2.5, extra=0.2, most=3)
    for ax, (name, numbers) in zip(axes, values.items(), strict=True):
        there = np.isfinite(numbers)
        ax.plot(x[there], numbers[there], "o", color=COLOURS[0], ms=6)
        for k in np.flatnonzero(there).tolist():
            (spot,) = ax.plot(x[k], numbers[k], "o", ms=13, alpha=0.0)
            hover(spot, f"{jobs[k]} | {name}: {numbers[k]:.4g}")
        ax.set_title(name.replace(": ", ":\n"), fontsize=9)
        ax.set_xlabel(x_label, fontsize=9)
        ax.tick_params(labelsize=8)
        ax.xaxis.set_major_locator(MaxNLocator(5, integer=bool((x == np.round(x)).all())))
        ax.margins(x=0.08, y=0.12)
        ax.grid(axis="y", alpha=0.25)
    return figure
