"""Figures of laws of the operating point: coefficients, maps and quantities.

The maps show frequency and amplitude of a law's limit cycle over its parameters; the trends, the
quantities of the parametric study over one parameter. Filled marks belong to the line, and every
mark stands at its own point.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain, cycle
from textwrap import wrap
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.textpath import TextPath

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.figures import style
from ep2sindy.figures.style import COLOURS, DATA, GREY, MORE_COLOURS, TITLE, WIDTH
from ep2sindy.library.equations import latex_derivative, latex_term_name
from ep2sindy.library.units import SECONDS, unit_product
from ep2sindy.operating.law import OperatingLaw
from ep2sindy.operating.quantities import ControlLaw

MIN_RANGE = 0.1  # least axis range, as a fraction of the coefficient's size
MAX_LINES = 5  # number of the other parameters' values that are drawn
FADED = 0.35  # opacity of a map's colours beyond the points that the law was fitted to
WRONG = "#d00000"  # marks where the law says otherwise than the record; no colour of the map
MARKERS = "os^Dv<>"  # seven, of eight colours: a pair recurs after 56

FILLED: dict[str, Any] = {"marker": "o", "ms": 3.5}
OPEN: dict[str, Any] = {"marker": "o", "ms": 6.0, "mfc": "none"}
RECORD: dict[str, Any] = {"marker": "o", "s": 52, "edgecolor": "white", "lw": 1.2}
CROSS: dict[str, Any] = {**RECORD, "marker": "X", "s": 64, "facecolor": DATA}
DIAMOND: dict[str, Any] = {"marker": "D", "s": 34, "edgecolor": DATA, "facecolor": "white"}

# Points of one kind on a map: their rows, their marks, and what the legend calls them.
Kind = tuple[pd.DataFrame, Mapping[str, Any], str]


def laws_figure(
    coefficients: pd.DataFrame,
    law: OperatingLaw,
    *,
    parameters: Sequence[str],
    labels: Mapping[str, str],
) -> Figure:
    """Every coefficient over the last parameter, with a line for each of some values of the others.

    coefficients: per point, state and term, its value by the law (filled, on the line) and refined
    at the point alone (open), with the ends of their intervals where there are any.
    """
    along, others = parameters[-1], list(parameters[:-1])
    titles = [_coef_title(law, *pair) for pair in law.coefficients]
    width = _panel_width(titles, WIDTH / min(len(titles), 3))
    figure, axes = style.make_grid(len(titles), width=width, height=2.4, extra=0.7)
    groups = _choose_lines(coefficients, along, others)
    coefs = zip(axes, titles, law.coefficients, law.coef, strict=True)
    for ax, title, (state, term), factors in coefs:
        ax.set_title(title, fontsize=TITLE, pad=14.0)  # above the ordinate's factor
        own = {"state": state, "term": term}
        for (held, group), colour in zip(groups, MORE_COLOURS, strict=False):
            rows = rows_at(group, own)
            line, points = style.sample_line(rows[along], along, held, law.parameters)
            ax.plot(line, law.functions.evaluate(points) @ factors, color=colour, lw=1.5)
            for kind, mark in (("law", FILLED), ("alone", OPEN)):
                of = rows[[kind, f"{kind}_low", f"{kind}_high"]]
                _draw_estimates(ax, rows[along], of, {"color": colour, **mark})
        ax.set_xlabel(style.name_label(along, labels))
        ax.grid(alpha=0.3)
        _focus(ax, rows_at(coefficients, own)[["alone", "law"]].to_numpy(float))
    entries = [
        Line2D([], [], color=style.SIGN, label="law of all points", **FILLED),
        Line2D([], [], color=style.SIGN, ls="none", label="each point alone", **OPEN),
    ]
    for (held, _), colour in zip(groups if others else [], MORE_COLOURS, strict=False):
        entries.append(Line2D([], [], color=colour, label=style.held_label(held, labels)))
    style.legend_above(figure, entries)
    return figure


def _coef_title(law: OperatingLaw, state: str, term: str) -> str:
    """A term in the equation of its state, with the unit of its coefficient."""
    units = {name: law.units.get(name, "1") for name in law.library.variables}
    of_term = law.library.units(units)[law.library.index(term)]
    unit = style.unit_text(unit_product([(units[state], 1), ("s", -1), (of_term, -1)]))
    return f"${latex_derivative(state)}$:  ${latex_term_name(term)}$  ({unit})"


def _panel_width(titles: Sequence[str], least: float) -> float:
    """Width in inches of panels that these titles fit above, at least this one."""
    lines = chain(*(title.splitlines() for title in titles))
    widest = max(TextPath((0, 0), line, size=TITLE).get_extents().width for line in lines)
    return max(least, widest / 72.0 + 0.3)


def _choose_lines(
    rows: pd.DataFrame, along: str, others: list[str]
) -> list[tuple[dict[str, float], pd.DataFrame]]:
    """At most MAX_LINES values of the other parameters, evenly chosen, with their rows.

    Values with a single point are left out if there are others.
    """
    by_value = rows.groupby(others) if others else [((), rows)]
    groups = [({name: float(of[name].iloc[0]) for name in others}, of) for _, of in by_value]
    groups = [group for group in groups if group[1][along].nunique() > 1] or groups
    chosen = np.linspace(0, len(groups) - 1, min(len(groups), MAX_LINES))
    return [groups[k] for k in chosen.round().astype(int)]


def _draw_estimates(ax: Axes, x: pd.Series, of: pd.DataFrame, mark: Mapping[str, Any]) -> None:
    """Draw marks at their x, with bars where the ends of an interval are known.

    of: columns of the values and of the two ends.
    """
    value, *ends = of.to_numpy(float).T
    reach = np.abs(ends - value)
    ax.errorbar(x, value, reach, ls="none", elinewidth=0.8, capsize=2, zorder=3, **mark)


def _focus(ax: Axes, values: np.ndarray) -> None:
    """Set limits by the values alone, as an interval may be very long."""
    low, high = values.min(), values.max()
    reach = max(0.65 * (high - low), 0.5 * MIN_RANGE * np.abs(values).max()) or 0.5
    ax.set_ylim(0.5 * (low + high) - reach, 0.5 * (low + high) + reach)


def cycle_figure(
    rows: pd.DataFrame,
    points: pd.DataFrame,
    *,
    branch: str,
    parameters: Sequence[str],
    labels: Mapping[str, str],
) -> Figure:
    """Frequency and amplitude of a law's cycle, with those of the records.

    A map over two parameters, a line over one, both faded where the law is extrapolated. rows: a
    grid of `MapPoint.row`, whose second parameter varies fastest. points: parameters, branch (empty
    for points that do not oscillate), f_kHz and relative_amplitude of the records. Amplitudes are
    left out if all are unknown, as of signals that swing around zero.
    """
    names, own = list(parameters), points["branch"] == branch
    factor, unit = SECONDS.frequency_scale(1e3 * float(np.nanmedian(points["f_kHz"][own])))
    rows, points = (table.assign(f_kHz=1e3 * factor * table["f_kHz"]) for table in (rows, points))
    quantities = {"f_kHz": f"frequency ({unit})", "relative_amplitude": "relative amplitude"}
    if points["relative_amplitude"][own].isna().all():
        del quantities["relative_amplitude"]
    kinds = _sort_points(rows, points.fillna({"relative_amplitude": 0.0}), own.to_numpy(), names)
    is_map = len(names) == 2
    size = (WIDTH, 4.0)
    figure, (axes,) = style.make_panels(1, len(quantities), size, sharex=True, sharey=is_map)
    for ax, (quantity, title) in zip(axes, quantities.items(), strict=True):
        colours = ScalarMappable(_colour_range(rows[quantity], points[quantity][own]))
        ax.set_xlabel(style.name_label(names[0], labels))
        if is_map:
            ax.set_ylabel(style.name_label(names[1], labels))
            figure.colorbar(colours, ax=ax, pad=0.02, extend="both", label=title)
            entries = _draw_map(ax, rows, names, quantity, colours)
        else:
            ax.set_ylabel(title)
            entries = _draw_line(ax, rows, names[0], quantity)
        for of, mark, _ in kinds:
            face = colours.to_rgba(of[quantity].to_numpy(float)) if is_map else DATA
            at = of[names] if is_map else of[[*names, quantity]]
            ax.scatter(*at.to_numpy(float).T, zorder=4, **{"facecolor": face, **mark})
    marks = [
        axes[0].scatter([], [], label=label, **{"facecolor": GREY if is_map else DATA, **mark})
        for _, mark, label in kinds
    ]
    if not rows["inside"].all():
        label = "faded: beyond the points fitted"
        entries.append(Patch(color=style.SIGN, alpha=FADED, label=label))
    style.legend_above(figure, [*marks, *entries])
    return figure


def _sort_points(
    rows: pd.DataFrame, points: pd.DataFrame, own: np.ndarray, names: list[str]
) -> list[Kind]:
    """The kinds of points that there are, each with the law's status nearest to it in rows."""
    grid, at = rows[names].to_numpy(float), points[names].to_numpy(float)
    apart = np.linalg.norm((at[:, None] - grid) / zero_to_one(np.ptp(grid, axis=0)), axis=-1)
    alive = (rows["status"] == "sustained").to_numpy()[apart.argmin(axis=1)]
    quiet = (points["branch"] == "").to_numpy()
    kinds = (
        (own & alive, RECORD, "record"),
        (own & ~alive, {**RECORD, "edgecolor": WRONG}, "record, no cycle by the law"),
        (quiet & ~alive, CROSS, "not oscillating"),
        (quiet & alive, {**CROSS, "facecolor": WRONG}, "not oscillating, unlike the law"),
        (~own & ~quiet, DIAMOND, "record of another cycle"),
    )
    return [(points[of], mark, label) for of, mark, label in kinds if of.any()]


