"""A disk that takes no more: one message with the path and a hint, and whole files."""

import os
import pickle
import subprocess
import sys
import time
from pathlib import Path

import pytest

from ep2sindy.runtime.files import LEFT_AFTER_S, WriteError, replacing, sweep

resource = pytest.importorskip("resource", reason="limits of a process need POSIX")

WRITE = """
import resource, sys
import numpy as np, xarray as xr
from pathlib import Path
from ep2sindy.data.open import write_field
from ep2sindy.thruster.cache import write

n = np.random.default_rng(0).random((3000, 20))
field = xr.Dataset(
    {"n_i": (("time", "z"), n, {"units": "m^-3"})},
    coords={"time": 1e-6 * np.arange(3000), "z": 1e-3 * np.arange(20)},
)
resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, 100_000))
for writer in (lambda: write_field(field, Path("field.nc")), lambda: write(field, Path("kept.nc"))):
    try:
        writer()
    except OSError as error:
        print(error)
"""


def test_no_netcdf_writer_falls_over_on_a_full_disk(tmp_path: Path) -> None:
    """HDF5 itself ends the process with a segmentation fault, when it closes the file."""
    (tmp_path / "field.nc").write_text("earlier")
    done = subprocess.run(
        [sys.executable, "-c", WRITE], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert [line.partition(" could")[0] for line in lines] == ["field.nc", "kept.nc"]
    assert all("File too large" in line and "make room there" in line for line in lines)
    assert (tmp_path / "field.nc").read_text() == "earlier"
    assert [path.name for path in tmp_path.iterdir()] == ["field.nc"]


def test_an_error_of_a_worker_arrives_whole() -> None:
    sent = WriteError(Path("kept/x.nc"), OSError(28, "No space left on device"))
    arrived = pickle.loads(pickle.dumps(sent))
    assert isinstance(arrived, WriteError)
    assert (str(arrived), arrived.reason) == (str(sent), "No space left on device")


def test_only_what_killed_processes_left_is_swept(tmp_path: Path) -> None:
    deeper = tmp_path / "run" / "figures"
    deeper.mkdir(parents=True)
    with replacing(deeper / "a.b.nc") as sustained:
        sustained.write_text("being written")
        left = sustained.with_name(sustained.name.replace("a.b", "c"))
        others = [deeper / ".hidden-0-1.nc", deeper / "mine.nc"]
        then = time.time() - 1.1 * LEFT_AFTER_S
        for path in (left, *others):
            path.write_text("x")
            os.utime(path, (then, then))
        sweep(tmp_path)
        assert sustained.exists()
    assert sorted(deeper.iterdir()) == sorted([*others, deeper / "a.b.nc"])
