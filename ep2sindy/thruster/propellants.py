"""Propellants: mass of the atom and rate coefficients of electron collisions, with sources.

All propellants have the same attributes and methods on arrays of T_e in eV, so that a simulation
takes any of them:

- `name`, `mass` (kg), `range_eV` (lowest and highest T_e that the coefficients cover, None for
  formulas), `charge_states` (the highest charge that has coefficients), energies in eV;
- `ionization`, `energy_loss`, `events`, `momentum`, `coulomb` for X and X+;
- `drift_events`: the inelastic events that take their energy from drift and heat together;
- `further_ionization(charge, higher, T_e_eV)` and `further_energy(charge, higher)` of what makes
  X2+ and X3+ (`FURTHER_IONIZATIONS`), if charge_states is above 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster.checks import check_increasing, check_not_negative, check_positive
from ep2sindy.thruster.constants import E_CHARGE, M_ELECTRON, M_XENON

E_IONIZATION_EV = 12.13  # eV, first ionisation of xenon (Goebel & Katz, appendix E)
E_EXCITATION_EV = 8.32  # eV, lowest excited level (Goebel & Katz, appendix E)

# Ionisations beyond X -> X+, by charge before and after: the names of their columns.
FURTHER_IONIZATIONS = {
    (0, 2): "double_ionization",
    (1, 2): "second_ionization",
    (0, 3): "triple_ionization",
    (1, 3): "ion_double_ionization",
    (2, 3): "third_ionization",
}

FloatArray = Float[np.ndarray, "..."] | np.float64  # NumPy turns arrays without axes into scalars


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


def coulomb_rate(T_e_eV: FloatArray) -> FloatArray:
    """2.9e-12 T^-1.5; times n and ln(Lambda) it gives nu_ei in 1/s (Goebel & Katz, chapter 3)."""
    return 2.9e-12 * T_e_eV**-1.5


@dataclass(frozen=True)
class XenonFits:
    """Xenon coefficients as published formulas.

    Inelastic rates are evaluated at the electrons' total mean energy 1.5 T_e + K, where K is the
    kinetic energy of their drift, that is at T_e + 2 K/3. The whole energy of an event is taken
    from the heat: drag along the field becomes heat whatever its cause, and the drift energy, which
    follows the field at once, is not stored.

    Parameters
    ----------
    drift_weight : float, default 1.0
        Factor on K. With 0 the rates are evaluated at T_e.

    Raises
    ------
    ValueError
        If the weight is negative.

    Notes
    -----
    Source: Goebel & Katz, appendix E and chapter 3.
    """

    drift_weight: float = 1.0
    name: ClassVar[str] = "XenonFits"
    mass: ClassVar[float] = M_XENON
    ionization_eV: ClassVar[float] = E_IONIZATION_EV
    range_eV: ClassVar[tuple[float, float] | None] = None
    charge_states: ClassVar[int] = 1

    def __post_init__(self) -> None:
        check_not_negative(self, "drift_weight")

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

    def drift_events(self, T_e_eV: FloatArray) -> FloatArray:
        """Zero: the energy of every event is taken from the heat."""
        return np.zeros_like(T_e_eV)

    def momentum(self, T_e_eV: FloatArray) -> FloatArray:
        """Momentum lost to neutrals in elastic collisions, in m^3/s.

        The fit turns negative below 0.4 eV, where it is held at zero.
        Source: Goebel & Katz, chapter 3.
        """
        sigma = 6.6e-19 * (T_e_eV / 4.0 - 0.1) / (1.0 + (T_e_eV / 4.0) ** 1.6)  # m^2
        return np.maximum(sigma, 0.0) * thermal_speed(T_e_eV)

    def coulomb(self, T_e_eV: FloatArray) -> FloatArray:
        """nu_ei divided by n and ln(Lambda)."""
        return coulomb_rate(T_e_eV)


@dataclass(frozen=True)
class FurtherIonization:
    """Ionisation from one charge to a higher one in a single event, beyond X -> X+.

    rate: coefficients in m^3/s, at the temperatures of a `PropellantTable`. energy_eV: that an
    electron loses.
    """

    charge: int
    higher: int
    rate: tuple[float, ...]
    energy_eV: float

    def __post_init__(self) -> None:
        check_positive(self, "energy_eV")


@dataclass(frozen=True)
class PropellantTable:
    """Any gas: rate coefficients in m^3/s over the electron temperature, linear between rows.

    T_e_eV: increasing. There are two kinds of inelastic events, ionisation and one lumped
    excitation. further: with X -> X2+ and X+ -> X2+ there are X2+; with X -> X3+, X+ -> X3+ and
    X2+ -> X3+ there are X3+ as well; a charge whose events are not all there is refused.
    coulomb_weight: 0 leaves electron-ion collisions out. drift_weight: as in `XenonFits`. Of the
    inelastic events, only excitation takes part of its energy from the drift, as in
    HallThruster.jl. Beyond the rows the end values are held, and a run that gets there reports it.
    """

    name: str
    mass: float  # kg
    ionization_eV: float
    excitation_eV: float
    T_e_eV: tuple[float, ...]
    ionization_rate: tuple[float, ...]
    excitation_rate: tuple[float, ...]
    momentum_rate: tuple[float, ...]
    further: tuple[FurtherIonization, ...] = ()
    drift_weight: float = 1.0
    coulomb_weight: float = 1.0

    def __post_init__(self) -> None:
        check_positive(self, "mass", "ionization_eV", "excitation_eV")
        check_not_negative(self, "drift_weight", "coulomb_weight")
        check_increasing(self, "T_e_eV")
        rates = {n: getattr(self, f"{n}_rate") for n in ("ionization", "excitation", "momentum")}
        rates |= {FURTHER_IONIZATIONS[each.charge, each.higher]: each.rate for each in self.further}
        for name, rate in rates.items():
            if len(rate) != len(self.T_e_eV) or not all(0.0 <= value < np.inf for value in rate):
                raise ValueError(
                    f"the rate of {name} must be zero or more in each of the {len(self.T_e_eV)} "
                    f"rows of T_e_eV, got {list(rate)}"
                )
        given = [(each.charge, each.higher) for each in self.further]
        needed = [pair for pair in FURTHER_IONIZATIONS if pair[1] <= self.charge_states]
        if sorted(given) != sorted(needed):
            names = [FURTHER_IONIZATIONS[pair] for pair in needed]
            raise ValueError(
                f"ions of charge {self.charge_states} of {self.name} need {names}, each with its "
                f"energy: got {given}"
            )

    @property
    def range_eV(self) -> tuple[float, float]:
        """Lowest and highest T_e of the rows."""
        return self.T_e_eV[0], self.T_e_eV[-1]

    @property
    def charge_states(self) -> int:
        """The highest charge that has rates: 1, 2 or 3."""
        return max((each.higher for each in self.further), default=1)

    def _interpolate(self, T_e_eV: FloatArray, values: tuple[float, ...]) -> FloatArray:
        return np.interp(T_e_eV, self.T_e_eV, values)

    def ionization(self, T_e_eV: FloatArray) -> FloatArray:
        """X -> X+, in m^3/s."""
        return self._interpolate(T_e_eV, self.ionization_rate)

    def excitation(self, T_e_eV: FloatArray) -> FloatArray:
        """X -> X*, one lumped level, in m^3/s."""
        return self._interpolate(T_e_eV, self.excitation_rate)

    def energy_loss(self, T_e_eV: FloatArray) -> FloatArray:
        """Energy lost in X -> X+ and excitation, in eV m^3/s."""
        lost = self.ionization_eV * self.ionization(T_e_eV)
        return lost + self.excitation_eV * self.excitation(T_e_eV)

    def events(self, T_e_eV: FloatArray) -> FloatArray:
        """Ionising and exciting collisions together, in m^3/s."""
        return self.ionization(T_e_eV) + self.excitation(T_e_eV)

    def drift_events(self, T_e_eV: FloatArray) -> FloatArray:
        """Exciting collisions, in m^3/s."""
        return self.excitation(T_e_eV)

    def momentum(self, T_e_eV: FloatArray) -> FloatArray:
        """Momentum lost to neutrals in elastic collisions, in m^3/s."""
        return self._interpolate(T_e_eV, self.momentum_rate)

    def coulomb(self, T_e_eV: FloatArray) -> FloatArray:
        """nu_ei divided by n and ln(Lambda)."""
        return self.coulomb_weight * coulomb_rate(T_e_eV)

    def further_ionization(self, charge: int, higher: int, T_e_eV: FloatArray) -> FloatArray:
        """From one charge to a higher one in a single event, in m^3/s.

        charge, higher: a pair of `FURTHER_IONIZATIONS`. Raises ValueError for one without rates.
        """
        return self._interpolate(T_e_eV, self._further(charge, higher).rate)

    def further_energy(self, charge: int, higher: int) -> float:
        """Energy in eV that an electron loses in the event of `further_ionization`."""
        return self._further(charge, higher).energy_eV

    def _further(self, charge: int, higher: int) -> FurtherIonization:
        known = {(each.charge, each.higher): each for each in self.further}
        if (charge, higher) not in known:
            raise ValueError(
                f"{self.name} has further ionisations between the charges {[*known]}, got "
                f"{(charge, higher)}; X -> X+ is `ionization`"
            )
        return known[charge, higher]


Propellant = XenonFits | PropellantTable


def describe_uncovered(propellant: Propellant, reached_eV: float) -> str | None:
    """Message if a run needed rates beyond those that there are; otherwise None.

    reached_eV: highest T_e + 2 K/3, at which rates are taken; K is the energy of the electrons'
    drift, for propellants that count it.
    """
    if propellant.range_eV is None or reached_eV <= propellant.range_eV[1]:
        return None
    top = propellant.range_eV[1]
    energy = "T_e + 2K/3 (K: energy of the electrons' drift)" if propellant.drift_weight else "T_e"
    return (
        f"the rates of {propellant.name} cover T_e up to {top:g} eV, and the run reached "
        f"{energy} of {reached_eV:g} eV, where the value at {top:g} eV is taken; extend the table"
    )
