"""Figures of fits of structures: what becomes of them at operating points, and by windows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pandas as pd
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from ep2sindy.figures import style
from ep2sindy.figures.style import COLOURS, DATA, GREY, SIGN, TITLE, WIDTH
from ep2sindy.model.comparison import Status

# Status -> marker, the best first; any other run has no cycle.
WEAK = "its cycle does not attract"
MARKERS = {"sustained": "o", WEAK: "^", "wrong frequency": "D", "wrong cycle": "s"}
WEAKLY = [str(each) for each in (Status.NOT_TOLD, Status.NEUTRAL, Status.REPELLING)]
OTHER = "no cycle: decays, diverges, turns negative"
NORM = LogNorm(0.01, 1.0)  # of the amplitude's error


def sustained_figure(rows: pd.DataFrame, *, labels: Mapping[str, str]) -> Figure:
    """A panel per way of fitting, a row per structure, a column per operating point.

    rows: structure, way, point, status, amplitude_error (relative, NaN for a run without one).
    labels: of the parameters of points.
    """
    ways, points = (list(rows[key].unique()) for key in ("way", "point"))
    structures = list(rows["structure"].unique())
    width, height = 1.6 / len(ways) + 0.5 * len(points), 1.9 + 0.3 * len(structures)
    figure, axes = style.make_row(len(ways), width=width, height=height)
    marked = rows["status"].replace(dict.fromkeys(WEAKLY, WEAK))
    places = rows.assign(
        x=rows["point"].map(points.index), y=rows["structure"].map(structures.index),
        kind=marked.where(marked.isin([*MARKERS]), OTHER),
    )  # fmt: skip
    look: dict[str, Any] = {"cmap": "viridis_r", "norm": NORM, "edgecolors": SIGN, "lw": 0.5}
    for ax, way in zip(axes, ways, strict=True):
        kinds = dict([*places[places["way"] == way].groupby("kind")])
        for status, marker in MARKERS.items():
            shown, size = kinds.get(status, places[:0]), 80 if status == "sustained" else 40
            colours = shown["amplitude_error"]
            marks = ax.scatter(shown["x"], shown["y"], size, colours, marker=marker, **look)
        rest = kinds.get(OTHER, places[:0])
        ax.plot(rest["x"], rest["y"], "x", color=GREY, ms=6)
        ax.set_title(way, fontsize=TITLE)
        ax.set_xlabel("\n".join(style.name_label(name, labels) for name in _split(points[0], 0)))
    values = ["\n".join(_split(point, 2)) for point in points]
    style.name_ticks(axes[0].xaxis, range(len(points)), values)
    names = [name.replace("_", " ") for name in structures]
    style.name_ticks(axes[0].yaxis, range(len(structures)), names)
    axes[0].set(xlim=(-0.5, len(points) - 0.5), ylim=(len(structures) - 0.5, -0.5))
    bar = figure.colorbar(marks, ax=list(axes), label="error of the amplitude", extend="max")
    style.name_ticks(bar.ax.yaxis, [0.01, 0.1, 1.0], ["1 %", "10 %", "100 %"])
    signs = [style.mark_sign(marker, status) for status, marker in MARKERS.items()]
    style.legend_above(figure, [*signs, style.mark_sign("x", OTHER, GREY)])
    return figure


def _split(point: str, part: int) -> list[str]:
    """The names (part 0) or values (part 2) of a point's label, `V_D_V=300, mdot_mg_s=5`."""
    return [each.partition("=")[part] for each in point.split(", ")]


def loss_against_window_figure(rows: pd.DataFrame, *, period: float) -> Figure:
    """Loss of refinement, and frequency error and nrmse on held-out data, by window length.

    rows: fit, window (samples), loss, f_error, nrmse, f_error_started, nrmse_started.
    period: of the data, in samples.
    """
    figure, (axes,) = style.make_panels(1, 3, (WIDTH, 3.6), sharex=True)
    lengths = [int(n) for n in rows["window"].unique()]
    titles = ("loss (1: a constant)", "frequency error (%)", "nrmse on held-out data")
    for (name, each), colour in zip(rows.groupby("fit", sort=False), COLOURS, strict=False):
        look = {"color": colour, "marker": "o", "ms": 3.5, "lw": 1.2}
        axes[0].plot(each["window"], each["loss"], label=name, **look)
        for ax, key, factor in ((axes[1], "f_error", 100.0), (axes[2], "nrmse", 1.0)):
            ax.plot(each["window"], factor * each[key].abs(), label=name, **look)
            dashed = look | {"ls": "--", "mfc": "none"}
            started = factor * each[f"{key}_started"].abs()
            ax.plot(each["window"], started, label=f"{name}, start fitted", **dashed)
    for ax, title in zip(axes, titles, strict=True):
        ax.set(xlabel="samples in a window", xscale="log")
        style.name_ticks(ax.xaxis, lengths, [str(n) for n in lengths])
        ax.axvline(period, color=DATA, lw=0.8, ls=":")
        ax.set_title(title, fontsize=TITLE)
        ax.grid(which="major", alpha=0.3)
    axes[0].set_ylim(bottom=0.0)
    axes[1].axhline(1.0, color=GREY, lw=0.8)
    axes[1].set_yscale("log")
    axes[2].set_ylim(bottom=0.0)
    style.legend_above(figure, axes[1].get_legend_handles_labels()[0])
    return figure
