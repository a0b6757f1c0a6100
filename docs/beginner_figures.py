"""Draw the figures of docs/beginners.md from what its own code finds.

python -m docs.beginner_figures     # runs the page: half a minute
"""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure

import ep2sindy as ep
from ep2sindy.figures.style import COLOURS, DATA, GREY, axis_label, legend_above, make_panels
from tests.pages import blocks

DOCS = Path(__file__).resolve().parent
SHOWN_S = 0.6e-3  # of the free runs, from their start


def front_figure(found: ep.Discovery) -> Figure:
    figure, axes = make_panels(1, len(found.fronts), (7.6, 2.6), sharey=True)
    for ax, (state, front) in zip(axes[0], found.fronts.items(), strict=True):
        sizes = [candidate.n_terms for candidate in front.candidates]
        ax.plot(sizes, [c.r2 for c in front.candidates], "o-", color=GREY, label="best of its size")
        chosen = found.chosen[state]
        ax.plot(
            chosen.n_terms, chosen.r2, "o", color=COLOURS[1], ms=9, label="selected, at the knee"
        )
        ax.set_title(f"equation for {state}'", fontsize=9)
        ax.set_xlabel("number of terms")
        ax.set_xticks(sizes)
    axes[0, 0].set_ylabel("R² of the derivative")
    legend_above(figure, axes[0, 0].lines)
    return figure


def runs_figure(
    held_out: ep.Trajectory, decaying: ep.model.Evaluation, free: ep.model.Evaluation
) -> Figure:
    figure, axes = make_panels(1, 1, (7.6, 2.6))
    ax, since = axes[0, 0], 1e3 * (held_out.t - held_out.t[0])
    n = int(SHOWN_S / held_out.dt_s)
    ax.plot(since[:n], held_out.states[:n, 0], color=DATA, lw=2.6, alpha=0.35, label="data")
    for run, colour, words in (
        (decaying, COLOURS[1], "selected by the fit of the derivative"),
        (free, COLOURS[0], "selected by free runs"),
    ):
        ax.plot(since[:n], run.rollout.states[:n, 0], color=colour, lw=1.2, label=words)
    ax.set_xlabel("time since the models' start (ms)")
    ax.set_ylabel(axis_label("n_i", "m^-3"))
    legend_above(figure, ax.lines)
    return figure


def main() -> None:
    known: dict = {}
    for block in blocks(DOCS / "beginners.md"):
        if block.language == "python":
            exec(compile(block.text, "beginners.md", "exec"), known)
    front_figure(known["found"]).savefig(DOCS / "beginners_front.png", dpi=130)
    runs = runs_figure(known["held_out"], known["decaying"], known["free"])
    runs.savefig(DOCS / "beginners_runs.png", dpi=130)


if __name__ == "__main__":
    main()
