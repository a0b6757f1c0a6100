"""Figures of several models of one trajectory, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.style import DATA, GREY, MORE_COLOURS, axis_label, framing, unit_text
from ep2sindy.library.equations import latex_derivative
from ep2sindy.library.units import prefixed, unit_product
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import Rollout
from ep2sindy.signals.smoothers import Smoother
from ep2sindy.signals.spectrum import dominant_frequency, frequency_text, power_spectrum


@dataclass(frozen=True, eq=False)
class _Curves:
    """One curve per state over a shared abscissa."""

    x: Float[np.ndarray, " points"]
    y: Float[np.ndarray, "points n_states"]

    def up_to(self, x_max: float, *, x_min: float = -np.inf) -> _Curves:
        inside = (self.x >= x_min) & (self.x <= x_max)
        return _Curves(self.x[inside], self.y[inside])


def settings_figures(
    run: Trajectory,
    rollouts: Mapping[str, Rollout],
    *,
    duration_s: float,
    f_max_Hz: float | None,
) -> dict[str, Figure]:
    """Trajectories, spectra and, of two states or more, phase portraits.

    f_max_Hz: None goes as far as the samples can tell.
    """
    figures = {
        "trajectories": settings_trajectory_figure(run, rollouts, duration_s=duration_s),
        "spectra": settings_spectrum_figure(run, rollouts, f_max_Hz=f_max_Hz or 0.5 / run.dt_s),
    }
    if len(run.state_names) > 1:
        figures["phase"] = settings_phase_figure(
            run, rollouts, plane=run.state_names[:2], duration_s=duration_s
        )
    return figures


def settings_trajectory_figure(
    run: Trajectory, rollouts: Mapping[str, Rollout], *, duration_s: float
) -> Figure:
    """A row per model: its run from the first sample (colour) over the data (grey)."""
    per_s, second = prefixed(duration_s)
    data = _since_start(run.t, run.states, run.t[0], per_s).up_to(per_s * duration_s)
    models = {
        _ending(name, r): _since_start(r.t, r.states, run.t[0], per_s).up_to(per_s * duration_s)
        for name, r in rollouts.items()
    }
    figure, axes = _rows(data, models)
    _framed(axes, data.y)
    _labelled(
        axes,
        [axis_label(name, run.units[name]) for name in run.state_names],
        f"time since start of integration ({second}s)",
    )
    return figure


def settings_derivative_figure(
    run: Trajectory, models: Mapping[str, SparseModel], *, smoother: Smoother, duration_s: float
) -> Figure:
    """A row per model: its right-hand side on the data (colour), the data's derivative (grey)."""
    per_s, second = prefixed(duration_s)
    slope = smoother.derivative(run.t, run.states)
    data = _since_start(run.t, slope, run.t[0], per_s).up_to(per_s * duration_s)
    right = {
        name: _since_start(
            run.t,
            m.derivative(run.columns(m.states), run.columns(m.inputs)),
            run.t[0],
            per_s,
        ).up_to(per_s * duration_s)
        for name, m in models.items()
    }
    figure, axes = _rows(data, right)
    _framed(axes, data.y)
    units = [unit_product([(run.units[name], 1), ("s", -1)]) for name in run.state_names]
    _labelled(
        axes,
        [
            f"${latex_derivative(name)}$ ({unit_text(unit)})"
            for name, unit in zip(run.state_names, units, strict=True)
        ],
        f"time ({second}s)",
    )
    return figure


def settings_spectrum_figure(
    run: Trajectory, rollouts: Mapping[str, Rollout], *, f_max_Hz: float
) -> Figure:
    """A row per model: power spectra of its run (colour) and of the data as long (grey).

    The dashed line marks the data's dominant frequency; a row says its model's.
    """
    per_Hz, hertz = prefixed(f_max_Hz)
    n_samples = max((len(r.t) for r in rollouts.values()), default=run.n_samples)
    data = _spectra(run.t[:n_samples], run.states[:n_samples], f_max_Hz, per_Hz)
    models = {
        _ending(name, r): _spectra(r.t, r.states, f_max_Hz, per_Hz) for name, r in rollouts.items()
    }
    figure, axes = _rows(data, models)
    for row, rollout in zip(axes, rollouts.values(), strict=True):
        for k, ax in enumerate(row):
            peak = dominant_frequency(run.t, run.states[:, k])
            ax.axvline(per_Hz * peak, color=DATA, lw=0.8, ls="--")
            ax.set_yscale("log")
            power = data.y[:, k]
            ax.set_ylim(0.3 * np.percentile(power, 2), 10.0 * power.max())
            if not rollout.diverged:
                text = frequency_text(dominant_frequency(rollout.t, rollout.states[:, k]))
                ax.text(0.98, 0.82, text, transform=ax.transAxes, ha="right", fontsize=8)
    units = [unit_product([(run.units[name], 2), ("Hz", -1)]) for name in run.state_names]
    _labelled(
        axes,
        [
            f"power of {axis_label(name, unit)}"
            for name, unit in zip(run.state_names, units, strict=True)
        ],
        f"frequency ({hertz}Hz)",
    )
    return figure


