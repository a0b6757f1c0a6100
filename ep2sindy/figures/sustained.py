"""What becomes of models at operating points: one mark per structure, way of fitting and point."""

from __future__ import annotations

from collections.abc import Mapping

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
    name_label,
)

# Status -> marker, the best first; any other run has no cycle.
MARKERS = {"sustained": "o", "wrong frequency": "D", "wrong cycle": "s"}
OTHER = "no cycle: decays, diverges, turns negative"
NORM = LogNorm(0.01, 1.0)  # of the amplitude's error


def sustained_figure(rows: pd.DataFrame, *, labels: Mapping[str, str]) -> Figure:
    """A panel per way of fitting, a row per structure, a column per operating point.

    rows: structure, way, point, status, amplitude_error (relative, NaN for a run without one).
    labels: of the parameters of points.
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
        ax.set_xticks(
            range(len(points)), ["\n".join(_split(point, 2)) for point in points], fontsize=SMALL
        )
        ax.set_yticks(range(len(structures)), [name.replace("_", " ") for name in structures])
        ax.set_xlim(-0.5, len(points) - 0.5)
        ax.set_ylim(len(structures) - 0.5, -0.5)
        ax.set_xlabel("\n".join(name_label(name, labels) for name in _split(points[0], 0)))
    colours = figure.colorbar(marks, ax=list(axes), label="error of the amplitude", extend="max")
    colours.ax.set_yticks([0.01, 0.1, 1.0], ["1 %", "10 %", "100 %"])
    signs = {**{marker: status for status, marker in MARKERS.items()}, "x": OTHER}
    legend_above(
        figure,
        [Line2D([], [], ls="", marker=m, color=SIGN, label=text) for m, text in signs.items()],
    )
    return figure


def _split(point: str, part: int) -> list[str]:
    """The names (part 0) or values (part 2) of a point's label, `V_D_V=300, mdot_mg_s=5`."""
    return [each.partition("=")[part] for each in point.split(", ")]
