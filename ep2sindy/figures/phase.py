"""Phase portraits: models beside the data in the plane of two states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import cycle
from types import MappingProxyType

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.curves import diverged_within, first_part, limits_of, run_labels
from ep2sindy.figures.frames import legend_marks, mark_exits
from ep2sindy.figures.style import GREY, MORE_COLOURS, axis_label, legend_above, panel_grid
from ep2sindy.model.rollout import Rollout


def phase_figure(
    run: Trajectory,
    rollouts: Mapping[str, Rollout],
    *,
    plane: Sequence[str],
    duration_s: float,
    verdicts: Mapping[str, str] = MappingProxyType({}),
) -> Figure:
    """A panel per model in the plane of two states: its run (colour) over the data (grey).

    The dot is where it starts; other marks and verdicts as in `series.trajectory_figure`.
    """
    pair = [run.state_names.index(name) for name in plane]
    data = first_part(run.t, run.states[:, pair], duration_s, run.clock)
    models = {
        n: first_part(r.t, r.states[:, pair], duration_s, run.clock) for n, r in rollouts.items()
    }
    diverged, labels = diverged_within(rollouts, duration_s), run_labels(rollouts, verdicts)
    figure, axes = panel_grid(len(models), width=2.75, height=2.75, extra=0.7, shared=True)
    limits = dict(enumerate(limits_of(data, models)))
    for ax, colour, (name, curves) in zip(axes, cycle(MORE_COLOURS), models.items(), strict=False):
        ax.plot(*data.y.T, color=GREY, lw=1.4, label="data")
        ax.plot(*curves.y.T, color=colour, lw=1.1)
        ax.plot(*curves.y[:1].T, "o", color=colour, ms=4)
        ax.set_title(labels[name], fontsize=9, pad=13.0)  # above the ordinate's factor
        mark_exits(
            ax, *curves.y.T, colour=colour, limits=(limits[0], limits[1]),
            diverged=name in diverged,
        )  # fmt: skip
    axes[0].set(xlim=limits[0], ylim=limits[1])
    _label_plane(axes, run, plane)
    legend_above(figure, [*axes[0].lines[:1], *legend_marks(axes)], size=9.0)
    return figure


def _label_plane(axes: Sequence[Axes], run: Trajectory, plane: Sequence[str]) -> None:
    """Names at the left of rows and below columns; the first panel's factor is everyone's."""
    labels = [axis_label(name, run.units[name]) for name in plane]
    for ax in axes:
        place = ax.get_subplotspec()
        assert place is not None
        n_columns = place.get_gridspec().ncols
        if place.is_first_col():
            ax.set_ylabel(labels[1])
            ax.yaxis.get_offset_text().set_visible(place.is_first_row())
        if axes.index(ax) + n_columns >= len(axes):  # none below it
            ax.tick_params(labelbottom=True)
            ax.xaxis.get_offset_text().set_visible(True)
            ax.set_xlabel(labels[0])
