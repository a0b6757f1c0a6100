"""The (z, r) simulator on three grids: its cycle, its mass balance, its cost.

    python -m benchmarks.simulator_2d

Prints the table of docs/thruster.md; tests/test_plane_reference.py holds it. Some ten
minutes.
"""

import time
from dataclasses import dataclass

import numpy as np

from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.thruster.plane.grid import MaskedGrid
from ep2sindy.thruster.plane.kernels import advance
from ep2sindy.thruster.plane.simulate import (
    OPERATING_POINT_2D,
    THRUSTER_2D,
    Rows,
    build_model,
    initial_state,
    state_of,
)
from ep2sindy.thruster.plane.state_kernels import PlaneModel, PlaneState, new_work

SAMPLE_S = 1.5e-6
WARM_UP_S, DURATION_S = 3e-3, 10e-3  # half milliseconds differ by 7 % in amplitude
GRIDS = ((41, 49), (62, 74), (82, 98))


@dataclass(frozen=True)
class Cycle:
    """What a run settles to, and what it cost."""

    mean_A: float
    std_A: float
    f_kHz: float
    mass_balance: float
    cpu_s_per_ms: float

    def __str__(self) -> str:
        return (
            f"{self.mean_A:6.2f} {self.std_A:6.2f} {self.f_kHz:7.2f} {self.mass_balance:9.6f} "
            f"{self.cpu_s_per_ms:8.2f}"
        )


def cold_state(grid: MaskedGrid, model: PlaneModel) -> PlaneState:
    """A thin, cold, resting plasma in the whole neutral flow: nothing of the cycle in it."""
    shape = (grid.n_z, grid.n_r)
    neutrals = np.full(shape, model.neutral_inflow / model.neutral_speed)
    ions = np.full(shape, 2e16)
    return state_of(grid, ions, np.zeros(shape), neutrals, np.full(grid.n_z, 5.0))


def cycle(n_z: int, n_r: int, *, cold: bool = False, warm_up_s: float = WARM_UP_S) -> Cycle:
    """Current after the warm-up, on one grid."""
    grid = MaskedGrid(THRUSTER_2D, n_z, n_r)
    model = build_model(THRUSTER_2D, OPERATING_POINT_2D, grid)
    state = (cold_state if cold else initial_state)(grid, model)
    one, work = Rows.allocate(1, grid), new_work(n_z, n_r)
    sample = tuple(one.planes), one.profiles, one.series
    advance(state, model, work, 1e-9, True, *sample)  # compiled
    n_warm_up, n_rows = round(warm_up_s / SAMPLE_S), round(DURATION_S / SAMPLE_S)
    series = np.empty((n_warm_up + n_rows, one.series.shape[1]))
    began = time.process_time()
    for k in range(len(series)):
        done = advance(state, model, work, SAMPLE_S, True, *sample)
        series[k] = one.series[0]
        if not done:
            raise RuntimeError(f"the run on {n_z} x {n_r} diverged at {1e3 * k * SAMPLE_S:.2f} ms")
    spent = time.process_time() - began
    current, ms = series[n_warm_up:, 0], 1e3 * SAMPLE_S * len(series)
    entered = 1e-6 * OPERATING_POINT_2D.mass_flow_mg_s * SAMPLE_S * (len(series) - 1)
    return Cycle(
        mean_A=float(current.mean()),
        std_A=float(current.std()),
        f_kHz=1e-3 * dominant_frequency(SAMPLE_S * np.arange(n_rows), current),
        mass_balance=float(np.diff(series[[0, -1], 2:].sum(axis=1))[0] / entered),
        cpu_s_per_ms=spent / ms,
    )


def main() -> None:
    """Print what every grid settles to, and a cold start on the middle one."""
    print("grid         mean A  std A   f kHz   out/in  CPU-s/ms")
    for n_z, n_r in GRIDS:
        print(f"{n_z:3d} x {n_r:<3d}    {cycle(n_z, n_r)}", flush=True)
    print(f"62 x 74 cold {cycle(62, 74, cold=True)}")


if __name__ == "__main__":
    main()
