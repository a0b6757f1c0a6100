"""Simulations kept on disk; the file name holds a hash of everything that determines them."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import xarray as xr
from tqdm import tqdm

from ep2sindy.data.fields import write_netcdf
from ep2sindy.runtime.files import cache_folder, fingerprint, sweep, writing
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.screen import in_line, on_screen
from ep2sindy.signals import spectrum
from ep2sindy.thruster.axial.settings import to_json

MADE_OF = "kept_for"  # attribute: the parameters of a kept result

# Source text on which a kept result depends: this subpackage, and what sets the status of a record.
SOURCES = [Path(__file__).parent, Path(str(spectrum.__file__))]


def read_or_run(
    cache: str | Path | bool | None, name: str, parameters: dict[str, Any],
    run: Callable[[], xr.Dataset], progress: Progress | bool,
) -> xr.Dataset:  # fmt: skip
    """The result of `run`, read from a file in the folder `cache`, or run and kept there.

    True: the user's own folder; where there is none, this is reported, and nothing is kept. None or
    False: nothing is kept. The hash in the file's name covers all parameters and the
    source text of SOURCES, so that a changed formula never returns an old result. Both ways return
    the same values. The file states its parameters, and HDF5 checks its values by checksums. A file
    that does not match, or cannot be read, is reported, recomputed and replaced. Results appear
    under their final name only once complete. Raises OSError if the folder cannot be written,
    before anything runs.
    """
    folder = _folder(cache)
    if folder is None:
        return run()
    text = to_json(parameters)
    path = folder / f"{name}_{fingerprint(text, sources=SOURCES)}.nc"
    if path.exists():
        try:
            return _of(read(path), text)
        except (OSError, ValueError, KeyError, RuntimeError) as error:
            _report(f"{path} cannot be read ({error}); simulating it again")
    with writing(path.parent):  # checked now, not after the simulation
        path.parent.mkdir(parents=True, exist_ok=True)
        sweep(path.parent)
        with TemporaryFile(dir=path.parent):
            pass
    field = run()
    with as_progress(progress).stage(None, "", "keeping the simulation"):
        write(field.assign_attrs({MADE_OF: text}), path)
    return field


def _folder(cache: str | Path | bool | None) -> Path | None:
    """The folder that `cache` means, or None where nothing is kept."""
    if cache is not True:
        return Path(cache) if cache else None
    try:
        return cache_folder("simulations", fingerprint("", sources=SOURCES))
    except OSError as error:
        _report(f"the simulation is not kept: {error}")
        return None


def _report(text: str) -> None:
    with on_screen(sys.stdout):
        tqdm.write(in_line(text))


def _of(stored: xr.Dataset, parameters: str) -> xr.Dataset:
    """A kept result; raises ValueError if it was computed from other parameters."""
    if stored.attrs.pop(MADE_OF, "") != parameters:
        raise ValueError("it is of other parameters")
    return stored.drop_attrs(deep=False).assign_attrs(stored.attrs)


def read(path: Path) -> xr.Dataset:
    """Load a kept result into memory; raises OSError, ValueError or KeyError if it is damaged."""
    with xr.open_dataset(path, engine="h5netcdf", decode_times=False) as stored:
        field = stored.load()
    field.attrs["parameters"]  # written last: a file without it is incomplete
    return field


def write(field: xr.Dataset, path: Path) -> None:
    """Write a file with checksums, completely or not at all.

    It is not compressed: that would save a third of the space, for twice the time.
    """
    checked = {str(variable): {"fletcher32": True} for variable in field.data_vars}
    write_netcdf(field, path, encoding=checked)
