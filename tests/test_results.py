"""One description of a figure makes its column, its cell, its JSON and its headline."""

from collections.abc import Mapping
from dataclasses import dataclass

from ep2sindy.report.results import Metric, ResultTable, View, percent


@dataclass(frozen=True)
class Fit:
    error: float
    r2: Mapping[str, float]
    status: str = "converged"


METRICS: list[Metric[Fit]] = [
    Metric("status", lambda fit: fit.status, View.ALL & ~View.HEADLINE),
    Metric("f_error", lambda fit: fit.error, View.ALL, heading="its error", format=percent(1)),
    Metric("r2", lambda fit: fit.r2, View.ALL, heading="R2 of {}", format="{:.2f}"),
    Metric("r2_text", lambda fit: str(fit.r2)),
]
FITS = {
    "free": Fit(0.012, {"x": 0.5, "y": 0.25}),
    "coupled": Fit(float("nan"), {"x": 1.0, "y": 0.0}),
}
TABLE = ResultTable(FITS, METRICS)


def test_a_row_per_record_spreads_states_over_columns() -> None:
    table = TABLE.csv("fit")
    assert list(table) == ["fit", "status", "f_error", "r2_x", "r2_y", "r2_text"]
    assert table["r2_y"].tolist() == [0.25, 0.0]


def test_a_row_per_state_repeats_what_has_no_states() -> None:
    table = TABLE.csv("fit", by_state=True)
    assert table["fit"].tolist() == ["free", "free", "coupled", "coupled"]
    assert table["state"].tolist() == ["x", "y", "x", "y"]
    assert table["r2"].tolist() == [0.5, 0.25, 1.0, 0.0]
    assert table["f_error"][:2].tolist() == [0.012, 0.012]


def test_json_keeps_states_together_and_headlines_part_them() -> None:
    assert TABLE.json()["free"] == {
        "status": "converged",
        "f_error": 0.012,
        "r2": {"x": 0.5, "y": 0.25},
        "r2_text": "{'x': 0.5, 'y': 0.25}",
    }
    headline = ResultTable({"free": FITS["free"]}, METRICS).headline()
    assert headline == {"free/f_error": 0.012, "free/x/r2": 0.5, "free/y/r2": 0.25}


def test_no_records_make_no_rows() -> None:
    empty: ResultTable[Fit] = ResultTable({}, METRICS)
    assert empty.csv("fit").empty
    assert empty.screen("fit").empty
    assert empty.headline() == {}
