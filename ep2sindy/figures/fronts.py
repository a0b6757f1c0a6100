"""Figures of Pareto fronts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ep2sindy.figures.style import COLOURS
from ep2sindy.library.equations import latex_derivative, latex_term_name
from ep2sindy.search.front import ParetoFront
from ep2sindy.selection.rule import selected


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
