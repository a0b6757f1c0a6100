"""The LANDMARK benchmark's 1-D fluid cases (test case 3), for verification.

The benchmark's closures differ from the default set: mean-energy pressure p_e = n eps,
conductivity (10/9) mu n eps, a constant sheath loss, ions born at rest, and a rate table that its
authors distribute (landmark-plasma.com); the table is the caller's to supply.
"""

from __future__ import annotations

import csv
from pathlib import Path

from ep2sindy.thruster.parameters import OperatingPoint, Thruster
from ep2sindy.thruster.propellants import TabulatedRates
from ep2sindy.thruster.transport import AnomalousTransport
from ep2sindy.thruster.walls import ExponentialWall, FixedAnode

ALPHA_CHANNEL = {1: 1.0, 2: 0.5, 3: 0.4}  # energy-loss coefficient by case; 1 in the plume
LANDMARK_POINT = OperatingPoint(300.0, 5.0, neutral_speed=150.0)


def landmark_thruster(case: int, rates: TabulatedRates) -> Thruster:
    """Build fluid case 1, 2 or 3 of the benchmark, to be run at LANDMARK_POINT.

    Both ends hold the mean energy at 3 eV, hence T_e = 2 eV. With eps = 1.5 T_e, p_e = n eps
    means pressure_factor 1.5, and (10/9) mu n eps d(eps)/dz = 2.5 mu n T_e dT_e/dz.
    """
    if case not in ALPHA_CHANNEL:
        raise ValueError(f"LANDMARK has fluid cases {sorted(ALPHA_CHANNEL)}, got {case!r}")
    return Thruster(
        transport=AnomalousTransport(c_channel=1 / 160, c_plume=1 / 16, transition=1e-3),
        propellant=rates,
        wall=ExponentialWall(power_weights=(ALPHA_CHANNEL[case], 1.0)),
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
    """Read mean energy (eV), ionisation rate (m^3/s) and energy loss (eV m^3/s) from a CSV.

    The first line is a header. Raises ValueError for a row without three numbers.
    """
    with path.open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    try:
        columns = list(zip(*((float(a), float(b), float(c)) for a, b, c in rows), strict=True))
    except ValueError as error:
        raise ValueError(
            f"{path}: every row must hold three numbers (mean energy in eV, ionisation rate in "
            f"m^3/s, energy loss in eV m^3/s): {error}"
        ) from error
    energy, ionization, loss = columns
    return TabulatedRates(energy, ionization, loss)
