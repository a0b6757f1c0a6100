"""Figures of time series: data, models next to them, each in its own row or panel, and forecasts.

The module also holds phase portraits of models and data in the plane of two states, and the
preparation of curves: the part of a run to show, its limits and its labels.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from textwrap import wrap
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FormatStrFormatter, LogLocator, NullFormatter

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures import style
from ep2sindy.figures.style import COLOURS, DATA, GREY, MORE_COLOURS, SMALL, TITLE, WIDTH, Limits
from ep2sindy.forecasting.forecast import LEVEL
from ep2sindy.forecasting.skill import MODEL, ForecastSkill
from ep2sindy.library.units import Clock, unit_product
from ep2sindy.model.rollout import Rollout, simulate
from ep2sindy.model.stability import LimitCycle
from ep2sindy.signals.spectrum import dominant_frequency, power_spectrum

SINCE_START = "time since start of integration"

HARMONICS = 10.0  # of the fastest state, up to which spectra are drawn

LABEL = 18  # letters in a line of a model's label next to or above its panel
PERIODS = 6.0  # periods shown at either end of a record

STARTS = (0.3, 0.6, 1.4, 0.6, 1.4)  # distance from the cycle's middle, relative to its states
N_PERIODS = 12.0  # duration of a run from such a start, in periods


def data_figure(run: Trajectory, *, duration_s: float, f_max_Hz: float | None = None) -> Figure:
    """A row per state: its first `duration_s`, and its power spectrum up to `f_max_Hz`.

    f_max_Hz: None means harmonics of the fastest state, up to half the sampling rate.
    """
    peaks_Hz = [dominant_frequency(run.t, column) for column in run.states.T]
    if f_max_Hz is None:
        f_max_Hz = min(0.5 / run.dt_s, HARMONICS * float(np.nanmax([0.0, *peaks_Hz])) or np.inf)
    n = len(run.state_names)
    figure, axes = style.make_panels(n, 2, (WIDTH, 2.2 * n + 0.6), sharex="col", widths=[3, 2])
    states = first_part(run.t, run.states, duration_s, run.clock)
    factor, unit = run.clock.frequency_scale(f_max_Hz)
    for k, (row, name, peak_Hz) in enumerate(zip(axes, run.state_names, peaks_Hz, strict=True)):
        row[0].plot(states.x, states.y[:, k], color=DATA, lw=1)
        row[0].set_ylabel(style.axis_label(name, run.units[name]))
        frequency_Hz, power = _spectrum(run, k, f_max_Hz)
        row[1].semilogy(factor * frequency_Hz, power, color=COLOURS[0], lw=0.8)
        text = run.clock.frequency_text(peak_Hz)
        row[1].axvline(factor * peak_Hz, color=COLOURS[1], lw=1, ls="--", label=text)
        row[1].legend(loc="upper right", frameon=False)
        row[1].set_ylabel(f"power ({style.unit_text(_power_unit(run, name))})")
    axes[-1, 0].set_xlabel(_time_label(run.clock, duration_s))
    axes[-1, 1].set_xlabel(f"frequency ({unit})")
    return figure


def trajectory_figure(
    run: Trajectory,
    rollouts: Mapping[str, Rollout],
    *,
    duration_s: float,
    statuses: Mapping[str, str] = MappingProxyType({}),
    since: str = SINCE_START,
) -> Figure:
    """A row per model: its run from the data's first sample (colour) over the data (grey).

    statuses: by name, how the run goes. since: the origin of the time axis, in words.
    """
    data = first_part(run.t, run.states, duration_s, run.clock)
    models = _runs(rollouts, statuses, duration_s, run.clock)
    n_states = len(run.state_names)
    height = float(np.clip(5.0 / len(models), 1.05, 2.2))
    size = (WIDTH, height * len(models) + 1.2)
    figure, axes = style.make_panels(len(models), n_states, size, sharex=True, sharey="col")
    limits = limits_of(data, models)
    for row, colour, model in zip(axes, cycle(MORE_COLOURS), models, strict=False):
        for k, ax in enumerate(row):
            style.draw_over(ax, (data.x, data.y[:, k]), (model.x, model.y[:, k]), colour=colour)
            ax.set_ylim(limits[k])
        text = model.label.replace(", ", ",\n")
        row[0].set_ylabel(text, rotation=0, ha="right", va="center", labelpad=10)
    for ax in axes[1:].flat:  # panels of a column share their axis and so the first row's factor
        ax.yaxis.get_offset_text().set_visible(False)
    for column, name in zip(axes.T, run.state_names, strict=True):
        column[0].set_title(style.axis_label(name, run.units[name]), fontsize=TITLE)
    # Once: three columns have no width for it.
    figure.supxlabel(_time_label(run.clock, duration_s, since), fontsize=SMALL)
    style.legend_above(figure, axes[0, 0].lines[:1])
    return figure


def _spectrum(run: Trajectory, k: int, f_max_Hz: float) -> style.Curve:
    """Frequencies up to `f_max_Hz`, and the power of state k; empty for fewer than 8 samples."""
    frequency_Hz, power = power_spectrum(run.t, run.states[:, k])
    shown = (frequency_Hz > 0.0) & (frequency_Hz <= f_max_Hz) & (run.n_samples >= 8)
    drawable = np.maximum(power[shown], np.finfo(float).tiny)  # on a log scale
    return frequency_Hz[shown], drawable / run.clock.seconds


def _time_label(clock: Clock, duration_s: float, what: str = "time") -> str:
    return f"{what} ({clock.scale(duration_s)[1]})"


def _power_unit(run: Trajectory, name: str) -> str:
    """Unit of a state's power density."""
    if run.clock.unit == "s":
        return unit_product([(run.units[name], 2), ("Hz", -1)])
    return f"{unit_product([(run.units[name], 2)])} {run.clock.unit}".removeprefix("1 ")


