"""Figures of the weak form: many settings side by side, window errors, frontiers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ep2sindy.model import Rollout, SparseModel
from ep2sindy.names import latex_derivative
from ep2sindy.plots import COLOURS, DATA, axis_label, framing, unit_text
from ep2sindy.smoothing import Smoother
from ep2sindy.spectrum import dominant_frequency, frequency_text, power_spectrum
from ep2sindy.trajectory import Trajectory
from ep2sindy.units import prefixed, unit_product

GREY = "#aaaaaa"
# Every model has a panel of its own, so these need not be told apart from all others.
MORE_COLOURS = (*COLOURS, "#7F3C8D", "#666666")


@dataclass(frozen=True, eq=False)
class _Curves:
    """One curve per state over a shared abscissa."""

    x: Float[np.ndarray, " points"]
    y: Float[np.ndarray, "points n_states"]

    def up_to(self, x_max: float, *, x_min: float = -np.inf) -> _Curves:
        inside = (self.x >= x_min) & (self.x <= x_max)
        return _Curves(self.x[inside], self.y[inside])


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


def window_error_figure(cells: pd.DataFrame, *, references: Sequence[str]) -> Figure:
    """Coefficient error against noise: a panel per window length, a line per number of windows.

    cells: as `studies.weak_windows.window_cells` gives them. references: settings without
    windows to choose, drawn in every panel.
    """
    # Without noise the errors are those of the integrals, decades below: the table has them.
    noisy = cells[cells["noise"] > 0.0]
    shown = noisy if len(noisy) else cells
    lengths = cells["n_points"].dropna().unique()
    figure = Figure(figsize=(2.9 * len(lengths) + 0.4, 3.6), layout="constrained")
    axes = figure.subplots(1, len(lengths), squeeze=False, sharex=True, sharey=True)[0]
    for ax, n_points in zip(axes, lengths, strict=True):
        for style, name in zip(("--", "-", ":"), references, strict=False):
            label = name.replace("_", ", ")
            _error_line(ax, shown[shown["setting"] == name], label=label, color=DATA, ls=style)
        panel = shown[shown["n_points"] == n_points]
        for colour, n_windows in zip(COLOURS, panel["n_windows"].unique(), strict=False):
            one = panel[panel["n_windows"] == n_windows]
            _error_line(ax, one, label=f"{n_windows} windows", color=colour, marker="o", ms=3.5)
        ax.set_title(f"{n_points} points per window", fontsize=10)
        ax.set_xlabel("noise (% of RMS)")
        ax.grid(which="major", alpha=0.3)
    axes[0].set_yscale("log")
    if len(noisy):
        axes[0].set_xscale("log")
    levels = 100.0 * np.unique(shown["noise"])
    axes[0].set_xticks(levels, [f"{level:g}" for level in levels])
    axes[0].set_xticks([], minor=True)
    axes[0].set_ylabel(r"coefficient error $\|\beta - \beta_{true}\| / \|\beta_{true}\|$")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)
    return figure


def _error_line(ax: Axes, cells: pd.DataFrame, *, label: str, **style: Any) -> None:
    ordered = cells.sort_values("noise")
    ax.plot(100.0 * ordered["noise"], ordered["error_mean"], label=label, lw=1.2, **style)


def frontier_figure(points: pd.DataFrame) -> Figure:
    """A panel per variant: sampling rate against duration, filled where it found the system.

    points: as `studies.frontier.identification_frontier` gives them.
    """
    variants = list(points["variant"].unique())
    figure = Figure(figsize=(2.6 * len(variants) + 0.4, 3.5), layout="constrained")
    axes = figure.subplots(1, len(variants), squeeze=False, sharex=True, sharey=True)[0]
    for ax, variant in zip(axes, variants, strict=True):
        for (found, ran), marker in _MARKERS.items():
            kind = (points["identified"] == found) & ((points["reason"] == "") == ran)
            one = points[kind & (points["variant"] == variant)]
            ax.plot(one["duration_s"], one["rate_Hz"], **marker)
        ax.set_title(variant, fontsize=10)
        ax.set_xlabel("duration (s)")
    axes[0].set_xscale("log")
    axes[0].set_yscale("log")
    axes[0].set_ylabel("sampling rate (Hz)")
    handles = [Line2D([], [], **marker) for marker in _MARKERS.values()]
    figure.legend(handles=handles, loc="outside upper center", ncols=len(handles), frameon=False)
    return figure


# (identified, ran) -> marker: told apart by shape and filling, not by colour alone.
_MARKERS: Mapping[tuple[bool, bool], Mapping[str, Any]] = {
    (True, True): {"ls": "", "marker": "o", "color": COLOURS[2], "label": "identified"},
    (False, True): {
        "ls": "", "marker": "o", "color": COLOURS[1], "mfc": "none", "label": "not identified",
    },
    (False, False): {
        "ls": "", "marker": "x", "color": GREY, "ms": 4, "label": "too few samples to run",
    },
}  # fmt: skip


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
