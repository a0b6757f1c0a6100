"""Figures of the studies: tables of outcomes in, a matplotlib Figure out."""

from __future__ import annotations

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from ep2sindy.studies.benchmark import merit_table

SYSTEM_LABELS = {
    "oscillator": "damped oscillator",
    "lotka_volterra": "Lotka–Volterra",
    "van_der_pol": "Van der Pol",
    "lorenz": "Lorenz",
}
PANELS = {"on_front": "true equations on the front", "selected": "true equations selected"}
# One hue from light to dark: read with any colour vision, and in grey.
COLOURMAP, DARK = "Blues", 0.7


def benchmark_figure(cells: pd.DataFrame, *, thesis: pd.DataFrame) -> Figure:
    """How often every variant finds the true equations, in percent, as numbers on a heat map.

    cells, thesis: as for `ep2sindy.studies.benchmark.merit_table`; the thesis's rows stand in
    italics below the variants they are about.
    """
    tables = {merit: merit_table(cells, thesis, merit) for merit in PANELS}
    n_rows, n_columns = tables["on_front"].shape
    figure = Figure(
        figsize=(1.8 + 2 * (0.36 * n_columns + 0.1), 0.9 + 0.25 * n_rows), layout="constrained"
    )
    axes = figure.subplots(1, len(PANELS), sharey=True, squeeze=False)[0]
    for ax, (merit, table) in zip(axes, tables.items(), strict=True):
        _heat_map(ax, table)
        ax.set_title(f"{PANELS[merit]} (%)", fontsize=10, pad=24)
    _name_rows(axes[0], tables["on_front"].index)
    return figure


def _heat_map(ax: Axes, table: pd.DataFrame) -> None:
    values = table.to_numpy(dtype=float)
    scale = Normalize(0.0, 100.0)
    ax.pcolormesh(
        np.ma.masked_invalid(values), cmap=COLOURMAP, norm=scale, edgecolors="white", linewidth=0.8
    )
    for (row, column), value in np.ndenumerate(values):
        known = np.isfinite(value)
        ax.text(
            column + 0.5,
            row + 0.5,
            f"{value:.0f}" if known else "–",
            ha="center",
            va="center",
            fontsize=7.5,
            color="#777777" if not known else "white" if scale(value) > DARK else "black",
            style="italic" if table.index[row][1] else "normal",
        )
    for row, (_, published) in enumerate(table.index):
        if not published:
            ax.axhline(row, color="white", lw=3)  # a variant and what the thesis says of it
    _name_columns(ax, table.columns)
    ax.set_ylim(len(values), 0.0)
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)


def _name_columns(ax: Axes, columns: pd.Index) -> None:
    """Noise levels below, the systems they belong to above, and a gap between systems."""
    ax.set_xticks(np.arange(len(columns)) + 0.5, [f"{100 * noise:g}" for _, noise in columns])
    ax.tick_params(axis="x", labelsize=7.5)
    ax.set_xlabel("noise (% of RMS)", fontsize=8.5)
    systems = columns.get_level_values(0)
    for system in systems.unique():
        places = np.flatnonzero(systems == system)
        label = SYSTEM_LABELS.get(system, system)
        middle = places.mean() + 0.5
        ax.text(middle, -0.25, label, ha="center", va="bottom", fontsize=8.5)
        ax.axvline(places[0], color="white", lw=5)


def _name_rows(ax: Axes, rows: pd.Index) -> None:
    labels = ["thesis" if published else name.replace("_", " ") for name, published in rows]
    ax.set_yticks(np.arange(len(rows)) + 0.5, labels, fontsize=8.5)
    for text, (_, published) in zip(ax.get_yticklabels(), rows, strict=True):
        if published:
            text.set(style="italic", color="#555555")
