"""Parameters of a simulation: the thruster and its circuit, the operating point, the six points."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster.checks import check_not_negative, check_positive, set_profile
from ep2sindy.thruster.constants import K_BOLTZMANN
from ep2sindy.thruster.magnetic_field import Field, MagneticField
from ep2sindy.thruster.plume import Plume
from ep2sindy.thruster.propellants import Propellant, XenonFits
from ep2sindy.thruster.transport import (
    AnomalousTransport,
    FunctionTransport,
    Points,
    PressureShift,
    Transport,
)
from ep2sindy.thruster.walls import Anode, FixedAnode, SheathWall, Wall

Volts = Float[np.ndarray, " times"]


@dataclass(frozen=True)
class Circuit:
    """Inductance behind the series resistance, and capacitance across the discharge.

    Parameters
    ----------
    inductance : float, default 0.0
        Inductance in H.
    capacitance : float, default 0.0
        Capacitance in F.

    Raises
    ------
    ValueError
        If both are zero, or either is negative.

    Notes
    -----
    The circuit is

        supply -- series resistance -- inductance --+-- anode
                                               capacitance
                                           cathode --+
    """

    inductance: float = 0.0
    capacitance: float = 0.0

    def __post_init__(self) -> None:
        check_not_negative(self, "inductance", "capacitance")
        if self.inductance == self.capacitance == 0.0:
            raise ValueError(
                "a Circuit must have an inductance or a capacitance: both are 0; leave the circuit "
                "out, or give one of them in H or F"
            )


@dataclass(frozen=True)
class ModulatedVoltage:
    """The operating point's voltage with a sinusoidal modulation during the record.

    Parameters
    ----------
    fraction : float
        Amplitude relative to the voltage, above 0 and below 1.
    frequency_Hz : float
        Frequency in Hz.

    Raises
    ------
    ValueError
        If the fraction is out of range, or the frequency is not positive.

    Notes
    -----
    The voltage is V_0 (1 + fraction sin(2 pi frequency_Hz t)), with t = 0 where the record begins.
    """

    fraction: float
    frequency_Hz: float

    def __post_init__(self) -> None:
        check_positive(self, "fraction", "frequency_Hz")
        if self.fraction >= 1.0:
            raise ValueError(
                "ModulatedVoltage.fraction must be below 1, or the supply turns round, got "
                f"{self.fraction:g}; 0.05 is five per cent"
            )

    def at(self, t: Volts, voltage: float) -> Volts:
        """Voltage in V at times in s, constant before t = 0."""
        phase = 2.0 * np.pi * self.frequency_Hz * np.maximum(t, 0.0)
        return voltage * (1.0 + self.fraction * np.sin(phase))


@dataclass(frozen=True)
class Background:
    """The facility's residual gas, of the same kind as the propellant.

    A `PressureShift` of the transport follows the pressure.

    Parameters
    ----------
    pressure_Pa : float
        Pressure in Pa. 1e-5 Torr are 1.33e-3 Pa.
    temperature_K : float, default 300.0
        Temperature in K.
    ingestion : float, default 1.0
        Factor on the flux of a gas at rest, as gas enters from the plume, too.

    Raises
    ------
    ValueError
        If the pressure or the ingestion is negative, or the temperature is not positive.

    Notes
    -----
    Besides the anode's flow, the channel takes in per area, with the gas pressure p and temperature
    T,

        ingestion p / (k_B T) sqrt(8 k_B T / (pi m)) / 4
    """

    pressure_Pa: float
    temperature_K: float = 300.0
    ingestion: float = 1.0

    def __post_init__(self) -> None:
        check_not_negative(self, "pressure_Pa", "ingestion")
        check_positive(self, "temperature_K")

    def flow_mg_s(self, area: float, mass: float) -> float:
        """Flow in mg/s into an area in m^2, for atoms of a mass in kg."""
        energy = K_BOLTZMANN * self.temperature_K
        speed = math.sqrt(8.0 * energy / (math.pi * mass))
        return 1e6 * self.ingestion * mass * self.pressure_Pa / energy * 0.25 * speed * area


@dataclass(frozen=True)
class NeutralSpeed:
    """Axial speed of the neutrals as a profile, linear between points, constant beyond their ends.

    Slow neutrals are ionized first, so that the mean speed grows along the channel.

    Parameters
    ----------
    distance : sequence of float
        Distances from the exit in m, increasing, negative in the channel.
    speed : sequence of float
        Speeds in m/s.

    Raises
    ------
    ValueError
        If there are gaps, points out of order, or a speed that is not positive.
    """

    distance: Points
    speed: Points

    def __post_init__(self) -> None:
        set_profile(self, "distance", "speed", "m/s")

    def at(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Speed in m/s at distances from the exit in m."""
        return np.interp(distance, self.distance, self.speed)


