"""Samples as a pandas table or an xarray Dataset, to go on with in other tools."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


def as_dataframe(
    t: Float[np.ndarray, " samples"],
    values: Float[np.ndarray, "samples variables"],
    names: Sequence[str],
) -> pd.DataFrame:
    """A column per variable, in SI, over an index `time` in s; `ep.discover` takes it as a run."""
    import pandas as pd  # takes time to import, and few ask for it

    return pd.DataFrame(values, index=pd.Index(t, name="time"), columns=list(names))


def as_dataset(
    t: Float[np.ndarray, " samples"],
    values: Float[np.ndarray, "samples variables"],
    names: Sequence[str],
    units: Mapping[str, str],
) -> xr.Dataset:
    """A variable for each name over the coordinate `time` in s, with its unit as an attribute."""
    import xarray as xr

    columns = zip(names, values.T, strict=True)
    return xr.Dataset(
        {name: ("time", column, {"units": units[name]}) for name, column in columns},
        coords={"time": ("time", t, {"units": "s"})},
    )
