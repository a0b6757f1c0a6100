"""Figures of the parametric study from tables of estimates and laws, and figures of a sweep.

A sweep's figure shows the results of its jobs against their settings.
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

from ep2sindy.figures.style import (
    COLOURS,
    SIGN,
    held_label,
    hover_spot,
    legend_above,
    make_grid,
    make_panels,
    name_label,
    sample_line,
)
from ep2sindy.operating.quantity_law import ControlLaw

Style = str | tuple[int, tuple[int, ...]]

# Markers of quantities that share panels; a single quantity has the first.
MARKERS = ("o", "^", "v", "D", "P", "X")

# Line styles of the fits' laws, then of a second quantity of one fit in a panel.
LINES: tuple[Style, ...] = ("-", "--", ":", "-.", (0, (5, 1)), (0, (1, 3)))

APART = 0.022  # offset of fits at one point, as share of the axis: error bars stay visible


@dataclass(frozen=True)
class Signs:
    """Styles of fits and quantities: colours and lines for fits, markers for quantities.

    lines: line styles of the laws, by fit and quantity. All laws of a fit share one style, unless
    the fit has several in one panel.
    """

    colours: Mapping[str, str]
    markers: Mapping[str, str]
    lines: Mapping[tuple[str, str], Style]

    def of_fit(self, fit: str) -> Style:
        """Style of a fit's laws, except those of further quantities in the same panel."""
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

    estimates: a column per parameter, then fit, quantity, value, low, high. published: the same
    without low and high, drawn as open markers. laws: fit -> quantity -> law, drawn as lines.
    panels: one row each, of one or more quantities. trends: one column each, (parameter, values of
    the others). labels: names of parameters, quantities and fits on axes and in the legend; by
    default their own.
    """
    size = (4.4 * len(trends) + 0.8, 2.3 * len(panels) + 1.1)
    figure, axes = make_panels(len(panels), len(trends), size, sharex="col", sharey="row")
    fits = list(dict.fromkeys([*estimates["fit"], *published["fit"]]))
    signs = _choose_signs(fits, panels, laws)
    for row, panel in zip(axes, panels, strict=True):
        for ax, (along, at) in zip(row, trends, strict=True):
            here = [rows_at(table, at) for table in (estimates, published)]
            x = pd.concat([table[along].astype(float) for table in here])
            width = float(np.ptp(x)) if len(x) else 0.0
            for k, fit in enumerate(fits):
                offset = APART * width * (k - 0.5 * (len(fits) - 1))
                of_fit = [table[table["fit"] == fit] for table in here]
                _draw_points(ax, of_fit, along, panel, fit, signs, offset=offset)
                if width:
                    _draw_laws(ax, laws.get(fit, {}), x, (along, at), panel, fit, signs)
            ax.set_xticks(np.unique(x), [f"{value:g}" for value in np.unique(x)])
            ax.margins(x=0.08)
            ax.grid(alpha=0.3)
        row[0].set_ylabel(", ".join(name_label(name, labels) for name in panel))
    for column, (along, at) in zip(axes.T, trends, strict=True):
        column[-1].set_xlabel(name_label(along, labels))
        column[0].set_title(held_label(at, labels), fontsize=10)
    entries = _list_entries(signs, labels, published=len(published) > 0)
    legend_above(figure, entries, n_columns=5, size=9.0)
    return figure


def rows_at(table: pd.DataFrame, held: Mapping[str, Any]) -> pd.DataFrame:
    """The rows with these values."""
    for name, value in held.items():
        table = table[table[name] == value]
    return table


def _choose_signs(
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


def _draw_points(
    ax: Axes,
    tables: Sequence[pd.DataFrame],
    along: str,
    panel: Sequence[str],
    fit: str,
    signs: Signs,
    *,
    offset: float,
) -> None:
    """Draw one fit in one panel: estimates with intervals, and published values as open markers."""
    for name in panel:
        ours, theirs = (table[table["quantity"] == name] for table in tables)
        style: dict[str, Any] = {"color": signs.colours[fit], "ls": "none"}
        style["marker"] = signs.markers.get(name, MARKERS[0])
        if len(ours):
            reach = np.abs(ours[["low", "high"]].sub(ours["value"], axis=0).to_numpy().T)
            ax.errorbar(
                ours[along] + offset, ours["value"], reach, ms=5, capsize=3, lw=1, zorder=3, **style
            )
        if len(theirs):
            ax.plot(theirs[along] + offset, theirs["value"], ms=7, mfc="none", zorder=2, **style)


def _draw_laws(
    ax: Axes,
    laws: Mapping[str, ControlLaw],
    x: pd.Series,
    trend: tuple[str, Mapping[str, float]],
    panel: Sequence[str],
    fit: str,
    signs: Signs,
) -> None:
    """Draw the laws of one fit as lines, from the least to the largest value of the parameter."""
    for name in (name for name in panel if name in laws):
        line, points = sample_line(x, *trend, laws[name].library.variables)
        style: dict[str, Any] = {"color": signs.colours[fit], "ls": signs.lines[fit, name]}
        ax.plot(line, laws[name].predict(points), lw=1.2, alpha=0.8, zorder=1, **style)


def _list_entries(signs: Signs, labels: Mapping[str, str], *, published: bool) -> list[Line2D]:
    """Legend entries: a fit has its laws' line; a quantity its marker, and a line if it has one."""

    def entry(label: str, **style: object) -> Line2D:
        return Line2D([], [], **({"color": SIGN, "ls": "none"} | style), label=label)  # type: ignore[arg-type]

    entries = [
        entry(
            labels.get(fit, fit.replace("_", ", ")), color=colour, marker="o", ls=signs.of_fit(fit)
        )
        for fit, colour in signs.colours.items()
    ]
    for name, marker in signs.markers.items():
        own = [s for (fit, q), s in signs.lines.items() if q == name and s != signs.of_fit(fit)]
        entries.append(entry(name_label(name, labels), marker=marker, ls=own[0] if own else "none"))
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
    """A panel per headline figure, with a dot per job; hovering over a dot names the job.

    x: the setting of each job, or its number. values: NaN if a job has none.
    """
    figure, axes = make_grid(len(values), width=3.4, height=2.5, extra=0.2, most=3)
    for ax, (name, numbers) in zip(axes, values.items(), strict=True):
        there = np.isfinite(numbers)
        ax.plot(x[there], numbers[there], "o", color=COLOURS[0], ms=6)
        for k in np.flatnonzero(there).tolist():
            hover_spot(ax, x[k], numbers[k], f"{jobs[k]} | {name}: {numbers[k]:.4g}")
        ax.set_title(name.replace(": ", ":\n"), fontsize=9)
        ax.set_xlabel(x_label, fontsize=9)
        ax.tick_params(labelsize=8)
        ax.xaxis.set_major_locator(MaxNLocator(5, integer=bool((x == np.round(x)).all())))
        ax.margins(x=0.08, y=0.12)
        ax.grid(axis="y", alpha=0.25)
    return figure
