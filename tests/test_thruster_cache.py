"""Kept simulations: identical on reading back, never half-written, never answered from old code."""

import re
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from ep2sindy.runtime import files
from ep2sindy.thruster import cache
from ep2sindy.thruster.axial import simulate as axial
from ep2sindy.thruster.axial.simulate import simulate
from ep2sindy.thruster.axial.starts import ColdStart, SoftStart
from ep2sindy.thruster.parameters import OperatingPoint, Thruster

POINT = OperatingPoint(300.0, 5.0)
BRIEF = {"duration_s": 3e-5, "warm_up_s": 0.0, "n_cells": 40, "progress": False}


def test_a_file_depends_on_all_source_text_that_sets_its_content():
    """Kept results carry the status of their record: its bounds stand in another room."""
    imported = re.compile(r"^from (ep2sindy\.signals\.\w+) import", re.MULTILINE)
    room = Path(cache.__file__).parent
    names = {name for path in room.rglob("*.py") for name in imported.findall(path.read_text())}
    files_named = {
        room.parent.parent.joinpath(*name.split(".")).with_suffix(".py") for name in names
    }
    assert names
    assert files_named <= set(cache.SOURCES)


def kept(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def small_runs(monkeypatch):
    """Simulations of two variables, each its own of its point; a list of those that ran."""
    done = []

    def simulate_as(_settings, _thruster, point, start, *, progress):
        done.append((point, start))
        n_i = point.neutral_speed * np.arange(12, dtype=np.float32).reshape(4, 3)
        variables = {"n_i": (("time", "z"), n_i), "n_n": ("time", np.linspace(0.0, 1.0, 4))}
        attributes = {"parameters": "{}", "status": "steady"}
        return xr.Dataset(variables, {"time": np.arange(4.0)}, attributes)

    monkeypatch.setattr(axial, "simulate_as", simulate_as)
    return done


def test_second_call_reads_identical_values(tmp_path, monkeypatch):
    first = simulate(Thruster(), POINT, cache=tmp_path, **BRIEF)
    monkeypatch.setattr(axial, "simulate_as", lambda *_, **__: pytest.fail("simulated twice"))
    second = simulate(Thruster(), POINT, cache=tmp_path, **BRIEF)
    xr.testing.assert_identical(first.drop_attrs(), second.drop_attrs())
    assert all(first[name].dtype == second[name].dtype for name in first.variables)
    for name, value in first.attrs.items():
        np.testing.assert_equal(second.attrs[name], value)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ({}, {"initial": ColdStart()}),
        ({"initial": SoftStart(hold_s=1e-5)}, {"initial": SoftStart(hold_s=2e-5)}),
        ({}, {"operating_point": OperatingPoint(300.0, 5.0, neutral_speed=281.0)}),
        ({}, {"n_cells": 41}),
    ],
)
def test_other_parameters_have_another_file(tmp_path, small_runs, one, other):
    usual = {"thruster": Thruster(), "operating_point": POINT, "cache": tmp_path, **BRIEF}
    for change in (one, other, one):
        simulate(**(usual | change))
    assert len(kept(tmp_path)) == len(small_runs) == 2


@pytest.mark.usefixtures("small_runs")
def test_changed_source_has_another_file(tmp_path, monkeypatch):
    simulate(Thruster(), POINT, cache=tmp_path / "kept", **BRIEF)
    (tmp_path / "closures.py").write_text("changed = True\n")
    monkeypatch.setattr(cache, "SOURCES", [tmp_path])
    simulate(Thruster(), POINT, cache=tmp_path / "kept", **BRIEF)
    assert len(kept(tmp_path / "kept")) == 2


@pytest.mark.usefixtures("small_runs")
def test_interrupted_write_leaves_nothing(tmp_path, monkeypatch):
    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(files.os, "replace", interrupt)
    with pytest.raises(KeyboardInterrupt):
        simulate(Thruster(), POINT, cache=tmp_path, **BRIEF)
    assert kept(tmp_path) == []


def damaged(content: bytes) -> bytes:
    """One byte in the middle of the values changed."""
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 0xFF]) + content[middle + 1 :]


def other_parameters(content: bytes) -> bytes:
    field = xr.load_dataset(BytesIO(content), engine="h5netcdf", decode_times=False)
    return bytes(field.assign_attrs(kept_for="{}").to_netcdf(None, engine="h5netcdf"))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (damaged, "cannot be read"),
        (lambda content: content[:-9], "cannot be read"),
        (other_parameters, "it is of other parameters"),
    ],
)
def test_a_kept_run_that_is_damaged_or_another_is_simulated_again(
    tmp_path, capsys, small_runs, change, reason
):
    first = simulate(Thruster(), POINT, cache=tmp_path, **BRIEF)
    (path,) = tmp_path.iterdir()
    path.write_bytes(change(path.read_bytes()))
    again = simulate(Thruster(), POINT, cache=tmp_path, **BRIEF)
    xr.testing.assert_identical(first.drop_attrs(), again.drop_attrs())
    assert len(small_runs) == 2
    printed = capsys.readouterr()
    assert reason in " ".join((printed.out + printed.err).split())


def test_a_cache_that_takes_no_file_costs_no_simulation(tmp_path, monkeypatch):
    """A folder that is there, but full or not to be written to."""

    def refuse(*_, **__):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(cache, "TemporaryFile", refuse)
    monkeypatch.setattr(axial, "simulate_as", lambda *_, **__: pytest.fail("simulated in vain"))
    with pytest.raises(OSError, match="No space left on device.*make room there"):
        simulate(Thruster(), POINT, cache=tmp_path, **BRIEF)
