"""The benchmark as table and heat map, and the frontier: who finds the equations, and when."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ep2sindy.figures.style import COLOURS, GREY, legend_above

COUNTS = ("on_front", "selected")  # of realizations

MERITS = (*COUNTS, "mean_correct_terms")

SYSTEM_LABELS = {
    "oscillator": "damped oscillator",
    "lotka_volterra": "Lotka–Volterra",
    "van_der_pol": "Van der Pol",
    "lorenz": "Lorenz",
}

PANELS = {"on_front": "true equations on the front", "selected": "true equations selected"}

# One hue from light to dark: read with any colour vision, and in grey.
COLOURMAP, DARK = "Blues", 0.7


def merit_table(cells: pd.DataFrame, published: pd.DataFrame, merit: str) -> pd.DataFrame:
    """One figure of merit of every variant, with its published row below it where there is one.

    cells: as `studies.benchmark.cells` gives them. published: the same, without the time.
    Index (variant, is it published), columns (system, noise), in the order of `cells`; counts
    become percentages of n.
    """
    place, shown = ["system", "noise"], ["variant", "system", "noise", merit, "n"]
    known = published.merge(cells[[*place, "variant"]])
    both = pd.concat(
        [cells[shown].assign(published=False), known[shown].assign(published=True)]
        if len(known)
        else [cells[shown].assign(published=False)]
    )
    if merit in COUNTS:
        both[merit] *= 100.0 / both["n"]
    table = both.set_index(["variant", "published", *place])[merit].unstack(place)
    rows = [(name, old) for name in cells["variant"].unique() for old in (False, True)]
    return table.reindex(
        index=pd.MultiIndex.from_tuples([row for row in rows if row in table.index]),
        columns=pd.MultiIndex.from_frame(cells[place].drop_duplicates()),
    )


def frontier_figure(points: pd.DataFrame) -> Figure:
    """A panel per variant: sampling rate against duration, filled where it found the system.

    points: as `Study.points` of `studies.frontier` gives them.
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
    legend_above(figure, [Line2D([], [], **marker) for marker in _MARKERS.values()])
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


def benchmark_figure(cells: pd.DataFrame, *, thesis: pd.DataFrame) -> Figure:
    """How often every variant finds the true equations, in percent, as numbers on a heat map.

    cells, thesis: as `merit_table` takes them; the thesis's rows stand in italics below the
    variants they are about.
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
