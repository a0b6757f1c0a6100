"""Fields of a few numbers, for any test."""

from collections.abc import Mapping, Sequence

import numpy as np
import xarray as xr


def along_channel(
    time: np.ndarray, z: Sequence[float], columns: Mapping[str, tuple[np.ndarray, str]]
) -> xr.Dataset:
    """A field that is the same everywhere in a channel of 25 mm, from samples and units by name."""
    data = {
        name: (("time", "z"), np.outer(values, np.ones(len(z))), {"units": unit})
        for name, (values, unit) in columns.items()
    }
    axes = {"time": time, "z": np.asarray(z, dtype=np.float64)}
    return xr.Dataset(data, coords=axes, attrs={"channel_m": 0.025})
