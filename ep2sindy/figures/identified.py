"""Tables and figures of the benchmark, the frontier, and models of known systems.

The benchmark is a table and a heat map of how often each variant finds the equations. Known
systems are drawn next to the identified models, as attractors and trajectories.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures import style
from ep2sindy.figures.series import when_it_diverges
from ep2sindy.figures.style import COLOURS, DATA, GREY, SMALL, TITLE, WIDTH, Curve, Limits
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

IDENTIFIED = COLOURS[1]

MIN_WIDTH = 2.3  # of a heat map, in inches: its title stands above it

# They differ by shape and filling, not by colour alone.
SIGNS: Mapping[str, Mapping[str, Any]] = {
    "identified": {"marker": "o", "color": COLOURS[2]},
    "not identified": {"marker": "o", "color": COLOURS[1], "mfc": "none"},
    "too few samples to run": {"marker": "x", "color": GREY, "ms": 4},
}

MAX_DOTS = 1500  # samples drawn in a panel


def merit_table(cells: pd.DataFrame, published: pd.DataFrame, merit: str) -> pd.DataFrame:
    """One figure of merit of every variant; a published row, if any, follows its variant's row.

    cells: from `studies.benchmark.cells`. published: the same, without the time. Returns a table
    with index (variant, is it published) and columns (system, noise), in the order of `cells`;
    counts become percentages of n.
    """
    place, shown = ["system", "noise"], ["variant", "system", "noise", merit, "n"]
    known = published.merge(cells[[*place, "variant"]])
    parts = {False: cells[shown], **({True: known[shown]} if len(known) else {})}
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

    points: from `Study.points` of `studies.frontier`.
    """
    variants = list(points["variant"].unique())
    figure, axes = style.make_row(len(variants), width=2.6, height=3.5)
    kinds = points["identified"].map({True: "identified", False: "not identified"})
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
    """How often every variant finds the true equations, in percent, as numbers on a heat map.

    cells, thesis: as for `merit_table`. The thesis's rows are in italics, each below its variant.
    """
    tables = {merit: merit_table(cells, thesis, merit) for merit in PANELS}
    rows, columns = tables["on_front"].axes
    width = max(0.36 * len(columns), MIN_WIDTH)
    size = (1.8 + 2 * (width + 0.1), 0.9 + 0.25 * len(rows))
    figure, (axes,) = style.make_panels(1, len(PANELS), size, sharey=True)
    for ax, (merit, table) in zip(axes, tables.items(), strict=True):
        _draw_heat_map(ax, table)
        ax.set_title(f"{PANELS[merit]} (%)", fontsize=TITLE, pad=24)
    labels = ["thesis" if published else name.replace("_", " ") for name, published in rows]
    style.name_ticks(axes[0].yaxis, np.arange(len(rows)) + 0.5, labels)
    for text, (_, published) in zip(axes[0].get_yticklabels(), rows, strict=True):
        text.set(style="italic" if published else "normal")
    return figure


def _draw_heat_map(ax: Axes, table: pd.DataFrame) -> None:
    """Draw percentages with noise levels below the columns, and system names above."""
    values = table.to_numpy(float)
    texts = ["–" if np.isnan(value) else f"{value:.0f}" for value in values.flat]
    written, n_columns = style.draw_cells(ax, values, texts, 100.0), values.shape[1]
    for row, published in enumerate(table.index.get_level_values(1)):
        if not published:
            ax.axhline(row, color="white", lw=3)  # gap between variants; thesis rows stay attached
        for text in written[row * n_columns : (row + 1) * n_columns]:
            text.set_fontstyle("italic" if published else "normal")
    noises = [f"{100 * noise:g}" for noise in table.columns.get_level_values(1)]
    style.name_ticks(ax.xaxis, np.arange(len(noises)) + 0.5, noises)
    ax.set(xlabel="noise (% of RMS)", ylim=(len(table), 0.0))
    ax.spines[:].set_visible(False)
    systems = table.columns.get_level_values(0)
    for system in systems.unique():
        places, label = np.flatnonzero(systems == system), SYSTEM_LABELS.get(system, system)
        ax.text(places.mean() + 0.5, -0.25, label, ha="center", va="bottom", fontsize=SMALL)
        ax.axvline(places[0], color="white", lw=5)


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

    def curves(self, over_time: bool) -> list[Curve]:
        """Samples, truth and run: the first and the last state, or the first over time."""
        parts = ((run.t, run.states) for run in (self.samples, self.truth, self.rollout))
        return [(t if over_time else x[:, 0], x[:, 0 if over_time else -1]) for t, x in parts]


def attractor_figure(found: Sequence[Identified], *, over_time: bool = False) -> Figure:
    """A column per system, a row per noise level: samples, truth and identified model.

    Panels show the plane of the first and the last state; with over_time, the first state over
    time.
    """
    systems = list(dict.fromkeys(each.system for each in found))
    noises = sorted({each.noise for each in found})
    width, height = (3.4, 1.7) if over_time else (2.6, 2.5)
    size = (min(WIDTH, width * len(systems) + 0.6), height * len(noises) + 0.9)
    figure, axes = style.make_panels(len(noises), len(systems), size, sharex="col", sharey="col")
    curves = [each.curves(over_time) for each in found]
    for each, drawn in zip(found, curves, strict=True):
        ax = axes[noises.index(each.noise), systems.index(each.system)]
        alike = [of[0] for of, one in zip(curves, found, strict=True) if one.system == each.system]
        x, y = (
            style.frame_limits(np.concatenate(of), np.empty(0)) for of in zip(*alike, strict=True)
        )
        _draw_one(ax, each, drawn, (x, y))
        first, last = (f"${latex_name(each.samples.state_names[k])}$" for k in (0, -1))
        ax.set_ylabel(first if over_time else last, labelpad=1)
        if each.noise == noises[-1]:
            ax.set_xlabel("time (s)" if over_time else first)
    for ax, system in zip(axes[0], systems, strict=True):
        ax.set_title(f"{SYSTEM_LABELS.get(system, system)}\n{ax.get_title()}", fontsize=TITLE)
    for ax, noise in zip(axes[:, 0], noises, strict=True):
        ax.set_ylabel(f"noise {100 * noise:g} %\n\n{ax.get_ylabel()}")
    style.legend_above(figure, axes[0, 0].lines[:3])
    return figure


def _draw_one(
    ax: Axes, each: Identified, curves: Sequence[Curve], limits: tuple[Limits, Limits]
) -> None:
    """Draw samples as dots, the truth as a line, and the model as a line that hides neither."""
    (x, y), truth, model = curves
    step = -(-len(x) // MAX_DOTS)
    ax.plot(x[::step], y[::step], ".", color=GREY, ms=3.5, mew=0, label="samples")
    ax.plot(*truth, color=DATA, lw=1.6, label="truth")
    ax.plot(*model, color=IDENTIFIED, lw=1.1, ls=(0, (4, 1.5)), label="identified model")
    ax.set(xlim=limits[0], ylim=limits[1])
    verdict = "true terms" if each.right else "other terms"
    if each.rollout.diverged:
        verdict += f", {when_it_diverges(each.rollout)}"
    ax.set_title(verdict, fontsize=TITLE, color=DATA if each.right else IDENTIFIED)
