"""The LANDMARK benchmark's 1-D fluid cases (test case 3), for verification.

The benchmark's closures differ from the default set: mean-energy pressure p_e = n eps,
conductivity (10/9) mu n eps, a constant sheath loss, ions born at rest, and a rate table that its
authors distribute (landmark-plasma.com); the table is the caller's to supply.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster.parameters import OperatingPoint, Thruster
from ep2sindy.thruster.propellants import FloatArray, XenonFits
from ep2sindy.thruster.transport import AnomalousTransport
from ep2sindy.thruster.walls import FixedAnode, fraction

ALPHA_CHANNEL = {1: 1.0, 2: 0.5, 3: 0.4}  # energy-loss coefficient by case; 1 in the plume
FREQUENCY = 1e7  # 1/s, of collisions with the wall
LANDMARK_POINT = OperatingPoint(300.0, 5.0, neutral_speed=150.0)


@dataclass(frozen=True, kw_only=True)
class TabulatedRates(XenonFits):
    """Xenon by a table over the mean energy 1.5 T_e in place of formulas, as defined by LANDMARK.

    mean_energy_eV: increasing. ionization_rate: m^3/s. energy_loss_rate: eV m^3/s. elastic_rate:
    constant momentum transfer, m^3/s. Coulomb collisions and the drift energy K are left out. Below
    the first row both coefficients fall to zero linearly; beyond the last row they are constant, as
    the benchmark's authors use them.
    """

    mean_energy_eV: tuple[float, ...]
    ionization_rate: tuple[float, ...]
    energy_loss_rate: tuple[float, ...]
    elastic_rate: float = 2.5e-13  # LANDMARK test case 3
    drift_weight: float = 0.0

    def _interpolate(self, T_e_eV: FloatArray, values: tuple[float, ...]) -> FloatArray:
        return np.interp(1.5 * T_e_eV, (0.0, *self.mean_energy_eV), (0.0, *values))

    def ionization(self, T_e_eV: FloatArray) -> FloatArray:
        """Rate coefficient in m^3/s."""
        return self._interpolate(T_e_eV, self.ionization_rate)

    def energy_loss(self, T_e_eV: FloatArray) -> FloatArray:
        """Energy lost in all inelastic collisions, in eV m^3/s."""
        return self._interpolate(T_e_eV, self.energy_loss_rate)

    def events(self, T_e_eV: FloatArray) -> FloatArray:
        """Zero: LANDMARK's constant momentum transfer includes all collisions."""
        return np.zeros_like(T_e_eV)

    def momentum(self, T_e_eV: FloatArray) -> FloatArray:
        """Momentum lost to neutrals, in m^3/s."""
        return np.full_like(T_e_eV, self.elastic_rate)

    def coulomb(self, T_e_eV: FloatArray) -> FloatArray:
        """Zero: this closure has no Coulomb collisions."""
        return np.zeros_like(T_e_eV)


@dataclass(frozen=True)
class ExponentialWall:
    """Wall loss 1e7 alpha eps exp(-U/eps) with eps = 1.5 T_e, as LANDMARK defines it at U = 20 V.

    alpha: in the channel and in the plume. Electrons collide with the channel wall at 1e7 1/s; ions
    never do. transition: as for `SheathWall`, in m. Source: LANDMARK, test case 3.
    """

    alpha: tuple[float, float]
    sheath_V: float = 20.0
    transition: float = 0.0

    def ion_loss(self, T_e_eV: FloatArray, gap: float, ion_mass: float) -> FloatArray:
        """No ion reaches the wall."""
        return np.zeros_like(T_e_eV)

    def collision(self, T_e_eV: FloatArray, gap: float, ion_mass: float) -> FloatArray:
        """Constant frequency, in 1/s."""
        return np.full_like(T_e_eV, FREQUENCY)

    def power(self, T_e_eV: FloatArray, gap: float, ion_mass: float) -> FloatArray:
        """Power lost to the wall per electron, in eV/s."""
        return FREQUENCY * 1.5 * T_e_eV * np.exp(-self.sheath_V / (1.5 * T_e_eV))

    def ion_weight(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """1 in the channel and 0 in the plume, but the ion loss itself is zero."""
        return fraction(distance, 1.0, 0.0, self.transition)

    def collision_weight(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Fraction of the wall collisions: electrons collide in the channel only."""
        return fraction(distance, 1.0, 0.0, self.transition)

    def power_weight(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """alpha at a distance from the exit in m, negative inside."""
        return fraction(distance, *self.alpha, self.transition)


def landmark_thruster(case: int, rates: TabulatedRates) -> Thruster:
    """Build fluid case 1, 2 or 3 of the benchmark, to be run at LANDMARK_POINT.

    Both ends hold the mean energy at 3 eV, hence T_e = 2 eV. With eps = 1.5 T_e, p_e = n eps
    means pressure_factor 1.5, and (10/9) mu n eps d(eps)/dz = 2.5 mu n T_e dT_e/dz.
    """
    return Thruster(
        transport=AnomalousTransport(c_channel=1 / 160, c_plume=1 / 16, transition=1e-3),
        propellant=rates,
        wall=ExponentialWall((ALPHA_CHANNEL[case], 1.0)),
        ion_temperature=0.0,
        anode=FixedAnode(T_e_eV=2.0),
        cathode_T_e_eV=2.0,
        cathode_potential=0.0,
        series_resistance=0.0,
        pressure_factor=1.5,
        conduction_factor=2.5,
        ions_born_at_rest=True,
    )


def read_landmark_rates(path: Path) -> TabulatedRates:
    """Read mean energy (eV), ionisation rate (m^3/s) and energy loss (eV m^3/s) below a header."""
    columns = np.loadtxt(path, delimiter=",", skiprows=1).T.tolist()
    energy, ionization, loss = map(tuple, columns)
    return TabulatedRates(mean_energy_eV=energy, ionization_rate=ionization, energy_loss_rate=loss)
