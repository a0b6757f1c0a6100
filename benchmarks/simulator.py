"""The map of stability of docs/thruster.md: the current's amplitude against plume transport and
series resistance.

    python -m benchmarks.simulator docs/thruster_stability.png
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import ep2sindy as ep

POINT = ep.thruster.OperatingPoint(300.0, 5.0)


def draw_stability_map(path: Path) -> None:
    """Draw std(I_d) at 300 V, 5 mg/s from 3 to 5 ms over c2 and the series resistance."""
    inverse_c2, ohms = (120, 105, 95, 85, 77, 69, 62, 55, 45), (0.0, 0.4, 0.8, 1.2, 2.0, 4.0)
    amplitude = np.full((len(ohms), len(inverse_c2)), np.nan)  # nan where a run diverged
    for i, resistance in enumerate(ohms):
        for j, inverse in enumerate(inverse_c2):
            thruster = ep.thruster.Thruster(
                transport=ep.thruster.AnomalousTransport(c_plume=1 / inverse),
                series_resistance=resistance,
            )
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


if __name__ == "__main__":
    draw_stability_map(Path(sys.argv[1]))
