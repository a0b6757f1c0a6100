"""Verdict on a run: whether it breathes, on which cycle, and whether its balances close."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.signal import find_peaks

from ep2sindy.signals.spectrum import SIMULATED, dominant_frequency, oscillation
from ep2sindy.thruster.constants import E_CHARGE
from ep2sindy.thruster.parameters import OperatingPoint

STANDARD_GRAVITY = 9.80665  # m/s^2, exact (CGPM 1901)
TRANSIT_HZ = 60e3  # ions cross the domain in microseconds; the breathing mode is slower
BREATHING = replace(SIMULATED, max_Hz=TRANSIT_HZ)
STRONG_FRACTION = 0.9  # of the mean: the strong cycle has a larger standard deviation
SAME_PEAKS, MOST_CYCLES = 0.01, 16  # of their mean; how many cycles it takes to tell
GONE_A = 1e-9  # no discharge comes back from it
OUT_FRACTION = 0.1  # of the current that the gas carries if each of its atoms is ionised once


def assess_status(current: Float[np.ndarray, " time"], sample_s: float) -> str:
    """Status of the current at the end of the record: oscillating, transit, steady or decaying.

    The second half is cut into four blocks. The status is steady if the last block varies by less
    than 2 % of its mean, and decaying if it holds less than 0.7 of the first block's amplitude. It
    is transit if the dominant frequency is above 60 kHz, where ions cross the acceleration zone and
    the breathing mode does not occur. Otherwise it is oscillating. Some parameter sets oscillate
    for 2 ms and die by 3 ms: a verdict needs 4 ms or more of simulated time.
    """
    late = current[current.size // 2 :]
    return str(oscillation(sample_s * np.arange(late.size), late[:, None], BREATHING))


def cycle_peaks(
    current: Float[np.ndarray, " time"], sample_s: float, f_Hz: float
) -> Float[np.ndarray, " cycles"]:
    """Highest current of every cycle in A: peaks above the mean, at least 0.6 of a period apart."""
    apart = max(0.6 / (f_Hz * sample_s), 1.0)
    return find_peaks(current, height=current.mean(), distance=apart)[1]["peak_heights"]


def multiplicity(peaks: Float[np.ndarray, " cycles"]) -> tuple[float, float]:
    """After how many cycles the peaks come again within SAME_PEAKS of their mean, and their spread.

    The first is NaN if they do not within MOST_CYCLES; the second is their standard deviation over
    their mean. A cycle that repeats after two or more carries another one, such as ions in transit.
    """
    if peaks.size < MOST_CYCLES:
        return math.nan, math.nan
    mean = float(peaks.mean())
    for m in range(1, MOST_CYCLES // 2 + 1):
        if np.sqrt(np.mean((peaks[m:] - peaks[:-m]) ** 2)) < SAME_PEAKS * mean:
            return float(m), float(peaks.std()) / mean
    return math.nan, float(peaks.std()) / mean


def diagnose(field: xr.Dataset, *, diverged: bool, flow_A: float) -> dict[str, Any]:
    """Status, cycle, dominant frequency in kHz, and mean and standard deviation of the current.

    Also `multiplicity` and `peak_spread` of the peaks of a discharge that oscillates. flow_A: mass
    flow in A, one charge per atom. A discharge whose current ends far below has gone out.
    """
    current, time = field["I_d"].values, field["time"].values
    if diverged:  # without a source of electrons a current falls until nothing can be divided by
        status = "out" if current.size and abs(current[-1]) < GONE_A else "diverged"
    elif current[current.size // 2 :].mean() < OUT_FRACTION * flow_A:
        status = "out"
    else:
        status = assess_status(current, float(time[1] - time[0]))
    moves = status in ("oscillating", "transit")
    f_Hz = dominant_frequency(time, current) if moves else math.nan
    mean, std = (float(current.mean()), float(current.std())) if current.size else (np.nan,) * 2
    cycle, again, spread = "none", math.nan, math.nan
    if status == "oscillating":
        cycle = "strong" if std > STRONG_FRACTION * mean else "weak"
        late = current[current.size // 2 :]
        again, spread = multiplicity(cycle_peaks(late, float(time[1] - time[0]), f_Hz))
    return {
        "status": status,
        "cycle": cycle,
        "f_kHz": 1e-3 * f_Hz,
        "multiplicity": again,
        "peak_spread": spread,
        "I_d_mean": mean,
        "I_d_std": std,
    }


def outcome(
    field: xr.Dataset, point: OperatingPoint, *, ion_mass: float, diverged: bool
) -> dict[str, Any]:
    """The results of `diagnose`, and the performance at mean thrust and power. ion_mass: in kg.

    Thrust in N, specific impulse in s and anode efficiency T^2/(2 mdot P), with the mean power of
    V_d I_d, which with a series resistor is less than the product of their means.
    Source: Goebel & Katz, Fundamentals of Electric Propulsion, chapter 2.
    """
    mass_flow = 1e-6 * point.mass_flow_mg_s
    found = diagnose(field, diverged=diverged, flow_A=mass_flow * E_CHARGE / ion_mass)
    if field.sizes["time"]:
        thrust_N = float(field["thrust"].mean())
        power_W = float((field["I_d"] * field["V_d"]).mean())
        efficiency = thrust_N**2 / (2.0 * mass_flow * power_W) if power_W else math.nan
        found |= {"thrust_N": thrust_N, "isp_s": thrust_N / (mass_flow * STANDARD_GRAVITY)}
        found["anode_efficiency"] = efficiency
    return found
