"""Zarr stores."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from ep2sindy.data.readers.source import UNDECODED, Reader, Source, dataset_source


def read_zarr(path: Path) -> Source:
    """Zarr store in a folder, with named dimensions as xarray writes it; read when asked for."""
    return dataset_source(
        path, xr.open_dataset(path, engine="zarr", consolidated=False, **UNDECODED)
    )


ZARR = Reader("Zarr", read_zarr, form="folder", endings=(".zarr",))
