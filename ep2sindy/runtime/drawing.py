"""Figures of results: the methods `plot` of values in low rooms, drawn by the room `figures`."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw(name: str, *values: Any, **settings: Any) -> Figure:
    """The figure that a function of `ep2sindy.figures.plots` draws.

    The room `figures` stands above the values that it draws, and loads matplotlib. So it is found
    by name, here alone, when a figure is asked for.
    """
    figure: Figure = getattr(import_module("ep2sindy.figures.plots"), name)(*values, **settings)
    return figure
