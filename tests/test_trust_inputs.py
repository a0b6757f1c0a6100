"""Inputs that are damaged, or ask for more than there is, end in words that name them."""

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from numcodecs.pickles import Pickle

import ep2sindy as ep
from ep2sindy.app.compare import read_run
from ep2sindy.data.mapping import read_array
from ep2sindy.data.readers.registry import open_source
from ep2sindy.library.names import split_term
from ep2sindy.library.units import SECONDS
from ep2sindy.report.page import read_png
from ep2sindy.report.results import value_text
from ep2sindy.runtime.files import check_regular, read_bytes
from ep2sindy.thruster.axial.settings import Settings
from ep2sindy.trust import memory
from tests.programs import ended

LAW = {
    "format": "ep2sindy.OperatingLaw/1", "parameters": ["V"], "functions": ["1"],
    "variables": ["x"], "library": ["x"], "states": ["x"], "coefficients": [["x", "x"]],
    "coef": [[1.0]], "points": [[2.0]], "covariance": [[0.5]], "units": {}, "provenance": {},
    "left_out": [0.1],
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
    "bytes": b"\xff\xfe\x00\x01" * 100, "a quote": b'"' + b"x" * 200_000,
    "nested": b"[" * 100_000, "cut": b'{"states": [',
}  # fmt: skip


@pytest.mark.parametrize("content", DAMAGED.values(), ids=DAMAGED)
@pytest.mark.parametrize("name", READERS)
def test_a_damaged_file_is_named(name: str, content: bytes, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=name):
        READERS[name](tmp_path / name)


@pytest.mark.parametrize(
    "change",
    [
        {"library": ["x^9999"]},
        {"coef": [[None]]},
        {"covariance": [[1.0, 0.0]]},
        {"format": "ep2sindy.OperatingLaw/2"},
    ],
)
def test_a_law_that_cannot_be_is_refused(change: dict, tmp_path: Path) -> None:
    path = tmp_path / "law.json"
    path.write_text(json.dumps(LAW))
    assert ep.operating.OperatingLaw.load(path).at(V=2.0).terms("x") == {"x": 1.0}
    path.write_text(json.dumps(LAW | change))
    with pytest.raises(ValueError, match=r"law\.json: .*a law file must hold"):
        ep.operating.OperatingLaw.load(path)


RUN = {"summary.json": '{"experiment": "weak", "seed": 1}', "provenance.json": "{}",
       "config.yaml": "seed: 1"}  # fmt: skip
NINE_TIMES = "a0: &a0 [x]\n" + "".join(
    f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12)
)  # 400 bytes that stand for 9^11 values
CONFIGS = {
    NINE_TIMES: "must hold 100000 values or fewer",
    f"a: {'[' * 3000}{']' * 3000}": "50 deep",
    "a: &a [*a]": "with its anchors expanded",
}


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("summary.json", '{"experiment": "weak", "seed": 1, "data": {"time_unit": "ages"}}', ""),
        ("summary.json", "[" * 100_000, "it is damaged"),
        ("provenance.json", "[1]", ""),
        ("provenance.json", '{"versions": "text"}', "it is damaged"),
        *(("config.yaml", content, message) for content, message in CONFIGS.items()),
    ],
)
def test_a_damaged_run_folder_is_named(
    name: str, content: str, message: str, tmp_path: Path
) -> None:
    for each, text in RUN.items():
        (tmp_path / each).write_text(text)
    assert read_run(tmp_path, 0).settings == {"seed": 1}
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=f"{name} cannot be read: .*{message}"):
        read_run(tmp_path, 0)


@pytest.mark.parametrize("content", CONFIGS)
def test_a_config_is_counted_before_it_is_expanded(
    content: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "conf" / "exp").mkdir(parents=True)
    (tmp_path / "conf" / "exp" / "theirs.yaml").write_text(f"# @package _global_\n{content}\n")
    assert re.search(rf"^error: .*theirs\.yaml .*{CONFIGS[content]}", ended("+exp=theirs"))


def test_pictures_are_pngs_and_numbers_of_any_size_are_shown(tmp_path: Path) -> None:
    (tmp_path / "a.png").write_bytes(b"x" * 99)
    with pytest.raises(ValueError, match=r"a\.png must be a PNG, got b'xxxx"):
        read_png(tmp_path / "a.png", "")
    assert value_text("one/f_kHz", 1e308, SECONDS) == "-"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes of POSIX")
def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.csv")
    for path in (tmp_path / "a.csv", Path("/dev/zero")):
        for read in (open_source, read_bytes, check_regular):
            with pytest.raises(ValueError, match="a file or a folder must come: .* is a pipe"):
                read(path)
    with pytest.raises(ValueError, match=r"a\.csv is a pipe"):
        check_regular(tmp_path)


@pytest.mark.skipif(not Path("/dev/null").exists(), reason="devices of POSIX")
@pytest.mark.parametrize("place", [".zgroup", "I/.zarray", "I/.zattrs", "I/0", "more"])
def test_a_zarr_store_holds_files_alone(place: str, tmp_path: Path) -> None:
    """A device, of which nothing is read, in the place of a pipe, which would be waited for."""
    path = tmp_path / "a.zarr"
    xr.Dataset({"I": ("time", np.arange(5.0))}).to_zarr(path, consolidated=False, zarr_format=2)
    assert open_source(path).names == ["I"]
    (path / place).unlink(missing_ok=True)
    (path / place).symlink_to("/" if place == "more" else "/dev/null")
    with pytest.raises(ValueError, match=rf"a\.zarr cannot be read: .*{place} is a pipe, .* link"):
        open_source(path)


