"""Figures of Pareto fronts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ep2sindy.figures import style
from ep2sindy.figures.style import COLOURS, GREY, SMALL, TITLE
from ep2sindy.library.equations import latex_derivative, latex_term_name
from ep2sindy.regression.front import Candidate, Ensemble, ParetoFront

# Smaller errors are rounding or zero; they are drawn at FLOOR, on a labelled line.
FLOOR = 1e-12

TOP = 3.0  # larger errors are marked at the edge: such a model is worse than none

TERMS_A_LINE = 4  # terms per line of a title


def front_figure(fronts: Mapping[str, ParetoFront], *, label: str) -> Figure:
    """Error against number of terms for every equation, log scale, the selected candidate marked.

    After a search of trajectories, which has no rows and so no error on them, the scores are drawn
    instead.

    The supports that the search proposed are drawn light behind the front. Errors below FLOOR are
    drawn on a line at FLOOR, and errors above TOP as marks at the upper edge.
    label: name of the scores, of which the lowest is selected; without scores none is marked.
    """
    figure, axes = style.make_grid(len(fronts), width=4.4, height=3.5, extra=0.4)
    for ax, front in zip(axes, fronts.values(), strict=True):
        chosen = None if np.isnan(front.scores).all() else front.candidates.index(front.best)
        if front.has_errors:
            _draw_front(ax, front, chosen)
        else:
            _draw_scores(ax, front, chosen, label)
        ax.set_title(_title(front, label, chosen=chosen is not None), fontsize=TITLE)
    entries = {line.get_label(): line for ax in axes for line in ax.lines}
    shown = [entries[name] for name in _LAYERS if name in entries]
    style.legend_above(figure, shown)
    return figure


def _title(front: ParetoFront, label: str, *, chosen: bool) -> str:
    """The state, and the terms and the score of the selected candidate if a rule has selected."""
    state = f"${latex_derivative(front.equation)}$"
    if not chosen:
        return state
    score = f"{_score_label(label)} = {front.best.score:.4g}"
    return f"{state}: {_write_terms(front.best)}\n{score}"


# Legend entries, from the back to the front.
_LAYERS = ("all supports fitted", "runners-up", "best of size", "selected")


def _draw_front(ax: Axes, front: ParetoFront, chosen: int | None) -> None:
    """Draw all supports, runners-up, the best of every size (line) and the selected (star)."""
    lowest = front.errors.min()
    if front.ensemble is not None:
        _draw_ensemble(ax, front.ensemble)
        lowest = min(lowest, front.ensemble.errors.min(initial=np.inf))
    _draw_candidates(ax, front, np.clip(front.errors, FLOOR, TOP), chosen)
    rows = "held-out" if front.held_out else "training"
    ax.set(ylabel=f"error, $1 - R^2$ ({rows} rows)", yscale="log")
    ax.set_ylim(0.4 * max(FLOOR, float(lowest)), TOP)
    if lowest <= FLOOR:
        ax.axhline(FLOOR, color=GREY, lw=0.8, ls=":", zorder=1)
        ax.annotate(
            rf"$10^{{{np.log10(FLOOR):.0f}}}$ or less", (0.02, FLOOR), (0, 3), fontsize=SMALL,
            xycoords=("axes fraction", "data"), textcoords="offset points", color="#666666",
        )  # fmt: skip


def _draw_scores(ax: Axes, front: ParetoFront, chosen: int | None, label: str) -> None:
    """Draw the scores of runners-up, of the best of every size (line) and of the selected (star).

    The axis is linear near zero, where the best scores are. A candidate that cannot be run, such as
    an equation without terms, has no finite score and is drawn at the upper edge, at ten times the
    largest finite score.
    """
    finite = np.isfinite(front.scores)
    edge = 10.0 * max(front.scores[finite].max(initial=1.0), 1.0)
    _draw_candidates(ax, front, np.where(finite, front.scores, edge), chosen)
    ax.set(ylabel=_score_label(label))
    ax.set_yscale("symlog", linthresh=1.0)


def _draw_candidates(ax: Axes, front: ParetoFront, heights: np.ndarray, chosen: int | None) -> None:
    """Draw runners-up, the best of every size as a line, and the selected candidate as a star."""
    _, runners_up, best_of_size, star = _LAYERS
    best = front.leading
    if not best.all():
        others = front.sizes[~best], heights[~best]
        ax.plot(*others, "o", mfc="none", mec=COLOURS[0], ms=5, zorder=3, label=runners_up)
    ax.plot(
        front.sizes[best], heights[best], "o-", c=COLOURS[0], ms=5, lw=1, zorder=4,
        label=best_of_size,
    )  # fmt: skip
    if chosen is not None:
        ax.plot(
            front.sizes[chosen], heights[chosen], "*", ms=14, color=COLOURS[1], mec="white",
            mew=0.5, zorder=5, label=star,
        )  # fmt: skip
    ax.set(xlabel="number of terms")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    ax.margins(x=0.06)
    ax.grid(axis="y", alpha=0.25)


def _draw_ensemble(ax: Axes, ensemble: Ensemble) -> None:
    """Draw light dots; models far worse than none are carets at the upper edge."""
    above = ensemble.errors > TOP
    look: dict[str, Any] = {"color": GREY, "ls": "none", "zorder": 2, "alpha": 0.85, "mew": 0.0}
    ax.plot(
        ensemble.sizes[~above], np.maximum(ensemble.errors[~above], FLOOR), marker="o", ms=3.5,
        label=_LAYERS[0], **look,
    )  # fmt: skip
    if above.any():
        sizes = np.unique(ensemble.sizes[above])
        at_edge = np.full(len(sizes), TOP)
        ax.plot(sizes, at_edge, marker=6, ms=5, clip_on=False, **look)  # 6: a caret up


def _write_terms(candidate: Candidate) -> str:
    """The terms as a title, a few per line."""
    names = [f"${latex_term_name(name)}$" for name in candidate.terms]
    lines = [names[k : k + TERMS_A_LINE] for k in range(0, len(names), TERMS_A_LINE)]
    return ",\n".join(", ".join(line) for line in lines) or "0"


def _score_label(label: str) -> str:
    """A score's label: `d_pareto` as a symbol with an index; `AICc` unchanged."""
    stem, _, index = label.partition("_")
    return rf"${stem}_\mathrm{{{index}}}$" if index else label
