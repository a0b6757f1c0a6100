"""What a finished (z, r) run did: its verdict, current, frequency and mass balance."""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr

from ep2sindy.thruster.parameters import OperatingPoint
from ep2sindy.thruster.verdict import diagnose as diagnose_current
from ep2sindy.thruster.verdict import performance


def diagnose(field: xr.Dataset, point: OperatingPoint, *, diverged: bool) -> dict[str, Any]:
    """Status, cycle, frequency, current, performance and mass balance."""
    found = {"initial": "guessed profiles", **diagnose_current(field, diverged=diverged)}
    if field.sizes["time"] > 1:
        mean = {name: float(field[name].mean()) for name in ("I_d", "V_d", "thrust")}
        found |= performance(
            point, thrust_N=mean["thrust"], current_A=mean["I_d"], voltage_V=mean["V_d"]
        )
        found["mass_balance"] = mass_balance(field, point)
    return found


def mass_balance(field: xr.Dataset, point: OperatingPoint) -> float:
    """Xenon that left plus xenon that accumulated, over xenon that entered."""
    ends = field[["mass_out", "mass_held"]].isel(time=[0, -1])
    left, accumulated = (float(np.diff(ends[name])[0]) for name in ("mass_out", "mass_held"))
    entered = 1e-6 * point.mass_flow_mg_s * float(field["time"][-1] - field["time"][0])
    return (left + accumulated) / entered