def leading(path: Path, leads: str, target: str) -> None:
    """An HDF5 file whose data set x lies in another file."""
    layout = h5py.VirtualLayout((5,), "f8")
    layout[:] = h5py.VirtualSource(target, "x", (5,))
    with h5py.File(path, "w") as file:
        if leads == "raw":
            file.create_dataset("x", (5,), "f8", external=[(target, 0, 40)])
        elif leads == "virtual":
            file.create_virtual_dataset("x", layout)
        else:
            file["x"] = h5py.ExternalLink(target, "/x")


@pytest.mark.parametrize("leads", ["raw", "virtual", "linked", "twice"])
def test_values_of_hdf5_lie_in_files(leads: str, tmp_path: Path) -> None:
    leading(tmp_path / "a.nc", leads, "b.h5" if leads == "twice" else os.devnull)
    leading(tmp_path / "b.h5", "raw", os.devnull)
    for read in (open_source, ep.data.read_field, ep.thruster.Restart):
        with pytest.raises(ValueError, match=r"a\.nc cannot be read: values must lie in files: it"):
            read(tmp_path / "a.nc")


def test_values_of_hdf5_may_lie_in_another_file(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["x"] = np.arange(5.0)
    for leads in ("virtual", "linked"):
        leading(tmp_path / f"{leads}.h5", leads, "b.h5")
    source = open_source(tmp_path / "virtual.h5")
    np.testing.assert_array_equal(source.read("x"), np.arange(5.0))
    assert not open_source(tmp_path / "linked.h5").names  # links are passed over


def test_what_is_packed_is_counted_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(10_000))
    xr.Dataset({"x": ("time", np.zeros(10_000, "i1"))}).to_netcdf(tmp_path / "a.nc")
    monkeypatch.setattr(memory, "UNCOUNTED", 0)
    monkeypatch.setattr(memory, "free_bytes", lambda: 70_000)
    with pytest.raises(ValueError, match=r"a\.npz cannot be read: 'x.npy' would take 8.01e-05 GB"):
        open_source(tmp_path / "a.npz")
    with pytest.raises(ValueError, match=r"a\.nc cannot be read: 'x' would take 8e-05 GB"):
        read_array(open_source(tmp_path / "a.nc"), "x", "x")


WAITS = """
import threading
from ep2sindy.app import main

def command(arguments):
    threading.Thread(target=threading.Event().wait).start()  # as for a file that never comes
    raise KeyboardInterrupt

main.command = command
main.main()
"""


def test_an_interrupted_run_ends_though_a_thread_waits() -> None:
    done = subprocess.run([sys.executable, "-c", WAITS], capture_output=True, text=True, timeout=99)
    assert (done.returncode, done.stderr.split(":")[0]) == (1, "interrupted")


def test_an_array_is_counted_before_memory_is_asked_for(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("x", (2**50,), "f8", chunks=(1024,))
    with pytest.raises(ValueError, match=r"a\.h5 cannot be read: '/x' would take .* GB of memory"):
        read_array(open_source(tmp_path / "a.h5"), "x", "x")


def test_a_circle_of_groups_is_not_walked_twice(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "circle.h5", "w") as file:
        file["g/x"] = np.arange(6.0)
        file["g/again"] = file["g"]
    assert "g/x" in open_source(tmp_path / "circle.h5").names


class Marks:
    """Unpickled, it leaves a mark."""

    def __reduce__(self) -> tuple[object, ...]:
        return eval, ("__import__('pathlib').Path('it_ran').touch()",)


@pytest.mark.parametrize("array", ["time", "I"])
def test_pickled_objects_of_a_zarr_store_do_not_run(
    array: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "a.zarr"
    field = xr.Dataset({"I": ("time", np.arange(5.0))}, coords={"time": np.arange(5.0)})
    field.to_zarr(path, consolidated=False, zarr_format=2)
    place = path / array / ".zarray"
    objects = {"dtype": "|O", "filters": [{"id": "pickle", "protocol": 4}], "compressor": None}
    place.write_text(json.dumps(json.loads(place.read_text()) | objects))
    content = Pickle().encode(np.array([Marks()] * 5, dtype=object))
    (path / array / "0").write_bytes(content)
    with pytest.raises(ValueError, match="a.zarr cannot be read"):
        ep.open_field(
            path, variables={"I_d": ep.data.Variable("I", "A")}, time=ep.data.Variable("time", "s")
        )
    assert not Path("it_ran").exists()


@pytest.mark.parametrize("text", ["x*" * 20_000, "sin(" + "1" * 40_000, "x" + " " * 100_000 + "!"])
def test_a_long_term_is_refused_in_a_time_that_grows_with_it(text: str) -> None:
    """Backtracking would take hours here."""
    with pytest.raises(ValueError, match="a term is variables") as caught:
        split_term(text)
    assert len(str(caught.value)) < 1000
