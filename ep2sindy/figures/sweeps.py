"""Figures of a sweep: what its jobs found, by what they were given."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ep2sindy.figures.style import COLOURS, hover, panel_grid


def sweep_figure(
    x: Float[np.ndarray, " jobs"],
    values: Mapping[str, Float[np.ndarray, " jobs"]],
    *,
    x_label: str,
    jobs: Sequence[str],
) -> Figure:
    """A panel per headline figure: a dot per job that has it, which says under the mouse which.

    x: what the jobs were given, or their numbers. values: NaN where a job has none.
    """
    figure, axes = panel_grid(len(values), width=3.4, height=2.5, extra=0.2, most=3)
    for ax, (name, numbers) in zip(axes, values.items(), strict=True):
        there = np.isfinite(numbers)
        ax.plot(x[there], numbers[there], "o", color=COLOURS[0], ms=6)
        for k in np.flatnonzero(there).tolist():
            (spot,) = ax.plot(x[k], numbers[k], "o", ms=13, alpha=0.0)
            hover(spot, f"{jobs[k]} | {name}: {numbers[k]:.4g}")
        ax.set_title(name.replace(": ", ":\n"), fontsize=9)
        ax.set_xlabel(x_label, fontsize=9)
        ax.tick_params(labelsize=8)
        ax.xaxis.set_major_locator(MaxNLocator(5, integer=bool((x == np.round(x)).all())))
        ax.margins(x=0.08, y=0.12)
        ax.grid(axis="y", alpha=0.25)
    return figure
