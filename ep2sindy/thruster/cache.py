"""Simulations kept on disk, named by a hash of everything that determines them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryFile

import xarray as xr
from tqdm import tqdm

from ep2sindy.data.netcdf import write_netcdf
from ep2sindy.runtime.files import fingerprint, sweep, writing
from ep2sindy.runtime.progress import Progress
from ep2sindy.runtime.screen import in_line, on_screen
from ep2sindy.thruster.axial.model import CFL
from ep2sindy.thruster.axial.settings import Settings, to_json
from ep2sindy.thruster.axial.simulate import as_start, simulate_as
from ep2sindy.thruster.axial.starts import Start
from ep2sindy.thruster.parameters import OperatingPoint, Thruster
from ep2sindy.trust.checksum import verified, with_checksum


def simulate_cached(
    thruster: Thruster,
    operating_point: OperatingPoint,
    *,
    cache: str | Path,
    duration_s: float = 18e-3,
    warm_up_s: float = 2e-3,
    sample_s: float = 1.5e-6,
    averaged: bool = True,
    n_cells: int = 100,
    stretch: float = 2.0,
    reconstruct: bool = True,
    cfl: float = CFL,
    coldest_T_e_eV: float = 0.0,
    initial: Start | xr.Dataset | str | Path | None = None,
    progress: Progress | bool = True,
) -> xr.Dataset:
    """Read this simulation from the folder `cache`, or run it once and keep it there.

    Arguments are those of `simulate`. The file name holds a hash of all parameters and of this
    package's source text, so a changed formula is never answered from an old file. Both ways
    return the same values. A file that cannot be read is reported, recomputed and replaced.
    Results appear under their final name only once complete. Raises OSError if the folder cannot
    be written.
    """
    start = as_start(initial)
    settings = Settings(
        duration_s, warm_up_s, sample_s, averaged, n_cells, stretch, reconstruct, cfl,
        coldest_T_e_eV,
    )  # fmt: skip
    parameters = {
        "thruster": thruster, "operating_point": operating_point, "settings": settings,
        "initial": start.label,
    }  # fmt: skip
    return kept(
        Path(cache) / f"thruster_{operating_point.label}",
        to_json(parameters),
        partial(simulate_as, settings, thruster, operating_point, start, progress=progress),
    )


def kept(stem: Path, parameters: str, run: Callable[[], xr.Dataset]) -> xr.Dataset:
    """What `run` returns, read from the file that is named by a stem and a hash, or run and kept.

    The file says what it was made of and holds a checksum; one that does not fit is run again.
    Raises OSError if the folder cannot be written, before anything runs.
    """
    key = fingerprint(parameters, sources=Path(__file__).parent)
    path = stem.with_name(f"{stem.name}_{key}.nc")
    if path.exists():
        try:
            return verified(read(path), parameters)
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            with on_screen(sys.stdout):
                tqdm.write(in_line(f"{path} cannot be read ({error}); simulating it again"))
    with writing(path.parent):  # now, not after the simulation
        path.parent.mkdir(parents=True, exist_ok=True)
        sweep(path.parent)
        with TemporaryFile(dir=path.parent):
            pass
    field = run()
    write(with_checksum(field, parameters), path)
    return field


def read(path: Path) -> xr.Dataset:
    """Load a kept result into memory; raises OSError, ValueError or KeyError if damaged."""
    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as stored:
        field = stored.load()
    field.attrs["parameters"]  # written last: a file without it is incomplete
    return field


def write(field: xr.Dataset, path: Path) -> None:
    """Write compressed, whole or not at all."""
    compressed = {
        str(variable): {"zlib": True, "complevel": 1, "shuffle": True}
        for variable in field.data_vars
    }
    write_netcdf(field, path, encoding=compressed)
