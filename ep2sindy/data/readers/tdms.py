"""Reader of TDMS, the files that LabVIEW writes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from ep2sindy.data.readers.source import FileSource, Reader, counted_dates

STEP, UNIT = "wf_increment", "unit_string"  # properties of a channel: its step in s, its unit


def read_tdms(path: Path) -> FileSource:
    """Read the channels of a TDMS file; a name is "group/channel", or "channel" in a single group.

    The time step is the increment of the waveforms, if all of them have the same. Times of day are
    counted from the first one.
    """
    from nptdms import TdmsFile

    with TdmsFile.open(path) as file:
        groups = [group for group in file.groups() if group.channels()]
        channels = {
            channel.name if len(groups) == 1 else f"{group.name}/{channel.name}": channel
            for group in groups
            for channel in group.channels()
        }
        values = {name: np.asarray(channel[:]) for name, channel in channels.items()}
        said = {name: dict(channel.properties) for name, channel in channels.items()}

    def read(name: str) -> xr.DataArray:
        array = values[name]
        if array.dtype.kind == "M":
            return counted_dates(pd.Series(array))
        return xr.DataArray(array, attrs={"units": str(said[name].get(UNIT, ""))})

    steps = {float(of[STEP]) for of in said.values() if of.get(STEP)}
    return FileSource(
        path, [*values], read, words=f"{len(values)} channels", is_table=True,
        step_s=steps.pop() if len(steps) == 1 else None,
    )  # fmt: skip


TDMS = Reader("TDMS", read_tdms, first_bytes=(b"TDSm",), package="nptdms")
