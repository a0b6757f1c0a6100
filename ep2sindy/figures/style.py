"""Colours, labels and frames that all figures share."""

from __future__ import annotations

import re
from collections.abc import Sequence

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ep2sindy.library.equations import latex_derivative, latex_name

DATA, GREY = "#222222", "#aaaaaa"

# Okabe & Ito 2008: told apart with any colour vision, and in print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")

# For panels of their own, whose colours need not be told apart from all others.
MORE_COLOURS = (*COLOURS, "#7F3C8D", "#666666")


def panel_grid(
    n: int, *, width: float, height: float, extra: float, shared: bool = False, most: int = 4
) -> tuple[Figure, Sequence[Axes]]:
    """A canvas of n panels of this size in inches, at most so many in a row, none empty.

    extra: height around them. shared: whether they share both axes.
    """
    n_rows = -(-n // most)
    n_columns = -(-n // n_rows)
    figure = Figure(figsize=(width * n_columns, height * n_rows + extra), layout="constrained")
    axes = figure.subplots(n_rows, n_columns, squeeze=False, sharex=shared, sharey=shared).flat
    for ax in axes[n:]:
        ax.remove()
    return figure, list(axes[:n])


def legend_above(
    figure: Figure,
    handles: Sequence[Artist],
    *,
    n_columns: int | None = None,
    size: float | None = None,
) -> None:
    """A legend of the labelled artists over all panels, by default in one line."""
    figure.legend(
        handles=handles,
        loc="outside upper center",
        ncols=n_columns or len(handles),
        frameon=False,
        fontsize=size,
    )


def hover(artist: Artist, text: str) -> None:
    """Let an artist say more where a page is read with a mouse; a bar parts the lines."""
    artist.set_gid(f"hover: {text}")


def axis_label(name: str, unit: str) -> str:
    return f"${latex_name(name)}$ ({unit_text(unit)})"


def equals_label(label: str, value: float) -> str:
    """`$V_D$ (V)` at 300 -> `$V_D$ = 300 V`."""
    symbol, _, unit = label.removesuffix(")").rpartition(" (")
    return f"{symbol} = {value:g} {unit}" if symbol else f"{label} = {value:g}"


def slope_label(name: str, unit: str) -> str:
    """Of the derivative in time, in its unit."""
    return f"${latex_derivative(name)}$ ({unit_text(unit)})"


def unit_text(unit: str) -> str:
    """`m^-3 s^-1` as mathtext."""
    return re.sub(r"\^(-?[\d.]+)", r"$^{\1}$", unit)
