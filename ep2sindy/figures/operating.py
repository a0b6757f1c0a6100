"""Figures of laws of the operating point: coefficients, points left out, and maps."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from ep2sindy.discovery.operating_law import OperatingLaw, in_hull
from ep2sindy.figures.style import (
    DATA,
    GREY,
    MORE_COLOURS,
    equals_label,
    legend_above,
    panel_grid,
)  # fmt: skip
from ep2sindy.library.equations import latex_derivative, latex_name, latex_term_name

FAR_PERCENT, FAR_WAVEFORM = 40.0, 0.6  # of errors; what is farther off stands filled on the edge

N_LINE = 60  # points of a law's line
MOST_LINES = 5  # values of the second parameter that are drawn
QUANTITIES = {"f_kHz": "frequency (kHz)", "relative_amplitude": "relative amplitude"}


def laws_figure(
    coefficients: pd.DataFrame,
    law: OperatingLaw,
    *,
    parameters: Sequence[str],
    labels: Mapping[str, str],
) -> Figure:
    """Every coefficient over the last parameter, a line for each of some values of the first.

    coefficients: per point, state and term the value refined alone, and its interval's ends.
    """
    along, others = parameters[-1], list(parameters[:-1])
    pairs = list(law.coefficients)
    figure, axes = panel_grid(len(pairs), width=3.3, height=2.5, extra=0.7, most=3)
    groups: list[tuple[tuple[float, ...], pd.DataFrame]] = [((), coefficients)]
    if others:
        by_value = coefficients.groupby(others)
        groups = [(tuple(np.array(key, dtype=float)), rows) for key, rows in by_value]
    groups = _spread([g for g in groups if g[1][along].nunique() > 1] or groups)
    for ax, (state, term) in zip(axes, pairs, strict=True):
        name = latex_term_name(term)
        ax.set_title(f"${latex_derivative(state)}$:  ${name}$", fontsize=10)
        for (values, rows), colour in zip(groups, MORE_COLOURS, strict=False):
            held = dict(zip(others, values, strict=True))
            here = rows[(rows["state"] == state) & (rows["term"] == term)].sort_values(along)
            _law_line(ax, here, law, (state, term), along, held, colour)
        ax.grid(alpha=0.3)
        ax.set_xlabel(_label(along, labels))
        _focus(ax, coefficients[(coefficients["state"] == state) & (coefficients["term"] == term)])
    if others:
        entries = [
            Line2D([], [], color=colour, marker="o", ms=4, label=_held(others, values, labels))
            for (values, _), colour in zip(groups, MORE_COLOURS, strict=False)
        ]
        legend_above(figure, entries, size=9.0)
    return figure


def _spread(
    groups: list[tuple[tuple[float, ...], pd.DataFrame]],
) -> list[tuple[tuple[float, ...], pd.DataFrame]]:
    """At most so many, evenly chosen."""
    n = min(len(groups), MOST_LINES)
    return [groups[k] for k in np.unique(np.linspace(0, len(groups) - 1, n).round().astype(int))]


def _law_line(
    ax: Axes,
    rows: pd.DataFrame,
    law: OperatingLaw,
    pair: tuple[str, str],
    along: str,
    held: Mapping[str, float],
    colour: str,
) -> None:
    x = rows[along].to_numpy(float)
    line = np.linspace(x.min(), x.max(), N_LINE)
    columns = [line if p == along else np.full(N_LINE, held[p]) for p in law.parameters]
    coef = law.coef[law.coefficients.index(pair)]
    values = law.functions.evaluate(np.column_stack(columns)) @ coef
    ax.plot(line, values, color=colour, lw=1.5)
    reach = None
    if {"alone_low", "alone_high"} <= set(rows):
        reach = 0.5 * (rows["alone_high"] - rows["alone_low"]).fillna(0.0)
    ax.errorbar(x, rows["alone"], reach, fmt="o", ms=4, mfc="white", color=colour, lw=0.8,
                capsize=2, zorder=3)  # fmt: skip


def _focus(ax: Axes, rows: pd.DataFrame) -> None:
    """The range of the values, not of an interval that reaches far."""
    values = np.concatenate([rows["alone"], rows["law"]])
    low, high = values.min(), values.max()
    margin = 0.15 * ((high - low) or abs(high) or 1.0)
    ax.set_ylim(low - margin, high + margin)


def left_out_figure(rows: pd.DataFrame) -> Figure:
    """Frequency and amplitudes of free runs at points left out, over those of the records."""
    columns = [str(name) for name in rows]
    states = [name.removeprefix("amplitude_") for name in columns if name.startswith("amplitude_")]
    figure = Figure(figsize=(9.0, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2)
    cycles = list(dict.fromkeys(rows["branch"]))
    for name, colour in zip(cycles, MORE_COLOURS, strict=False):
        here = rows[rows["branch"] == name]
        for enclosed, face in ((True, colour), (False, "white")):
            of = here[here["enclosed"] == enclosed]
            left.plot(of["f_kHz"], of["f_model_kHz"], "o", color=colour, mfc=face, ms=6, zorder=3)
    known = rows[["f_kHz", "f_model_kHz"]].to_numpy(float)
    ends = np.array([np.nanmin(known), np.nanmax(known)])
    ends = ends + np.array([-0.04, 0.04]) * ends.mean()
    left.plot(ends, ends, color=GREY, lw=1.0, zorder=1)
    left.fill_between(ends, 0.99 * ends, 1.01 * ends, color=GREY, alpha=0.3, lw=0, zorder=0)
    left.set(xlabel="frequency of the record (kHz)", ylabel="of the free run (kHz)")
    left.set(xlim=ends, ylim=ends, aspect="equal")
    for state, marker in zip(states, "os^Dv", strict=False):
        for name, colour in zip(cycles, MORE_COLOURS, strict=False):
            of = rows[rows["branch"] == name]
            off, error = 100.0 * (of[f"amplitude_{state}"] - 1.0), of[f"waveform_{state}"]
            near = (off.abs() <= FAR_PERCENT) & (error <= FAR_WAVEFORM)
            right.plot(off[near], error[near], marker, color=colour, mfc="none", ms=6)
            edge = off[~near].clip(-FAR_PERCENT, FAR_PERCENT), error[~near].clip(0, FAR_WAVEFORM)
            right.plot(*edge, marker, color=colour, mfc=colour, ms=6, clip_on=False, zorder=5)
    right.axvspan(-10, 10, color=GREY, alpha=0.3, lw=0)
    right.axhline(0.2, color=GREY, lw=1.0)
    right.set(xlabel="error of the amplitude (%)", ylabel="error of the waveform (std)")
    right.set(xlim=(-FAR_PERCENT, FAR_PERCENT), ylim=(0.0, FAR_WAVEFORM))
    for ax in (left, right):
        ax.grid(alpha=0.3)
    entries = [
        Line2D([], [], label=f"${latex_name(s)}$ (right)", ls="none", marker=m, mfc="none", c=DATA)
        for s, m in zip(states, "os^Dv", strict=False)
    ]
    entries += [
        Line2D([], [], ls="none", marker="o", color=DATA, label="enclosed by the others (left)"),
        Line2D([], [], ls="none", marker="o", color=DATA, mfc="white", label="outside them"),
        Patch(color=GREY, alpha=0.3, label="1 % of frequency, 10 % of amplitude"),  # type: ignore[list-item]
    ]
    if len(cycles) > 1:
        entries += [
            Line2D([], [], ls="none", marker="s", color=colour, label=f"{name} cycle")
            for name, colour in zip(cycles, MORE_COLOURS, strict=False)
        ]
    legend_above(figure, entries, n_columns=min(len(entries), 4), size=9.0)
    return figure


def map_figure(
    rows: pd.DataFrame,
    points: pd.DataFrame,
    fitted: np.ndarray,
    *,
    parameters: Sequence[str],
    labels: Mapping[str, str],
) -> Figure:
    """Frequency and amplitude of a law's cycle over two parameters, over the simulated points.

    rows: a grid, its second parameter varying fastest. points: status, f_kHz and
    relative_amplitude of the simulated ones. fitted: those that the law was fitted to.
    """
    x, y = (np.unique(rows[name].to_numpy(float)) for name in parameters)
    figure = Figure(figsize=(11.0, 4.4), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True, sharey=True)
    breathes = points["status"] == "oscillating"
    for ax, (quantity, title) in zip(axes, QUANTITIES.items(), strict=True):
        values = rows[quantity].to_numpy(float).reshape(len(x), len(y))
        seen = points.loc[breathes, quantity].to_numpy(float)
        low, high = np.nanmin(seen), np.nanmax(seen)
        margin = 0.1 * (high - low)
        scale = Normalize(max(low - margin, 0.0), high + margin)
        colours = colormaps["viridis"]
        ax.pcolormesh(x, y, values.T, norm=scale, cmap=colours, shading="nearest", rasterized=True)
        _boundaries(ax, x, y, rows, fitted)
        at = points.loc[breathes, list(parameters)].to_numpy(float)
        ax.scatter(*at.T, c=colours(scale(seen)), s=52, edgecolor="white", lw=1.2, zorder=4)
        quiet = points.loc[~breathes, list(parameters)].to_numpy(float)
        if len(quiet):
            ax.scatter(*quiet.T, c="#D55E00", marker="x", s=42, lw=1.8, zorder=4)
        ax.set(xlabel=_label(parameters[0], labels), ylabel=_label(parameters[1], labels))
        bar = figure.colorbar(ScalarMappable(scale, colours), ax=ax, pad=0.02, extend="both")
        bar.set_label(title)
    entries = [
        Line2D([], [], ls="none", marker="o", color=GREY, mec=DATA, label="simulated, oscillating"),
        Line2D([], [], ls="none", marker="x", color="#D55E00", mew=1.8, label="simulated, quiet"),
        Line2D([], [], color="black", lw=1.8, label="the model's cycle ends"),
        Line2D([], [], color="black", lw=1.3, ls="--", label="its fixed point turns stable"),
        Line2D([], [], color=GREY, lw=1.5, label="points fitted"),
    ]
    legend_above(figure, entries, size=9.0)
    return figure


def _boundaries(
    ax: Axes, x: np.ndarray, y: np.ndarray, rows: pd.DataFrame, fitted: np.ndarray
) -> None:
    """Where cycles end, where the fixed point turns stable, and the hull of what was fitted."""
    shape = (len(x), len(y))
    alive = (rows["fate"] == "oscillates").to_numpy().reshape(shape).astype(float)
    if 0.0 < alive.mean() < 1.0:
        ax.contour(x, y, alive.T, levels=[0.5], colors="black", linewidths=1.8)
    growth = rows["growth_per_s"].to_numpy(float).reshape(shape)
    if np.nanmin(growth) < 0.0 < np.nanmax(growth):
        ax.contour(
            x, y, np.ma.masked_invalid(growth.T), levels=[0.0], colors="black", linewidths=1.3,
            linestyles="--",
        )  # fmt: skip
    fine_x, fine_y = np.linspace(x[0], x[-1], 60), np.linspace(y[0], y[-1], 60)
    inside = [[float(in_hull(fitted, np.array([a, b]))) for a in fine_x] for b in fine_y]
    if 0.0 < np.mean(inside) < 1.0:
        ax.contour(fine_x, fine_y, np.array(inside), levels=[0.5], colors=GREY, linewidths=1.5)


def _label(name: str, labels: Mapping[str, str]) -> str:
    return labels.get(name, f"${latex_name(name)}$")


def _held(names: Sequence[str], values: Sequence[float], labels: Mapping[str, str]) -> str:
    """`$V_D$ = 300 V`."""
    return ", ".join(equals_label(_label(n, labels), v) for n, v in zip(names, values, strict=True))