def _tuned_wall() -> SheathWall:
    return SheathWall(
        electron_scale=0.8, ion_scale=0.95, plume_collisions=0.5, plume_power=0.6, transition=1e-3
    )


@dataclass(frozen=True)
class Thruster:
    """Geometry, field, closures and boundary values of one thruster; the default is SPT-100-like.

    Transport, wall, resistance and conduction are tuned (docs/thruster.md).

    Parameters
    ----------
    channel_length : float, default 0.025
        Length of the channel in m.
    domain_length : float, default 0.05
        Length of the domain from the anode to the cathode plane in m.
    inner_radius : float, default 0.035
        Inner radius of the channel in m.
    outer_radius : float, default 0.05
        Outer radius of the channel in m.
    magnetic_field : MagneticField or MagneticFieldTable, default MagneticField()
        Radial magnetic field along the axis.
    transport : Transport, default AnomalousTransport()
        Anomalous collisions of the electrons, such as `AnomalousTransport`.
    propellant : Propellant, default XenonFits()
        Rates of the gas, such as `XenonFits()` or `propellant("krypton")`.
    charge_states : int, optional
        Highest charge of the ions, 1 to 3. None takes 2 where the gas has the rates, else 1.
    wall : Wall, default _tuned_wall()
        Losses to the channel's walls, such as `SheathWall`.
    ion_temperature : float, default 1000.0
        Temperature of the ions in K.
    anode : AnodeSheath or FixedAnode, default FixedAnode()
        Boundary condition at the anode.
    cathode_T_e_eV : float, default 3.0
        Electron temperature at the cathode plane in eV.
    cathode_potential : float, default 20.0
        Potential of the cathode plane relative to the cathode (coupling voltage) in V.
    series_resistance : float, default 0.8
        Resistance between the supply and the anode in ohm.
    circuit : Circuit, optional
        Inductance and capacitance of the circuit, in addition to the series resistance.
    pressure_factor : float, default 1.0
        Factor in the electron pressure p_e = pressure_factor n T_e.
    conduction_factor : float, default 7.5
        Factor in the heat conduction, see Notes.
    conduction_coulomb : float, default 0.0
        Weight of Coulomb collisions in the heat conduction, see Notes.
    ions_born_at_rest : bool, default False
        True if ionization adds no momentum to the ions, as in LANDMARK. False adds the momentum of
        the neutrals.
    plume : Plume, optional
        How the plasma spreads beyond the exit. None keeps the channel's cross-section.

    Raises
    ------
    ValueError
        If a length or factor has the wrong sign, the channel is longer than the domain, the radii
        are out of order, the circuit has no resistance, or the magnetic field does not cover the
        domain.

    Notes
    -----
    The heat conduction is

        kappa = conduction_factor / (1 + conduction_coulomb nu_ei / nu) mu n T_e

    where 4.66 and 0 are Braginskii's values for singly charged ions.
    """

    channel_length: float = 0.025  # m
    domain_length: float = 0.05  # m
    inner_radius: float = 0.035  # m
    outer_radius: float = 0.05  # m
    magnetic_field: Field = field(default_factory=MagneticField)
    transport: Transport = field(default_factory=AnomalousTransport)
    propellant: Propellant = field(default_factory=XenonFits)
    charge_states: int | None = None
    wall: Wall = field(default_factory=_tuned_wall)
    ion_temperature: float = 1000.0  # K
    anode: Anode = field(default_factory=FixedAnode)
    cathode_T_e_eV: float = 3.0
    cathode_potential: float = 20.0  # V
    series_resistance: float = 0.8  # ohm
    circuit: Circuit | None = None  # besides the series resistance
    pressure_factor: float = 1.0  # p_e = factor n T_e
    conduction_factor: float = 7.5
    conduction_coulomb: float = 0.0
    ions_born_at_rest: bool = False
    plume: Plume | None = None

    def __post_init__(self) -> None:
        check_positive(
            self, "channel_length", "domain_length", "inner_radius", "outer_radius",
            "cathode_T_e_eV", "pressure_factor", "conduction_factor",
        )  # fmt: skip
        check_not_negative(
            self, "ion_temperature", "cathode_potential", "series_resistance", "conduction_coulomb"
        )
        if self.channel_length >= self.domain_length:
            raise ValueError(
                f"the channel must end inside the domain: channel_length {self.channel_length} m "
                f"against domain_length {self.domain_length} m; lengthen the domain"
            )
        if self.inner_radius >= self.outer_radius:
            raise ValueError(
                f"inner_radius must be below outer_radius: {self.inner_radius} m against "
                f"{self.outer_radius} m"
            )
        if self.circuit is not None and self.series_resistance == 0.0:
            raise ValueError(
                "a circuit must have a resistance, or nothing damps it: series_resistance is 0 "
                f"next to {self.circuit}; give it in ohm"
            )
        self.magnetic_field.check_covers(
            -self.channel_length, self.domain_length - self.channel_length
        )
        self._check_propellant()

    def _check_propellant(self) -> None:
        known = self.propellant.charge_states
        if self.charge_states is None:
            object.__setattr__(self, "charge_states", min(2, known))
        if self.highest_charge not in (1, 2, 3):
            raise ValueError(f"charge_states must be 1, 2 or 3, got {self.charge_states!r}")
        if self.highest_charge > known:
            raise ValueError(
                f"charge_states {self.charge_states} needs rates of every charge up to it, and the "
                f"propellant {self.propellant.name} has them up to {known}; take "
                "ep2sindy.thruster.propellant(name='xenon')"
            )
        if self.propellant.range_eV is None:
            return
        low, high = self.propellant.range_eV
        for place, T_e_eV in (("anode", self.anode.T_e_eV), ("cathode", self.cathode_T_e_eV)):
            if not low <= T_e_eV <= high:
                raise ValueError(
                    f"the rates of {self.propellant.name} cover T_e from {low:g} to {high:g} "
                    f"eV, and it is {T_e_eV:g} eV at the {place}; extend the table"
                )

    @property
    def highest_charge(self) -> int:
        """Highest charge of the ions; `charge_states` with its default filled in."""
        assert self.charge_states is not None
        return self.charge_states

    @property
    def gap(self) -> float:
        """Channel width in m."""
        return self.outer_radius - self.inner_radius

    @property
    def area(self) -> float:
        """Channel cross-section in m^2."""
        return math.pi * (self.outer_radius**2 - self.inner_radius**2)

    def transport_at(
        self, distance: Float[np.ndarray, " z"], background: Background | None
    ) -> Float[np.ndarray, " z"]:
        """Coefficient c of the transport, which a background's pressure may shift; None: vacuum.

        A `FunctionTransport` is not known before the plasma is: NaN everywhere.
        """
        if isinstance(self.transport, FunctionTransport):
            return np.full_like(distance, np.nan)
        if not isinstance(self.transport, PressureShift):
            return self.transport.at(distance)
        pressure_Pa = 0.0 if background is None else background.pressure_Pa
        shift = self.channel_length * self.transport.shift(pressure_Pa)
        return self.transport.transport.at(distance - shift)


