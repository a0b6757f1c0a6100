"""What becomes of models at operating points: one mark per structure, way of fitting and point."""

from __future__ import annotations

import pandas as pd
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from ep2sindy.figures.style import (
    GREY,
    SIGN,
    SMALL,
    TITLE,
    WIDTH,
    legend_above,
    make_panels,
)

# Status -> marker, the best first; any other run has no cycle.
MARKERS = {"sustained": "o", "wrong frequency": "D", "wrong cycle": "s"}
OTHER = "decays, diverges or turns negative"
NORM = LogNorm(0.01, 1.0)  # of the amplitude's error


def sustained_figure(rows: pd.DataFrame) -> Figure:
    """A panel per way of fitting, a row per structure, a column per operating point.

    rows: structure, way, point, status, amplitude_error (relative, NaN for a run without one).
    """
    ways, points = (list(rows[key].unique()) for key in ("way", "point"))
    structures = list(rows["structure"].unique())
    size = (min(WIDTH, 2.0 + 0.5 * len(points) * len(ways)), 1.9 + 0.3 * len(structures))
    figure, (axes,) = make_panels(1, len(ways), size, sharex=True, sharey=True)
    for ax, way in zip(axes, ways, strict=True):
        of_way = rows[rows["way"] == way]
        cycles = of_way["status"].isin([*MARKERS])
        for status, marker in MARKERS.items():
            shown = of_way[of_way["status"] == status]
            marks = ax.scatter(
                shown["point"].map(points.index), shown["structure"].map(structures.index),
                c=shown["amplitude_error"], marker=marker, s=80 if status == "sustained" else 40,
                cmap="viridis_r", norm=NORM, edgecolors=SIGN, linewidths=0.5,
            )  # fmt: skip
        rest = of_way[~cycles]
        ax.plot(
            rest["point"].map(points.index), rest["structure"].map(structures.index), "x",
            color=GREY, ms=6,
        )  # fmt: skip
        ax.set_title(way, fontsize=TITLE)
        ax.set_xticks(range(len(points)), [_short(point) for point in points], fontsize=SMALL)
        ax.set_yticks(range(len(structures)), [name.replace("_", " ") for name in structures])
        ax.set_xlim(-0.5, len(points) - 0.5)
        ax.set_ylim(len(structures) - 0.5, -0.5)
        ax.set_xlabel(", ".join(part.partition("=")[0] for part in points[0].split(", ")))
    colours = figure.colorbar(marks, ax=list(axes), label="error of the amplitude", extend="max")
    colours.ax.set_yticks([0.01, 0.1, 1.0], ["1 %", "10 %", "100 %"])
    signs = {**{marker: status for status, marker in MARKERS.items()}, "x": OTHER}
    legend_above(
        figure,
        [Line2D([], [], ls="", marker=m, color=SIGN, label=text) for m, text in signs.items()],
    )
    return figure


def _short(point: str) -> str:
    """`V_D_V=300, mdot_mg_s=5` -> its values, one below the other."""
    return "\n".join(part.partition("=")[2] for part in point.split(", "))