@dataclass(frozen=True, eq=False)
class Curves:
    """One curve per state over a shared abscissa, scaled to the axis's prefix.

    label: of the panels that show it.
    """

    x: Float[np.ndarray, " points"]
    y: Float[np.ndarray, "points n_states"]
    label: str = ""


def first_part(
    t: Float[np.ndarray, " samples"],
    values: Float[np.ndarray, "samples n_states"],
    duration_s: float,
    clock: Clock,
    label: str = "",
) -> Curves:
    """The first `duration_s` of the values, over time in the clock's unit."""
    since = t - t[:1]
    shown = since <= duration_s
    return Curves(clock.scale(duration_s)[0] * since[shown], values[shown], label)


def _runs(
    rollouts: Mapping[str, Rollout], statuses: Mapping[str, str], duration_s: float, clock: Clock
) -> list[Curves]:
    """The first part of every run."""
    return [
        first_part(run.t, run.states, duration_s, clock, _run_label(name, run, statuses))
        for name, run in rollouts.items()
    ]


def limits_of(data: Curves, models: Sequence[Curves]) -> list[Limits]:
    together = np.concatenate([curves.y for curves in models])
    return [style.frame_limits(*pair) for pair in zip(data.y.T, together.T, strict=True)]


def _run_label(name: str, run: Rollout, statuses: Mapping[str, str]) -> str:
    """The name, and below it the status if it is known; for a diverged run the time it lasted.

    `diverges at 182 µs` is counted from the run's start.
    """
    status = f"diverges at {run.lasted_text or 'once'}" if run.diverged else statuses.get(name)
    return f"{_label(name)}\n({status})" if status else _label(name)


def _label(name: str) -> str:
    """A model's name in words, in lines that leave room for its panel."""
    return "\n".join(wrap(name.replace("_", " "), LABEL))


