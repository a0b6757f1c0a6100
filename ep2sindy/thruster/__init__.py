"""The embedded data source: a 1-D axial Hall-thruster fluid model."""

from ep2sindy.thruster.cache import simulate_cached
from ep2sindy.thruster.closures import (
    ExponentialWall,
    SheathWall,
    TabulatedRates,
    XenonFits,
    ionization_rate,
)
from ep2sindy.thruster.landmark import LANDMARK_POINT, landmark_thruster, read_rate_table
from ep2sindy.thruster.parameters import (
    OPERATING_POINTS,
    AnomalousTransport,
    MagneticField,
    OperatingPoint,
    Thruster,
)
from ep2sindy.thruster.simulate import simulate

__all__ = [
    "LANDMARK_POINT",
    "OPERATING_POINTS",
    "AnomalousTransport",
    "ExponentialWall",
    "MagneticField",
    "OperatingPoint",
    "SheathWall",
    "TabulatedRates",
    "Thruster",
    "XenonFits",
    "ionization_rate",
    "landmark_thruster",
    "read_rate_table",
    "simulate",
    "simulate_cached",
]
