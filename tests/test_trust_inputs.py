"""Inputs that are damaged, or ask for more than there is, end in words that name them."""

import json
from collections.abc import Callable
from pathlib import Path

import pytest

import ep2sindy as ep
from ep2sindy.app.compare import read_run
from ep2sindy.library.names import split_term
from ep2sindy.thruster.axial.settings import Settings
from ep2sindy.trust import memory

LAW = {
    "format": "ep2sindy.OperatingLaw/1", "parameters": ["V"], "functions": ["1"],
    "variables": ["x"], "library": ["x"], "states": ["x"],
}  # fmt: skip


@pytest.mark.parametrize("setting", [{"n_cells": 10**9}, {"duration_s": 1e9}, {"sample_s": 1e-18}])
def test_samples_of_a_simulation_are_counted_first(
    setting: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(memory, "free_bytes", lambda: 2**33)
    with pytest.raises(ValueError, match=r"duration_s / sample_s = .* would take .* GB of memory"):
        Settings(**setting)


READERS: dict[str, Callable[[Path], object]] = {
    "field.csv": lambda path: ep.thruster.read_magnetic_field(path, exit_m=0.025),
    "gas.csv": lambda path: ep.thruster.read_propellant(
        path, mass_u=131.3, ionization_eV=12.1, excitation_eV=8.3
    ),
    "restart.nc": lambda path: ep.thruster.Restart(path),
    "law.json": lambda path: ep.operating.OperatingLaw.load(path),
    "model.json": lambda path: ep.SparseModel.load(path),
}
DAMAGED = {
    "bytes": b"\xff\xfe\x00\x01" * 100, "NUL": b"\0" * 4000, "a quote": b'"' + b"x" * 200_000,
    "nested": b"[" * 100_000, "cut": b'{"states": [', "nothing": b"\n",
}  # fmt: skip


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_named(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=name):
        READERS[name](tmp_path / name)


@pytest.mark.parametrize(
    "change", [{}, {"states": [1]}, {"library": "x"}, {"library": ["x^9999"]}, {"units": [[]]}]
)
def test_a_law_that_cannot_be_is_refused(change: dict, tmp_path: Path) -> None:
    path = tmp_path / "law.json"
    path.write_text(json.dumps(LAW | change))
    with pytest.raises(ValueError, match="law.json: a law file must hold"):
        ep.operating.OperatingLaw.load(path)


RUN = {"summary.json": '{"experiment": "weak", "seed": 1}', "provenance.json": "{}",
       "config.yaml": "seed: 1"}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("summary.json", '{"experiment": "weak"}'),
        ("summary.json", '{"experiment": "weak", "seed": 1, "headline": {"f": "<b>"}}'),
        ("summary.json", '{"experiment": "weak", "seed": 1, "data": {"time_unit": "ages"}}'),
        ("summary.json", '{"experiment": "weak", "seed": 1, "warnings": {}}'),
        ("summary.json", "[" * 100_000),
        ("provenance.json", '{"commit": 1}'),
        ("config.yaml", "- 1"),
        ("config.yaml", "a: &a {b: *a}"),
        ("config.yaml", "a: ["),
    ],
)
def test_a_damaged_run_folder_is_named(name: str, content: str, tmp_path: Path) -> None:
    for each, text in (RUN | {name: content}).items():
        (tmp_path / each).write_text(text)
    with pytest.raises(
        ValueError, match=rf"(?s){name} cannot be read .*: the run's folder is damaged"
    ):
        read_run(tmp_path, 0)


def test_a_run_folder_with_little_in_it_is_read(tmp_path: Path) -> None:
    for each, text in RUN.items():
        (tmp_path / each).write_text(text)
    assert read_run(tmp_path, 0).settings == {"seed": 1}


@pytest.mark.parametrize("text", ["x*" * 20_000, "sin(" + "1" * 40_000, "x" + " " * 100_000 + "!"])
def test_a_long_term_is_refused_in_a_time_that_grows_with_it(text: str) -> None:
    """Backtracking would take hours here."""
    with pytest.raises(ValueError, match="a term is variables") as caught:
        split_term(text)
    assert len(str(caught.value)) < 1000
