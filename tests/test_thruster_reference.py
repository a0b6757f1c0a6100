"""Long runs against reference values: LANDMARK's fluid cases and the six operating points."""

import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from benchmarks.operating_points import COEFFICIENTS, CURRENTS, coefficient_ratios
from ep2sindy.thruster.landmark import LANDMARK_POINT, landmark_thruster, read_landmark_rates
from ep2sindy.thruster.parameters import OPERATING_POINTS, Thruster
from ep2sindy.thruster.simulate import simulate

pytestmark = pytest.mark.slow
# The benchmark's own table is not ours to ship: name it with EP2SINDY_DATA=folder.
RATE_TABLE = Path(os.environ.get("EP2SINDY_DATA", ".")) / "landmark_rates.csv"
needs_table = pytest.mark.skipif(
    not RATE_TABLE.exists(), reason="needs EP2SINDY_DATA with landmark_rates.csv"
)


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


def deviations(case):
    """Relative deviation of all coefficients of one point and zone."""
    return np.abs(coefficient_ratios(full_run(case[0]), case) - 1.0)


@pytest.mark.parametrize("case", COEFFICIENTS, ids=lambda c: f"{c[0]}-from-{c[1][0] * 1e2:g}-cm")
def test_zone_coefficients_are_near_the_reference_code(case):
    # The amplitude of the limit cycle differs at 200 V and at 300 V, 5 mg/s: see the docs.
    near = 0.36 if case[0] in ("200V_5mgs", "300V_5mgs") else 0.155
    assert deviations(case).max() < near


def test_most_zone_coefficients_meet_the_reference_code():
    close = np.concatenate([deviations(case) for case in COEFFICIENTS]) < 0.15
    assert close.size == 62
    assert close.sum() >= 52


@needs_table
def test_landmark_case_2_is_steady_at_the_benchmark_current():
    thruster = landmark_thruster(2, read_landmark_rates(RATE_TABLE))
    run = simulate(thruster, LANDMARK_POINT, duration_s=2e-3, progress=False)
    assert run.attrs["I_d_mean"] == pytest.approx(8.09, rel=0.01)
    assert run.attrs["I_d_std"] < 0.1


@needs_table
def test_landmark_case_3_oscillates_as_the_benchmark():
    thruster = landmark_thruster(3, read_landmark_rates(RATE_TABLE))
    run = simulate(thruster, LANDMARK_POINT, duration_s=4e-3, progress=False)
    assert run.attrs["status"] == "oscillating"
    assert run.attrs["I_d_mean"] == pytest.approx(7.89, rel=0.02)
    assert run.attrs["f_kHz"] == pytest.approx(9.7, rel=0.04)
    assert 3.5 < run.attrs["I_d_std"] < 4.6  # between 2-4 ms and saturation
