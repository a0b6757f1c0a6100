"""Figures: values in, a matplotlib Figure out. Nothing is written or shown here."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ep2sindy.model import Rollout, SparseModel
from ep2sindy.names import latex_derivative, latex_name, latex_term_name
from ep2sindy.pareto import ParetoFront
from ep2sindy.selection import selected
from ep2sindy.smoothing import Smoother
from ep2sindy.spectrum import dominant_frequency, frequency_text, power_spectrum
from ep2sindy.trajectory import Trajectory
from ep2sindy.units import prefixed, unit_product

DATA = "#222222"
# Okabe & Ito 2008: told apart with any colour vision, and in print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


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


def front_figure(
    fronts: Mapping[str, ParetoFront],
    scores: Mapping[str, Float[np.ndarray, " candidates"]],
    *,
    label: str,
) -> Figure:
    """Error against number of terms for every equation, the selected candidate marked.

    scores: by state, one per candidate, the lowest selected; label: what they are called.
    """
    figure = Figure(figsize=(4.4 * len(fronts), 3.4), layout="constrained")
    axes = figure.subplots(1, len(fronts), squeeze=False)[0]
    for ax, (state, front) in zip(axes, fronts.items(), strict=True):
        _front(ax, front)
        chosen = selected(front, scores[state])
        index = front.candidates.index(chosen)
        ax.plot(
            front.sizes[index],
            front.errors[index],
            "*",
            ms=15,
            color=COLOURS[1],
            label=f"selected, {_score_label(label)} = {scores[state][index]:.4g}",
        )
        terms = ", ".join(f"${latex_term_name(name)}$" for name in chosen.terms)
        ax.set_title(f"${latex_derivative(state)}$: {terms or '0'}", fontsize=9)
        ax.legend(frameon=False, fontsize=8)
    return figure


def _front(ax: Axes, front: ParetoFront) -> None:
    """The best of every size as a line, runners-up as small dots."""
    best = front.leading
    ax.plot(
        front.sizes[best], front.errors[best], "o-", c=COLOURS[0], ms=5, lw=1, label="best of size"
    )
    if not best.all():
        others = front.sizes[~best], front.errors[~best]
        ax.plot(*others, ".", color="#999999", ms=4, zorder=1, label="runners-up")
    rows = "held-out" if front.problem.test.any() else "training"
    ax.set_xlabel("number of terms")
    ax.set_ylabel(f"error, $1 - R^2$ ({rows} rows)")
    ax.set_xticks(front.sizes[best].astype(int))
    ax.set_ylim(0.0, 1.05 * max(1.0, min(front.errors[best].max(), 1.5)))


def _score_label(label: str) -> str:
    """`d_pareto` as a symbol with an index; `AICc` as it is."""
    stem, _, index = label.partition("_")
    return rf"${stem}_\mathrm{{{index}}}$" if index else label


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
    _legend_above(figure, axes[0])
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
    _legend_above(figure, axes[0])
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


def framing(values: Float[np.ndarray, " samples"]) -> tuple[float, float]:
    """Limits of twice the data's range: a model that runs away must not shrink the rest."""
    low, high = float(values.min()), float(values.max())
    margin = 0.5 * (high - low)
    return (max(0.0, low - margin) if low >= 0.0 else low - margin), high + margin


def _legend_above(figure: Figure, ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)


def axis_label(name: str, unit: str) -> str:
    return f"${latex_name(name)}$ ({unit_text(unit)})"


def unit_text(unit: str) -> str:
    """`m^-3 s^-1` as mathtext."""
    return re.sub(r"\^(-?[\d.]+)", r"$^{\1}$", unit)
