"""Long runs of the (z, r) model: one cycle on every grid, from every start, at a known cost."""

from functools import cache

import pytest

from benchmarks.simulator_2d import Cycle, cycle
from ep2sindy.thruster.plane.simulate import simulate_2d

pytestmark = pytest.mark.slow

MIDDLE, FINE = (62, 74), (82, 98)


@cache
def settled(n_z: int, n_r: int, cold: bool = False) -> Cycle:
    return cycle(n_z, n_r, cold=cold)


def test_the_cycle_does_not_depend_on_the_grid():
    middle, fine = settled(*MIDDLE), settled(*FINE)
    assert fine.std_A > 2.0
    assert middle.std_A == pytest.approx(fine.std_A, rel=0.15)  # 0.12: finer grids damp it
    assert middle.f_kHz == pytest.approx(fine.f_kHz, rel=0.02)
    assert middle.mean_A == pytest.approx(fine.mean_A, rel=0.02)


def test_a_cold_start_reaches_the_same_cycle():
    usual, cold = settled(*MIDDLE), settled(*MIDDLE, cold=True)
    assert cold.std_A == pytest.approx(usual.std_A, rel=0.06)
    assert cold.f_kHz == pytest.approx(usual.f_kHz, rel=0.02)


@pytest.mark.parametrize("grid", [MIDDLE, FINE])
def test_what_enters_leaves_or_stays(grid):
    assert settled(*grid).mass_balance == pytest.approx(1.0, abs=1e-6)


def test_the_default_run_oscillates_to_its_end():
    run = simulate_2d(duration_s=6e-3, progress=False)
    assert run.attrs["status"] == "oscillating"
    assert 10.0 < run.attrs["f_kHz"] < 12.5
    assert run.attrs["I_d_std"] > 2.0
