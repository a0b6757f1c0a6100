"""Long runs: one cycle at every operating point, and balances."""

import numpy as np
import pytest

from benchmarks.source import (
    CHECKED,
    DOWNSTREAM,
    LIF_POINT,
    NEAR_KM_S,
    PERFORMANCE,
    POINTS,
    VARIANTS,
    alternation_eV,
    at_point,
    full_run,
    speed_misses_km_s,
)
from ep2sindy.thruster.balance import zone_balance

pytestmark = pytest.mark.slow
BASE = "guessed start, N = 100"


def figures(label, variant):
    attributes = full_run(label, variant).attrs
    return [attributes[name] for name in ("I_d_mean", "I_d_std", "f_kHz")]


@pytest.mark.parametrize("label", POINTS)
def test_every_point_sustains_its_oscillation(label):
    run = full_run(label, BASE)
    assert run.attrs["status"] == "oscillating"
    assert run.attrs["I_d_std"] < 1.05 * run.attrs["I_d_mean"]
    blocks = [block.std() for block in np.array_split(run["I_d"].values, 4)]
    assert max(blocks) < 1.03 * min(blocks)  # a limit cycle, not a transient


@pytest.mark.parametrize("label", POINTS)
def test_hard_and_soft_starts_reach_one_cycle(label):
    hard, soft, guessed = (figures(label, name) for name in ("hard start", "soft start", BASE))
    for other in (soft, guessed):
        assert other[1] == pytest.approx(hard[1], rel=0.02)


@pytest.mark.parametrize("label", POINTS)
def test_grids_and_steps_agree(label):
    mean, std, f_kHz = figures(label, BASE)
    finer = figures(label, "N = 200")
    assert finer[0] == pytest.approx(mean, rel=0.01)
    assert finer[1] == pytest.approx(std, rel=0.06 if label != "400V_5mgs" else 0.08)
    assert finer[2] == pytest.approx(f_kHz, rel=0.011)
    assert figures(label, "CFL 0.2")[1] == pytest.approx(std, rel=0.03)  # first order in time


@pytest.mark.parametrize("label", POINTS)
def test_balances_close(label):
    run = full_run(label, BASE)
    balance = zone_balance(run, DOWNSTREAM)
    largest = max(float(abs(balance[name]).max()) for name in balance if name != "residual")
    assert float(abs(balance["residual"]).max()) < 1e-6 * largest
    assert run.attrs["mass_balance"] == pytest.approx(1.0, abs=1e-6)
    assert run.attrs["energy_balance"] == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("label", ["300V_5mgs", "400V_5mgs"])
def test_the_temperature_does_not_alternate_from_step_to_step(label):
    assert alternation_eV(label) < 0.01


def test_the_set_lif_has_the_measured_speeds_of_the_ions():
    assert (speed_misses_km_s(at_point("lif", *LIF_POINT)) <= NEAR_KM_S).sum() >= 8


@pytest.mark.parametrize(("point", "known"), PERFORMANCE.items())
def test_the_set_lif_has_the_measured_current_and_thrust(point, known):
    current_A, thrusts = known
    run = at_point("lif", *point)
    assert run.attrs["status"] == "oscillating"
    assert run.attrs["I_d_mean"] == pytest.approx(current_A, rel=0.15 if point[0] < 250 else 0.08)
    assert 1e3 * run.attrs["thrust_N"] == pytest.approx(np.mean(thrusts), rel=0.12)


@pytest.mark.parametrize(
    ("point", "between_grids"), [(LIF_POINT, 0.01), ((300.0, 4.0), 0.03), ((200.0, 5.0), 0.03)]
)
def test_the_set_lif_has_one_cycle_on_both_grids(point, between_grids):
    guessed, hard, soft, fine = (
        at_point("lif", *point, **VARIANTS[name]).attrs for name in CHECKED
    )
    for other in (hard, soft):
        assert other["f_kHz"] == pytest.approx(guessed["f_kHz"], rel=0.01)
        assert other["I_d_std"] == pytest.approx(guessed["I_d_std"], rel=0.05)
    assert fine["f_kHz"] == pytest.approx(guessed["f_kHz"], rel=between_grids)
