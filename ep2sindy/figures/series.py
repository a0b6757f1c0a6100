"""Figures of time series: data, models beside them, each in its own row or panel, and forecasts.

The module also holds phase portraits of models and data in the plane of two states, and the
preparation of curves: the part of a run to show, its limits and its labels.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import cycle
from types import MappingProxyType

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.style import (
    COLOURS,
    DATA,
    GREY,
    MORE_COLOURS,
    SMALL,
    TITLE,
    WIDTH,
    Limits,
    axis_label,
    frame_limits,
    legend_above,
    legend_curves,
    make_grid,
    make_panels,
    mark_exits,
    slope_label,
    unit_text,
)
from ep2sindy.forecasting.forecast import LEVEL
from ep2sindy.forecasting.skill import MODEL, ForecastSkill
from ep2sindy.library.units import Clock, unit_product
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import Rollout
from ep2sindy.signals.smoothers import Smoother
from ep2sindy.signals.spectrum import dominant_frequency, power_spectrum

SINCE_START = "time since start of integration"

RARE = 0.01  # share of derivative samples, low or high, kept out of the scale as edge spikes


def data_figure(run: Trajectory, *, duration_s: float, f_max_Hz: float) -> Figure:
    """A row per state: its first `duration_s`, and its power spectrum up to `f_max_Hz`."""
    n = len(run.state_names)
    figure, axes = make_panels(n, 2, (WIDTH, 2.2 * n + 0.6), sharex="col", widths=[3, 2])
    states = first_part(run.t, run.states, duration_s, run.clock)
    spectra = _spectra(run.t, run.states, f_max_Hz, run.clock)
    for k, (row, name) in enumerate(zip(axes, run.state_names, strict=True)):
        row[0].plot(states.x, states.y[:, k], color=DATA, lw=1)
        row[0].set_ylabel(axis_label(name, run.units[name]))
        row[1].semilogy(spectra.x, spectra.y[:, k], color=COLOURS[0], lw=0.8)
        peak_Hz = dominant_frequency(run.t, run.states[:, k])
        peak = run.clock.frequency_scale(f_max_Hz)[0] * peak_Hz
        text = run.clock.frequency_text(peak_Hz)
        row[1].axvline(peak, color=COLOURS[1], lw=1, ls="--", label=text)
        row[1].legend(loc="upper right", frameon=False)
        row[1].set_ylabel(f"power ({unit_text(_power_unit(run, name))})")
    axes[-1, 0].set_xlabel(_time_label(run.clock, duration_s))
    axes[-1, 1].set_xlabel(_frequency_label(run.clock, f_max_Hz))
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

    Carets mark where a run leaves the panel; a cross marks where a diverged run stops inside it.
    statuses: by name, how the run goes. since: the origin of the time axis, in words.
    """
    data = first_part(run.t, run.states, duration_s, run.clock)
    models = {n: first_part(r.t, r.states, duration_s, run.clock) for n, r in rollouts.items()}
    titles = [axis_label(name, run.units[name]) for name in run.state_names]
    return _draw_rows(
        data, models, titles=titles, x_label=_time_label(run.clock, duration_s, since),
        labels=run_labels(rollouts, statuses), limits=limits_of(data, models),
        diverged=find_diverged(rollouts, duration_s),
    )[0]  # fmt: skip


def derivative_figure(
    run: Trajectory, models: Mapping[str, SparseModel], *, smoother: Smoother, duration_s: float
) -> Figure:
    """A row per model: its right-hand side on the data (colour), the data's derivative (grey).

    Spikes of the derivative do not set the scale; carets mark where a curve leaves the panel.
    """
    clock, pieces = run.clock, run.stretches()
    slopes = np.concatenate([smoother.derivative(each.t, each.states) for each in pieces])
    times = np.concatenate([each.t for each in pieces])
    data = first_part(times, clock.seconds * slopes, duration_s, clock)
    sides = {}
    for name, model in models.items():
        slopes = clock.seconds * model.derivative(
            run.columns(model.states), run.columns(model.inputs)
        )
        order = [model.states.index(state) for state in run.state_names]
        sides[name] = first_part(run.t, slopes[:, order], duration_s, clock)
    titles = [slope_label(name, clock.rate_unit(run.units[name])) for name in run.state_names]
    x_label, limits = _time_label(clock, duration_s), limits_of(data, sides, RARE)
    return _draw_rows(data, sides, titles=titles, x_label=x_label, limits=limits)[0]


