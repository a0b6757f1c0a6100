"""What is written in some container, type or packing is read back as the same samples."""

from pathlib import Path
from tempfile import TemporaryDirectory

import h5py
import netCDF4
import numpy as np
import pandas as pd
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.io import savemat

from ep2sindy.data.mapping import Variable
from ep2sindy.data.numbers import seconds
from ep2sindy.data.open import open_field
from ep2sindy.data.runs import trajectories_of

FEW = settings(max_examples=15, deadline=None, derandomize=True)
TYPES = st.sampled_from(["f8", "f4", ">f8", ">f4", "i4", "i2", "u2"])
N = 7
SETTINGS = {"variables": {"n_i": Variable("n", "m^-3")}, "time": Variable("t", "s")}


def samples(dtype: str) -> st.SearchStrategy[np.ndarray]:
    """Of sizes that every type holds, without those that mark what was never written."""
    whole = arrays(np.int16, N, elements=st.integers(0, 32_000))
    return whole.map(lambda values: values.astype(dtype))


def opened(path: Path) -> np.ndarray:
    return np.asarray(open_field(path, **SETTINGS)["n_i"].values, dtype=np.float64)


def write(path: Path, values: np.ndarray) -> None:
    t = np.arange(float(N))
    match path.suffix:
        case ".nc":
            with netCDF4.Dataset(path, "w") as file:
                file.createDimension("t", N)
                file.createVariable("t", "f8", ("t",))[:] = t
                file.createVariable("n", values.dtype.newbyteorder("="), ("t",))[:] = values
        case ".h5":
            with h5py.File(path, "w") as file:
                file["t"], file["n"] = t, values
        case ".mat":
            savemat(path, {"t": t, "n": values.astype(values.dtype.newbyteorder("="))})
        case ".npz":
            np.savez(path, t=t, n=values)
        case _:
            pd.DataFrame({"t": t, "n": values.astype(float)}).to_csv(path, index=False)


@FEW
@given(st.data(), TYPES, st.sampled_from([".nc", ".h5", ".mat", ".npz", ".csv"]))
def test_every_kind_of_file_gives_its_samples(data: st.DataObject, dtype: str, kind: str) -> None:
    values = data.draw(samples(dtype))
    with TemporaryDirectory() as folder:
        path = Path(folder) / f"a{kind}"
        write(path, values)
        np.testing.assert_array_equal(opened(path), values.astype(np.float64))


@FEW
@given(
    samples("i2"), st.sampled_from([0.5, 2.0, 1e-3]), st.floats(-100, 100), st.integers(-99, -1),
    arrays(bool, N), st.booleans(),
)  # fmt: skip
def test_packing_and_fill_values_are_undone(
    packed: np.ndarray, scale: float, offset: float, fill: int, lost: np.ndarray, in_netcdf: bool
) -> None:
    stored = np.where(lost, fill, packed).astype("i2")
    marks = {"scale_factor": scale, "add_offset": offset, "_FillValue": np.int16(fill)}
    with TemporaryDirectory() as folder:
        path = Path(folder) / ("a.nc" if in_netcdf else "a.h5")
        write(path, stored)
        with h5py.File(path, "a") as file:
            file["n"].attrs.update(marks)
        found = opened(path)
    wanted = np.where(lost, np.nan, packed * scale + offset)
    # xarray unpacks 16 bits in single precision where that holds them.
    np.testing.assert_allclose(found, wanted, rtol=2e-7, atol=1e-5 * scale)


@FEW
@given(
    arrays(np.float64, (N, 2), elements=st.floats(-1e6, 1e6, width=32)),
    st.sampled_from(["plain", "fortran", "read only", "float32", "masked", "strided", "frame"]),
)
def test_every_container_gives_its_samples(values: np.ndarray, kind: str) -> None:
    values = values + np.arange(2.0 * N).reshape(N, 2) * 1e7  # no state stands still
    values = values.astype(np.float32).astype(np.float64)
    t = np.arange(float(N))
    run: object = (t, values)
    if kind == "fortran":
        run = (t, np.asfortranarray(values))
    elif kind == "read only":
        values.flags.writeable = False
    elif kind == "float32":
        run = (t.astype(np.float32), values.astype(np.float32))
    elif kind == "masked":
        run = (np.ma.array(t), np.ma.array(values))
    elif kind == "strided":
        run = (np.repeat(t, 2)[::2], np.repeat(values, 2, axis=0)[::2])
    elif kind == "frame":
        run = pd.DataFrame({"t": t, "a": values[:, 0], "b": values[:, 1]})
    (found,) = trajectories_of(run)
    np.testing.assert_array_equal(found.states, values)
    np.testing.assert_array_equal(found.t, t)


@FEW
@given(st.integers(-(10**9), 4 * 10**9), st.sampled_from(["s", "ms", "ns"]), st.integers(1, 9))
def test_dates_of_any_unit_are_seconds(start: int, unit: str, step: int) -> None:
    dates = np.datetime64(start, "s").astype(f"M8[{unit}]") + np.arange(N) * step
    per_second = float(np.timedelta64(1, "s") / np.timedelta64(1, unit))
    np.testing.assert_allclose(seconds(dates), np.arange(N) * step / per_second, rtol=1e-14)
    back = dates - dates[0]
    assert seconds(back)[-1] == seconds(dates)[-1]
