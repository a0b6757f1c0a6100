"""Long runs against reference values: LANDMARK's fluid cases and the six operating points."""

import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.signal import savgol_filter

from ep2sindy.thruster import (
    LANDMARK_POINT,
    OPERATING_POINTS,
    Thruster,
    landmark_thruster,
    read_rate_table,
    simulate,
)

pytestmark = pytest.mark.slow
# The benchmark's own table is not ours to ship: name it with EP2SINDY_DATA=folder.
RATE_TABLE = Path(os.environ.get("EP2SINDY_DATA", ".")) / "landmark_rates.csv"
needs_table = pytest.mark.skipif(
    not RATE_TABLE.exists(), reason="needs EP2SINDY_DATA with landmark_rates.csv"
)

# A reference code's I_d mean (A), standard deviation (A) and frequency (kHz) at the same set.
CURRENTS = {
    "200V_5mgs": (3.37, 3.45, 11.7),
    "300V_2mgs": (1.48, 1.39, 12.7),
    "300V_4mgs": (3.50, 3.03, 15.7),
    "300V_5mgs": (4.48, 4.60, 14.3),
    "300V_6mgs": (5.36, 6.60, 13.7),
    "400V_5mgs": (5.23, 4.75, 17.0),
}
DOWNSTREAM, MIDDLE = (1.5e-2, 2.5e-2), (1.0e-2, 2.5e-2)  # m
EQUATIONS = ("n_i'=n_i,n_i n_n", "n_n'=n_n,n_i n_n", "n_i'=n_i u,n_i n_n R", "n_n'=1,n_i n_n R")
# Its least-squares coefficients on zone averages, two per equation.
COEFFICIENTS = {
    ("300V_5mgs", DOWNSTREAM): (-2.91e5, 4.31e-14, 4.92e4, -5.18e-14, -39.4, 0.59, 1.75e23, -0.63),
    ("300V_5mgs", MIDDLE): (-2.48e5, 2.98e-14, 4.20e4, -5.86e-14, -43.9, 0.48, 2.86e23, -0.85),
    ("200V_5mgs", DOWNSTREAM): (-2.26e5, 2.21e-14, 4.10e4, -7.13e-14, -43.9, 0.69, 2.60e23, -1.28),
    ("300V_2mgs", DOWNSTREAM): (-5.44e5, 1.22e-13, 1.39e4, -8.21e-14, -50.1, 0.99, 5.6e22, -0.77),
    ("300V_4mgs", DOWNSTREAM): (-3.76e5, 7.87e-14, 3.62e4, -7.12e-14, -42.1, 0.81, 1.21e23, -0.69),
    ("300V_6mgs", DOWNSTREAM): (-3.09e5, 3.48e-14, 6.17e4, -4.64e-14, -49.3, 0.66, 2.50e23, -0.66),
    ("400V_5mgs", DOWNSTREAM): (-2.97e5, 8.46e-14, 5.65e4, -7.62e-14, -32.2, 0.72, 1.39e23, -0.61),
}


@cache
def full_run(label):
    (point,) = [point for point in OPERATING_POINTS if point.label == label]
    return simulate(Thruster(), point, progress=False)


@pytest.mark.parametrize("label", CURRENTS)
def test_every_point_sustains_its_oscillation(label):
    run = full_run(label)
    assert run.sizes["time"] == 12001
    assert run.attrs["status"] == "oscillating"
    assert run.attrs["mass_balance"] == pytest.approx(1.0, abs=1e-4)  # stored in float32
    blocks = [block.std() for block in np.array_split(run["I_d"].values, 6)]
    assert max(blocks) < 1.05 * min(blocks)  # a limit cycle, not a transient


@pytest.mark.parametrize("label", CURRENTS)
def test_current_meets_the_reference_code(label):
    run, (mean, std, f_kHz) = full_run(label), CURRENTS[label]
    assert run.attrs["I_d_mean"] == pytest.approx(mean, rel=0.06)
    assert run.attrs["f_kHz"] == pytest.approx(f_kHz, rel=0.03)
    assert run.attrs["I_d_std"] == pytest.approx(std, rel=0.35)  # near threshold: see the docs


def zone_coefficients(run, zone, equation):
    """Least-squares coefficients of one equation on zone averages, smoothed then differenced."""
    inside = run.where((run["z"] >= zone[0]) & (run["z"] <= zone[1]), drop=True).astype(float)
    n_i, n_n, u, R = (
        savgol_filter(inside[name].mean("z").values, 11, 3)
        for name in ("n_i", "n_n", "u_iz", "R_ion")
    )
    terms = (
        (n_i, n_i * n_n),
        (n_n, n_i * n_n),
        (n_i * u, n_i * n_n * R),
        (1 + 0 * R, n_i * n_n * R),
    )
    target = np.gradient((n_i, n_n)[equation % 2], 1.5e-6)
    theta = np.stack(terms[equation], axis=1)
    scale = np.linalg.norm(theta, axis=0)
    return np.linalg.lstsq(theta / scale, target)[0] / scale


def deviations(case):
    """Relative deviation of all coefficients of one point and zone."""
    label, zone = case
    found = [zone_coefficients(full_run(label), zone, k) for k in range(len(EQUATIONS))]
    return np.abs(np.concatenate(found) / COEFFICIENTS[case] - 1.0)


@pytest.mark.parametrize("case", COEFFICIENTS, ids=lambda c: f"{c[0]}-from-{c[1][0] * 1e2:g}-cm")
def test_zone_coefficients_are_near_the_reference_code(case):
    # The amplitude of the limit cycle differs at 200 V and at 300 V, 5 mg/s: see the docs.
    near = 0.36 if case[0] in ("200V_5mgs", "300V_5mgs") else 0.155
    assert deviations(case).max() < near


def test_most_zone_coefficients_meet_the_reference_code():
    close = np.concatenate([deviations(case) for case in COEFFICIENTS]) < 0.15
    assert close.size == 56
    assert close.sum() >= 48


@needs_table
def test_landmark_case_2_is_steady_at_the_benchmark_current():
    thruster = landmark_thruster(2, read_rate_table(RATE_TABLE))
    run = simulate(thruster, LANDMARK_POINT, duration_s=2e-3, progress=False)
    assert run.attrs["I_d_mean"] == pytest.approx(8.09, rel=0.01)
    assert run.attrs["I_d_std"] < 0.1


@needs_table
def test_landmark_case_3_oscillates_as_the_benchmark():
    thruster = landmark_thruster(3, read_rate_table(RATE_TABLE))
    run = simulate(thruster, LANDMARK_POINT, duration_s=4e-3, progress=False)
    assert run.attrs["status"] == "oscillating"
    assert run.attrs["I_d_mean"] == pytest.approx(7.89, rel=0.02)
    assert run.attrs["f_kHz"] == pytest.approx(9.7, rel=0.04)
    assert 3.5 < run.attrs["I_d_std"] < 4.6  # between 2-4 ms and saturation
