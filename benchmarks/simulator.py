"""What a simulated millisecond costs: `python -m benchmarks.simulator`.

`python -m benchmarks.simulator docs/thruster_stability.png` also draws the stability map of
docs/thruster.md: the current's amplitude against plume transport and series resistance.
"""

import sys
import time
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from ep2sindy.thruster import kernels
from ep2sindy.thruster.discretization import build_model, initial_state
from ep2sindy.thruster.parameters import OperatingPoint, Thruster
from ep2sindy.thruster.simulate import FIELDS, simulate
from ep2sindy.thruster.transport import AnomalousTransport

SAMPLE_S = 1.5e-6
TARGET_CPU_S_PER_MS = 0.64  # at 100 cells, one core


def cost(n_cells: int, duration_s: float) -> tuple[float, int]:
    """CPU seconds and time steps of a run at 300 V, 5 mg/s, after its warm-up."""
    model = build_model(Thruster(), OperatingPoint(300.0, 5.0), n_cells)
    state = initial_state(Thruster(), model)
    for seconds in (0.2e-3, duration_s):  # the first pass compiles and leaves the start behind
        n_rows = round(seconds / SAMPLE_S)
        fields = [np.empty((n_rows, n_cells), np.float32) for _ in FIELDS]
        began = time.process_time()
        series = [np.empty(n_rows) for _ in range(3)]
        done, steps = kernels.advance(state, model, SAMPLE_S, *fields, *series)
        spent = time.process_time() - began
        if done < n_rows:
            raise RuntimeError(f"the benchmark run diverged at sample {done} of {n_rows}")
    return spent, steps


def draw_stability_map(path: Path) -> None:
    """Draw std(I_d) at 300 V, 5 mg/s from 3 to 5 ms over c2 and the series resistance."""
    inverse_c2, ohms = (160, 120, 100, 90, 80, 70, 60, 50, 40), (0.0, 1.0, 2.0, 3.0, 5.0)
    amplitude = np.full((len(ohms), len(inverse_c2)), np.nan)  # nan where a run diverged
    for i, resistance in enumerate(ohms):
        for j, inverse in enumerate(inverse_c2):
            thruster = Thruster(
                transport=AnomalousTransport(c_plume=1 / inverse), series_resistance=resistance
            )
            point = OperatingPoint(300.0, 5.0)
            run = simulate(thruster, point, duration_s=2e-3, warm_up_s=3e-3, progress=False)
            if run.attrs["status"] != "diverged":
                amplitude[i, j] = run.attrs["I_d_std"]
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(amplitude, origin="lower", aspect="auto", cmap="viridis")
    for (i, j), value in np.ndenumerate(amplitude):
        label = f"{value:.1f}" if np.isfinite(value) else "div"
        axes.text(j, i, label, ha="center", va="center", color="white", fontsize=8)
    axes.set_xticks(range(len(inverse_c2)), [f"1/{inverse}" for inverse in inverse_c2])
    axes.set_yticks(range(len(ohms)), [f"{resistance:g}" for resistance in ohms])
    axes.set(xlabel="plume coefficient $c_2$", ylabel="series resistance (ohm)")
    figure.colorbar(image, label="standard deviation of $I_d$ (A)")
    figure.savefig(path, dpi=110)
    print(f"drawn: {path}")


def main() -> None:
    """Print the cost on three grids; 100 cells has a target."""
    print("cells  CPU-s per ms  ns per cell and step  time step (ns)")
    for n_cells in (50, 100, 200):
        duration_s = 4e-3
        spent, steps = cost(n_cells, duration_s)
        per_ms = spent / (1e3 * duration_s)
        per_cell = 1e9 * spent / (steps * n_cells)
        print(f"{n_cells:5d}  {per_ms:12.3f}  {per_cell:20.1f}  {1e9 * duration_s / steps:14.1f}")
        if n_cells == 100:
            verdict = "met" if per_ms <= TARGET_CPU_S_PER_MS else "missed"
            print(f"       target {TARGET_CPU_S_PER_MS} CPU-s per ms at 100 cells: {verdict}")
    if len(sys.argv) > 1:
        draw_stability_map(Path(sys.argv[1]))


if __name__ == "__main__":
    main()
