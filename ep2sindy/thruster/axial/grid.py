"""Cells along the axis: all of one length, or longer in the plume, where ions are fast."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster.parameters import Thruster

FEWEST_CELLS = 10
CENTRE_M, WIDTH_M = 12e-3, 4e-3  # beyond the exit; of the passage from short to long cells


def cell_faces(thruster: Thruster, n_cells: int, stretch: float) -> Float[np.ndarray, " faces"]:
    """Places of the faces in m, from the anode to the cathode plane.

    stretch: length of the plume's cells over that of the channel's; 1 makes all alike. The time
    step is that of the ions' fastest passage through a cell, so that longer cells in the plume
    take fewer steps for as many cells in all.
    Raises ValueError for fewer than ten cells, or a stretch below 1.
    """
    if n_cells < FEWEST_CELLS:
        raise ValueError(
            f"n_cells must be {FEWEST_CELLS} or more to resolve the channel, got {n_cells}"
        )
    if not 1.0 <= stretch <= 10.0:
        raise ValueError(f"stretch must be between 1 (cells of one length) and 10, got {stretch!r}")
    if stretch == 1.0:
        return np.linspace(0.0, thruster.domain_length, n_cells + 1)
    z = np.linspace(0.0, thruster.domain_length, 20 * n_cells + 1)
    beyond = 0.5 * (z[1:] + z[:-1]) - thruster.channel_length - CENTRE_M
    length = 1.0 + (stretch - 1.0) * 0.5 * (1.0 + np.tanh(beyond / WIDTH_M))
    number = np.concatenate([[0.0], np.cumsum(np.diff(z) / length)])
    return np.interp(np.linspace(0.0, number[-1], n_cells + 1), number, z)
