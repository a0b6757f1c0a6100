"""Figures of laws of the operating point: coefficients, points left out, maps and trends.

The maps show frequency and amplitude of a law's limit cycle over its parameters; the trends, the
quantities of the parametric study over one parameter.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
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

from ep2sindy.figures.style import (
    COLOURS,
    DATA,
    GREY,
    MORE_COLOURS,
    SMALL,
    TITLE,
    WIDTH,
    held_label,
    legend_above,
    make_grid,
    make_panels,
    name_label,
    sample_line,
    unit_text,
)
from ep2sindy.library.equations import latex_derivative, latex_name, latex_term_name
from ep2sindy.library.units import unit_product, with_prefix
from ep2sindy.operating.law import OperatingLaw
from ep2sindy.operating.quantities import ControlLaw

FAR_PERCENT, FAR_WAVEFORM = 40.0, 0.6  # beyond: filled marks on the edge

MIN_RANGE = 0.1  # least axis range, as a share of the coefficient's size

MAX_LINES = 5  # number of the second parameter's values that are drawn

QUANTITIES = ("f_kHz", "relative_amplitude")
_MARK = {"ls": "none", "color": COLOURS[1], "zorder": 4}
CROSS: dict[str, Any] = {**_MARK, "marker": "x", "mew": 1.8, "ms": 6.5}
DIAMOND: dict[str, Any] = {**_MARK, "marker": "D", "mfc": "white", "mew": 1.5, "ms": 6.0}

# Records of a cycle, points that do not oscillate, and records of another cycle.
Records = tuple[pd.DataFrame, pd.DataFrame, pd.DataFrame]


def laws_figure(
    coefficients: pd.DataFrame,
    law: OperatingLaw,
    *,
    parameters: Sequence[str],
    labels: Mapping[str, str],
) -> Figure:
    """Every coefficient over the last parameter, with a line for each of some values of the first.

    coefficients: per point, state and term, the value refined alone and the ends of its interval.
    """
    along, others = parameters[-1], list(parameters[:-1])
    pairs = list(law.coefficients)
    figure, axes = make_grid(len(pairs), width=3.0, height=2.4, extra=0.7)
    groups = _choose_lines(coefficients, along, others)
    for ax, (state, term) in zip(axes, pairs, strict=True):
        unit = unit_text(_unit_of_coef(law, state, term))
        name = f"${latex_derivative(state)}$:  ${latex_term_name(term)}$  ({unit})"
        ax.set_title(name, fontsize=TITLE, pad=14.0)
        for (held, rows), colour in zip(groups, MORE_COLOURS, strict=False):
            here = rows[(rows["state"] == state) & (rows["term"] == term)].sort_values(along)
            _draw_law(ax, here, law, (state, term), along, held, colour)
        ax.grid(alpha=0.3)
        ax.set_xlabel(name_label(along, labels))
        _focus(ax, coefficients[(coefficients["state"] == state) & (coefficients["term"] == term)])
    if others:
        entries = [
            Line2D(
                [], [], color=colour, marker="o", ms=4, mfc="white", label=held_label(held, labels)
            )
            for (held, _), colour in zip(groups, MORE_COLOURS, strict=False)
        ]
        legend_above(figure, entries)
    return figure


def _choose_lines(
    rows: pd.DataFrame, along: str, others: list[str]
) -> list[tuple[dict[str, float], pd.DataFrame]]:
    """At most MAX_LINES values of the other parameters, evenly chosen, with their rows.

    Values with a single point are left out if there are others.
    """
    by_value = rows.groupby(others) if others else [((), rows)]
    groups = [
        (dict(zip(others, np.array(key, dtype=float).tolist(), strict=True)), of)
        for key, of in by_value
    ]
    groups = [group for group in groups if group[1][along].nunique() > 1] or groups
    n = min(len(groups), MAX_LINES)
    return [groups[k] for k in np.unique(np.linspace(0, len(groups) - 1, n).round().astype(int))]


def _draw_law(
    ax: Axes,
    rows: pd.DataFrame,
    law: OperatingLaw,
    pair: tuple[str, str],
    along: str,
    held: Mapping[str, float],
    colour: str,
) -> None:
    line, points = sample_line(rows[along], along, held, law.parameters)
    coef = law.coef[law.coefficients.index(pair)]
    ax.plot(line, law.functions.evaluate(points) @ coef, color=colour, lw=1.5)
    reach = None
    if {"alone_low", "alone_high"} <= set(rows):
        reach = 0.5 * (rows["alone_high"] - rows["alone_low"]).fillna(0.0)
    ax.errorbar(rows[along], rows["alone"], reach, fmt="o", ms=4, mfc="white", color=colour, lw=0.8,
                capsize=2, zorder=3)  # fmt: skip


def _focus(ax: Axes, rows: pd.DataFrame) -> None:
    """Set limits by the values alone, as an interval may be very long."""
    values = np.concatenate([rows["alone"], rows["law"]])
    low, high = values.min(), values.max()
    size = (MIN_RANGE * np.abs(values).max()) or 1.0
    margin = max(0.15 * (high - low), 0.5 * (size - (high - low)))
    ax.set_ylim(low - margin, high + margin)


def _unit_of_coef(law: OperatingLaw, state: str, term: str) -> str:
    """Unit of a term's coefficient in the equation of a state."""
    units = {name: law.units.get(name, "1") for name in law.library.variables}
    of_term = law.library.units(units)[law.library.index(term)]
    return unit_product([(units[state], 1), ("s", -1), (of_term, -1)])