@dataclass(frozen=True)
class OperatingPoint:
    """What the operator sets, supply voltage and anode flow, and the speed of the neutrals.

    Parameters
    ----------
    voltage : float
        Voltage of the supply in V.
    mass_flow_mg_s : float
        Anode flow in mg/s.
    neutral_speed : float or NeutralSpeed, default 338.0
        Speed of the neutrals in m/s, or its profile along the axis.
    supply : ModulatedVoltage, optional
        How the voltage varies in time. None means that it is constant.
    background : Background, optional
        The gas of the facility. None is a perfect vacuum.

    Raises
    ------
    ValueError
        If a number is not positive.
    """

    voltage: float  # V
    mass_flow_mg_s: float
    neutral_speed: float | NeutralSpeed = 338.0  # m/s, tuned
    supply: ModulatedVoltage | None = None
    background: Background | None = None

    def __post_init__(self) -> None:
        check_positive(self, "voltage", "mass_flow_mg_s")
        if not isinstance(self.neutral_speed, NeutralSpeed):
            check_positive(self, "neutral_speed")

    def neutral_speed_at(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Speed of the neutrals in m/s at distances from the exit in m."""
        if isinstance(self.neutral_speed, NeutralSpeed):
            return self.neutral_speed.at(distance)
        return np.full_like(distance, self.neutral_speed)

    def inflow_mg_s(self, thruster: Thruster) -> float:
        """Flow of neutrals at the anode in mg/s: the anode's own and what the channel ingests."""
        if self.background is None:
            return self.mass_flow_mg_s
        ingested = self.background.flow_mg_s(thruster.area, thruster.propellant.mass)
        return self.mass_flow_mg_s + ingested

    @property
    def label(self) -> str:
        """Name such as `300V_5mgs`."""
        return f"{self.voltage:g}V_{self.mass_flow_mg_s:g}mgs"


OPERATING_POINTS = (
    OperatingPoint(200.0, 5.0, neutral_speed=320.0),
    OperatingPoint(300.0, 2.0, neutral_speed=195.0),
    OperatingPoint(300.0, 4.0),
    OperatingPoint(300.0, 5.0),
    OperatingPoint(300.0, 6.0),
    OperatingPoint(400.0, 5.0),
)
"""The six operating points that the experiments on several points use."""
