"""Parameters of a simulation: the thruster, its operating point, the six points studied."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from ep2sindy.thruster.checks import check_not_negative, check_positive
from ep2sindy.thruster.magnetic_field import Field, MagneticField
from ep2sindy.thruster.propellants import Propellant, XenonFits, gas_name
from ep2sindy.thruster.transport import AnomalousTransport, Transport
from ep2sindy.thruster.walls import Anode, FixedAnode, SheathWall, Wall


@dataclass(frozen=True)
class Thruster:
    """Geometry, field, closures and boundary values of one thruster; the default is SPT-100-like.

    kappa = conduction_factor/(1 + conduction_coulomb nu_ei/nu) mu n T_e; 4.66 and 0 are
    Braginskii's values for singly charged ions. charge_states: highest charge of the ions, 1 or 2.
    cathode_potential: potential of the cathode plane relative to the cathode (coupling voltage).
    ions_born_at_rest: if True, ionisation adds no momentum to the ions, as in LANDMARK; otherwise
    it adds the neutrals' momentum.
    """

    channel_length: float = 0.025  # m
    domain_length: float = 0.05  # m
    inner_radius: float = 0.035  # m
    outer_radius: float = 0.05  # m
    magnetic_field: Field = field(default_factory=MagneticField)
    transport: Transport = field(default_factory=AnomalousTransport)
    propellant: Propellant = field(default_factory=XenonFits)
    charge_states: int = 1
    wall: Wall = field(default_factory=SheathWall)
    ion_temperature: float = 1000.0  # K
    anode: Anode = field(default_factory=FixedAnode)
    cathode_T_e_eV: float = 3.0
    cathode_potential: float = 20.0  # V
    series_resistance: float = 1.0  # ohm
    pressure_factor: float = 1.0  # p_e = factor n T_e
    conduction_factor: float = 4.66
    conduction_coulomb: float = 0.0
    ions_born_at_rest: bool = False

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
        self.magnetic_field.check_covers(
            -self.channel_length, self.domain_length - self.channel_length
        )
        self._check_propellant()

    def _check_propellant(self) -> None:
        if self.charge_states not in (1, 2):
            raise ValueError(f"charge_states must be 1 or 2, got {self.charge_states!r}")
        if self.charge_states > self.propellant.charge_states:
            raise ValueError(
                "charge_states 2 needs rates of the second charge, which the propellant "
                f"{gas_name(self.propellant)} has not; take "
                "ep2sindy.thruster.propellant(name='xenon')"
            )
        if self.propellant.range_eV is None:
            return
        low, high = self.propellant.range_eV
        for place, T_e_eV in (("anode", self.anode.T_e_eV), ("cathode", self.cathode_T_e_eV)):
            if not low <= T_e_eV <= high:
                raise ValueError(
                    f"the rates of {gas_name(self.propellant)} cover T_e from {low:g} to {high:g} "
                    f"eV, and it is {T_e_eV:g} eV at the {place}; extend the table"
                )

    @property
    def gap(self) -> float:
        """Channel width in m."""
        return self.outer_radius - self.inner_radius

    @property
    def area(self) -> float:
        """Channel cross-section in m^2."""
        return math.pi * (self.outer_radius**2 - self.inner_radius**2)


@dataclass(frozen=True)
class OperatingPoint:
    """The operator's settings: supply voltage in V, anode flow in mg/s; and the neutrals' speed."""

    voltage: float  # V
    mass_flow_mg_s: float
    neutral_speed: float = 280.0  # m/s, tuned

    def __post_init__(self) -> None:
        check_positive(self, "voltage", "mass_flow_mg_s", "neutral_speed")

    @property
    def label(self) -> str:
        """Name such as `300V_5mgs`."""
        return f"{self.voltage:g}V_{self.mass_flow_mg_s:g}mgs"


OPERATING_POINTS = (
    OperatingPoint(200.0, 5.0),
    OperatingPoint(300.0, 2.0, neutral_speed=190.0),
    OperatingPoint(300.0, 4.0),
    OperatingPoint(300.0, 5.0),
    OperatingPoint(300.0, 6.0),
    OperatingPoint(400.0, 5.0),
)
