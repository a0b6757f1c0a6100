"""The masked (z, r) grid: a channel between two walls, and a wider plume."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.thruster.parameters import Thruster

CHANNEL_FRACTION = 25 / 49  # fraction of the rows in the channel
MIN_CELLS = 10


@dataclass(frozen=True)
class MaskedGrid:
    """Equal cells in z and r; rows beyond the channel's walls hold plasma in the plume only.

    About half of the rows (25 of 49) lie in the channel, the others equally on both sides. plane:
    makes all radial faces as large as at mid radius, for cases that must be symmetric about it.
    Cells whose centre lies beyond the exit belong to the plume.
    """

    thruster: Thruster
    n_z: int
    n_r: int
    plane: bool = False

    def __post_init__(self) -> None:
        for name in ("n_z", "n_r"):
            if getattr(self, name) < MIN_CELLS:
                raise ValueError(
                    f"{name} must be {MIN_CELLS} or more to resolve the channel, got "
                    f"{getattr(self, name)}"
                )
        if self.r_faces[0] <= 0.0:
            raise ValueError(
                f"the plume must end before the axis: {self.n_side} rows of {self.dr:g} m below "
                f"the inner radius of {self.thruster.inner_radius:g} m pass it; the (z, r) model "
                "needs a wider channel about a thicker centre"
            )

    @property
    def dz(self) -> float:
        return self.thruster.domain_length / self.n_z

    @property
    def n_side(self) -> int:
        """Rows of the plume on either side of the channel's rows."""
        return round(self.n_r * (1.0 - CHANNEL_FRACTION) / 2.0)

    @property
    def dr(self) -> float:
        return self.thruster.gap / (self.n_r - 2 * self.n_side)

    @property
    def exit_column(self) -> int:
        """The first column of the plume."""
        return math.floor(self.thruster.channel_length / self.dz + 0.5)

    @property
    def z(self) -> Float[np.ndarray, " z"]:
        """Axial centres of the cells in m, from the anode."""
        return (np.arange(self.n_z) + 0.5) * self.dz

    @property
    def r_faces(self) -> Float[np.ndarray, " faces"]:
        """Radii of the faces in m, from the innermost."""
        steps = np.arange(self.n_r + 1) - self.n_side
        return self.thruster.inner_radius + steps * self.dr

    @property
    def r(self) -> Float[np.ndarray, " r"]:
        """Radial centres of the cells in m."""
        return 0.5 * (self.r_faces[1:] + self.r_faces[:-1])

    @property
    def perimeter(self) -> Float[np.ndarray, " faces"]:
        """Area of a radial face per length along z, in m."""
        middle = 0.5 * (self.thruster.inner_radius + self.thruster.outer_radius)
        radii = np.full(self.n_r + 1, middle) if self.plane else self.r_faces
        return 2.0 * np.pi * radii

    @property
    def area(self) -> Float[np.ndarray, " r"]:
        """Cross-section of a row in m^2."""
        return 0.5 * (self.perimeter[1:] + self.perimeter[:-1]) * self.dr

    @property
    def lower(self) -> Int[np.ndarray, " z"]:
        """First row of the plasma in every column."""
        return np.where(np.arange(self.n_z) < self.exit_column, self.n_side, 0)

    @property
    def upper(self) -> Int[np.ndarray, " z"]:
        """One past the last row of the plasma in every column."""
        return self.n_r - self.lower

    @property
    def plasma(self) -> Bool[np.ndarray, "z r"]:
        """Cells that hold plasma; the others are the thruster's body."""
        row = np.arange(self.n_r)
        return (row >= self.lower[:, None]) & (row < self.upper[:, None])
