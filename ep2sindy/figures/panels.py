"""Panels of maps: cells by colour over z and r; over one axis, points on an ordinate."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure

from ep2sindy.data.fields import SPACE, cell_edges
from ep2sindy.figures.style import DATA
from ep2sindy.thruster.parameters import Thruster

CM = 100.0  # per m

PANEL_WIDTH = 1.9  # inches

# Neither has a shade near white, which is a cell without a value.
SHARES = colormaps["viridis"]

COUNTS = ListedColormap(colormaps["Purples"](np.linspace(0.35, 1.0, 256)))


def space_axes(array: xr.DataArray | xr.Dataset) -> list[str]:
    return [axis for axis in SPACE if axis in array.dims]


def map_figure(
    array: xr.DataArray, shape: tuple[int, int], *, scale: float = 1.0, extra: float
) -> Figure:
    """A canvas whose panels come out at the field's own proportions; extra: inches around them."""
    n_rows, n_columns = shape
    spans = [float(np.ptp(_edges(array, axis))) for axis in space_axes(array)]
    width = scale * PANEL_WIDTH
    height = width * min(max(spans[1] / spans[0], 0.25), 2.0) if len(spans) == 2 else 1.3
    return Figure(
        figsize=(max(n_columns * (width + 0.35) + 0.8, 5.5), n_rows * (height + 0.45) + extra),
        layout="constrained",
    )


def _edges(array: xr.DataArray, axis: str) -> Float[np.ndarray, " edges"]:
    """Edges of the cells in m; a single point gets a millimetre to either side."""
    points = array[axis].values.astype(np.float64)
    return cell_edges(points) if len(points) > 1 else points[0] + np.array([-1e-3, 1e-3])


def draw_map(
    ax: Axes,
    values: xr.DataArray,
    colours: Colormap,
    norm: Normalize,
    *,
    opacity: xr.DataArray | None = None,
) -> None:
    """Cells by colour; over one axis, a strip. opacity: 0 to 1, of the same cells; NaN is 1."""
    space = space_axes(values)
    z = CM * _edges(values, space[0])
    if len(space) == 1:
        ax.pcolormesh(z, [0.0, 1.0], values.values[None], cmap=colours, norm=norm)
        ax.set_yticks([])
        return
    r = CM * _edges(values, "r")
    mesh = ax.pcolormesh(z, r, values.transpose("r", "z").values, cmap=colours, norm=norm)
    if opacity is not None:
        mesh.set(alpha=opacity.fillna(1.0).transpose("r", "z").values)
    ax.set_aspect("equal")


def draw_values(
    figure: Figure, ax: Axes, values: xr.DataArray, colours: Colormap, norm: Normalize
) -> None:
    """A map with its colour bar; over one axis, points on an ordinate."""
    space = space_axes(values)
    if len(space) == 1:
        ax.plot(CM * values[space[0]].values, values.values, ".", color=DATA, ms=4)
        low, high = norm.vmin or 0.0, norm.vmax or 0.0
        ax.set_ylim(low - 0.05 * (high - low), high + 0.05 * (high - low))
        if isinstance(norm, BoundaryNorm):
            ax.set_yticks(_middles(norm))
        return
    draw_map(ax, values, colours, norm)
    bar = figure.colorbar(ScalarMappable(norm, colours), ax=ax, shrink=0.7, aspect=12, pad=0.02)
    if isinstance(norm, BoundaryNorm):
        bar.set_ticks(_middles(norm))
    bar.ax.tick_params(labelsize=7)


def _middles(norm: BoundaryNorm) -> list[float]:
    return list(np.add(norm.boundaries[1:], norm.boundaries[:-1]) / 2)


def finish_panels(axes: np.ndarray, array: xr.DataArray, outline: Thruster | None) -> None:
    """Labels at the rim, the channel, and one axis alone from end to end of its cells."""
    space = space_axes(array)
    for ax in axes.flat:
        ax.tick_params(labelsize=8)
        if len(space) == 1:
            ax.set_xlim(*CM * _edges(array, space[0])[[0, -1]])
        if outline is not None:
            _outline(ax, space, outline)
    for ax in axes[-1]:
        ax.tick_params(labelbottom=True)
        ax.set_xlabel(f"{space[0]} (cm)", fontsize=9)
    if len(space) == 2:
        for ax in axes[:, 0]:
            ax.set_ylabel("r (cm)", fontsize=9)


def _outline(ax: Axes, space: Sequence[str], thruster: Thruster) -> None:
    """Walls, anode and front face as one line, the exit plane dashed; the limits stay."""
    length, inner, outer = (
        CM * x for x in (thruster.channel_length, thruster.inner_radius, thruster.outer_radius)
    )
    limits = ax.get_xlim(), ax.get_ylim()
    if len(space) == 1:
        for place in [length] if space == ["z"] else [inner, outer]:
            ax.axvline(place, color=DATA, lw=0.8, ls="--")
    else:
        ax.plot([length, length], [inner, outer], color=DATA, lw=0.8, ls="--")
        bottom, top = limits[1]
        ax.plot(
            [length, length, 0.0, 0.0, length, length],
            [min(bottom, inner), inner, inner, outer, outer, max(top, outer)],
            color=DATA,
            lw=1.2,
        )
    ax.set(xlim=limits[0], ylim=limits[1])
