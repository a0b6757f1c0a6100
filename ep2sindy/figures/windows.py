"""Figures of error and loss against the number and length of windows."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ep2sindy.figures import style
from ep2sindy.figures.style import COLOURS, DATA, GREY, TITLE, WIDTH


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


def window_error_figure(cells: pd.DataFrame) -> Figure:
    """Coefficient error against noise: a panel per window length, a line per number of windows.

    cells: from `studies.benchmark.error_cells`. Forms without a choice of windows are in every
    panel.
    """
    # Errors without noise come from the quadrature and are decades lower; see the table.
    noisy = cells[cells["noise"] > 0.0]
    shown = noisy if len(noisy) else cells
    lengths = cells["n_points"].dropna().unique()
    references = cells.loc[cells["n_points"].isna(), "fit"].unique()
    figure, axes = style.make_row(len(lengths), width=2.9, height=3.6)
    for ax, n_points in zip(axes, lengths, strict=True):
        for look, name in zip(("--", "-", ":"), references, strict=False):
            label = name.replace("_", ", ")
            _draw_error(ax, shown[shown["fit"] == name], label=label, color=DATA, ls=look)
        panel = shown[shown["n_points"] == n_points]
        for colour, n_windows in zip(COLOURS, panel["n_windows"].unique(), strict=False):
            one = panel[panel["n_windows"] == n_windows]
            _draw_error(ax, one, label=f"{n_windows} windows", color=colour, marker="o", ms=3.5)
        ax.set_title(f"{n_points} points per window", fontsize=TITLE)
        ax.set_xlabel("noise (% of RMS)")
        ax.grid(which="major", alpha=0.3)
    axes[0].set_yscale("log")
    if len(noisy):
        axes[0].set_xscale("log")
    levels = 100.0 * np.unique(shown["noise"])
    style.name_ticks(axes[0].xaxis, levels, [f"{level:g}" for level in levels])
    axes[0].set_ylabel(r"coefficient error $\|\beta - \beta_{true}\| / \|\beta_{true}\|$")
    style.legend_above(figure, axes[0].get_legend_handles_labels()[0])
    return figure


def _draw_error(ax: Axes, cells: pd.DataFrame, *, label: str, **look: Any) -> None:
    ordered = cells.sort_values("noise")
    ax.plot(100.0 * ordered["noise"], ordered["error_mean"], label=label, lw=1.2, **look)
