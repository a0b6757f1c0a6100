"""Runs that a code wrote step by step: groups of one file, or a file for each."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.data.steps import records_of

N, DT = 8, 2e-6
NUMBERS = 100 * np.arange(N)
T = DT * np.arange(N)
Z = np.linspace(0.0, 0.03, 5)
N_I = 1e18 * (1.0 + 0.1 * np.random.default_rng(0).random((N, len(Z))))


def by_attribute(file: h5py.File, k: int) -> None:
    group = file.create_group(f"data/{NUMBERS[k]}")
    group["n_i"], group.attrs["time"] = N_I[k], T[k]
    if "grid/z" not in file:
        file["grid/z"] = Z


def by_dataset(file: h5py.File, k: int) -> None:
    group = file.create_group(f"step_{k:05d}")
    group["n_i"], group["time"], group["z"] = N_I[k], T[k], Z


def by_step(file: h5py.File, k: int) -> None:
    group = file.create_group(f"{NUMBERS[k]}")
    group["n_i"], group["z"], group.attrs["dt"] = N_I[k], Z, DT / 100


def by_quantity(file: h5py.File, k: int) -> None:
    """The number stands last, as in iPIC3D."""
    file[f"moments/n_i/cycle_{k}"], file[f"time/cycle_{k}"] = N_I[k], T[k]
    if "grid/z" not in file:
        file["grid/z"] = Z


def openpmd(file: h5py.File, k: int) -> None:
    """Meshes with units and grids in attributes, next to particles whose number changes."""
    group = file.create_group(f"data/{NUMBERS[k]}")
    group.attrs.update({"time": 1e6 * T[k], "dt": 0.02, "timeUnitSI": 1e-6})
    mesh = group.create_dataset("fields/n_i", data=1e-18 * N_I[k])
    mesh.attrs.update(
        {
            "unitSI": 1e18, "unitDimension": [-3.0, 0, 0, 0, 0, 0, 0], "axisLabels": [b"z"],
            "gridSpacing": [0.0075], "gridGlobalOffset": [0.0], "gridUnitSI": 1.0,
            "position": [0.0],
        }
    )  # fmt: skip
    group["particles/e/position/x"] = np.arange(20.0 + k)


def in_modes(file: h5py.File, k: int) -> None:
    """The same in azimuthal modes, of which the first is the average over the azimuth."""
    openpmd(file, k)
    group = file[f"data/{NUMBERS[k]}/fields"]
    attributes = dict(group["n_i"].attrs)
    mode = group["n_i"][()]
    del group["n_i"]
    mesh = group.create_dataset("n_i", data=np.stack([mode, 9.0 * mode, -mode]))
    mesh.attrs.update(attributes | {"geometry": np.bytes_("thetaMode")})


LAYOUTS = [by_attribute, by_dataset, by_step, by_quantity, openpmd, in_modes]


@pytest.mark.parametrize("layout", LAYOUTS)
def test_groups_of_steps_are_joined_along_time(
    tmp_path: Path, layout: Callable[[h5py.File, int], None]
) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for k in (*range(5, N), *range(5)):  # in any order
            layout(file, k)
    found = ep.inspect_file(tmp_path / "a.h5")
    assert f"{N} groups joined along time, steps 0 to" in found.source.words
    check(ep.open_field(tmp_path / "a.h5", plasma=True))


def check(field: xr.Dataset) -> None:
    assert field["n_i"].dims == ("time", "z")
    np.testing.assert_allclose(field["n_i"].values, N_I, rtol=1e-12)
    np.testing.assert_allclose(field["time"].values, T, rtol=1e-12)
    np.testing.assert_allclose(field["z"].values, Z, rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_file_for_each_step_is_joined(
    tmp_path: Path, layout: Callable[[h5py.File, int], None]
) -> None:
    for k in range(N):
        with h5py.File(tmp_path / f"dump_{NUMBERS[k]}.h5", "w") as file:
            layout(file, k)
    pattern = f"{tmp_path}/dump_*.h5"
    assert records_of(pattern) == [pattern]
    check(ep.open_field(pattern, plasma=True))


def test_a_list_of_the_files_of_all_steps_is_their_pattern(tmp_path: Path) -> None:
    pattern = without_time(tmp_path)
    files = list(tmp_path.glob("dump_*.npz"))
    for each in (pattern, files, files[::-1]):
        assert ep.open_field(each, dt_s=DT / 100, plasma=True).attrs["file"] == pattern


@pytest.mark.parametrize("ending", ["nc", "npz"])
def test_steps_of_other_kinds_are_joined(tmp_path: Path, ending: str) -> None:
    for k in range(N):
        path = tmp_path / f"dump_{k:03d}.{ending}"
        if ending == "npz":
            np.savez(path, n_i=N_I[k], time=T[k], z=Z)
        else:
            step = xr.Dataset(
                {"n_i": (("time", "z"), N_I[k : k + 1])}, coords={"time": T[k : k + 1], "z": Z}
            )
            step.to_netcdf(path)
    check(ep.open_field(f"{tmp_path}/dump_*.{ending}", plasma=True))


def without_time(folder: Path) -> str:
    for k in range(N):
        np.savez(folder / f"dump_{NUMBERS[k]}.npz", n_i=N_I[k], z=Z)
    return f"{folder}/dump_*.npz"


def test_without_time_the_time_of_a_step_is_asked_for(tmp_path: Path) -> None:
    pattern = without_time(tmp_path)
    (note, *_) = ep.inspect_file(pattern).notes()
    assert "give the time of one step, of those numbered 0 to 700, data.dt_s=STEP" in note
    with pytest.raises(ValueError, match="a field needs time: give the time of one step"):
        ep.open_field(pattern)
    check(ep.open_field(pattern, dt_s=DT / 100, plasma=True))


def test_files_with_times_are_records_of_their_own(tmp_path: Path) -> None:
    for k in range(3):
        np.savez(tmp_path / f"run_{k}.npz", n_i=N_I[:, 0], time=T)
    pattern = f"{tmp_path}/run_*.npz"
    assert len(records_of(pattern)) == 3
    with pytest.raises(ValueError, match="names 3 files that are records of their own"):
        ep.open_field(pattern)


@pytest.mark.parametrize("names", [("probe1", "probe2", "probe3"), ("0", "1"), ("a/0", "b/1")])
def test_groups_of_kinds_are_no_steps(tmp_path: Path, names: tuple[str, ...]) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name in names:
            file[f"{name}/current"] = N_I[:, 0]
    found = ep.inspect_file(tmp_path / "a.h5")
    assert len(found.held) == len(names)


def test_numbered_groups_next_to_times_are_no_steps(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["time"] = T
        for k in range(4):
            file[f"charge/{k}/n"] = N_I[:, k]
    assert len(ep.inspect_file(tmp_path / "a.h5").variables) == 4
