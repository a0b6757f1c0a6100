from pathlib import Path

import pandas as pd
import pytest
from hydra.utils import instantiate
from omegaconf import DictConfig

from ep2sindy.app.runner import run_config
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.studies.benchmark import Variant, published_cells
from tests import programs
from tests.programs import summary_of

TOYS = {
    "benchmark": [
        "n_realizations=1", "systems=[lotka_volterra,oscillator]", "noises=[0,0.05]",
        "variants=[ALASSO,ours]",
    ],
    "frontier": ["variants=[STLSQ,ours]", "rates_Hz=[1,20]", "durations_s=[5,40]"],
    "weak_windows": [
        "grids.boxes.test_functions={n_windows: [100,300], n_points: [10,30]}", "noises=[0.0,0.1]",
        "n_realizations=2",
    ],
}  # fmt: skip


def composed(name: str = "benchmark", *overrides: str) -> DictConfig:
    return programs.composed(f"+exp={name}", *overrides)


def toy(name: str, output: Path) -> list[str]:
    return [*TOYS[name], f"output={output}", "parallel=serial"]


@pytest.fixture(scope="module")
def toy_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_config(composed("benchmark", *toy("benchmark", tmp_path_factory.mktemp("outputs"))))


def test_every_cell_is_counted(toy_run: Path) -> None:
    summary = summary_of(toy_run)
    places = [(c["system"], c["noise"], c["variant"]) for c in summary["cells"]]
    assert places == [
        (system, noise, variant)
        for system in ("lotka_volterra", "oscillator")
        for noise in (0.0, 0.05)
        for variant in ("ALASSO", "ours")
    ]
    assert all(cell["n"] == 1 for cell in summary["cells"])
    ours = [c for c in summary["cells"] if c["variant"] == "ours"]
    assert all(c["on_front"] == c["selected"] == 1 for c in ours)
    assert [c["mean_correct_terms"] for c in ours] == [4, 4, 3, 3]


def test_the_thesis_stands_next_to_our_cells(toy_run: Path) -> None:
    table = pd.read_csv(toy_run / "tables" / "cells.csv")
    columns = ["thesis_on_front", "thesis_selected", "thesis_mean_correct_terms"]
    assert list(table.columns[-3:]) == columns
    assert table[table["variant"] == "ours"][columns].isna().to_numpy().all()
    alasso = table[table["variant"] == "ALASSO"][columns]
    assert alasso.to_numpy().tolist()[:2] == [[100, 92, 3.92], [92, 91, 3.88]]
    assert len(pd.read_csv(toy_run / "tables" / "outcomes.csv")) == 8


def test_the_published_tables_are_those_of_the_thesis() -> None:
    table = published_cells().set_index(["variant", "system", "noise"])
    assert len(table) == 4 * 4 * 3
    assert table.loc[("STLSQ", "oscillator", 0.2), "selected"] == 55.0  # 57.9 % of 95
    # Sums over the printed tables.
    assert table["on_front"].sum() == 3367
    assert table["selected"].isna().sum() == 7
    assert table["mean_correct_terms"].sum() == pytest.approx(171.42)


def test_every_definition_makes_a_variant() -> None:
    config = composed()
    assert set(config.variants) <= set(config.definitions)
    for name, definition in config.definitions.items():
        if not name.startswith("PySINDy"):
            assert isinstance(instantiate(definition), AnyMethod)
    pytest.importorskip("pysindy")
    for name, definition in composed("benchmark", "definitions=pysindy").definitions.items():
        if name.startswith("PySINDy"):
            assert isinstance(instantiate(definition), Variant)


def test_a_frontier_says_where_variants_cannot_run(tmp_path: Path) -> None:
    frontier = programs.computed(composed("frontier", *toy("frontier", tmp_path)))
    points = frontier.summary["cells"]
    found = {(p["variant"], p["rate_Hz"], p["duration_s"]): p["on_front"] for p in points}
    assert {key[1:] for key in found} == {(1, 5), (1, 40), (20, 5), (20, 40)}
    assert len(found) == 8
    assert (found["STLSQ", 20, 40], found["ours", 20, 40], found["STLSQ", 1, 5]) == (1, 1, 0)
    headline = frontier.report.headline
    for name in ("STLSQ", "ours"):
        identified = [value for key, value in found.items() if key[0] == name]
        assert headline[f"{name}/on_front_percent"] == 25.0 * sum(identified)
    assert "STLSQ 1" in frontier.page  # too few samples to smooth
    frontier.check_figures("frontier")


def test_every_kind_of_window_has_an_error(tmp_path: Path) -> None:
    found = programs.computed(composed("weak_windows", *toy("weak_windows", tmp_path)))
    cells = found.summary["cells"]
    assert len(cells) == 2 * (4 + 3)
    grid = {f"n_windows_{n}_n_points_{length}" for n in (100, 300) for length in (10, 30)}
    others = {"differential", "automatic", "automatic_weighted"}
    assert {cell["variant"] for cell in cells} == grid | others
    assert all(cell["n"] == 2 for cell in cells)
    assert found.report.headline["n_windows_100_n_points_10/error_mean"] > 0.0
    found.check_figures("benchmark")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("variants=[STLSQ,weak]", r"must all choose terms, or none of them, got \['STLSQ', 'w"),
        ("variants=[other]", r"unknown variants \['other'\]; there are"),
        ("+grids={other: {a: [1]}}", r"unknown variants \['other'\]; there are"),
        ("+grids={STLSQ: {depth: [1]}, ours: {depth: [1]}}", "of its own, got 'depth_1' twice"),
        ("variants=[knee]", "has `find`, or a form of the regression, got Knee"),
    ],
)
def test_variants_are_methods_or_forms(override: str, message: str) -> None:
    more = [f"+definitions.{n}={{_target_: ep2sindy.{n.title()}}}" for n in ("weak", "knee")]
    with pytest.raises(ValueError, match=message):
        programs.computed(composed("benchmark", *more, override))
