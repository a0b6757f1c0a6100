"""Classic NetCDF files have no checksums: what their headers say of places must fit the file."""

from pathlib import Path

import netCDF4
import numpy as np
import pytest
from scipy.io import netcdf_file

from ep2sindy.data.readers.netcdf import check_places

FORMS = ["NETCDF3_CLASSIC", "NETCDF3_64BIT", "NETCDF3_64BIT_DATA"]
T, N = np.arange(20.0), 3.0 + np.arange(20.0)


def write(path: Path, form: str, n_records: int | None, kinds: list[str]) -> None:
    """Variables over time and height, of records where their number is given."""
    with netCDF4.Dataset(path, "w", format=form) as file:
        file.createDimension("t", 4 if n_records is None else None)
        file.createDimension("z", 3)
        file.title = "abcde"
        file.createVariable("z", "f8", ("z",))[:] = 1.0
        file.createVariable("scalar", "i1", ())[...] = 1
        for kind in kinds:
            dims = ("t",) if kind == "i1" else ("t", "z")
            variable = file.createVariable(kind, kind, dims)
            variable.units = "m/s"
            if n_records != 0:
                variable[: n_records or 4] = 1


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("n_records", [None, 0, 1, 5])
@pytest.mark.parametrize("kinds", [["f8"], ["i1"], ["i2", "i1", "f8", "f4"]])
def test_a_sound_file_passes(
    tmp_path: Path, form: str, n_records: int | None, kinds: list[str]
) -> None:
    write(tmp_path / "a.nc", form, n_records, kinds)
    check_places(tmp_path / "a.nc")


@pytest.mark.parametrize("version", [1, 2])
def test_a_sound_file_of_scipy_passes(tmp_path: Path, version: int) -> None:
    with netcdf_file(str(tmp_path / "a.nc"), "w", version=version) as file:
        file.createDimension("t", None)
        file.createVariable("a", "i1", ("t",))[:] = np.ones(5, dtype="i1")
        file.createVariable("b", "f8", ("t",))[:] = np.ones(5)
    check_places(tmp_path / "a.nc")


@pytest.mark.parametrize("form", FORMS)
def test_a_place_in_the_header_or_in_another_variable_is_damage(tmp_path: Path, form: str) -> None:
    path = tmp_path / "a.nc"
    with netCDF4.Dataset(path, "w", format=form) as file:
        file.createDimension("t", 20)
        for name, values in (("t", T), ("n", N)):
            file.createVariable(name, "f8", ("t",))[:] = values
    sound = path.read_bytes()
    width = 4 if form == FORMS[0] else 8
    begin = sound.index(N.astype(">f8").tobytes()).to_bytes(width, "big")
    assert sound.count(begin) == 1
    for place in (0, sound.index(T.astype(">f8").tobytes()) + 8):
        path.write_bytes(sound.replace(begin, place.to_bytes(width, "big")))
        with pytest.raises(ValueError, match="its header is damaged: two of its parts claim"):
            check_places(path)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("n_records", [None, 5])
def test_a_cut_file_is_refused(tmp_path: Path, form: str, n_records: int | None) -> None:
    path = tmp_path / "a.nc"
    write(path, form, n_records, ["i2", "f8"])
    sound = path.read_bytes()
    path.write_bytes(sound[:-1])
    with pytest.raises(ValueError, match=f"describes {len(sound)} bytes, and it has"):
        check_places(path)
    path.write_bytes(sound[:60])
    with pytest.raises(ValueError, match="header is cut or damaged"):
        check_places(path)
