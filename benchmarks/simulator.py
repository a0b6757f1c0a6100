"""What a simulated millisecond costs: `python -m benchmarks.simulator`.

`python -m benchmarks.simulator docs/thruster_stability.png` also draws the stability map of
docs/thruster.md: the current's amplitude against plume transport and series resistance.
"""

import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import ep2sindy as ep

TARGETS_CPU_S_PER_MS = {100: 0.15, 200: 0.55}  # on the uniform grid, one core
POINT = ep.thruster.OperatingPoint(300.0, 5.0)


def cost(n_cells: int, *, duration_s: float = 2e-3, n_repeats: int = 3) -> tuple[float, float]:
    """Least and median CPU seconds of a millisecond, averages recorded, after its warm-up."""
    settings = {"n_cells": n_cells, "stretch": 1.0, "progress": False}
    started = ep.thruster.simulate(
        ep.thruster.Thruster(), POINT, duration_s=3e-4, warm_up_s=1e-3, **settings
    )
    spent = []
    for _ in range(n_repeats):
        began = time.process_time()
        ep.thruster.simulate(
            ep.thruster.Thruster(),
            POINT,
            duration_s=duration_s,
            warm_up_s=0.0,
            initial=started,
            **settings,
        )
        spent.append((time.process_time() - began) / (1e3 * duration_s))
    return min(spent), float(np.median(spent))


def draw_stability_map(path: Path) -> None:
    """Draw std(I_d) at 300 V, 5 mg/s from 3 to 5 ms over c2 and the series resistance."""
    inverse_c2, ohms = (120, 105, 95, 85, 77, 69, 62, 55, 45), (0.0, 0.4, 0.8, 1.2, 2.0, 4.0)
    amplitude = np.full((len(ohms), len(inverse_c2)), np.nan)  # nan where a run diverged
    for i, resistance in enumerate(ohms):
        for j, inverse in enumerate(inverse_c2):
            thruster = ep.thruster.Thruster()
            transport = replace(thruster.transport, c_plume=1 / inverse)
            thruster = replace(thruster, transport=transport, series_resistance=resistance)
            run = ep.thruster.simulate(
                thruster, POINT, duration_s=2e-3, warm_up_s=3e-3, progress=False
            )
            if run.attrs["status"] != "diverged":
                amplitude[i, j] = run.attrs["I_d_std"]
    figure = Figure(figsize=(6.4, 3.2), layout="constrained")
    axes = figure.subplots()
    image = axes.imshow(amplitude, origin="lower", aspect="auto", cmap="viridis")
    for (i, j), value in np.ndenumerate(amplitude):
        label = f"{value:.1f}" if np.isfinite(value) else "div"
        ink = "black" if value > 0.6 * np.nanmax(amplitude) else "white"
        axes.text(j, i, label, ha="center", va="center", color=ink, fontsize=8)
    axes.set_xticks(range(len(inverse_c2)), [f"1/{inverse}" for inverse in inverse_c2])
    axes.set_yticks(range(len(ohms)), [f"{resistance:g}" for resistance in ohms])
    axes.set(xlabel="plume coefficient $c_2$", ylabel="series resistance (ohm)")
    figure.colorbar(image, label="standard deviation of $I_d$ (A)")
    figure.savefig(path, dpi=110)
    print(f"drawn: {path}")


def main() -> None:
    """Print the cost on three grids, and of the default run; two grids have a target."""
    print("cells  CPU-s per ms: least, median")
    for n_cells in (50, 100, 200):
        least, median = cost(n_cells)
        target = TARGETS_CPU_S_PER_MS.get(n_cells)
        verdict = (
            "" if target is None else f"  target {target}: {'met' if least <= target else 'missed'}"
        )
        print(f"{n_cells:5d}  {least:.3f}, {median:.3f}{verdict}")
    began = time.process_time()
    ep.thruster.simulate(ep.thruster.Thruster(), POINT, progress=False)
    print(f"18 ms and 2 ms of warm-up: {time.process_time() - began:.1f} CPU-s, target 5")
    if len(sys.argv) > 1:
        draw_stability_map(Path(sys.argv[1]))


if __name__ == "__main__":
    main()
