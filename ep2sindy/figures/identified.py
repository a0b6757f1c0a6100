"""Figures of the benchmark, a heat map of how often each variant is right, and of the frontier."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

from ep2sindy.figures import style
from ep2sindy.figures.style import COLOURS, GREY, SMALL, TITLE

COUNTS = ("on_front", "selected")  # numbers of realizations

MERITS = (*COUNTS, "mean_correct_terms")

# Merit -> title, format of a cell, and its width in inches.
PANELS = {
    "on_front": ("true equations on the front (%)", "{:.0f}", 0.36),
    "selected": ("true equations selected (%)", "{:.0f}", 0.36),
    "error_mean": ("error of the coefficients (%)", "{:.2g}", 0.5),
}

MIN_WIDTH = 2.3  # of a heat map, in inches: its title stands above it

# One hue from light to dark: legible with any colour vision, and in grey. A text on a shade beyond
# DARK is white.
CELLS, DARK = "Blues", 0.65

# They differ by shape and filling, not by colour alone.
SIGNS: Mapping[str, Mapping[str, Any]] = {
    "identified": {"marker": "o", "color": COLOURS[2]},
    "not identified": {"marker": "o", "color": COLOURS[1], "mfc": "none"},
    "too few samples to run": {"marker": "x", "color": GREY, "ms": 4},
}


def merit_table(cells: pd.DataFrame, published: pd.DataFrame, merit: str) -> pd.DataFrame:
    """One figure of merit of every variant; a published row, if any, follows its variant's row.

    cells: from `studies.benchmark.cells`. published: the same, without the time. Returns a table
    with index (variant, is it published) and columns (system, noise), in the order of `cells`;
    counts become percentages of n.
    """
    place, shown = ["system", "noise"], ["variant", "system", "noise", merit, "n"]
    known = published.merge(cells[[*place, "variant"]]).reindex(columns=shown)
    parts = {False: cells[shown], **({True: known} if len(known) else {})}
    both = pd.concat(parts, names=["published"]).reset_index("published")
    if merit in COUNTS:
        both[merit] *= 100.0 / both["n"]
    table = both.set_index(["variant", "published", *place])[merit].unstack(place)
    rows = [(name, old) for name in cells["variant"].unique() for old in (False, True)]
    return table.reindex(
        index=pd.MultiIndex.from_tuples([row for row in rows if row in table.index]),
        columns=pd.MultiIndex.from_frame(cells[place].drop_duplicates()),
    )


def frontier_figure(points: pd.DataFrame) -> Figure:
    """A panel per variant: sampling rate against duration, filled marks where it found the system.

    points: variant, rate_Hz, duration_s, on_front of n, reason, of `studies.benchmark.cells`.
    """
    variants = list(points["variant"].unique())
    figure, axes = style.make_row(len(variants), width=2.6, height=3.5)
    identified = points["on_front"] == points["n"]
    kinds = identified.map({True: "identified", False: "not identified"})
    kinds = kinds.where(points["reason"] == "", "too few samples to run")
    for ax, variant in zip(axes, variants, strict=True):
        for kind, sign in SIGNS.items():
            one = points[(kinds == kind) & (points["variant"] == variant)]
            ax.plot(one["duration_s"], one["rate_Hz"], ls="", label=kind, **sign)
        ax.set(xlabel="duration (s)", xscale="log", yscale="log")
        ax.set_title(variant, fontsize=TITLE)
    axes[0].xaxis.set_minor_formatter("")  # decades alone: others overlap
    axes[0].set_ylabel("sampling rate (Hz)")
    style.legend_above(figure, axes[0].lines)
    return figure


def benchmark_figure(cells: pd.DataFrame, *, thesis: pd.DataFrame) -> Figure:
    """How right every variant is, in percent, as numbers on a heat map for each merit.

    cells, thesis: as for `merit_table`. The thesis's rows are in italics, each below its variant.
    """
    tables = {merit: merit_table(cells, thesis, merit) for merit in PANELS if merit in cells}
    rows, columns = next(iter(tables.values())).axes
    width = max(*(PANELS[merit][2] * len(columns) for merit in tables), MIN_WIDTH)
    size = (1.8 + len(tables) * (width + 0.1), 0.9 + 0.25 * len(rows))
    figure, (axes,) = style.make_panels(1, len(tables), size, sharey=True)
    for ax, (merit, table) in zip(axes, tables.items(), strict=True):
        title, form, _ = PANELS[merit]
        _draw_heat_map(ax, table, form)
        ax.set_title(title, fontsize=TITLE, pad=24)
    labels = ["thesis" if published else name.replace("_", " ") for name, published in rows]
    style.name_ticks(axes[0].yaxis, np.arange(len(rows)) + 0.5, labels)
    for text, (_, published) in zip(axes[0].get_yticklabels(), rows, strict=True):
        text.set(style="italic" if published else "normal")
    return figure


def _draw_heat_map(ax: Axes, table: pd.DataFrame, form: str) -> None:
    """Draw percentages as cells, with noise levels below the columns and system names above.

    A cell is blue by its value, and white if it has none.
    """
    values, scale = table.to_numpy(float), Normalize(0.0, 100.0)
    cells = np.ma.masked_invalid(values)
    ax.pcolormesh(cells, cmap=CELLS, norm=scale, edgecolors="white", linewidth=0.8)
    ax.tick_params(length=0)
    for row, published in enumerate(table.index.get_level_values(1)):
        if not published:
            ax.axhline(row, color="white", lw=3)  # gap between variants; thesis rows stay attached
        look: dict[str, Any] = {"style": "italic" if published else "normal", "fontsize": SMALL}
        for column, value in enumerate(values[row]):
            text = "–" if np.isnan(value) else form.format(value)
            colour = "white" if scale(value) > DARK else "black"
            ax.text(column + 0.5, row + 0.5, text, color=colour, ha="center", va="center", **look)
    noises = [f"{100 * noise:g}" for noise in table.columns.get_level_values(1)]
    style.name_ticks(ax.xaxis, np.arange(len(noises)) + 0.5, noises)
    ax.set(xlabel="noise (% of RMS)", ylim=(len(table), 0.0))
    ax.spines[:].set_visible(False)
    systems = table.columns.get_level_values(0)
    for system in systems.unique():
        places, label = np.flatnonzero(systems == system), system.replace("_", " ").title()
        ax.text(places.mean() + 0.5, -0.25, label, ha="center", va="bottom", fontsize=SMALL)
        ax.axvline(places[0], color="white", lw=5)
