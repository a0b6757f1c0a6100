"""Rate coefficients of xenon, wall models and their published sources, as vectorised functions.

Everything here is a function of the electron temperature alone; the compiled loop reads it from
a fine table (`closure_table`), so each formula exists once.
"""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

E_CHARGE = 1.602176634e-19  # C, exact (SI 2019)
M_ELECTRON = 9.1093837015e-31  # kg, CODATA 2018
K_BOLTZMANN = 1.380649e-23  # J/K, exact (SI 2019)
M_XENON = 131.293 * 1.66053906660e-27  # kg: IUPAC 2021 standard weight, CODATA 2018 unit

E_IONIZATION_EV = 12.13  # eV, first ionisation of xenon (Goebel & Katz, appendix E)
E_EXCITATION_EV = 8.32  # eV, lowest excited level (Goebel & Katz, appendix E)
SHEATH_DENSITY_RATIO = 0.4965  # edge over mean density, 0.86 / sqrt(3) (Marks et al. 2023)

FloatArray = Float[np.ndarray, "..."] | np.float64  # NumPy makes scalars of arrays without axes


def thermal_speed(T_e_eV: FloatArray) -> FloatArray:
    """Mean speed of Maxwellian electrons sqrt(8 e T / (pi m_e)), in m/s."""
    return np.sqrt(8.0 * E_CHARGE * T_e_eV / (np.pi * M_ELECTRON))


def ionization_rate(T_e_eV: FloatArray | float) -> FloatArray:
    """Rate coefficient of electron-impact ionisation of xenon, in m^3/s.

    T_e_eV: electron temperature in eV, any shape, positive.
    Source: Goebel & Katz, Fundamentals of Electric Propulsion, appendix E.
    """
    T = np.asarray(T_e_eV, dtype=float)
    threshold = np.exp(-12.127 / T)
    cold = (3.97 + 0.643 * T - 0.0368 * T**2) * threshold
    hot = -1.031e-4 * T**2 + 6.386 * threshold
    return 1e-20 * np.where(T < 5.0, cold, hot) * thermal_speed(T)


def excitation_rate(T_e_eV: FloatArray) -> FloatArray:
    """Rate coefficient of electron-impact excitation of xenon, in m^3/s.

    Source: Goebel & Katz, appendix E, one lumped level.
    """
    return 1.93e-19 * np.exp(-11.6 / T_e_eV) / np.sqrt(T_e_eV) * thermal_speed(T_e_eV)


def momentum_transfer_rate(T_e_eV: FloatArray) -> FloatArray:
    """Rate coefficient of electron-neutral momentum transfer, in m^3/s.

    The fit turns negative below 0.4 eV, where it is held at zero.
    Source: Goebel & Katz, chapter 3.
    """
    sigma = 6.6e-19 * (T_e_eV / 4.0 - 0.1) / (1.0 + (T_e_eV / 4.0) ** 1.6)  # m^2
    return np.maximum(sigma, 0.0) * thermal_speed(T_e_eV)


@dataclass(frozen=True)
class XenonFits:
    """Xenon coefficients as published formulas (Goebel & Katz, appendix E and chapter 3).

    Inelastic rates and wall losses are taken at the electrons' whole mean energy 1.5 T_e + K,
    K the kinetic energy of their drift, hence at the temperature T_e + 2 K/3 (`drift_weight` 1).
    """

    drift_weight: ClassVar[float] = 1.0

    def ionization(self, T_e_eV: FloatArray) -> FloatArray:
        """Rate coefficient in m^3/s."""
        return ionization_rate(T_e_eV)

    def energy_loss(self, T_e_eV: FloatArray) -> FloatArray:
        """Energy lost in ionisation and excitation, in eV m^3/s."""
        ionization = E_IONIZATION_EV * ionization_rate(T_e_eV)
        return ionization + E_EXCITATION_EV * excitation_rate(T_e_eV)

    def events(self, T_e_eV: FloatArray) -> FloatArray:
        """Ionising and exciting collisions together, in m^3/s."""
        return ionization_rate(T_e_eV) + excitation_rate(T_e_eV)

    def momentum(self, T_e_eV: FloatArray) -> FloatArray:
        """Momentum lost to neutrals in elastic collisions, in m^3/s."""
        return momentum_transfer_rate(T_e_eV)

    def coulomb(self, T_e_eV: FloatArray) -> FloatArray:
        """2.9e-12 T^-1.5; times n and ln(Lambda) it is nu_ei in 1/s (Goebel & Katz, chapter 3)."""
        return 2.9e-12 * T_e_eV**-1.5