def left_out_figure(rows: pd.DataFrame) -> Figure:
    """Frequency and amplitudes of free runs at points left out, against those of the records."""
    columns = [str(name) for name in rows]
    states = [name.removeprefix("amplitude_") for name in columns if name.startswith("amplitude_")]
    cycles = list(dict.fromkeys(rows["branch"]))
    colours = dict(zip(cycles, MORE_COLOURS, strict=False))
    figure, ((left, right),) = make_panels(1, 2, (WIDTH, 4.2))
    _draw_frequencies(left, rows, colours)
    _draw_shapes(right, rows, states, colours)
    for ax in (left, right):
        ax.set_box_aspect(1.0)
        ax.grid(alpha=0.3)
        ax.legend(
            loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False, fontsize=SMALL
        )
    return figure


def _draw_frequencies(ax: Axes, rows: pd.DataFrame, colours: Mapping[str, str]) -> None:
    """Draw frequencies of the free runs against those of the records."""
    factor, unit = frequency_scale(rows["f_kHz"])
    for name, colour in colours.items():
        for enclosed, face in ((True, colour), (False, "white")):
            of = rows[(rows["branch"] == name) & (rows["enclosed"] == enclosed)]
            f, of_model = factor * of["f_kHz"], factor * of["f_model_kHz"]
            ax.plot(f, of_model, "o", color=colour, mfc=face, ms=6, zorder=3)
        if len(colours) > 1:
            ax.plot([], [], "s", color=colour, label=f"{name} cycle")
    for face, words in ((DATA, "enclosed by the others"), ("white", "outside them")):
        ax.plot([], [], "o", color=DATA, mfc=face, ms=6, label=words)
    known = factor * rows[["f_kHz", "f_model_kHz"]].to_numpy(float)
    ends = np.array([np.nanmin(known), np.nanmax(known)])
    ends = ends + np.array([-0.04, 0.04]) * ends.mean()
    ax.plot(ends, ends, color=GREY, lw=1.0, zorder=1)
    ax.fill_between(
        ends, 0.99 * ends, 1.01 * ends, color=GREY, alpha=0.3, lw=0, zorder=0, label="1 %"
    )
    ax.set(xlabel=f"frequency of the record ({unit})", ylabel=f"of the free run ({unit})")
    ax.set(xlim=ends, ylim=ends)


def _draw_shapes(
    ax: Axes, rows: pd.DataFrame, states: Sequence[str], colours: Mapping[str, str]
) -> None:
    """Draw waveform errors against amplitude errors."""
    for state, marker in zip(states, "os^Dv", strict=False):
        for name, colour in colours.items():
            of = rows[rows["branch"] == name]
            off, error = 100.0 * (of[f"amplitude_{state}"] - 1.0), of[f"waveform_{state}"]
            near = (off.abs() <= FAR_PERCENT) & (error <= FAR_WAVEFORM)
            ax.plot(off[near], error[near], marker, color=colour, mfc="none", ms=6)
            if near.all():
                continue  # an empty artist that is not clipped would fill the canvas in the layout
            edge = off[~near].clip(-FAR_PERCENT, FAR_PERCENT), error[~near].clip(0, FAR_WAVEFORM)
            ax.plot(*edge, marker, color=colour, mfc=colour, ms=6, clip_on=False, zorder=5)
        ax.plot([], [], marker, color=DATA, mfc="none", ms=6, label=f"${latex_name(state)}$")
    ax.axvspan(-10, 10, color=GREY, alpha=0.3, lw=0, label="10 % of amplitude")
    ax.axhline(0.2, color=GREY, lw=1.0, label="0.2 of waveform")
    ax.set(xlabel="error of the amplitude (%)", ylabel="error of the waveform (std)")
    ax.set(xlim=(-FAR_PERCENT, FAR_PERCENT), ylim=(0.0, FAR_WAVEFORM))


