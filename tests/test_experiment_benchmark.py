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


def composed(*overrides: str) -> DictConfig:
    return programs.composed("+exp=benchmark", *overrides)


def toy(output: Path) -> list[str]:
    return [
        f"output={output}",
        "n_realizations=1",
        "parallel=serial",
        "systems=[lotka_volterra,oscillator]",
        "noises=[0,0.05]",
        "variants=[ALASSO,ours]",
    ]


@pytest.fixture(scope="module")
def toy_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_config(composed(*toy(tmp_path_factory.mktemp("outputs"))))


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
    for name, definition in composed("definitions=pysindy").definitions.items():
        if name.startswith("PySINDy"):
            assert isinstance(instantiate(definition), Variant)