def spectrum_figure(
    run: Trajectory,
    rollouts: Mapping[str, Rollout],
    *,
    f_max_Hz: float,
    statuses: Mapping[str, str] = MappingProxyType({}),
) -> Figure:
    """A row per model: power spectra of its run (colour) and of the data of equal length (grey).

    The dashed line marks the data's dominant frequency; each row states its model's.
    statuses: by name, how the run goes.
    """
    n_samples = max(len(rollout.t) for rollout in rollouts.values())
    data = _spectra(run.t[:n_samples], run.states[:n_samples], f_max_Hz, run.clock)
    models = {name: _spectra(r.t, r.states, f_max_Hz, run.clock) for name, r in rollouts.items()}
    titles = [f"power of {axis_label(name, _power_unit(run, name))}" for name in run.state_names]
    figure, axes = _draw_rows(
        data, models, titles=titles, x_label=_frequency_label(run.clock, f_max_Hz),
        labels=run_labels(rollouts, statuses),
    )  # fmt: skip
    for k, column in enumerate(axes.T):
        peak = run.clock.frequency_scale(f_max_Hz)[0] * dominant_frequency(run.t, run.states[:, k])
        column[0].set_yscale("log")
        power = data.y[:, k]
        column[0].set_ylim(0.3 * np.percentile(power, 2), 10.0 * power.max())
        for ax, rollout in zip(column, rollouts.values(), strict=True):
            ax.axvline(peak, color=DATA, lw=0.8, ls="--")
            if not rollout.diverged:
                text = run.clock.frequency_text(dominant_frequency(rollout.t, rollout.states[:, k]))
                ax.text(0.98, 0.82, text, transform=ax.transAxes, ha="right", fontsize=SMALL)
    return figure


def _draw_rows(
    data: Curves,
    models: Mapping[str, Curves],
    *,
    titles: Sequence[str],
    x_label: str,
    labels: Mapping[str, str] = MappingProxyType({}),
    limits: Sequence[Limits] = (),
    diverged: Collection[str] = (),
) -> tuple[Figure, np.ndarray]:
    """Draw a row per model and a column per state, with the data in grey behind.

    labels: row labels, by name. limits: of every column; marks show where curves leave them, and
    which runs diverged.
    """
    n_rows, n_columns = len(models), len(titles)
    height = float(np.clip(5.0 / n_rows, 1.05, 2.2))
    size = (WIDTH, height * n_rows + 1.2)
    figure, axes = make_panels(n_rows, n_columns, size, sharex=True, sharey="col")
    for row, colour, (name, curves) in zip(axes, cycle(MORE_COLOURS), models.items(), strict=False):
        for k, ax in enumerate(row):
            # Wider than the model, so that it shows on both sides of one that follows it.
            ax.plot(data.x, data.y[:, k], color=GREY, lw=2.4, label="data")
            ax.plot(curves.x, curves.y[:, k], color=colour, lw=1.1)
            for shown, shade in ((data, GREY), (curves, colour)):
                if limits and len(shown.x):
                    frame = (float(shown.x[0]), float(shown.x[-1])), limits[k]
                    stops = name in diverged and shown is curves
                    mark_exits(
                        ax, shown.x, shown.y[:, k], colour=shade, limits=frame, diverged=stops
                    )
        text = labels.get(name, name).replace(", ", ",\n")
        row[0].set_ylabel(text, rotation=0, ha="right", va="center", labelpad=10)
    for ax in axes[1:].flat:  # panels of a column share their axis and so the first row's factor
        ax.yaxis.get_offset_text().set_visible(False)
    for column, title in zip(axes.T, titles, strict=True):
        column[0].set_title(title, fontsize=TITLE)
        column[-1].set_xlabel(x_label)
    for column, ends in zip(axes.T, limits, strict=False):
        column[0].set_ylim(ends)
    legend_curves(figure, list(axes.flat))
    return figure, axes