def frequency_scale(f_kHz: pd.Series) -> tuple[float, str]:
    """Factor on kHz, and the unit, in which the typical frequency is near one."""
    factor, prefix = with_prefix(1e3 * float(np.nanmedian(f_kHz)))
    return 1e3 * factor, f"{prefix}Hz"


def cycle_figure(
    rows: pd.DataFrame,
    points: pd.DataFrame,
    fitted: np.ndarray,
    *,
    branch: str,
    parameters: Sequence[str],
    labels: Mapping[str, str],
) -> Figure:
    """Frequency and amplitude of a law's cycle, with those of the records.

    A map over two parameters, a line over one. rows: a grid whose second parameter varies fastest.
    points: branch (empty for points that do not oscillate), f_kHz and relative_amplitude of the
    records. fitted: parameters of the law's points.
    """
    own, quiet = points["branch"] == branch, points["branch"] == ""
    records = points[own], points[quiet], points[~own & ~quiet]
    draw = _draw_cycle_map if len(parameters) == 2 else _draw_cycle_line
    return draw(rows, records, fitted, list(parameters), labels)


def _draw_cycle_map(
    rows: pd.DataFrame,
    records: Records,
    fitted: np.ndarray,
    parameters: list[str],
    labels: Mapping[str, str],
) -> Figure:
    x, y = (np.unique(rows[name].to_numpy(float)) for name in parameters)
    own, quiet, other = records
    figure, (axes,) = make_panels(1, 2, (WIDTH, 4.0), sharex=True, sharey=True)
    for ax, quantity in zip(axes, QUANTITIES, strict=True):
        factor, title = _scale_quantity(quantity, own)
        values = factor * rows[quantity].to_numpy(float).reshape(len(x), len(y))
        seen = factor * own[quantity].to_numpy(float)
        scale, colours = _colour_range(values, seen), colormaps["viridis"]
        ax.pcolormesh(x, y, values.T, norm=scale, cmap=colours, shading="nearest", rasterized=True)
        boundaries = _draw_boundaries(ax, x, y, rows, fitted)
        at = own[parameters].to_numpy(float)
        ax.scatter(*at.T, c=colours(scale(seen)), s=52, edgecolor="white", lw=1.2, zorder=4)
        for which, style in ((quiet, CROSS), (other, DIAMOND)):
            ax.plot(*which[parameters].to_numpy(float).T, **style)
        xlabel, ylabel = (name_label(name, labels) for name in parameters)
        ax.set(xlabel=xlabel, ylabel=ylabel)
        bar = figure.colorbar(ScalarMappable(scale, colours), ax=ax, pad=0.02, extend="both")
        bar.set_label(title)
    legend_above(figure, [*_list_entries(quiet, other, face=GREY), *boundaries])
    return figure


def _draw_cycle_line(
    rows: pd.DataFrame,
    records: Records,
    fitted: np.ndarray,
    parameters: list[str],
    labels: Mapping[str, str],
) -> Figure:
    (name,) = parameters
    own, quiet, other = records
    figure, (axes,) = make_panels(1, 2, (WIDTH, 3.6))
    for ax, quantity in zip(axes, QUANTITIES, strict=True):
        factor, title = _scale_quantity(quantity, own)
        ax.axvspan(fitted.min(), fitted.max(), color=GREY, alpha=0.2, lw=0)
        ax.plot(rows[name], factor * rows[quantity], color=COLOURS[0], lw=1.8)
        ax.plot(own[name], factor * own[quantity], "o", color=DATA, mfc="white", zorder=3)
        ax.plot(other[name], factor * other[quantity], **DIAMOND)
        bottom = ax.get_xaxis_transform()
        ax.plot(quiet[name], np.full(len(quiet), 0.05), transform=bottom, **CROSS)
        ax.set(xlabel=name_label(name, labels), ylabel=title)
        ax.grid(alpha=0.3)
    entries = _list_entries(quiet, other, face="white")
    law = Line2D([], [], color=COLOURS[0], lw=1.8, label="the model's cycle")
    legend_above(figure, [law, *entries, Patch(color=GREY, alpha=0.2, label="points fitted")])
    return figure