@dataclass(frozen=True)
class TabulatedRates:
    """Coefficients from a user's table over the mean energy 1.5 T_e, as LANDMARK defines them.

    mean_energy_eV: increasing. ionization_rate: m^3/s. energy_loss_rate: eV m^3/s.
    elastic_rate: constant momentum transfer, m^3/s.
    Coulomb collisions and the drift energy K are left out. Below the first row both
    coefficients fall to zero linearly; beyond the last they stay.
    """

    mean_energy_eV: tuple[float, ...]
    ionization_rate: tuple[float, ...]
    energy_loss_rate: tuple[float, ...]
    elastic_rate: float = 2.5e-13  # LANDMARK test case 3
    drift_weight: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        energy = np.asarray(self.mean_energy_eV)
        lengths = {len(self.mean_energy_eV), len(self.ionization_rate), len(self.energy_loss_rate)}
        if len(lengths) > 1 or energy.size < 2 or not np.all(np.diff(energy) > 0.0):
            raise ValueError(
                "a rate table needs two or more rows of increasing mean energy, with both rates "
                f"in every row: got lengths {len(self.mean_energy_eV)}, "
                f"{len(self.ionization_rate)}, {len(self.energy_loss_rate)}; sort the rows first"
            )

    def _interpolate(self, T_e_eV: FloatArray, values: tuple[float, ...]) -> FloatArray:
        return np.interp(1.5 * T_e_eV, (0.0, *self.mean_energy_eV), (0.0, *values))

    def ionization(self, T_e_eV: FloatArray) -> FloatArray:
        """Rate coefficient in m^3/s."""
        return self._interpolate(T_e_eV, self.ionization_rate)

    def energy_loss(self, T_e_eV: FloatArray) -> FloatArray:
        """Energy lost in all inelastic collisions, in eV m^3/s."""
        return self._interpolate(T_e_eV, self.energy_loss_rate)

    def events(self, T_e_eV: FloatArray) -> FloatArray:
        """LANDMARK's constant momentum transfer holds all collisions: none are added to it."""
        return np.zeros_like(T_e_eV)

    def momentum(self, T_e_eV: FloatArray) -> FloatArray:
        """Momentum lost to neutrals, in m^3/s."""
        return np.full_like(T_e_eV, self.elastic_rate)

    def coulomb(self, T_e_eV: FloatArray) -> FloatArray:
        """No Coulomb collisions in this closure."""
        return np.zeros_like(T_e_eV)


@dataclass(frozen=True)
class SheathWall:
    """Dielectric channel wall behind a sheath, with linear secondary-electron emission.

    gamma = min(gamma_max, yield_0 + (1 - yield_0) 1.5 T_e / crossover_eV), where
    gamma_max = 1 - 8.3 sqrt(m_e/m) is the space-charge limit; wall collisions
    nu_w = electron_scale 0.4965 sqrt(e T_e/m) / (gap (1 - gamma)); each costs
    2 T_e + (1 - gamma) phi_w, phi_w = T_e ln((1 - gamma) sqrt(m / (2 pi m_e))).
    Default: BN-SiO2. Sources: Marks et al., JOSS 8 (2023) 4672; Goebel & Katz, chapter 7.
    """

    yield_0: float = 0.54
    crossover_eV: float = 40.0
    electron_scale: float = 0.9
    ion_scale: float = 0.5
    power_weights: ClassVar[tuple[float, float]] = (1.0, 1.0)  # channel, plume
    collision_weights: ClassVar[tuple[float, float]] = (1.0, 1.0)

    def emission(self, T_e_eV: FloatArray) -> FloatArray:
        """Secondary electrons per primary, held at the space-charge limit."""
        limit = 1.0 - 8.3 * np.sqrt(M_ELECTRON / M_XENON)
        linear = self.yield_0 + (1.0 - self.yield_0) * 1.5 * T_e_eV / self.crossover_eV
        return np.minimum(limit, linear)

    def ion_loss(self, T_e_eV: FloatArray, gap: float) -> FloatArray:
        """Frequency at which an ion reaches the wall, in 1/s; gap: channel width in m."""
        bohm = np.sqrt(E_CHARGE * T_e_eV / M_XENON)
        return self.ion_scale * SHEATH_DENSITY_RATIO * bohm / gap

    def collision(self, T_e_eV: FloatArray, gap: float) -> FloatArray:
        """Frequency at which an electron reaches the wall, in 1/s."""
        bohm = np.sqrt(E_CHARGE * T_e_eV / M_XENON)
        arriving = self.electron_scale * SHEATH_DENSITY_RATIO * bohm / gap
        return arriving / (1.0 - self.emission(T_e_eV))

    def power(self, T_e_eV: FloatArray, gap: float) -> FloatArray:
        """Power lost to the wall per electron, in eV/s."""
        kept = 1.0 - self.emission(T_e_eV)
        sheath = T_e_eV * np.log(kept * np.sqrt(M_XENON / (2.0 * np.pi * M_ELECTRON)))
        return self.collision(T_e_eV, gap) * (2.0 * T_e_eV + kept * sheath)


@dataclass(frozen=True)
class ExponentialWall:
    """Wall loss 1e7 alpha eps exp(-20/eps) with eps = 1.5 T_e, as LANDMARK defines it.

    power_weights: alpha in the channel and in the plume. Electrons collide with the channel
    wall at 1e7 1/s; ions never do. Source: LANDMARK, test case 3.
    """

    power_weights: tuple[float, float]
    frequency: float = 1e7  # 1/s
    collision_weights: ClassVar[tuple[float, float]] = (1.0, 0.0)

    def ion_loss(self, T_e_eV: FloatArray, gap: float) -> FloatArray:
        """No ion reaches the wall."""
        return np.zeros_like(T_e_eV)

    def collision(self, T_e_eV: FloatArray, gap: float) -> FloatArray:
        """Constant frequency, in 1/s."""
        return np.full_like(T_e_eV, self.frequency)

    def power(self, T_e_eV: FloatArray, gap: float) -> FloatArray:
        """Power lost to the wall per electron, in eV/s."""
        energy = 1.5 * T_e_eV
        return self.frequency * energy * np.exp(-20.0 / energy)
