"""The continuity equations at every point of a channel: how many points find the factors that hold.

Each row is one run of `+exp=pointwise pointwise=continuity`, whose equations are

    n_i' = a ionization - w wall_loss - d div_i,    n_n' = -a ionization + w' wall_loss - u grad_n

The simulator has a = d = 1 and the speed u that was set.

    python -m benchmarks.continuity
"""

import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import xarray as xr

# Voltage (V), mass flow (mg/s) and the speed of the neutrals that is set (m/s).
POINTS = [(300, 5, 338), (200, 5, 320), (300, 2, 195), (400, 5, 338)]
VARIANTS = {
    "ionization free in each equation": ["relations=[]"],
    "n_i in place of wall_loss": ["terms=[n_i,ionization,div_i,grad_n]"],
}


def line(name: str, overrides: Sequence[str], speed: float) -> str:
    """Points whose factors of ionization, divergence and speed come within their fractions of 1."""
    with tempfile.TemporaryDirectory() as folder:
        program = [sys.executable, "-m", "experiments.run", "+exp=pointwise"]
        given = ["pointwise=continuity", *overrides, f"output={folder}", "keep=false"]
        subprocess.run([*program, *given], check=True, capture_output=True)
        with xr.open_dataset(next(Path(folder).rglob("pointwise.nc"))) as file:
            found = file.dropna("z", how="all", subset=["coef"]).load()
    ions, neutrals = found["coef"].sel(equation="n_i"), found["coef"].sel(equation="n_n")
    factors = {
        "ionization": ions.sel(term="ionization"),
        "divergence": -ions.sel(term="div_i"),
        "u_n": -neutrals.sel(term="grad_n") / speed,
    }
    words = []
    for term, values in factors.items():
        off = np.abs(values - 1.0)
        within = [f"{int((off < limit).sum())} within {limit:.0%}" for limit in (0.03, 0.05, 0.15)]
        words.append(f"{term} {', '.join(within)}")
    least = found["r2_test"].min().item()
    return f"{name}: {found.sizes['z']} points; {'; '.join(words)}; R2 {least:.3f} or more"


def main() -> None:
    for voltage, flow, speed in POINTS:
        point = "data.operating_point.{}={}"
        values = {"voltage": voltage, "mass_flow_mg_s": flow, "neutral_speed": speed}
        given = [point.format(key, value) for key, value in values.items()]
        print(line(f"{voltage} V, {flow} mg/s", given, speed), flush=True)
    for name, overrides in VARIANTS.items():
        print(line(name, overrides, POINTS[0][2]), flush=True)


if __name__ == "__main__":
    main()
