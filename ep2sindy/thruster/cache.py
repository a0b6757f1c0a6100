"""Simulations kept on disk, named by a hash of everything that determines them."""

from __future__ import annotations

from pathlib import Path

import xarray as xr
from tqdm import tqdm

from ep2sindy.machine.files import fingerprint, replacing
from ep2sindy.thruster.parameters import OperatingPoint, Thruster
from ep2sindy.thruster.simulate import simulate, to_json


def simulate_cached(
    thruster: Thruster,
    operating_point: OperatingPoint,
    *,
    cache: str | Path,
    duration_s: float = 18e-3,
    warm_up_s: float = 2e-3,
    sample_s: float = 1.5e-6,
    n_cells: int = 100,
    progress: bool = True,
) -> xr.Dataset:
    """Read this simulation from the folder `cache`, or run it once and keep it there.

    The file name holds a hash of all parameters and of this package's source text, so a
    changed formula is never answered from an old file. Both ways return the same values.
    A file that cannot be read is reported, recomputed and replaced. Results appear under
    their final name only once complete. Raises OSError if the folder cannot be written.
    """
    settings = {
        "duration_s": duration_s, "warm_up_s": warm_up_s, "sample_s": sample_s, "n_cells": n_cells,
    }  # fmt: skip
    parameters = {"thruster": thruster, "operating_point": operating_point, "settings": settings}
    key = fingerprint(to_json(parameters), sources=Path(__file__).parent)
    path = Path(cache) / f"thruster_{operating_point.label}_{key}.nc"
    if path.exists():
        try:
            return read(path)
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            tqdm.write(f"{path} cannot be read ({error}); simulating it again")
    try:  # now, not after the simulation
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OSError(
            f"simulations need a folder they can be kept in: {path.parent} failed with "
            f"{error.strerror!r}; choose another cache"
        ) from error
    field = simulate(
        thruster,
        operating_point,
        duration_s=duration_s,
        warm_up_s=warm_up_s,
        sample_s=sample_s,
        n_cells=n_cells,
        progress=progress,
    )
    write(field, path)
    return field


def read(path: Path) -> xr.Dataset:
    """Load a kept result into memory; raises OSError, ValueError or KeyError if damaged."""
    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as stored:
        field = stored.load()
    field.attrs["parameters"]  # written last: a file without it is incomplete
    return field


def write(field: xr.Dataset, path: Path) -> None:
    """Write compressed, whole or not at all."""
    compressed = {str(variable): {"zlib": True, "complevel": 4} for variable in field.data_vars}
    with replacing(path) as temporary:
        field.to_netcdf(temporary, engine="h5netcdf", encoding=compressed)
