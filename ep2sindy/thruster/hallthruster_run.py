"""Simulate what an input file of HallThruster.jl describes."""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from ep2sindy.runtime.progress import Progress
from ep2sindy.thruster.axial.simulate import simulate
from ep2sindy.thruster.hallthruster_input import read_hallthruster_input


def simulate_hallthruster_input(
    path: str | Path,
    *,
    cache: str | Path | None = None,
    duration_s: float | None = None,
    warm_up_s: float = 0.0,
    sample_s: float | None = None,
    n_cells: int | None = None,
    progress: Progress | bool = True,
) -> xr.Dataset:
    """Run the thruster of an input file by this package's own simulator, or read the kept run.

    What is None is as the file says: its duration, its frames, its cells.
    Raises ValueError for what the file asks for and this simulator has not; see
    `read_hallthruster_input`.
    """
    given = read_hallthruster_input(path)
    if n_cells is None and not given.run.even_grid:
        raise ValueError(
            f"{path}: simulation.grid must be an EvenGrid here; n_cells={given.run.n_cells} takes "
            "one of as many cells"
        )
    return simulate(
        given.thruster,
        given.operating_point,
        cache=cache,
        duration_s=given.run.duration_s if duration_s is None else duration_s,
        warm_up_s=warm_up_s,
        sample_s=given.run.sample_s if sample_s is None else sample_s,
        n_cells=given.run.n_cells if n_cells is None else n_cells,
        stretch=1.0,  # their EvenGrid
        reconstruct=given.run.reconstruct,
        coldest_T_e_eV=given.run.coldest_T_e_eV,
        progress=progress,
    )