def _draw_map(
    ax: Axes, rows: pd.DataFrame, names: list[str], quantity: str, colours: ScalarMappable
) -> list[Artist]:
    """Draw the map, and lines where its cycle ends; returns their legend entries."""
    x, y = (np.unique(rows[name].to_numpy(float)) for name in names)
    fate, faded = (rows["status"] == "sustained") - 0.5, FADED + (1.0 - FADED) * rows["inside"]
    values, opacity, alive, growth = (
        of.to_numpy(float).reshape(len(x), len(y)).T
        for of in (rows[quantity], faded, fate, rows["growth_per_s"])
    )
    mesh: dict[str, Any] = {"norm": colours.norm, "alpha": opacity, "rasterized": True}
    ax.pcolormesh(x, y, values, shading="nearest", **mesh)
    entries: list[Artist] = []
    for field, dash, label in (
        (alive, "-", "the law's cycle ends"),
        (growth, "--", "its fixed point turns stable"),
    ):
        if min(field.shape) > 1 and (field < 0.0).any() and (field > 0.0).any():
            lines: dict[str, Any] = {"linestyles": dash, "linewidths": 1.5, "colors": "black"}
            ax.contour(x, y, np.ma.masked_invalid(field), levels=[0.0], **lines)
            entries.append(Line2D([], [], color="black", lw=1.5, ls=dash, label=label))
    return entries


