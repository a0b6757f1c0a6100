"""What a simulation needs to know: the thruster, its operating point, the six points studied."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster.closures import ExponentialWall, SheathWall, TabulatedRates, XenonFits


def check_positive(owner: object, *names: str) -> None:
    """Raise ValueError for the first named field that is not a finite positive number."""
    for name in names:
        value = getattr(owner, name)
        if not (math.isfinite(value) and value > 0.0):
            raise ValueError(
                f"{type(owner).__name__}.{name} must be finite and positive, got {value!r}"
            )


def check_not_negative(owner: object, *names: str) -> None:
    """Raise ValueError for the first named field that is negative or not finite."""
    for name in names:
        value = getattr(owner, name)
        if not (math.isfinite(value) and value >= 0.0):
            raise ValueError(
                f"{type(owner).__name__}.{name} must be finite and zero or more, got {value!r}"
            )


@dataclass(frozen=True)
class MagneticField:
    """Radial field on the channel axis: a Gaussian about the exit, wider in the plume."""

    peak: float = 15e-3  # T
    width_channel: float = 11e-3  # m, standard deviation
    width_plume: float = 18e-3  # m

    def __post_init__(self) -> None:
        check_positive(self, "peak", "width_channel", "width_plume")

    def at(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Field in T at a distance from the exit in m, negative inside."""
        width = np.where(distance < 0.0, self.width_channel, self.width_plume)
        return self.peak * np.exp(-0.5 * (distance / width) ** 2)


@dataclass(frozen=True)
class AnomalousTransport:
    """Anomalous collisions nu = c omega_ce, with c linear across a layer about the exit.

    The three numbers are tuned, as in every 1-D code; see docs/thruster.md.
    """

    c_channel: float = 1 / 300
    c_plume: float = 1 / 80
    transition: float = 3e-3  # m

    def __post_init__(self) -> None:
        check_positive(self, "c_channel", "c_plume")
        check_not_negative(self, "transition")

    def at(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Coefficient c at a distance from the exit in m."""
        if self.transition == 0.0:
            return np.where(distance < 0.0, self.c_channel, self.c_plume)
        share = np.clip(distance / self.transition + 0.5, 0.0, 1.0)
        return self.c_channel + (self.c_plume - self.c_channel) * share


@dataclass(frozen=True)
class Thruster:
    """Geometry, field, closures and boundary values of one thruster. Default: SPT-100-like."""

    channel_length: float = 0.025  # m
    domain_length: float = 0.05  # m
    inner_radius: float = 0.035  # m
    outer_radius: float = 0.05  # m
    magnetic_field: MagneticField = field(default_factory=MagneticField)
    transport: AnomalousTransport = field(default_factory=AnomalousTransport)
    rates: XenonFits | TabulatedRates = field(default_factory=XenonFits)
    wall: SheathWall | ExponentialWall = field(default_factory=SheathWall)
    ion_temperature: float = 1000.0  # K
    boundary_T_e_eV: float = 3.0
    cathode_potential: float = 20.0  # V
    series_resistance: float = 1.0  # ohm
    pressure_factor: float = 1.0  # p_e = factor n T_e
    conduction_factor: float = 4.66  # kappa = factor mu n T_e; Braginskii, singly charged ions

    def __post_init__(self) -> None:
        check_positive(
            self, "channel_length", "domain_length", "inner_radius", "outer_radius",
            "boundary_T_e_eV", "pressure_factor", "conduction_factor",
        )  # fmt: skip
        check_not_negative(self, "ion_temperature", "cathode_potential", "series_resistance")
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
    """What the operator sets: supply voltage in V, anode flow in mg/s, and the neutrals' speed."""

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
