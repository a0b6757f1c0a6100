"""Simulations in (z, r) kept on disk."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import xarray as xr

from ep2sindy.runtime.progress import Progress
from ep2sindy.thruster.axial.settings import to_json
from ep2sindy.thruster.cache import kept
from ep2sindy.thruster.parameters import OperatingPoint, Thruster
from ep2sindy.thruster.plane.simulate import OPERATING_POINT_2D, THRUSTER_2D, simulate_2d


def simulate_2d_cached(
    thruster: Thruster = THRUSTER_2D,
    operating_point: OperatingPoint = OPERATING_POINT_2D,
    *,
    cache: str | Path,
    duration_s: float = 18e-3,
    warm_up_s: float = 2e-3,
    sample_s: float = 1.5e-6,
    n_z: int = 41,
    n_r: int = 49,
    averaged: bool = True,
    progress: Progress | bool = True,
) -> xr.Dataset:
    """Read this simulation from the folder `cache`, or run it once and keep it there.

    As `simulate_cached` does for one axis; the defaults' file takes some 300 MB.
    """
    settings: dict[str, Any] = {
        "duration_s": duration_s, "warm_up_s": warm_up_s, "sample_s": sample_s,
        "n_z": n_z, "n_r": n_r, "averaged": averaged,
    }  # fmt: skip
    parameters = {"thruster": thruster, "operating_point": operating_point, "settings": settings}
    return kept(
        Path(cache) / f"plane_{operating_point.label}",
        to_json(parameters),
        partial(simulate_2d, thruster, operating_point, **settings, progress=progress),
    )
