"""Elements shared by all figures: colours, labels and frames.

A frame sets the range of a panel whose curves may leave it.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import ScalarFormatter

from ep2sindy.library.equations import latex_name

DATA, GREY = "#222222", "#aaaaaa"

# Okabe & Ito 2008: distinct with any colour vision, and in print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")

# For separate panels, whose colours need not differ from all others.
MORE_COLOURS = (*COLOURS, "#7F3C8D", "#666666")

# One width in inches, of 96 px on a page, and two sizes of type in points: ticks, marks in panels
# and legends are small; titles are as large as the labels of axes.
WIDTH, TITLE, SMALL = 9.0, 10.0, 9.0

Limits = tuple[float, float]

Curve = tuple[Float[np.ndarray, " _"], Float[np.ndarray, " _"]]  # abscissa, ordinate

Sharing = bool | Literal["row", "col"]

SIGN = "#555555"  # colour of legend marks, which stand for marks of any colour

N_LINE = 60  # points on the line of a law


def make_panels(
    n_rows: int,
    n_columns: int,
    size: tuple[float, float],
    *,
    sharex: Sharing = False,
    sharey: Sharing = False,
    widths: Sequence[int | float] | None = None,
    heights: Sequence[int | float] | None = None,
) -> tuple[Figure, np.ndarray]:
    """A figure of this width and height in inches, and its panels by row and column.

    sharex, sharey: as in matplotlib. widths, heights: of columns and rows, relative to each other.
    """
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(
        n_rows, n_columns, squeeze=False, sharex=sharex, sharey=sharey, width_ratios=widths,
        height_ratios=heights,
    )  # fmt: skip
    for ax in axes.flat:
        ax.tick_params(labelsize=SMALL)
        for axis in (ax.xaxis, ax.yaxis):
            # 2 with 10^5 above the axis, not 200000; and no number that is to be added.
            formatter = ScalarFormatter(useOffset=False, useMathText=True)
            formatter.set_powerlimits((-3, 4))
            axis.set_major_formatter(formatter)
            axis.get_offset_text().set_size(SMALL)
    return figure, axes


def make_row(n: int, *, width: float, height: float) -> tuple[Figure, Sequence[Axes]]:
    """A figure of n panels side by side that share both axes, each of this width in inches."""
    size = (min(WIDTH, width * n + 0.4), height)
    figure, (axes,) = make_panels(1, n, size, sharex=True, sharey=True)
    return figure, [*axes]


def name_ticks(axis: Axis, places: Iterable[float], names: Sequence[str]) -> None:
    """Name these places of an axis, and no others."""
    axis.set_ticks([*places], names, fontsize=SMALL)
    axis.set_ticks([], minor=True)


def make_grid(
    n: int,
    *,
    width: float,
    height: float,
    extra: float,
    sharex: bool = False,
    sharey: bool = False,
    x_label: str = "",
) -> tuple[Figure, Sequence[Axes]]:
    """A canvas of n panels of this size in inches, as many in a row as fit, none empty.

    extra: additional height in inches. sharex, sharey: whether the panels share these axes.
    x_label: written below the lowest panel of every column.
    """
    n_rows = -(-n // max(1, int(WIDTH / width)))
    n_columns = -(-n // n_rows)
    size = (width * n_columns, height * n_rows + extra)
    figure, grid = make_panels(n_rows, n_columns, size, sharex=sharex, sharey=sharey)
    axes = list(grid.flat[:n])
    for ax in grid.flat[n:]:
        ax.remove()
    for ax in axes[-n_columns:]:  # sharing hides the labels of a panel above a gap
        ax.tick_params(labelbottom=True)
        ax.xaxis.get_offset_text().set_visible(True)
        ax.set_xlabel(x_label)
    return figure, axes


def legend_above(figure: Figure, handles: Sequence[Artist], *, title: str = "") -> None:
    """A legend of the labelled artists over all panels, in as few lines as the figure's width has.

    A label has some twelve letters to an inch; its sign takes half an inch. Under a title every
    entry has a line.
    """
    longest = max((0.5 + 0.08 * len(str(each.get_label())) for each in handles), default=1.0)
    n_columns = 1 if title else max(1, int(figure.get_figwidth() / longest))
    n_lines = -(-len(handles) // n_columns) or 1
    figure.legend(
        handles=handles, loc="outside upper center", ncols=-(-len(handles) // n_lines) or 1,
        frameon=False, fontsize=SMALL, title=title or None, title_fontsize=SMALL,
    )  # fmt: skip


def axis_label(name: str, unit: str) -> str:
    return f"${latex_name(name)}$ ({unit_text(unit)})"


def name_label(name: str, labels: Mapping[str, str]) -> str:
    """Name of a quantity on axes and in legends: its label, or else its name as a symbol."""
    return labels.get(name, f"${latex_name(name)}$")


def held_label(held: Mapping[str, float], labels: Mapping[str, str]) -> str:
    """Parameters with their values: `$V_D$ (V)` at 300 gives `$V_D$ = 300 V`."""
    return ", ".join(_equals(name_label(name, labels), value) for name, value in held.items())


def _equals(label: str, value: float) -> str:
    symbol, _, unit = label.removesuffix(")").rpartition(" (")
    return f"{symbol} = {value:g} {unit}" if symbol else f"{label} = {value:g}"


def sample_line(
    x: pd.Series, along: str, held: Mapping[str, float], parameters: Sequence[str]
) -> tuple[Float[np.ndarray, " line"], Float[np.ndarray, "line parameters"]]:
    """Points along one parameter from its least to its largest value in x.

    Returns the values of that parameter, and the points with all parameters. held: values of the
    others.
    """
    line = np.linspace(x.min(), x.max(), N_LINE)
    columns = [line if name == along else np.full(N_LINE, held[name]) for name in parameters]
    return line, np.column_stack(columns)


def unit_text(unit: str) -> str:
    """`m^-3 s^-1` as mathtext."""
    return re.sub(r"\^(-?[\d.]+)", r"$^{\1}$", unit)


def frame_limits(
    data: Float[np.ndarray, " samples"], models: Float[np.ndarray, " values"]
) -> Limits:
    """Limits around data and models, within twice the data's range.

    A model that runs away must not shrink the rest.
    """
    low, high = float(data.min()), float(data.max())
    reach = 0.5 * (high - low)
    everything = np.concatenate([data, models[np.isfinite(models)]])
    bottom = max(low - reach, float(everything.min()))
    top = min(high + reach, float(everything.max()))
    margin = 0.05 * (top - bottom) or 0.05 * abs(top) or 1.0
    return bottom - margin, top + margin


def draw_over(ax: Axes, data: Curve, model: Curve, *, colour: str = COLOURS[0]) -> None:
    """Draw a model over data, which are grey and wider, so that both show where they agree."""
    ax.plot(*data, color=GREY, lw=2.4, label="data")
    ax.plot(*model, color=colour, lw=1.1, label="model")


def mark_sign(marker: Any, label: str, colour: str = SIGN, **style: Any) -> Line2D:
    """An entry of a legend for marks: by itself, of any colour."""
    return Line2D([], [], ls="none", marker=marker, color=colour, label=label, **style)
