"""The plasma's cross-section beyond the exit: how an axial model lets the beam spread.

Both plumes spread between two cones: at a distance x beyond the exit, the outer radius has grown by
h and the inner one has shrunk by h, to zero at least, where dh/dx is the tangent of the half-angle
there. They share `tangents`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster.constants import E_CHARGE

MAX_HALF_ANGLE_DEG = 45.0  # a wider beam is no longer described along its axis

Profile = Float[np.ndarray, " z"]


@dataclass(frozen=True)
class ConicalPlume:
    """A plume of one half-angle.

    Parameters
    ----------
    half_angle_deg : float
        Half-angle in degrees, 0 to 45.
    axial_thrust : bool, default True
        True counts only the axial part of the ions' momentum as thrust, cos(angle) A sum(m n u^2)
        at the cathode plane; False counts all of it. True is right where the ions' speed stands for
        the whole drop of the potential, as in every 1-D model. HallThruster.jl
        (apply_thrust_divergence_correction) has the same factor and takes False unless set.

    Raises
    ------
    ValueError
        If the angle is out of range.
    """

    half_angle_deg: float
    axial_thrust: bool = True

    def __post_init__(self) -> None:
        if not 0.0 <= self.half_angle_deg <= MAX_HALF_ANGLE_DEG:
            raise ValueError(
                f"ConicalPlume.half_angle_deg must be from 0 to {MAX_HALF_ANGLE_DEG:g}, got "
                f"{self.half_angle_deg!r}; give the beam's half-angle in degrees"
            )

    def tangents(self, u_i: Profile, *, exit_T_e_eV: float, ion_mass: float) -> Profile:
        """Tangent of the half-angle, the same everywhere."""
        return np.full_like(u_i, math.tan(math.radians(self.half_angle_deg)))


@dataclass(frozen=True)
class ThermalPlume:
    """A plume that spreads by the ions' sound speed at the exit over their speed at each place.

    Parameters
    ----------
    axial_thrust : bool, default True
        As for `ConicalPlume`, with the half-angle at the cathode plane.

    Notes
    -----
    The tangent of the half-angle is

        min(1, sqrt(5 e T_e / (3 m)) / u_i)

    with T_e at the exit. Slower ions and those that move back spread by 45 degrees. u_i is the mean
    over the charges, weighted by density.

    Source: the plume of HallThruster.jl, Marks et al., JOSS 8 (2023) 4672; its older versions hold
    the tangent at pi/4 or not at all.
    """

    axial_thrust: bool = True

    def tangents(self, u_i: Profile, *, exit_T_e_eV: float, ion_mass: float) -> Profile:
        """Tangent of the half-angle at each place, for u_i in m/s and an ion mass in kg."""
        sound = math.sqrt(5.0 * E_CHARGE * exit_T_e_eV / (3.0 * ion_mass))
        return sound / np.maximum(u_i, sound)


Plume = ConicalPlume | ThermalPlume


def relative_area(
    distance: Profile, tangents: Profile, *, inner_radius: float, outer_radius: float
) -> Profile:
    """Cross-section over that of the channel, A(z)/A_channel.

    distance: of increasing places from the exit in m, negative inside, where the result is 1.
    tangents: of the half-angle at these places; linear between them, and constant from the exit to
    the first place beyond it. Radii of the channel in m.
    """
    beyond = np.maximum(distance, 0.0)
    before = np.where(distance > 0.0, tangents, 0.0)
    before[1:] = np.where(distance[:-1] > 0.0, tangents[:-1], tangents[1:])
    growth = np.cumsum(0.5 * (before + tangents) * np.diff(beyond, prepend=0.0))
    inner = np.maximum(inner_radius - growth, 0.0)
    return ((outer_radius + growth) ** 2 - inner**2) / (outer_radius**2 - inner_radius**2)
