"""Short and coarse simulations along the axis, for any test."""

from typing import Any

import xarray as xr

import ep2sindy as ep

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
