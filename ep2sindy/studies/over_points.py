"""Fits of structures at several operating points, and where each is sustained: `+exp=theories`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial

import pandas as pd

from ep2sindy.figures.sustained import sustained_figure
from ep2sindy.forecasting.evaluation import Evaluation
from ep2sindy.model.comparison import Status
from ep2sindy.report.document import Result, Text
from ep2sindy.report.models import equations
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, Metrics, ResultTable, View
from ep2sindy.studies.fitted import (
    FITTED,
    SEVERAL,
    SEVERAL_NOTE,
    Fitted,
    count_words,
    n_sustained,
    worst_amplitude,
)

NOTE = (
    f"{SEVERAL_NOTE} Signs wrong: terms whose sign contradicts the recorded balance of the same "
    "process, and at how many points."
)
CAPTION = (
    "What becomes of every model, run freely from one sample at every operating point, by the way "
    "its coefficients were found. Colour: error of the amplitude of the state that is farthest off."
)


def _runs(fits: Sequence[Fitted]) -> list[Evaluation]:
    return [fit.from_sample for fit in fits]


AT_POINTS: Metrics[Sequence[Fitted]] = [
    Metric("n_free", lambda fits: max(fit.n_free for fit in fits), View.SHOWN, "free"),
    *(metric.of(_runs) for metric in SEVERAL),
    Metric(
        "wrong_signs", lambda fits: count_words([t for fit in fits for t in fit.wrong], "; "),
        View.SHOWN, "signs wrong",
    ),
    Metric("source", lambda fits: fits[0].structure.source),
]  # fmt: skip


def add_points(
    found: Mapping[str, Mapping[str, Fitted]], labels: Mapping[str, str], report: Report
) -> None:
    """Every fit over all points, and the models of each point.

    found: by point, then by fit. labels: of parameters, for the figure.
    Raises ValueError if no point has a record.
    """
    if not found:
        raise ValueError("structures need a record to be fitted to: no operating point has one")
    first = next(iter(found.values()))
    over = {name: [fits[name] for fits in found.values()] for name in first}
    sources = {fit.name: fit.structure.source for fit in first.values()}
    report.section(f"{len(over)} fits at {len(found)} operating points")
    draw = partial(sustained_figure, _rows(found), labels=labels)
    report.figure("sustained", draw, CAPTION)
    report.table("over_points", ResultTable(over, AT_POINTS), heading="fit", note=NOTE)
    report.section("Structures", *(f"{key}: {text}" for key, text in sources.items() if text))
    rows = {f"{n}, {p}": fit for n in over for p, fit in zip(found, over[n], strict=True)}
    report.section("Every point")
    report.table("fits", ResultTable(rows, FITTED), heading="fit", page_only=True)
    for number, (point, fits) in enumerate(found.items()):
        report.section(point, level=3)
        for name, fit in fits.items():
            held_to = fit.first.held_to
            report.add(*equations(fit.model, held=held_to, lead=name, on_screen=False))
            report.model(f"{name}_{number}", fit.model, held=held_to, shown=False)
    counts = {name: n_sustained(_runs(fits)) for name, fits in over.items()}
    lines = [
        Text(f"fits that sustain it at {n} of {len(found)} points: {', '.join(names)}")
        for n in range(len(found), 0, -1)
        if (names := [name for name, count in counts.items() if count == n])
    ]
    structures = {over[name][0].name for name, n in counts.items() if n == len(found)}
    report.found(
        Result(
            f"{len(structures)} of {len(sources)} structures sustain the oscillation at all "
            f"{len(found)} points",
            lines or [Text("no fit sustains the oscillation at any point")],
            load='pandas.read_csv("{}/tables/over_points.csv")',
            picture="sustained",
        )
    )


def _rows(found: Mapping[str, Mapping[str, Fitted]]) -> pd.DataFrame:
    """One row per structure, way and point: what the figure draws."""
    rows = [
        (fit.name, fit.way.name, point,
         str(Status.SUSTAINED if fit.from_sample.holds else fit.from_sample.status),
         abs(worst_amplitude(fit.from_sample) - 1.0))
        for point, fits in found.items()
        for fit in fits.values()
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=["structure", "way", "point", "status", "amplitude_error"])