def _draw_line(ax: Axes, rows: pd.DataFrame, name: str, quantity: str) -> list[Artist]:
    ax.plot(rows[name], rows[quantity], color=COLOURS[0], lw=1.8, alpha=FADED)
    inside = rows[quantity].where(rows["inside"])
    law = ax.plot(rows[name], inside, color=COLOURS[0], lw=1.8, label="the law's cycle")
    ax.grid(alpha=0.3)
    return [*law]


def _colour_range(values: pd.Series, seen: pd.Series) -> Normalize:
    """Colour range of the records and nearly all of the map, kept close to the records."""
    low, high = seen.min(), seen.max()
    reach = (high - low) or abs(high)
    least, most = values.quantile([0.02, 0.98]).fillna(low)
    return Normalize(min(low, max(least, low - reach, 0.0)), max(high, min(most, high + reach)))


def trends_figure(
    estimates: pd.DataFrame,
    laws: Mapping[str, ControlLaw],
    *,
    trends: Sequence[tuple[str, Mapping[str, float]]],
    labels: Mapping[str, str],
    from_zero: bool = False,
) -> Figure:
    """Quantities of one fit against one parameter at a time, the others held, with 95 % intervals.

    estimates: a column per parameter, then kind, quantity, value, low, high; a column of panels per
    quantity, in several blocks if they are many. The first kind is drawn filled, the others open.
    laws: by quantity, of the first kind, drawn as lines between its points. trends: one row of
    panels each, (parameter, values of the others). labels: names of parameters and quantities on
    axes; by default their own. from_zero: whether axes hold zero, and thin lines join the marks of
    the first kind.
    """
    marks: dict[str, dict[str, Any]] = {
        kind: {"color": colour, "marker": marker, "ms": 5, "mfc": "none" if k else colour}
        for k, (kind, colour, marker) in enumerate(
            zip(dict.fromkeys(estimates["kind"]), cycle(COLOURS), cycle(MARKERS), strict=False)
        )
    }
    quantities = list(dict.fromkeys(estimates["quantity"]))
    titles = [style.name_label(quantity, labels) for quantity in quantities]
    figure, panels = _make_blocks(titles, len(trends))
    for of_quantity, quantity, title in zip(panels, quantities, titles, strict=True):
        shown = rows_at(estimates, {"quantity": quantity})
        of_quantity[0].set_title(title, fontsize=TITLE, y=1.0, pad=14.0)
        for ax, (along, at) in zip(of_quantity, trends, strict=True):
            ax.sharey(of_quantity[0])
            own = rows_at(shown, at)
            _draw_trend(ax, own, along, at, laws.get(quantity), marks)
            if from_zero:
                first = rows_at(own, {"kind": estimates["kind"].iloc[0]}).sort_values(along)
                ax.plot(first[along], first["value"], color=COLOURS[0], lw=0.8, zorder=1)
                ax.axhline(0.0, color=DATA, lw=0.5, zorder=1)
                reached = shown[["low", "high"]].to_numpy(float).ravel()
                ax.set_ylim(style.frame_limits(np.append(shown["value"], 0.0), reached))
            ax.set_xlabel(style.name_label(along, labels))
            if at and ax.get_subplotspec().is_first_col():
                ax.set_ylabel(f"at {style.held_label(at, labels)}".replace(", ", ",\n"))
    entries = [Line2D([], [], ls="none", label=kind, **mark) for kind, mark in marks.items()]
    if laws:
        label = f"control law, {entries[0].get_label()}"
        entries.append(Line2D([], [], color=COLOURS[0], lw=1.2, label=label))
    style.legend_above(figure, entries)
    return figure


