"""Short and coarse simulations along the axis, and tables of closures, for any test."""

from typing import Any

import numpy as np
import xarray as xr

import ep2sindy as ep
from ep2sindy.thruster.closures import TABLE_STEP_EV

POINT = ep.thruster.OperatingPoint(300.0, 5.0)


def brief(
    thruster: ep.thruster.Thruster | None = None,
    point: ep.thruster.OperatingPoint = POINT,
    **settings: Any,
) -> xr.Dataset:
    """0.3 ms of the default discharge on 40 equal cells, or what these settings change of it."""
    ours = {"duration_s": 3e-4, "warm_up_s": 1e-4, "n_cells": 40, "stretch": 1.0}
    return ep.thruster.simulate(
        thruster or ep.thruster.Thruster(), point, **(ours | settings), progress=False
    )


def at(table: np.ndarray, column: int, T: np.ndarray) -> np.ndarray:
    """A column of a table of closures at some temperatures."""
    return np.interp(T, TABLE_STEP_EV * np.arange(len(table)), table[:, column])


def slope_at(table: np.ndarray, column: int, T: np.ndarray) -> np.ndarray:
    """Slope of a column there, per eV."""
    row = (T / TABLE_STEP_EV).astype(int)
    return (table[row + 1, column] - table[row, column]) / TABLE_STEP_EV