def _spectra(
    t: Float[np.ndarray, " samples"],
    states: Float[np.ndarray, "samples n_states"],
    f_max_Hz: float,
    clock: Clock,
) -> Curves:
    """Power of every state up to `f_max_Hz`; empty for a run that stopped at once."""
    if len(t) < 8:
        return Curves(np.empty(0), np.empty((0, states.shape[1])))
    pairs = [power_spectrum(t, column) for column in states.T]
    frequency = pairs[0][0]
    power = np.stack([power for _, power in pairs], axis=1)
    shown = (frequency > 0.0) & (frequency <= f_max_Hz)
    drawable = np.maximum(power[shown], np.finfo(float).tiny)  # on a log scale
    return Curves(clock.frequency_scale(f_max_Hz)[0] * frequency[shown], drawable / clock.seconds)


def _time_label(clock: Clock, duration_s: float, what: str = "time") -> str:
    return f"{what} ({clock.scale(duration_s)[1]})"


def _frequency_label(clock: Clock, f_max_Hz: float) -> str:
    return f"frequency ({clock.frequency_scale(f_max_Hz)[1]})"


def _power_unit(run: Trajectory, name: str) -> str:
    """Unit of a state's power density."""
    if run.clock.unit == "s":
        return unit_product([(run.units[name], 2), ("Hz", -1)])
    return f"{unit_product([(run.units[name], 2)])} {run.clock.unit}".removeprefix("1 ")


@dataclass(frozen=True, eq=False)
class Curves:
    """One curve per state over a shared abscissa, scaled to the axis's prefix."""

    x: Float[np.ndarray, " points"]
    y: Float[np.ndarray, "points n_states"]


def first_part(
    t: Float[np.ndarray, " samples"],
    values: Float[np.ndarray, "samples n_states"],
    duration_s: float,
    clock: Clock,
) -> Curves:
    """The first `duration_s` of the values, over time in the clock's unit."""
    since = t - t[:1]
    shown = since <= duration_s
    return Curves(clock.scale(duration_s)[0] * since[shown], values[shown])


def limits_of(data: Curves, models: Mapping[str, Curves], rare: float = 0.0) -> list[Limits]:
    together = np.concatenate([curves.y for curves in models.values()])
    return [frame_limits(*pair, rare=rare) for pair in zip(data.y.T, together.T, strict=True)]


def find_diverged(rollouts: Mapping[str, Rollout], duration_s: float) -> set[str]:
    """Names of the runs that stop before the end of the shown time."""
    return {name for name, r in rollouts.items() if r.diverged and r.lasted_s <= duration_s}


def run_labels(rollouts: Mapping[str, Rollout], statuses: Mapping[str, str]) -> dict[str, str]:
    """Row labels: the name, and below it the status if it is known.

    statuses: by name; for a diverged run the label gives the time since its start instead.
    """
    found = {}
    for name, rollout in rollouts.items():
        status = when_it_diverges(rollout) if rollout.diverged else statuses.get(name)
        found[name] = f"{name}\n({status})" if status else name
    return found


def when_it_diverges(rollout: Rollout) -> str:
    """`diverges at 182 µs`; the time is counted from the run's start."""
    return f"diverges at {rollout.lasted_text or 'once'}"


def phase_figure(
    run: Trajectory,
    rollouts: Mapping[str, Rollout],
    *,
    duration_s: float,
    statuses: Mapping[str, str] = MappingProxyType({}),
) -> Figure:
    """A panel per model in the plane of the first two states: its run (colour) over data (grey).

    The dot marks the start; other marks and statuses are as in `trajectory_figure`.
    """
    data = first_part(run.t, run.states[:, :2], duration_s, run.clock)
    models = {
        n: first_part(r.t, r.states[:, :2], duration_s, run.clock) for n, r in rollouts.items()
    }
    diverged, labels = find_diverged(rollouts, duration_s), run_labels(rollouts, statuses)
    x_label, y_label = (axis_label(name, run.units[name]) for name in run.state_names[:2])
    figure, axes = make_grid(
        len(models), width=2.75, height=2.75, extra=0.7, sharex=True, sharey=True, x_label=x_label
    )
    limits = dict(enumerate(limits_of(data, models)))
    for ax, colour, (name, curves) in zip(axes, cycle(MORE_COLOURS), models.items(), strict=False):
        ax.plot(*data.y.T, color=GREY, lw=1.4, label="data")
        ax.plot(*curves.y.T, color=colour, lw=1.1)
        ax.plot(*curves.y[:1].T, "o", color=colour, ms=4)
        ax.set_title(labels[name], fontsize=TITLE, pad=13.0)  # above the ordinate's factor
        mark_exits(
            ax, *curves.y.T, colour=colour, limits=(limits[0], limits[1]),
            diverged=name in diverged,
        )  # fmt: skip
    axes[0].set(xlim=limits[0], ylim=limits[1])
    for ax in axes:
        place = ax.get_subplotspec()
        if place is not None and place.is_first_col():
            ax.set_ylabel(y_label)
            # All panels share the first one's factor.
            ax.yaxis.get_offset_text().set_visible(place.is_first_row())
    legend_curves(figure, axes)
    return figure


