"""Colours, labels and frames that all figures share."""

from __future__ import annotations

import re

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ep2sindy.library.equations import latex_name

DATA = "#222222"


# Okabe & Ito 2008: told apart with any colour vision, and in print.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")


def framing(values: Float[np.ndarray, " samples"]) -> tuple[float, float]:
    """Limits of twice the data's range: a model that runs away must not shrink the rest."""
    low, high = float(values.min()), float(values.max())
    margin = 0.5 * (high - low)
    return (max(0.0, low - margin) if low >= 0.0 else low - margin), high + margin


def legend_above(figure: Figure, ax: Axes) -> None:
    handles, labels = ax.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=len(labels), frameon=False)


def axis_label(name: str, unit: str) -> str:
    return f"${latex_name(name)}$ ({unit_text(unit)})"


def unit_text(unit: str) -> str:
    """`m^-3 s^-1` as mathtext."""
    return re.sub(r"\^(-?[\d.]+)", r"$^{\1}$", unit)


GREY = "#aaaaaa"


# Every model has a panel of its own, so these need not be told apart from all others.
MORE_COLOURS = (*COLOURS, "#7F3C8D", "#666666")
