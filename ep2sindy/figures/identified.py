"""Tables and figures of the benchmark, the frontier, and models of known systems.

The benchmark is a table and a heat map of how often each variant finds the equations. Known
systems are drawn beside the identified models, as attractors and trajectories.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.series import when_it_diverges
from ep2sindy.figures.style import (
    COLOURS,
    DATA,
    GREY,
    SMALL,
    TITLE,
    WIDTH,
    Limits,
    frame_limits,
    legend_above,
    legend_curves,
    make_panels,
    mark_exits,
    write_in_cell,
)
from ep2sindy.library.equations import latex_name
from ep2sindy.model.rollout import Rollout

COUNTS = ("on_front", "selected")  # numbers of realizations

MERITS = (*COUNTS, "mean_correct_terms")

SYSTEM_LABELS = {
    "oscillator": "damped oscillator",
    "lotka_volterra": "Lotka–Volterra",
    "van_der_pol": "Van der Pol",
    "lorenz": "Lorenz",
}

PANELS = {"on_front": "true equations on the front", "selected": "true equations selected"}

# One hue from light to dark: legible with any colour vision, and in grey.
COLOURMAP, DARK = "Blues", 0.7

IDENTIFIED = COLOURS[1]

MIN_WIDTH = 2.3  # of a heat map, in inches: its title stands above it

MAX_DOTS = 1500  # samples drawn in a panel


def merit_table(cells: pd.DataFrame, published: pd.DataFrame, merit: str) -> pd.DataFrame:
    """One figure of merit of every variant; a published row, if any, follows its variant's row.

    cells: from `studies.benchmark.cells`. published: the same, without the time. Returns a table
    with index (variant, is it published) and columns (system, noise), in the order of `cells`;
    counts become percentages of n.
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
    """A panel per variant: sampling rate against duration, filled marks where it found the system.

    points: from `Study.points` of `studies.frontier`.
    """
    variants = list(points["variant"].unique())
    size = (min(WIDTH, 2.6 * len(variants) + 0.4), 3.5)
    figure, (axes,) = make_panels(1, len(variants), size, sharex=True, sharey=True)
    for ax, variant in zip(axes, variants, strict=True):
        for (found, ran), marker in _MARKERS.items():
            kind = (points["identified"] == found) & ((points["reason"] == "") == ran)
            one = points[kind & (points["variant"] == variant)]
            ax.plot(one["duration_s"], one["rate_Hz"], **marker)
        ax.set_title(variant, fontsize=TITLE)
        ax.set_xlabel("duration (s)")
    axes[0].set_xscale("log")
    axes[0].set_yscale("log")
    axes[0].xaxis.set_minor_formatter("")  # decades alone: others overlap
    axes[0].set_ylabel("sampling rate (Hz)")
    legend_above(figure, [Line2D([], [], **marker) for marker in _MARKERS.values()])
    return figure


