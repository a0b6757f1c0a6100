"""Figures of time series: data, trajectories, derivatives, phase planes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.style import COLOURS, DATA, axis_label, framing, legend_above, unit_text
from ep2sindy.library.equations import latex_derivative
from ep2sindy.library.units import prefixed, unit_product
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import Rollout
from ep2sindy.signals.smoothers import Smoother
from ep2sindy.signals.spectrum import dominant_frequency, frequency_text, power_spectrum


def data_figure(run: Trajectory, *, duration_s: float, f_max_Hz: float) -> Figure:
    """Every state over the first `duration_s`, and its power spectrum up to `f_max_Hz`."""
    n = len(run.state_names)
    figure = Figure(figsize=(9.0, 2.2 * n + 0.6), layout="constrained")
    axes = figure.subplots(n, 2, squeeze=False, sharex="col", width_ratios=[3, 2])
    shown = run.t - run.t[0] <= duration_s
    per_s, second = prefixed(duration_s)
    per_Hz, hertz = prefixed(f_max_Hz)
    for k, name in enumerate(run.state_names):
        axes[k, 0].plot(per_s * (run.t[shown] - run.t[0]), run.states[shown, k], color=DATA, lw=1)
        axes[k, 0].set_ylabel(axis_label(name, run.units[name]))
        frequency, power = power_spectrum(run.t, run.states[:, k])
        inside = (frequency > 0) & (frequency <= f_max_Hz)
        axes[k, 1].semilogy(per_Hz * frequency[inside], power[inside], color=COLOURS[0], lw=0.8)
        peak = dominant_frequency(run.t, run.states[:, k])
        label = frequency_text(peak)
        axes[k, 1].axvline(per_Hz * peak, color=COLOURS[1], lw=1, ls="--", label=label)
        axes[k, 1].legend(loc="upper right", frameon=False)
        axes[k, 1].set_ylabel(
            f"power ({unit_text(unit_product([(run.units[name], 2), ('Hz', -1)]))})"
        )
    axes[-1, 0].set_xlabel(f"time ({second}s)")
    axes[-1, 1].set_xlabel(f"frequency ({hertz}Hz)")
    return figure


def trajectory_figure(
    run: Trajectory, rollouts: Mapping[str, Rollout], *, duration_s: float
) -> Figure:
    """Models integrated from the data's first sample, over the data."""
    n = len(run.state_names)
    figure = Figure(figsize=(9.0, 2.4 * n + 0.6), layout="constrained")
    axes = figure.subplots(n, 1, squeeze=False, sharex=True)[:, 0]
    start = min((r.t[0] for r in rollouts.values() if len(r.t)), default=run.t[0])
    per_s, second = prefixed(duration_s)
    for k, (ax, name) in enumerate(zip(axes, run.state_names, strict=True)):
        shown = (run.t >= start) & (run.t <= start + duration_s)
        ax.plot(
            per_s * (run.t[shown] - start), run.states[shown, k], color=DATA, lw=1.6, label="data"
        )
        for colour, (label, rollout) in zip(COLOURS, rollouts.items(), strict=False):
            inside = rollout.t <= start + duration_s
            ending = " (diverged)" if rollout.diverged else ""
            ax.plot(
                per_s * (rollout.t[inside] - start),
                rollout.states[inside, k],
                color=colour,
                lw=1.1,
                ls=(0, (5, 1)),
                label=label + ending,
            )
        ax.set_ylim(framing(run.states[shown, k]))
        ax.set_ylabel(axis_label(name, run.units[name]))
    axes[-1].set_xlabel(f"time since start of integration ({second}s)")
    legend_above(figure, axes[0])
    return figure


def derivative_figure(
    run: Trajectory, models: Mapping[str, SparseModel], *, smoother: Smoother, duration_s: float
) -> Figure:
    """Derivative of the data, and each model's right-hand side evaluated on the data."""
    n = len(run.state_names)
    figure = Figure(figsize=(9.0, 2.4 * n + 0.6), layout="constrained")
    axes = figure.subplots(n, 1, squeeze=False, sharex=True)[:, 0]
    shown = run.t - run.t[0] <= duration_s
    per_s, second = prefixed(duration_s)
    t = per_s * (run.t[shown] - run.t[0])
    slope = smoother.derivative(run.t, run.states)
    for k, (ax, name) in enumerate(zip(axes, run.state_names, strict=True)):
        ax.plot(t, slope[shown, k], color=DATA, lw=1.6, label="data")
        for colour, (label, model) in zip(COLOURS, models.items(), strict=False):
            predicted = model.derivative(run.columns(model.states), run.columns(model.inputs))
            column = predicted[shown, model.states.index(name)]
            ax.plot(t, column, color=colour, lw=1.1, ls=(0, (5, 1)), label=label)
        slope_unit = unit_product([(run.units[name], 1), ("s", -1)])
        ax.set_ylabel(f"${latex_derivative(name)}$ ({unit_text(slope_unit)})")
    axes[-1].set_xlabel(f"time ({second}s)")
    legend_above(figure, axes[0])
    return figure


def phase_figure(
    run: Trajectory, rollouts: Mapping[str, Rollout], *, plane: Sequence[str], duration_s: float
) -> Figure:
    """Phase portrait in the plane of two states: data beside every model, on equal axes."""
    x, y = (run.state_names.index(name) for name in plane)
    figure = Figure(figsize=(3.0 * (len(rollouts) + 1), 3.2), layout="constrained")
    axes = figure.subplots(1, len(rollouts) + 1, squeeze=False, sharex=True, sharey=True)[0]
    start = min((r.t[0] for r in rollouts.values() if len(r.t)), default=run.t[0])
    shown = (run.t >= start) & (run.t <= start + duration_s)
    _orbit(axes[0], run.states[shown], x, y, DATA, "data")
    for ax, colour, (label, rollout) in zip(axes[1:], COLOURS, rollouts.items(), strict=False):
        ax.plot(run.states[shown, x], run.states[shown, y], color="#bbbbbb", lw=0.8)
        inside = rollout.t <= start + duration_s
        ending = " (diverged)" if rollout.diverged else ""
        _orbit(ax, rollout.states[inside], x, y, colour, label + ending)
    axes[0].set_xlim(framing(run.states[shown, x]))
    axes[0].set_ylim(framing(run.states[shown, y]))
    for ax in axes:
        ax.set_xlabel(axis_label(plane[0], run.units[plane[0]]))
    axes[0].set_ylabel(axis_label(plane[1], run.units[plane[1]]))
    return figure


def _orbit(
    ax: Axes, states: Float[np.ndarray, "samples states"], x: int, y: int, colour: str, label: str
) -> None:
    ax.plot(states[:, x], states[:, y], color=colour, lw=1.0)
    ax.plot(states[:1, x], states[:1, y], "o", color=colour, ms=4)
    ax.set_title(label, fontsize=10)
