"""Verdict on a run: whether it breathes, on which cycle, and whether its balances close."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from ep2sindy.signals.oscillation import SIMULATED, oscillation
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.thruster.constants import E_CHARGE
from ep2sindy.thruster.parameters import OperatingPoint

STANDARD_GRAVITY = 9.80665  # m/s^2, exact (CGPM 1901)
TRANSIT_HZ = 60e3  # ions cross the domain in microseconds; the breathing mode is slower
BREATHING = replace(SIMULATED, max_Hz=TRANSIT_HZ)
STRONG_SHARE = 0.9  # of the mean: the strong cycle has a larger standard deviation
OUT_SHARE = 0.1  # of the current that the gas carries if each of its atoms is ionised once


def judge_status(current: Float[np.ndarray, " time"], sample_s: float) -> str:
    """Status of the current at the end of the record: oscillating, transit, steady or decaying.

    The second half is cut into four blocks. The status is steady if the last block varies by less
    than 2 % of its mean, and decaying if it holds less than 0.7 of the first block's amplitude. It
    is transit if the dominant frequency is above 60 kHz, where ions cross the acceleration zone and
    the breathing mode does not occur. Otherwise it is oscillating. Some parameter sets oscillate
    for 2 ms and die by 3 ms: a verdict needs 4 ms or more of simulated time.
    """
    late = current[current.size // 2 :]
    return str(oscillation(sample_s * np.arange(late.size), late[:, None], BREATHING))


def diagnose(field: xr.Dataset, *, diverged: bool, flow_A: float) -> dict[str, Any]:
    """Status, cycle, dominant frequency in kHz, and mean and standard deviation of the current.

    flow_A: mass flow in A, one charge per atom. A discharge whose current ends far below has gone
    out.
    """
    current, time = field["I_d"].values, field["time"].values
    if diverged:
        status = "diverged"
    elif current[current.size // 2 :].mean() < OUT_SHARE * flow_A:
        status = "out"
    else:
        status = judge_status(current, float(time[1] - time[0]))
    moves = status in ("oscillating", "transit")
    mean, std = (float(current.mean()), float(current.std())) if current.size else (np.nan,) * 2
    cycle = "none"
    if status == "oscillating":
        cycle = "strong" if std > STRONG_SHARE * mean else "weak"
    return {
        "status": status,
        "cycle": cycle,
        "f_kHz": 1e-3 * dominant_frequency(time, current) if moves else np.nan,
        "I_d_mean": mean,
        "I_d_std": std,
    }


def outcome(
    field: xr.Dataset, point: OperatingPoint, *, ion_mass: float, diverged: bool
) -> dict[str, Any]:
    """The results of `diagnose`, and `performance` at mean thrust and power. ion_mass: in kg."""
    flow_A = 1e-6 * point.mass_flow_mg_s * E_CHARGE / ion_mass
    found = diagnose(field, diverged=diverged, flow_A=flow_A)
    if field.sizes["time"]:
        thrust_N, power_W = field["thrust"].mean(), (field["I_d"] * field["V_d"]).mean()
        found |= performance(point, thrust_N=float(thrust_N), power_W=float(power_W))
    return found


def performance(point: OperatingPoint, *, thrust_N: float, power_W: float) -> dict[str, float]:
    """Mean thrust in N, specific impulse in s and anode efficiency T^2/(2 mdot P).

    power_W: mean of V_d I_d, which with a series resistor is less than the product of their means.
    Source: Goebel & Katz, Fundamentals of Electric Propulsion, chapter 2.
    """
    mass_flow = 1e-6 * point.mass_flow_mg_s
    return {
        "thrust_N": thrust_N,
        "isp_s": thrust_N / (mass_flow * STANDARD_GRAVITY),
        "anode_efficiency": thrust_N**2 / (2.0 * mass_flow * power_W) if power_W else math.nan,
    }