HISTORY = 0.5  # of the horizon, shown before the start
FLOOR = 1e-3  # lowest error drawn, in standard deviations


def forecast_figure(run: Trajectory, skill: ForecastSkill) -> Figure:
    """The first forecast with its band over the samples, and the errors of all, by horizon.

    run: the record that was forecast; its variables of the model's states are drawn.
    """
    ahead = skill.example
    noise = dict(zip(ahead.state_names, ahead.noise_std, strict=True))  # NaN if not measured
    names = [name for name in ahead.state_names if name in run.names and np.isfinite(noise[name])]
    width = 4.5 if len(names) == 1 else 3.0
    figure, axes = make_grid(len(names) + 1, width=width, height=2.8, extra=0.4)
    low, high = ahead.band(LEVEL)
    begin = run.t[max(0, int(np.searchsorted(run.t, ahead.t[0] - 1e-9 * run.dt_s)) - 1)]
    factor, unit = run.clock.scale(float(ahead.t[-1] - begin))
    shown = (run.t >= begin - HISTORY * (ahead.t[-1] - begin)) & (run.t <= ahead.t[-1])
    for ax, name in zip(axes, names, strict=False):
        k = ahead.state_names.index(name)
        since = factor * (run.t[shown] - begin)
        values = run.columns([name])[shown, 0]
        ax.plot(since, values, ".", ms=3, color=DATA, label="samples")
        later = factor * (ahead.t - begin)
        ax.fill_between(
            later, low[:, k], high[:, k], color=COLOURS[0], alpha=0.25, lw=0,
            label=f"band of {100.0 * LEVEL:.0f} %",
        )  # fmt: skip
        ax.plot(later, ahead.states[:, k], color=COLOURS[0], lw=1.2, label="forecast")
        ax.axvline(0.0, color=GREY, lw=0.8, ls="--")
        ax.set_xlabel(f"time since the start ({unit})")
        ax.set_ylabel(axis_label(name, run.units[name]))
        ax.set_ylim(_limits(values))
    _draw_errors(axes[-1], skill)
    baselines = axes[-1].lines[1 : len(skill.nrmse)]  # the first line is the model's
    handles = [*axes[0].get_legend_handles_labels()[0], *baselines]
    legend_above(figure, handles)
    return figure


def _draw_errors(ax: Axes, skill: ForecastSkill) -> None:
    in_periods = np.isfinite(skill.period_s)
    unit_s = skill.period_s if in_periods else float(skill.horizons_s[0])
    colours = dict(zip(("persistence", "harmonics", "autoregression"), COLOURS[1:], strict=False))
    for name, values in skill.nrmse.items():
        ax.plot(
            skill.horizons_s / unit_s, np.maximum(values, FLOOR), label=name,
            color=COLOURS[0] if name == MODEL else colours[name], lw=1.8 if name == MODEL else 1.0,
        )  # fmt: skip
    ax.axhline(1.0, color=GREY, lw=0.8, ls="--")
    ax.set_yscale("log")
    ax.set_xlabel(f"horizon ({'periods' if in_periods else 'samples'})")
    ax.set_ylabel("error (standard deviations)")


def _limits(values: Float[np.ndarray, " samples"]) -> tuple[float, float]:
    room = 0.25 * float(np.ptp(values))
    return float(values.min()) - room, float(values.max()) + room