def settings_phase_figure(
    run: Trajectory, rollouts: Mapping[str, Rollout], *, plane: Sequence[str], duration_s: float
) -> Figure:
    """A panel per model in the plane of two states: its run (colour) over the data (grey)."""
    x, y = (run.state_names.index(name) for name in plane)
    n_columns = min(4, len(rollouts))
    n_rows = -(-len(rollouts) // n_columns)
    figure = Figure(figsize=(2.6 * n_columns + 0.6, 2.6 * n_rows + 0.4), layout="constrained")
    axes = figure.subplots(n_rows, n_columns, squeeze=False, sharex=True, sharey=True)
    shown = run.states[run.t <= run.t[0] + duration_s]
    for ax, colour, (name, rollout) in zip(
        axes.flat, MORE_COLOURS * n_rows, rollouts.items(), strict=False
    ):
        ax.plot(shown[:, x], shown[:, y], color=GREY, lw=0.9)
        states = rollout.states[rollout.t <= run.t[0] + duration_s]
        ax.plot(states[:, x], states[:, y], color=colour, lw=1.1)
        ax.plot(states[:1, x], states[:1, y], "o", color=colour, ms=4)
        ax.set_title(_ending(name, rollout), fontsize=9)
    axes[0, 0].set_xlim(framing(shown[:, x]))
    axes[0, 0].set_ylim(framing(shown[:, y]))
    for k in range(len(rollouts), axes.size):
        axes.flat[k].remove()
        axes.flat[k - n_columns].tick_params(labelbottom=True)
    figure.supxlabel(axis_label(plane[0], run.units[plane[0]]), fontsize=10)
    figure.supylabel(axis_label(plane[1], run.units[plane[1]]), fontsize=10)
    return figure


def _rows(data: _Curves, models: Mapping[str, _Curves]) -> tuple[Figure, np.ndarray]:
    """A row per model, a column per state; the data in grey behind."""
    n = data.y.shape[1]
    figure = Figure(figsize=(10.0, 1.05 * len(models) + 0.9), layout="constrained")
    axes = figure.subplots(len(models), n, squeeze=False, sharex=True, sharey="col")
    colours = MORE_COLOURS * len(models)
    for row, colour, (name, curves) in zip(axes, colours, models.items(), strict=False):
        for k, ax in enumerate(row):
            ax.plot(data.x, data.y[:, k], color=GREY, lw=1.4)
            ax.plot(curves.x, curves.y[:, k], color=colour, lw=1.1)
            ax.tick_params(labelsize=8)
        row[0].set_ylabel(
            name.replace(", ", ",\n"), rotation=0, ha="right", va="center", fontsize=9
        )
    for ax in axes.flat:
        ax.yaxis.get_offset_text().set(size=8)
    for ax in axes[1:].flat:  # columns share their axis, so the first row's factor is everyone's
        ax.yaxis.get_offset_text().set_visible(False)
    return figure, axes


def _framed(axes: np.ndarray, data: Float[np.ndarray, "samples n_states"]) -> None:
    for ax, values in zip(axes[0], data.T, strict=True):
        ax.set_ylim(framing(values))


def _labelled(axes: np.ndarray, titles: Sequence[str], x_label: str) -> None:
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=10)
    for ax in axes[-1]:
        ax.set_xlabel(x_label)


def _since_start(
    t: Float[np.ndarray, " samples"],
    values: Float[np.ndarray, "samples n_states"],
    start_s: float,
    per_s: float,
) -> _Curves:
    return _Curves(per_s * (t - start_s), values)


def _spectra(
    t: Float[np.ndarray, " samples"],
    states: Float[np.ndarray, "samples n_states"],
    f_max_Hz: float,
    per_Hz: float,
) -> _Curves:
    """Power of every state; none for a run that stopped at once."""
    if len(t) < 8:
        return _Curves(np.empty(0), np.empty((0, states.shape[1])))
    pairs = [power_spectrum(t, column) for column in states.T]
    frequency = per_Hz * pairs[0][0]
    power = np.stack([power for _, power in pairs], axis=1)
    tiny = np.finfo(float).tiny
    return _Curves(frequency, np.maximum(power, tiny)).up_to(per_Hz * f_max_Hz, x_min=tiny)


def _ending(name: str, rollout: Rollout) -> str:
    return f"{name} (diverged)" if rollout.diverged else name
