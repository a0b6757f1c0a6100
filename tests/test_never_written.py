"""Numbers that a file packs, marks as missing, or never got: none is taken for a sample."""

from pathlib import Path

import h5py
import netCDF4
import numpy as np
import pytest

from ep2sindy.data.mapping import Variable
from ep2sindy.data.open import open_field

T = np.arange(6.0)
SETTINGS = {"variables": {"n_i": Variable("n", "m^-3")}, "time": Variable("t", "s")}


def values(path: Path) -> np.ndarray:
    return open_field(path, **SETTINGS)["n_i"].values


@pytest.mark.parametrize("form", ["NETCDF4", "NETCDF3_CLASSIC", "NETCDF3_64BIT_DATA"])
@pytest.mark.parametrize("kind", ["f8", "f4", "i4", "i2"])
def test_samples_that_netcdf_never_got_are_missing(tmp_path: Path, form: str, kind: str) -> None:
    with netCDF4.Dataset(tmp_path / "a.nc", "w", format=form) as file:
        file.createDimension("t", 6)
        file.createVariable("t", "f8", ("t",))[:] = T
        file.createVariable("n", kind, ("t",))[:4] = [1, 2, 3, 4]
    np.testing.assert_array_equal(values(tmp_path / "a.nc"), [1, 2, 3, 4, np.nan, np.nan])


def test_chunks_that_hdf5_never_got_are_missing(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["t"] = T
        file.create_dataset("n", (6,), chunks=(2,), dtype="i4")[:4] = [1, 0, 3, 4]
    np.testing.assert_array_equal(values(tmp_path / "a.h5"), [1, 0, 3, 4, np.nan, np.nan])


@pytest.mark.parametrize("chunks", [None, (2,)])
def test_an_array_that_hdf5_never_got_is_refused(tmp_path: Path, chunks: object) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["t"] = T
        file.create_dataset("n", (6,), chunks=chunks, dtype="f8")
    with pytest.raises(ValueError, match="'/n' was never written"):
        values(tmp_path / "a.h5")


def test_packed_numbers_of_hdf5_are_unpacked(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["t"] = T
        found = file.create_dataset("n", data=np.array([0, 1, 2, 3, -9, 5], dtype="i2"))
        found.attrs.update({"scale_factor": [2.0], "add_offset": 10.0, "_FillValue": np.int16(-9)})
        found.attrs["Units"] = np.bytes_("m^-3")
    np.testing.assert_array_equal(values(tmp_path / "a.h5"), [10, 12, 14, 16, np.nan, 20])
    wrong = {**SETTINGS, "variables": {"n_i": Variable("n", "cm^-3")}}
    with pytest.raises(ValueError, match="must agree with the file"):
        open_field(tmp_path / "a.h5", **wrong)


@pytest.mark.parametrize("unlimited", [False, True])
@pytest.mark.parametrize("form", ["NETCDF3_CLASSIC", "NETCDF3_64BIT_DATA"])
def test_a_classic_file_that_is_cut_is_refused(tmp_path: Path, form: str, unlimited: bool) -> None:
    path = tmp_path / "a.nc"
    with netCDF4.Dataset(path, "w", format=form) as file:
        file.createDimension("t", None if unlimited else 600)
        for name in ("t", "n"):
            file.createVariable(name, "f8", ("t",))[:] = np.arange(600.0)
    whole = path.read_bytes()
    assert values(path)[-1] == 599.0
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="a.nc cannot be read: "):
        values(path)
