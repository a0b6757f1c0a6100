"""Known systems beside what was identified of them: attractors and trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.curves import when_it_diverges
from ep2sindy.figures.frames import Limits, framing, legend_marks, mark_exits
from ep2sindy.figures.identified import SYSTEM_LABELS
from ep2sindy.figures.style import COLOURS, DATA, GREY, legend_above
from ep2sindy.library.equations import latex_name
from ep2sindy.model.rollout import Rollout

IDENTIFIED = COLOURS[1]

MOST_DOTS = 1500  # of the samples in a panel


@dataclass(frozen=True, eq=False)
class Identified:
    """One realization of a known system, and the model that was found in it.

    samples: with noise, of which it was found. truth: without, of all states. rollout: of the
    model from where the truth starts. right: whether its terms are the true ones.
    """

    system: str
    noise: float
    samples: Trajectory
    truth: Trajectory
    rollout: Rollout
    right: bool


def attractor_figure(found: Sequence[Identified], *, over_time: bool = False) -> Figure:
    """A column per system, a row per noise level: samples, truth and identified model.

    In the plane of the first and the last state, or over_time, the first state alone. Carets mark
    where a model leaves the panel, a cross where one that diverged stops inside it.
    """
    systems = list(dict.fromkeys(each.system for each in found))
    noises = sorted({each.noise for each in found})
    width, height = (3.4, 1.7) if over_time else (2.6, 2.5)
    size = (width * len(systems) + 0.6, height * len(noises) + 0.9)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(noises), len(systems), squeeze=False, sharex="col", sharey="col")
    limits = {
        system: _limits([each for each in found if each.system == system], over_time)
        for system in systems
    }
    for each in found:
        ax = axes[noises.index(each.noise), systems.index(each.system)]
        _draw(ax, each, limits[each.system], over_time=over_time)
        first, last = each.samples.state_names[0], each.samples.state_names[-1]
        across, up = ("time (s)", first) if over_time else (f"${latex_name(first)}$", last)
        ax.set_ylabel(f"${latex_name(up)}$", labelpad=1)
        if each.noise == noises[-1]:
            ax.set_xlabel(across)
    for ax, system in zip(axes[0], systems, strict=True):
        ax.set_title(f"{SYSTEM_LABELS.get(system, system)}\n{ax.get_title()}", fontsize=9)
    for ax, noise in zip(axes[:, 0], noises, strict=True):
        ax.set_ylabel(f"noise {100 * noise:g} %\n\n{ax.get_ylabel()}")
    legend_above(figure, [*axes[0, 0].lines[:3], *legend_marks(axes.flat)], size=9.0)
    return figure


def _limits(found: Sequence[Identified], over_time: bool) -> tuple[Limits, Limits]:
    """Of all samples of one system, whatever the models do."""
    pairs = [_coordinates(each.samples.t, each.samples.states, over_time) for each in found]
    x, y = (framing(np.concatenate(column), np.empty(0)) for column in zip(*pairs, strict=True))
    return x, y


def _draw(ax: Axes, each: Identified, limits: tuple[Limits, Limits], *, over_time: bool) -> None:
    """Samples as dots, the truth as a line, the model as one that both show beneath."""
    x, y = _coordinates(each.samples.t, each.samples.states, over_time)
    step = -(-len(x) // MOST_DOTS)
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
    ax.set_title(verdict, fontsize=8, color=DATA if each.right else IDENTIFIED)
    ax.tick_params(labelsize=8)


def _coordinates(
    t: Float[np.ndarray, " samples"], states: Float[np.ndarray, "samples n_states"], over_time: bool
) -> tuple[Float[np.ndarray, " samples"], Float[np.ndarray, " samples"]]:
    return (t, states[:, 0]) if over_time else (states[:, 0], states[:, -1])
