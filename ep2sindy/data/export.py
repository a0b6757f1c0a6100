"""Samples as a pandas table or an xarray Dataset, to go on with in other tools."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from ep2sindy.library.units import Clock

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

CLOCK = "read_in"  # attribute of the time coordinate: the unit in which times are displayed


def as_dataframe(
    t: Float[np.ndarray, " samples"],
    values: Float[np.ndarray, "samples variables"],
    names: Sequence[str],
) -> pd.DataFrame:
    """A column per variable, in SI, over an index `time_s`; `ep.discover` takes it as a run."""
    import pandas as pd  # takes time to import, and few ask for it

    return pd.DataFrame(values, index=pd.Index(t, name="time_s"), columns=list(names))


def as_dataset(
    t: Float[np.ndarray, " samples"],
    values: Float[np.ndarray, "samples variables"],
    names: Sequence[str],
    units: Mapping[str, str],
    clock: Clock,
) -> xr.Dataset:
    """A variable for each name over `time` in s, with units and the clock's as attributes."""
    import xarray as xr

    columns = zip(names, values.T, strict=True)
    return xr.Dataset(
        {name: ("time", column, {"units": units[name]}) for name, column in columns},
        coords={"time": ("time", t, {"units": "s", CLOCK: clock.unit})},
    )
