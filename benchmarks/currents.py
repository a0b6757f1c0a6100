"""One law from the discharge current at each operating point, every point left out and run freely.

    python -m benchmarks.currents [--noise 0.02]

The current of the package's thruster, 6 ms at four voltages and three mass flows, with white noise
in fractions of its mean, is written as files, and `+exp=predict` is run over them as a user would:
it makes a second state, searches its equation over all records, and chooses at points left out.
Prints the equation, and how the models of the others run there, next to interpolation.
"""

import argparse
import json
import subprocess
import sys
import tempfile
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

import ep2sindy as ep

POINTS = tuple(product((300.0, 320.0, 340.0, 360.0), (4.0, 4.5, 5.0)))  # V and mg/s
SPEED = 338.0  # m/s, of the neutrals


def write_currents(folder: Path, noise: float) -> None:
    """One file for every point."""
    rng = np.random.default_rng(0)
    for voltage, flow in POINTS:
        field = ep.thruster.simulate(
            ep.thruster.Thruster(), ep.thruster.OperatingPoint(voltage, flow, neutral_speed=SPEED),
            cache=True, duration_s=6e-3, progress=False,
        )  # fmt: skip
        x = field["I_d"].values
        x = x + noise * x.mean() * rng.standard_normal(len(x))
        samples = pd.DataFrame({"time (s)": field["time"].values, "I (A)": x})
        samples.to_csv(folder / f"V={voltage:g}_m={flow:g}.csv", index=False)


def measure(folder: Path) -> str:
    """What the program finds in the files of a folder."""
    run = subprocess.run(
        [sys.executable, "-m", "experiments.run", "+exp=predict", "data=recognised",
         f"points.files='{folder}/V={{V_D_V}}_m={{mdot_mg_s}}.csv'", "trajectory.states=[I]",
         f"output={folder}", "map_points=null"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if run.returncode:
        return run.stderr.strip() or run.stdout.strip()
    (path,) = folder.glob("predict/*/summary.json")
    summary = json.loads(path.read_text())
    (chosen,) = [trial for trial in summary["trials"] if trial["chosen"]]
    errors = summary["headline"]
    return (
        f"{chosen['terms']} by {chosen['functions']}; {errors['n_sustained']} of {errors['n']} "
        f"sustained, frequency {errors['f_median']:.2%} in the median, {errors['f_90']:.2%} for "
        f"nine in ten, amplitude {errors['amplitude_median']:.1%}; at the {errors['n_enclosed']} "
        f"that the others enclose: frequency {errors['f_enclosed']:.3%}, amplitude "
        f"{errors['amplitude_enclosed']:.1%}; interpolated without a model: "
        f"{errors['f_interpolated']:.3%}, {errors['amplitude_interpolated']:.1%}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="one law from the current at each point")
    parser.add_argument("--noise", type=float, default=0.0)
    noise = parser.parse_args().noise
    with tempfile.TemporaryDirectory() as folder:
        write_currents(Path(folder), noise)
        print(measure(Path(folder)))


if __name__ == "__main__":
    main()