# (identified, ran) -> marker: they differ by shape and filling, not by colour alone.
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

    cells, thesis: as for `merit_table`. The thesis's rows are in italics, each below its variant.
    """
    tables = {merit: merit_table(cells, thesis, merit) for merit in PANELS}
    n_rows, n_columns = tables["on_front"].shape
    width = max(0.36 * n_columns, MIN_WIDTH)
    size = (1.8 + 2 * (width + 0.1), 0.9 + 0.25 * n_rows)
    figure, (axes,) = make_panels(1, len(PANELS), size, sharey=True)
    for ax, (merit, table) in zip(axes, tables.items(), strict=True):
        _draw_heat_map(ax, table)
        ax.set_title(f"{PANELS[merit]} (%)", fontsize=TITLE, pad=24)
    _name_rows(axes[0], tables["on_front"].index)
    return figure


def _draw_heat_map(ax: Axes, table: pd.DataFrame) -> None:
    values = table.to_numpy(dtype=float)
    scale = Normalize(0.0, 100.0)
    ax.pcolormesh(
        np.ma.masked_invalid(values), cmap=COLOURMAP, norm=scale, edgecolors="white", linewidth=0.8
    )
    for (row, column), value in np.ndenumerate(values):
        known = np.isfinite(value)
        colour = "#777777" if not known else "white" if scale(value) > DARK else "black"
        text = write_in_cell(ax, column, row, f"{value:.0f}" if known else "–", colour=colour)
        text.set_fontstyle("italic" if table.index[row][1] else "normal")
    for row, (_, published) in enumerate(table.index):
        if not published:
            ax.axhline(row, color="white", lw=3)  # gap between variants; thesis rows stay attached
    _name_columns(ax, table.columns)
    ax.set_ylim(len(values), 0.0)
    ax.spines[:].set_visible(False)
    ax.tick_params(length=0)


def _name_columns(ax: Axes, columns: pd.Index) -> None:
    """Write noise levels below the columns and system names above; leave a gap between systems."""
    ax.set_xticks(np.arange(len(columns)) + 0.5, [f"{100 * noise:g}" for _, noise in columns])
    ax.tick_params(axis="x", labelsize=SMALL)
    ax.set_xlabel("noise (% of RMS)")
    systems = columns.get_level_values(0)
    for system in systems.unique():
        places = np.flatnonzero(systems == system)
        label = SYSTEM_LABELS.get(system, system)
        middle = places.mean() + 0.5
        ax.text(middle, -0.25, label, ha="center", va="bottom", fontsize=SMALL)
        ax.axvline(places[0], color="white", lw=5)


def _name_rows(ax: Axes, rows: pd.Index) -> None:
    labels = ["thesis" if published else name.replace("_", " ") for name, published in rows]
    ax.set_yticks(np.arange(len(rows)) + 0.5, labels, fontsize=SMALL)
    for text, (_, published) in zip(ax.get_yticklabels(), rows, strict=True):
        if published:
            text.set(style="italic", color="#555555")


@dataclass(frozen=True, eq=False)
class Identified:
    """One realization of a known system, and the model identified from it.

    samples: noisy data of the fit. truth: noise-free, all states. rollout: run of the model from
    the truth's initial state. right: whether the model has the true terms.
    """

    system: str
    noise: float
    samples: Trajectory
    truth: Trajectory
    rollout: Rollout
    right: bool


def attractor_figure(found: Sequence[Identified], *, over_time: bool = False) -> Figure:
    """A column per system, a row per noise level: samples, truth and identified model.

    Panels show the plane of the first and the last state; with over_time, the first state over
    time. Carets mark where a model leaves the panel; a cross marks where a diverged run stops
    inside it.
    """
    systems = list(dict.fromkeys(each.system for each in found))
    noises = sorted({each.noise for each in found})
    width, height = (3.4, 1.7) if over_time else (2.6, 2.5)
    size = (min(WIDTH, width * len(systems) + 0.6), height * len(noises) + 0.9)
    figure, axes = make_panels(len(noises), len(systems), size, sharex="col", sharey="col")
    limits = {
        system: _frame_samples([each for each in found if each.system == system], over_time)
        for system in systems
    }
    for each in found:
        ax = axes[noises.index(each.noise), systems.index(each.system)]
        _draw_one(ax, each, limits[each.system], over_time=over_time)
        first, last = each.samples.state_names[0], each.samples.state_names[-1]
        across, up = ("time (s)", first) if over_time else (f"${latex_name(first)}$", last)
        ax.set_ylabel(f"${latex_name(up)}$", labelpad=1)
        if each.noise == noises[-1]:
            ax.set_xlabel(across)
    for ax, system in zip(axes[0], systems, strict=True):
        ax.set_title(f"{SYSTEM_LABELS.get(system, system)}\n{ax.get_title()}", fontsize=TITLE)
    for ax, noise in zip(axes[:, 0], noises, strict=True):
        ax.set_ylabel(f"noise {100 * noise:g} %\n\n{ax.get_ylabel()}")
    legend_curves(figure, list(axes.flat), n=3)
    return figure


def _frame_samples(found: Sequence[Identified], over_time: bool) -> tuple[Limits, Limits]:
    """Limits around all samples of one system, regardless of the models."""
    pairs = [_coordinates(each.samples.t, each.samples.states, over_time) for each in found]
    x, y = (np.concatenate(column) for column in zip(*pairs, strict=True))
    return frame_limits(x, np.empty(0)), frame_limits(y, np.empty(0))


def _draw_one(
    ax: Axes, each: Identified, limits: tuple[Limits, Limits], *, over_time: bool
) -> None:
    """Draw samples as dots, the truth as a line, and the model as a line that hides neither."""
    x, y = _coordinates(each.samples.t, each.samples.states, over_time)
    step = -(-len(x) // MAX_DOTS)
    ax.plot(x[::step], y[::step], ".", color=GREY, ms=3.5, mew=0, label="samples")
    truth = _coordinates(each.truth.t, each.truth.states, over_time)
    ax.plot(*truth, color=DATA, lw=1.6, label="truth")
    model = _coordinates(each.rollout.t, each.rollout.states, over_time)
    ax.plot(*model, color=IDENTIFIED, lw=1.1, ls=(0, (4, 1.5)), label="identified model")
    ax.set(xlim=limits[0], ylim=limits[1])
    mark_exits(ax, *model, colour=IDENTIFIED, limits=limits, diverged=each.rollout.diverged)
    verdict = "true terms" if each.right else "other terms"
    if each.rollout.diverged:
        verdict += f", {when_it_diverges(each.rollout)}"
    ax.set_title(verdict, fontsize=TITLE, color=DATA if each.right else IDENTIFIED)


def _coordinates(
    t: Float[np.ndarray, " samples"], states: Float[np.ndarray, "samples n_states"], over_time: bool
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]:
    return (t, states[:, 0]) if over_time else (states[:, 0], states[:, -1])
