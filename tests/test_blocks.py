"""Fields that exceed memory: read in parts, in the order of the file, or refused beforehand."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.data import blocks
from ep2sindy.data.blocks import blocks_of, read_whole
from ep2sindy.data.readers import arrays
from ep2sindy.trust import memory

SHAPE = (30, 8, 6)
ZONE = ep.Zone(z=(0.02, 0.06))
SLABS, PENCILS = (5, 8, 6), (30, 2, 3)


@pytest.fixture(autouse=True)
def few_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything is large: it is read when it is used, in blocks of 240 values."""
    for module in (blocks, arrays, ep.data.readers.source):
        monkeypatch.setattr(module, "AT_ONCE", 0)
    monkeypatch.setattr(blocks, "BLOCK_VALUES", 240)


def density(seed: int) -> np.ndarray:
    values = np.random.default_rng(seed).uniform(1.0, 2.0, SHAPE)
    values[:, :, 0] = np.nan  # a wall
    return values


def written(path: Path, chunks: tuple[int, ...]) -> Path:
    """Densities in cm^-3 on (time, z, r), of the kind that the name of the file says."""
    coords = {
        "time": ("time", 1e-6 * np.arange(SHAPE[0]), {"units": "s"}),
        "z": ("z", 0.01 * np.arange(SHAPE[1]), {"units": "m"}),
        "r": ("r", 0.03 + 0.001 * np.arange(SHAPE[2]), {"units": "m"}),
    }
    field = xr.Dataset(
        {
            n: (("time", "z", "r"), density(k), {"units": "cm^-3"})
            for k, n in enumerate(("n_i", "n_n"))
        },
        coords,
    )
    if path.suffix == ".nc":
        field.to_netcdf(
            path, engine="h5netcdf", encoding={n: {"chunksizes": chunks} for n in field}
        )
    elif path.suffix == ".zarr":
        field.to_zarr(path, encoding={n: {"chunks": chunks} for n in field}, consolidated=False)
    elif path.suffix == ".npy":
        np.save(path, density(0))
    else:
        with h5py.File(path, "w") as file:
            for name, array in field.variables.items():
                kept = chunks if array.ndim == 3 else None
                file.create_dataset(str(name), data=array.values, chunks=kept)
                file[str(name)].attrs["units"] = array.attrs["units"]
    return path


@pytest.mark.parametrize("chunks", [SLABS, PENCILS])
@pytest.mark.parametrize("name", ["a.nc", "a.zarr", "a.h5"])
def test_ranges_and_averages_in_blocks_are_those_of_the_whole(
    tmp_path: Path, name: str, chunks: tuple[int, ...]
) -> None:
    path = written(tmp_path / name, chunks)
    held = {one.name: one for one in ep.inspect_file(path).held}
    assert (held["n_i"].low, held["n_i"].high) == (np.nanmin(density(0)), np.nanmax(density(0)))
    assert held["n_i"].n_missing == 30 * 8
    field = ep.open_field(path)
    settings = {"states": ["n_i", "n_n"], "products": ["n_i*n_n"]}
    run = ep.zone_average(field, ZONE, **settings)
    whole = ep.zone_average(field.compute(), ZONE, **settings)
    np.testing.assert_allclose(run.values, whole.values, rtol=1e-14)
    weights = 0.03 + 0.001 * np.arange(1, 6)
    means = np.average(1e6 * density(0)[:, 2:7, 1:].mean(axis=1), axis=1, weights=weights)
    np.testing.assert_allclose(run.states[:, 0], means, rtol=1e-12)


@pytest.mark.parametrize("chunks", [SLABS, PENCILS])
def test_each_chunk_is_read_once_and_no_more_than_a_block_at_a_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, chunks: tuple[int, ...]
) -> None:
    path, sizes, read = written(tmp_path / "a.h5", chunks), [], arrays._Stored._read

    def counted(stored: arrays._Stored, key: tuple[object, ...]) -> np.ndarray:
        values = read(stored, key)
        sizes.append(values.size if stored.name == "/n_i" else 0)
        return values

    monkeypatch.setattr(arrays._Stored, "_read", counted)
    ep.inspect_file(path)
    assert max(sizes) <= 240
    assert sum(sizes) == np.prod(SHAPE)


def test_chunks_of_a_block_that_were_never_written_are_missing(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, points in (("time", 1e-6 * np.arange(6.0)), ("z", 0.01 * np.arange(4.0))):
            file[name] = points
            file[name].attrs["units"] = {"time": "s", "z": "m"}[name]
        x = file.create_dataset("x", (6, 4), "f8", chunks=(2, 2))
        x[2:4, :2], x[4:, 2:] = 3.0, 5.0
    values = ep.open_field(tmp_path / "a.h5")["x"]
    expected = np.full((6, 4), np.nan)
    expected[2:4, :2], expected[4:, 2:] = 3.0, 5.0
    for part in ((slice(1, 5), slice(None)), (3, slice(1, 3)), ([0, 2, 5], slice(None, None, 2))):
        np.testing.assert_array_equal(values[part], expected[part])


def test_without_chunks_the_first_dimension_is_divided() -> None:
    array = xr.DataArray(np.zeros((30, 8, 6)), dims=("time", "z", "r"))
    starts = [where["time"].start for where in blocks_of(array)]
    assert starts == [0, 5, 10, 15, 20, 25]
    assert all(where["z"] == slice(0, 8) for where in blocks_of(array))


def test_what_does_not_fit_into_memory_is_refused_before_it_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = written(tmp_path / "a.npy", SLABS)
    monkeypatch.setattr(memory, "UNCOUNTED", 0)
    monkeypatch.setattr(memory, "free_bytes", lambda: path.stat().st_size - 1)
    with pytest.raises(ValueError, match=r"a\.npy, which is read at once, would take"):
        ep.open_field(path)
    array = xr.DataArray(np.broadcast_to(0.0, (2**28,)), dims="time", name="n_i")
    monkeypatch.setattr(memory, "free_bytes", lambda: 10**9)
    with pytest.raises(ValueError, match=r"n_i, of shape .* 2.15 GB of memory: 1 GB are free"):
        read_whole(array)