def _list_entries(quiet: pd.DataFrame, other: pd.DataFrame, *, face: str) -> list[Artist]:
    """Legend entries: records, with this marker face, and the other kinds of points that occur."""
    there = ((quiet, CROSS, "not oscillating"), (other, DIAMOND, "record of another cycle"))
    record = Line2D([], [], ls="none", marker="o", mec=DATA, mfc=face, label="record")
    return [record, *(Line2D([], [], **mark, label=label) for of, mark, label in there if len(of))]


def _scale_quantity(quantity: str, records: pd.DataFrame) -> tuple[float, str]:
    """Factor on a quantity, and the label of its axis."""
    if quantity != "f_kHz":
        return 1.0, "relative amplitude"
    factor, unit = frequency_scale(records["f_kHz"])
    return factor, f"frequency ({unit})"


def _colour_range(values: np.ndarray, seen: np.ndarray) -> Normalize:
    """Colour range of the records and nearly all of the map, kept close to the records."""
    low, high = seen.min(), seen.max()
    reach = (high - low) or abs(high)
    if np.isfinite(values).any():
        ends = np.nanquantile(values, [0.02, 0.98])
        low = min(low, max(ends[0], low - reach, 0.0))
        high = max(high, min(ends[1], high + reach))
    return Normalize(low, high)


def _draw_boundaries(
    ax: Axes, x: np.ndarray, y: np.ndarray, rows: pd.DataFrame, fitted: np.ndarray
) -> list[Artist]:
    """Draw where cycles end, where the fixed point turns stable, and the hull of fitted points.

    Returns legend entries of those that there are.
    """
    shape = (len(x), len(y))
    entries: list[Artist] = []
    alive = (rows["fate"] == "oscillates").to_numpy().reshape(shape).astype(float)
    if min(shape) > 1 and 0.0 < alive.mean() < 1.0:
        ax.contour(x, y, alive.T, levels=[0.5], colors="black", linewidths=1.8)
        entries.append(Line2D([], [], color="black", lw=1.8, label="the model's cycle ends"))
    growth = rows["growth_per_s"].to_numpy(float).reshape(shape)
    if min(shape) > 1 and (growth < 0.0).any() and (growth > 0.0).any():
        style: dict[str, Any] = {"linestyles": "--", "colors": "black", "linewidths": 1.3}
        ax.contour(x, y, np.ma.masked_invalid(growth.T), levels=[0.0], **style)
        label = "its fixed point turns stable"
        entries.append(Line2D([], [], color="black", lw=1.3, ls="--", label=label))
    ax.plot(*_enclose(fitted).T, color=GREY, lw=1.5)
    return [*entries, Line2D([], [], color=GREY, lw=1.5, label="points fitted")]


def _enclose(points: np.ndarray) -> np.ndarray:
    """Closed convex outline of the points; the two ends if all lie on one line."""
    scaled = (points - points.min(axis=0)) / np.ptp(points, axis=0)
    try:
        around = ConvexHull(scaled).vertices
    except QhullError:
        around = np.argsort(scaled[:, 0])[[0, -1]]
    return points[[*around, around[0]]]


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
                line, points = sample_line(x, along, at, laws[quantity].functions.variables)
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
    legend_above(figure, _list_kinds(colours, labels, laws=bool(laws)))
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


def _list_kinds(
    colours: Mapping[str, str], labels: Mapping[str, str], *, laws: bool
) -> list[Line2D]:
    """Legend entries: a mark for each kind, and the line of the laws in the first one's colour."""
    marks = [
        Line2D([], [], label=labels.get(kind, kind), **_mark(kind, colour))
        for kind, colour in colours.items()
    ]
    colour = next(iter(colours.values()))
    return marks + ([Line2D([], [], color=colour, lw=1.2, label="control law")] if laws else [])
