"""Figures of the weak form: window errors, frontiers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ep2sindy.plots import COLOURS, DATA
from ep2sindy.setting_plots import GREY


def window_error_figure(cells: pd.DataFrame, *, references: Sequence[str]) -> Figure:
    """Coefficient error against noise: a panel per window length, a line per number of windows.

    cells: as `studies.weak_windows.window_cells` gives them. references: settings without
    windows to choose, drawn in every panel.
    """
    # Without noise the errors are those of the integrals, decades below: the table has them.
    noisy = cells[cells["noise"] > 0.0]
    shown = noisy if len(noisy) else cells
    lengths = cells["n_points"].dropna().unique()
    figure = Figure(figsize=(2.9 * len(lengths) + 0.4, 3.6), layout="constrained")
    axes = figure.subplots(1, len(lengths), squeeze=False, sharex=True, sharey=True)[0]
    for ax, n_points in zip(axes, lengths, strict=True):
        for style, name in zip(("--", "-", ":"), references, strict=False):
            label = name.replace("_", ", ")
            _error_line(ax, shown[shown["setting"] == name], label=label, color=DATA, ls=style)
        panel = shown[shown["n_points"] == n_points]
        for colour, n_windows in zip(COLOURS, panel["n_windows"].unique(), strict=False):
            one = panel[panel["n_windows"] == n_windows]
            _error_line(ax, one, label=f"{n_windows} windows", color=colour, marker="o", ms=3.5)
        ax.set_title(f"{n_points} points per window", fontsize=10)
        ax.set_xlabel("noise (% of RMS)")
        ax.grid(which="major", alpha=0.3)
    axes[0].set_yscale("log")
    if len(noisy):
        axes[0].set_xscale("log")
    levels = 100.0 * np.unique(shown["noise"])
    axes[0].set_xticks(levels, [f"{level:g}" for level in levels])
    axes[0].set_xticks([], minor=True)
    axes[0].set_ylabel(r"coefficient error $\|\beta - \beta_{true}\| / \|\beta_{true}\|$")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    return figure


def _error_line(ax: Axes, cells: pd.DataFrame, *, label: str, **style: Any) -> None:
    ordered = cells.sort_values("noise")
    ax.plot(100.0 * ordered["noise"], ordered["error_mean"], label=label, lw=1.2, **style)


def frontier_figure(points: pd.DataFrame) -> Figure:
    """A panel per variant: sampling rate against duration, filled where it found the system.

    points: as `studies.frontier.identification_frontier` gives them.
    """
    variants = list(points["variant"].unique())
    figure = Figure(figsize=(2.6 * len(variants) + 0.4, 3.5), layout="constrained")
    axes = figure.subplots(1, len(variants), squeeze=False, sharex=True, sharey=True)[0]
    for ax, variant in zip(axes, variants, strict=True):
        for (found, ran), marker in _MARKERS.items():
            kind = (points["identified"] == found) & ((points["reason"] == "") == ran)
            one = points[kind & (points["variant"] == variant)]
            ax.plot(one["duration_s"], one["rate_Hz"], **marker)
        ax.set_title(variant, fontsize=10)
        ax.set_xlabel("duration (s)")
    axes[0].set_xscale("log")
    axes[0].set_yscale("log")
    axes[0].set_ylabel("sampling rate (Hz)")
    handles = [Line2D([], [], **marker) for marker in _MARKERS.values()]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    return figure


# (identified, ran) -> marker: told apart by shape and filling, not by colour alone.
_MARKERS: Mapping[tuple[bool, bool], Mapping[str, Any]] = {
    (True, True): {"ls": "", "marker": "o", "color": COLOURS[2], "label": "identified"},
    (False, True): {
        "ls": "", "marker": "o", "color": COLOURS[1], "mfc": "none", "label": "not identified",
    },
    (False, False): {
        "ls": "", "marker": "x", "color": GREY, "ms": 4, "label": "too few samples to run",
    },
}  # fmt: skip
