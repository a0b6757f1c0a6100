"""Figures of forecasts: one with its band over the data, and errors by horizon beside baselines."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.style import COLOURS, DATA, GREY, axis_label, legend_above, make_grid
from ep2sindy.forecasting.bands import LEVEL
from ep2sindy.forecasting.skill import MODEL, ForecastSkill

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
