"""Tables as text."""

from __future__ import annotations

from pathlib import Path

import pandas as pd
import xarray as xr

from ep2sindy.data.readers.source import Reader, Source


def read_csv(path: Path) -> Source:
    """CSV with a header line of names, one row per sample; lines from # on are left out."""
    frame = pd.read_csv(path, comment="#", skipinitialspace=True)
    frame.columns = frame.columns.str.strip()
    return Source(path, [*map(str, frame)], lambda name: xr.DataArray(frame[name].to_numpy()))


CSV = Reader("CSV", read_csv, form="other", endings=(".csv",))
