"""Figures of a model's free run: over the data, on its limit cycle, and by process."""

from __future__ import annotations

from collections.abc import Mapping
from textwrap import wrap

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures import style
from ep2sindy.figures.style import COLOURS, DATA, GREY, TITLE, WIDTH
from ep2sindy.library.units import Clock
from ep2sindy.model.rollout import Rollout, simulate
from ep2sindy.model.stability import LimitCycle

PERIODS = 6.0  # periods shown at either end of a record

STARTS = (0.3, 0.6, 1.4, 0.6, 1.4)  # distance from the cycle's middle, relative to its states
N_PERIODS = 12.0  # duration of a run from such a start, in periods


def free_run_figure(run: Trajectory, rollout: Rollout, *, period_s: float) -> Figure:
    """A row per state: the model over the data in the first and the last periods of a record.

    run: the record; the model started from its first sample.
    """
    shown = min(PERIODS * period_s, 0.5 * float(run.t[-1] - run.t[0]))
    factor, unit = run.clock.scale(shown)
    n = len(run.state_names)
    height = float(np.clip(5.0 / n, 1.3, 2.2))
    figure, axes = style.make_panels(n, 2, (WIDTH, height * n + 0.8), sharex="col", sharey="row")
    since = run.t - run.t[0]
    parts = (since <= shown, since >= since[-1] - shown)
    for k, (row, name) in enumerate(zip(axes, run.state_names, strict=True)):
        model = rollout.states[:, rollout.state_names.index(name)]
        for ax, part in zip(row, parts, strict=True):
            reached = part & (np.arange(len(part)) < len(model))
            data = factor * since[part], run.states[part, k]
            style.draw_over(ax, data, (factor * since[reached], model[reached[: len(model)]]))
        row[0].set_ylim(style.frame_limits(run.states[:, k], model))
        row[0].set_ylabel(style.axis_label(name, run.units[name]))
    for ax, words in zip(axes[0], ("first periods", "last periods"), strict=True):
        ax.set_title(words, fontsize=TITLE)
    for ax in axes[-1]:
        ax.set_xlabel(f"time since the model's start ({unit})")
    style.legend_above(figure, axes[0, 0].lines[:2])
    return figure


def cycle_figure(run: Trajectory | None, cycle: LimitCycle) -> Figure:
    """A model's limit cycle over data in the plane of its first two states, and other runs.

    run: the data; None leaves them out. Other runs start off the cycle, at the dots. A run that
    leaves the panel is not drawn again. A neutral cycle is one of a family, and is called so.
    """
    own, others = "the model's cycle", "from other starts"
    if cycle.stability == "neutral":
        own, others = "the cycle from the record's start", "others of the family"
    plane, paths = cycle.model.states[:2], paths_off(cycle)
    figure, (ax,) = style.make_grid(1, width=4.4, height=3.8, extra=0.5)
    handles = [
        Line2D([], [], color=COLOURS[1], lw=2.0, label=own),
        Line2D([], [], color=COLOURS[5], marker="o", ms=4, lw=0.8, label=others),
    ]
    closed = np.concatenate([cycle.states, cycle.states[:1]])[:, :2]
    data = closed
    if run is not None:
        data = run.columns(plane)
        ax.plot(*data.T, color=GREY, lw=0.6)
        handles.insert(0, Line2D([], [], color=GREY, lw=2.0, label="data"))
    for path in paths:
        ax.plot(*path.states[:, :2].T, color=COLOURS[5], lw=0.7)
        ax.plot(*path.states[0, :2], "o", color=COLOURS[5], ms=4)
    ax.plot(*closed.T, color=COLOURS[1], lw=2.0)
    shown = np.concatenate([closed, *(path.states[:1, :2] for path in paths)])
    x_limits, y_limits = map(style.frame_limits, data.T, shown.T)
    x_label, y_label = (style.axis_label(name, cycle.model.units[name]) for name in plane)
    ax.set(xlim=x_limits, ylim=y_limits, xlabel=x_label, ylabel=y_label)
    style.legend_above(figure, handles)
    return figure


def paths_off(cycle: LimitCycle) -> list[Rollout]:
    """Runs of a cycle's model from states off it, some nearer to its middle and some farther."""
    middle = cycle.states.mean(axis=0)
    places = np.arange(len(STARTS)) * len(cycle.states) // len(STARTS)
    starts = middle + np.array(STARTS)[:, None] * (cycle.states[places] - middle)
    lowest = cycle.states.min(axis=0)  # of a state that is positive, no start may be below zero
    starts = np.where(lowest > 0.0, np.maximum(starts, 0.5 * lowest), starts)
    t = np.linspace(0.0, N_PERIODS * cycle.period_s, 1200)
    reach = np.abs(cycle.states).max(axis=0)
    return [simulate(cycle.model, t, start, None, blow_up=30.0, reach=reach) for start in starts]


def balance_figure(
    t: Float[np.ndarray, " samples"],
    parts: Mapping[str, tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]],
    *,
    clock: Clock,
) -> Figure:
    """A panel per process: its rate in the record and by the model's terms, in m^-3/s."""
    factor, unit = clock.scale(float(t[-1] - t[0]))
    figure, axes = style.make_grid(
        len(parts), width=WIDTH / 2, height=2.2, extra=0.6, sharex=True, x_label=f"time ({unit})"
    )
    time = factor * (t - t[0])
    for ax, (name, (recorded, modelled)) in zip(axes, parts.items(), strict=True):
        style.draw_over(ax, (time, recorded), (time, modelled))
        ax.axhline(0.0, color=DATA, lw=0.5)
        ax.set_title("\n".join(wrap(name, 44)), fontsize=TITLE)
    figure.supylabel(style.axis_label("rate", "m^-3/s"), fontsize=TITLE)
    style.legend_above(figure, axes[0].lines[:2])
    return figure
