"""Channel walls and the anode: losses of electrons and ions to them, with published sources."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster.checks import check_not_negative, check_positive, check_range
from ep2sindy.thruster.constants import E_CHARGE, M_ELECTRON

SHEATH_DENSITY_RATIO = 0.4965  # edge over mean density, 0.86 / sqrt(3) (Marks et al. 2023)

# Secondary emission: yield at zero energy, and mean energy 1.5 T_e (eV) at which it reaches one
# (linear fits of Marks et al., JOSS 8 (2023) 4672, HallThruster.jl v0.22). Goebel & Katz,
# chapter 7, give power laws of the same measurements.
MATERIALS: dict[str, tuple[float, float]] = {
    "BN-SiO2": (0.54, 40.0),
    "BN": (0.24, 45.0),
    "alumina": (0.57, 22.0),
    "SiC": (0.69, 43.0),
    "SiO2": (0.50, 18.0),
}

FloatArray = Float[np.ndarray, "..."] | np.float64


def fraction(
    distance: Float[np.ndarray, " z"], channel: float, plume: float, transition: float
) -> Float[np.ndarray, " z"]:
    """From `channel` to `plume` across the exit: a step, or linear over `transition` in m."""
    if transition == 0.0:
        return np.where(distance < 0.0, channel, plume)
    return channel + (plume - channel) * np.clip(distance / transition + 0.5, 0.0, 1.0)


@runtime_checkable
class Wall(Protocol):
    """What a wall takes: per electron by T_e, and the fractions at distances from the exit in m."""

    def ion_loss(self, T_e_eV: FloatArray, gap: float, ion_mass: float) -> FloatArray: ...
    def collision(self, T_e_eV: FloatArray, gap: float, ion_mass: float) -> FloatArray: ...
    def power(self, T_e_eV: FloatArray, gap: float, ion_mass: float) -> FloatArray: ...
    def ion_weight(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]: ...
    def collision_weight(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]: ...
    def power_weight(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]: ...


@dataclass(frozen=True)
class SheathWall:
    """Dielectric channel wall behind a sheath, with linear secondary-electron emission.

    The default is BN-SiO2. Beyond the exit, ions are not lost.

    Parameters
    ----------
    yield_0 : float, default 0.54
        Emission at zero temperature, below 1.
    crossover_eV : float, default 40.0
        Energy at which one electron is emitted per electron, in eV.
    electron_scale : float, default 0.9
        Factor on the collisions of electrons with the wall.
    ion_scale : float, default 0.5
        Factor on the loss of ions.
    plume_collisions : float, default 1.0
        Fraction of the collisions that remains beyond the exit.
    plume_power : float, default 1.0
        Fraction of the power loss that remains beyond the exit.
    transition : float, default 0.0
        Length in m over which the fractions change at the exit.
    shielded_T_e_eV : float, optional
        Temperature at the walls of a magnetically shielded thruster, whose field lines bring the
        anode's cold electrons there. It replaces T_e in all losses. None means that the thruster is
        not shielded.

    Raises
    ------
    ValueError
        If a number has the wrong sign, or yield_0 is not below 1.

    Notes
    -----
    With the electron temperature T_e in eV and the ion mass m,

        gamma = min(1 - 8.3 sqrt(m_e / m), yield_0 + (1 - yield_0) 1.5 T_e / crossover_eV)
        nu_w = electron_scale 0.4965 sqrt(e T_e / m) / (gap (1 - gamma))
        phi_w = T_e ln((1 - gamma) sqrt(m / (2 pi m_e)))

    gamma is the emission, held at the space-charge limit; electrons collide with the wall at nu_w,
    and each collision costs 2 T_e + (1 - gamma) phi_w.

    Source: Marks et al., JOSS 8 (2023) 4672; Goebel & Katz, chapter 7.
    """

    yield_0: float = 0.54
    crossover_eV: float = 40.0
    electron_scale: float = 0.9
    ion_scale: float = 0.5
    plume_collisions: float = 1.0
    plume_power: float = 1.0
    transition: float = 0.0  # m
    shielded_T_e_eV: float | None = None

    def __post_init__(self) -> None:
        check_positive(self, "crossover_eV")
        if self.shielded_T_e_eV is not None:
            check_positive(self, "shielded_T_e_eV")
        check_not_negative(
            self, "yield_0", "electron_scale", "ion_scale", "plume_collisions", "plume_power",
            "transition",
        )  # fmt: skip
        check_range(self, "below 1", lambda value: value < 1.0, "yield_0")

    def emission(self, T_e_eV: FloatArray, ion_mass: float) -> FloatArray:
        """Secondary electrons per primary, held at the space-charge limit."""
        limit = 1.0 - 8.3 * np.sqrt(M_ELECTRON / ion_mass)
        linear = self.yield_0 + (1.0 - self.yield_0) * 1.5 * T_e_eV / self.crossover_eV
        return np.minimum(limit, linear)

    def _at_wall(self, T_e_eV: FloatArray) -> FloatArray:
        """Temperature of the electrons that reach the wall."""
        if self.shielded_T_e_eV is None:
            return T_e_eV
        return np.full_like(T_e_eV, self.shielded_T_e_eV)

    def ion_loss(self, T_e_eV: FloatArray, gap: float, ion_mass: float) -> FloatArray:
        """Frequency at which an ion reaches the wall, in 1/s; gap: channel width in m."""
        bohm = np.sqrt(E_CHARGE * self._at_wall(T_e_eV) / ion_mass)
        return self.ion_scale * SHEATH_DENSITY_RATIO * bohm / gap

    def collision(self, T_e_eV: FloatArray, gap: float, ion_mass: float) -> FloatArray:
        """Frequency at which an electron reaches the wall, in 1/s."""
        T = self._at_wall(T_e_eV)
        arriving = self.electron_scale * SHEATH_DENSITY_RATIO * np.sqrt(E_CHARGE * T / ion_mass)
        return arriving / gap / (1.0 - self.emission(T, ion_mass))

    def power(self, T_e_eV: FloatArray, gap: float, ion_mass: float) -> FloatArray:
        """Power lost to the wall per electron, in eV/s."""
        T = self._at_wall(T_e_eV)
        kept = 1.0 - self.emission(T, ion_mass)
        sheath = T * np.log(kept * np.sqrt(ion_mass / (2.0 * np.pi * M_ELECTRON)))
        return self.collision(T, gap, ion_mass) * (2.0 * T + kept * sheath)

    def ion_weight(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Fraction of the ion loss at a distance from the exit in m, negative inside."""
        return fraction(distance, 1.0, 0.0, self.transition)

    def collision_weight(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Fraction of the electrons' wall collisions at a distance from the exit in m."""
        return fraction(distance, 1.0, self.plume_collisions, self.transition)

    def power_weight(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Fraction of the power loss at a distance from the exit in m."""
        return fraction(distance, 1.0, self.plume_power, self.transition)


def wall_material(
    name: str,
    *,
    electron_scale: float = 0.9,
    ion_scale: float = 0.5,
    plume_collisions: float = 1.0,
    plume_power: float = 1.0,
    transition: float = 0.0,
    shielded_T_e_eV: float | None = None,
) -> SheathWall:
    """A wall of a named material, as a `SheathWall`.

    Parameters
    ----------
    name : str
        BN-SiO2, BN, alumina, SiC or SiO2.
    electron_scale : float, default 0.9
        Factor on the collisions of electrons with the wall.
    ion_scale : float, default 0.5
        Factor on the loss of ions.
    plume_collisions : float, default 1.0
        Fraction of the collisions that remains beyond the exit.
    plume_power : float, default 1.0
        Fraction of the power loss that remains beyond the exit.
    transition : float, default 0.0
        Length in m over which the fractions change at the exit.
    shielded_T_e_eV : float, optional
        Temperature at the walls of a magnetically shielded thruster in eV. None means not shielded.

    Returns
    -------
    SheathWall
        The wall.

    Raises
    ------
    ValueError
        If the material is unknown.
    """
    if name not in MATERIALS:
        raise ValueError(
            f"there are walls of {list(MATERIALS)}, got {name!r}; another material is "
            "ep2sindy.thruster.SheathWall(yield_0=..., crossover_eV=...)"
        )
    yield_0, crossover_eV = MATERIALS[name]
    return SheathWall(
        yield_0, crossover_eV, electron_scale, ion_scale, plume_collisions, plume_power, transition,
        shielded_T_e_eV,
    )  # fmt: skip


@dataclass(frozen=True)
class FixedAnode:
    """An anode with a fixed electron temperature at its face and no sheath drop.

    Parameters
    ----------
    T_e_eV : float, default 3.0
        Electron temperature in eV.

    Raises
    ------
    ValueError
        If the temperature is not positive.
    """

    T_e_eV: float = 3.0

    def __post_init__(self) -> None:
        check_positive(self, "T_e_eV")


@dataclass(frozen=True)
class AnodeSheath:
    """An anode sheath that transmits just the electrons that the current needs.

    The temperature has no gradient at the face, unless electrons leave the anode.

    Parameters
    ----------
    T_e_eV : float, default 2.0
        Temperature in eV of electrons that leave the anode, and of the first guess.
    potential_weight : float, default 1.0
        Weight of V_s in the heat that each electron removes, 2 T + potential_weight V_s. 1 is that
        of Maxwellian electrons that climb the sheath; HallThruster.jl v0.22 takes 2.

    Raises
    ------
    ValueError
        If the temperature is not positive, or the weight is negative.

    Notes
    -----
    With n, T and j_i at the face and j_e = I_d/A - j_i, the thermal flux of electrons to the anode
    would be j_th; the sheath repels the excess:

        j_th = e n sqrt(8 e T / (pi m_e)) / 4
        V_s = -T ln(min(1, j_e / j_th)), and 0 where j_e <= 0

    The potential of the plasma at the face is then V_0 + V_s, that is V_s above the anode. Ions
    leave at this speed or faster, with T of the first cell and x = V_s/T:

        sqrt((e T + k T_i) / m) / sqrt(1 + chi)
        chi = exp(-x) / (sqrt(pi x) (1 + erf(sqrt(x))))

    Source: Goebel & Katz, chapter 7; Hara, Plasma Sources Sci. Technol. 28 (2019) 044001.
    """

    T_e_eV: float = 2.0  # temperature of electrons from the anode, and of the first guess
    potential_weight: float = 1.0

    def __post_init__(self) -> None:
        check_positive(self, "T_e_eV")
        check_not_negative(self, "potential_weight")


Anode = FixedAnode | AnodeSheath