def phase_figure(
    run: Trajectory,
    rollouts: Mapping[str, Rollout],
    *,
    duration_s: float,
    statuses: Mapping[str, str] = MappingProxyType({}),
) -> Figure:
    """A panel per model in the plane of the first two states: its run (colour) over data (grey).

    The dot marks the start; statuses are as in `trajectory_figure`.
    """
    data = first_part(run.t, run.states, duration_s, run.clock)
    models = _runs(rollouts, statuses, duration_s, run.clock)
    x_label, y_label = (style.axis_label(name, run.units[name]) for name in run.state_names[:2])
    figure, axes = style.make_grid(
        len(models), width=2.75, height=2.75, extra=0.7, sharex=True, sharey=True, x_label=x_label
    )
    x_limits, y_limits = limits_of(data, models)[:2]
    for ax, colour, model in zip(axes, cycle(MORE_COLOURS), models, strict=False):
        style.draw_over(
            ax, (data.y[:, 0], data.y[:, 1]), (model.y[:, 0], model.y[:, 1]), colour=colour
        )
        ax.plot(*model.y[:1, :2].T, "o", color=colour, ms=4)
        ax.set_title(model.label, fontsize=TITLE, pad=13.0)  # above the ordinate's factor
    axes[0].set(xlim=x_limits, ylim=y_limits)
    for ax in axes:
        place = ax.get_subplotspec()
        if place is not None and place.is_first_col():
            ax.set_ylabel(y_label)
            # All panels share the first one's factor.
            ax.yaxis.get_offset_text().set_visible(place.is_first_row())
    style.legend_above(figure, axes[0].lines[:1])
    return figure


HISTORY = 0.5  # of the horizon, shown before the start
FLOOR = 1e-3  # lowest error drawn, in standard deviations
FEW_DECADES = 100.0  # ratio of the ends of an axis of errors with ticks inside its decades


def forecast_figure(run: Trajectory, skill: ForecastSkill) -> Figure:
    """The first forecast with its band over the samples, and the errors of all, by horizon.

    run: the record that was forecast; its variables of the model's states are drawn.
    """
    ahead = skill.example
    noise = dict(zip(ahead.state_names, ahead.noise_std, strict=True))  # NaN if not measured
    names = [name for name in ahead.state_names if name in run.names and np.isfinite(noise[name])]
    width = 4.5 if len(names) == 1 else 3.0
    figure, axes = style.make_grid(len(names) + 1, width=width, height=2.8, extra=0.4)
    low, high = ahead.band(LEVEL)
    begin = run.t[max(0, int(np.searchsorted(run.t, ahead.t[0] - 1e-9 * run.dt_s)) - 1)]
    factor, unit = run.clock.scale(float(ahead.t[-1] - begin))
    shown = (run.t >= begin - HISTORY * (ahead.t[-1] - begin)) & (run.t <= ahead.t[-1])
    since, later = factor * (run.t[shown] - begin), factor * (ahead.t - begin)
    for ax, name in zip(axes, names, strict=False):
        k = ahead.state_names.index(name)
        values, mean = run.columns([name])[shown, 0], ahead.states[:, k]
        ax.plot(since, values, ".", ms=3, color=DATA, label="samples")
        band: dict[str, Any] = {"color": COLOURS[0], "alpha": 0.25, "lw": 0}
        label = f"band of {100.0 * LEVEL:.0f} %"
        ax.fill_between(later, low[:, k], high[:, k], label=label, **band)
        ax.plot(later, mean, color=COLOURS[0], lw=1.2, label="forecast")
        ax.axvline(0.0, color=GREY, lw=0.8, ls="--")
        ax.set(
            xlabel=f"time since the start ({unit})", ylabel=style.axis_label(name, run.units[name])
        )
        ax.set_ylim(style.frame_limits(values, mean))
    _draw_errors(axes[-1], skill)
    baselines = axes[-1].lines[1 : len(skill.nrmse)]  # the first line is the model's
    style.legend_above(figure, [*axes[0].get_legend_handles_labels()[0], *baselines])
    return figure


def _draw_errors(ax: Axes, skill: ForecastSkill) -> None:
    names = (MODEL, "persistence", "harmonics", "autoregression", "neighbours")
    colours = dict(zip(names, COLOURS, strict=False))
    for name, values in skill.nrmse.items():
        look: dict[str, Any] = {"color": colours[name], "lw": 1.8 if name == MODEL else 1.0}
        horizons = skill.horizons_s / skill.unit_s
        ax.plot(horizons, np.maximum(values, FLOOR), label=name, **look)
    ax.axhline(1.0, color=GREY, lw=0.8, ls="--")
    ax.set(yscale="log", ylabel="error (standard deviations)")
    low, high = ax.get_ylim()
    steps = (1.0, 2.0, 5.0) if high < FEW_DECADES * low else (1.0,)
    ax.yaxis.set_major_locator(LogLocator(subs=steps))
    ax.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    ax.yaxis.set_minor_formatter(NullFormatter())
    ax.set_xlabel(f"horizon ({skill.unit})")


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