def _make_blocks(titles: Sequence[str], n_trends: int) -> tuple[Figure, np.ndarray]:
    """Panels by quantity and trend, below each other in blocks that these titles fit above."""
    most = max(1, int(WIDTH / _panel_width(titles, WIDTH / 4)))
    n_blocks = -(-len(titles) // most)
    n_columns, n_rows = -(-len(titles) // n_blocks), n_blocks * n_trends
    figure, grid = style.make_panels(n_rows, n_columns, (WIDTH, 2.1 * n_rows + 0.5), sharex="row")
    panels = grid.reshape(n_blocks, n_trends, n_columns).swapaxes(1, 2).reshape(-1, n_trends)
    for ax in panels[len(titles) :].flat:
        ax.remove()
    return figure, panels[: len(titles)]


def rows_at(table: pd.DataFrame, held: Mapping[str, Any]) -> pd.DataFrame:
    """The rows with these values."""
    for name, value in held.items():
        table = table[table[name] == value]
    return table


def _draw_trend(
    ax: Axes,
    rows: pd.DataFrame,
    along: str,
    at: Mapping[str, float],
    law: ControlLaw | None,
    marks: Mapping[str, Mapping[str, Any]],
) -> None:
    """Draw estimates of one quantity with their intervals, and the law of the first kind."""
    for kind, mark in marks.items():
        of = rows_at(rows, {"kind": kind})
        _draw_estimates(ax, of[along], of[["value", "low", "high"]], mark)
    x = rows_at(rows, {"kind": next(iter(marks))})[along]
    if law is not None and x.nunique() > 1:
        line, points = style.sample_line(x, along, at, law.functions.variables)
        ax.plot(line, law.predict(points), color=COLOURS[0], lw=1.2, zorder=1)
    ax.margins(x=0.1)
    ax.grid(alpha=0.3)


def processes_figure(
    rates: pd.DataFrame,
    *,
    trends: Sequence[tuple[str, Mapping[str, float]]],
    labels: Mapping[str, str],
    unit: str,
) -> Figure:
    """Mean rates of processes against one parameter at a time: see `trends_figure`.

    Its quantities are the processes. Panels show zero, so that the eye compares rates and not only
    their changes. unit: of all rates.
    """
    titles = {name: "\n".join(wrap(name, 28)) for name in dict.fromkeys(rates["quantity"])}
    figure = trends_figure(rates, {}, trends=trends, labels={**labels, **titles}, from_zero=True)
    figure.supylabel(style.axis_label("rate", unit), fontsize=TITLE)
    return figure
