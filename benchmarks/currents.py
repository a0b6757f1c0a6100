"""One law from one signal at each operating point, every point left out in turn and run freely.

    python -m benchmarks.currents [grid voltage flow tube] [--noise 0.02]

Records of one signal: the discharge current of the package's thruster, 6 ms at twelve points, with
white noise in fractions of its mean; and the pressure of an oscillator of six terms at eleven
powers of its heater (tube), with 1.5 % noise. They are written as files, and `+exp=predict` is run
over them as a user would: it makes a second state, searches its equation over all records, and
chooses at points left out. A line per set: the equation, and how the models of the others live
there.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path

import numpy as np
import pandas as pd

import ep2sindy as ep

POINTS: dict[str, list[dict[str, float]]] = {
    "grid": [{"V_D_V": v, "mdot_mg_s": m} for v, m in product((300, 320, 340, 360), (4, 4.5, 5))],
    "voltage": [{"V_D_V": v} for v in range(290, 401, 10)],
    "flow": [{"mdot_mg_s": m} for m in np.linspace(3.8, 5.45, 12).round(2).tolist()],
}
VOLTAGE, FLOW, SPEED = 320.0, 4.5, 338.0  # of what does not vary, in V, mg/s and m/s
POWERS_kW, TUBE_NOISE = np.linspace(1.0, 2.0, 11), 0.015

Signal = tuple[Mapping[str, float], pd.DataFrame]


def currents(points: Sequence[Mapping[str, float]], noise: float) -> list[Signal]:
    rng, found = np.random.default_rng(0), []
    for point in points:
        at = point.get("V_D_V", VOLTAGE), point.get("mdot_mg_s", FLOW)
        field = ep.thruster.simulate(
            ep.thruster.Thruster(), ep.thruster.OperatingPoint(*at, neutral_speed=SPEED),
            cache=True, duration_s=6e-3, progress=False,
        )  # fmt: skip
        x = field["I_d"].values
        x = x + noise * x.mean() * rng.standard_normal(len(x))
        found.append((point, pd.DataFrame({"time (s)": field["time"].values, "I (A)": x})))
    return found


def tube() -> list[Signal]:
    """A pressure, with t in ms: 180 to 230 Hz, sixty periods."""
    library, rng, found = ep.polynomial(["p", "v"], degree=3), np.random.default_rng(0), []
    for power in POWERS_kW.tolist():
        w = 2.0 * np.pi * 0.18 * (0.94 + 0.06 * power)
        second = {
            "p": -(w**2), "v": w * (0.25 * power - 0.1), "p^2": w**2 * (0.084 + 0.036 * power),
            "p*v": -0.1 * w * power, "p^2*v": -w * (0.35 + 0.07 * (power - 1.0) ** 2),
            "p^3": -0.1 * w**2 * power,
        }  # fmt: skip
        coef = ep.model.coef_matrix(library, [{"v": 1.0}, second])
        model = ep.SparseModel(library, ["p", "v"], coef)
        x = model.simulate(np.arange(4200) / 10.8, [0.5, 0.0]).states[600:, 0]
        x = x + TUBE_NOISE * x.std() * rng.standard_normal(len(x))
        t = np.arange(len(x)) / 10.8e3
        found.append(({"P_kW": power}, pd.DataFrame({"time (s)": t, "p (Pa)": x})))
    return found


def measure(name: str, signals: Sequence[Signal], folder: Path) -> str:
    for point, samples in signals:
        words = "_".join(f"{key}={value:g}" for key, value in point.items())
        samples.to_csv(folder / f"{words}.csv", index=False)
    parameters = list(signals[0][0])
    pattern = "_".join(f"{key}={{{key}}}" for key in parameters)
    state = signals[0][1].columns[1].partition(" ")[0]
    run = subprocess.run(
        [sys.executable, "-m", "experiments.run", "+exp=predict", "models=null", "data=recognised",
         f"points.files='{folder / pattern}.csv'", f"trajectory.states=[{state}]",
         f"output={folder}", "map_points=null"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if run.returncode:
        return f"{name}: {run.stderr.strip() or run.stdout.strip()}"
    (path,) = folder.glob("predict/*/summary.json")
    summary = json.loads(path.read_text())
    (chosen,) = [trial for trial in summary["trials"] if trial["chosen"]]
    errors = summary["headline"]
    return (
        f"{name}: {chosen['terms']} by {chosen['functions']}; "
        f"{errors['n_sustained']} of {errors['n']} live, frequency "
        f"{errors['f_median']:.2%} in the median, {errors['f_90']:.2%} for nine in ten, "
        f"amplitude {errors['amplitude_median']:.1%}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="one law from one signal at each operating point")
    parser.add_argument("sets", nargs="*", default=[*POINTS, "tube"])
    parser.add_argument("--noise", type=float, default=0.0)
    arguments = parser.parse_args()
    for name in arguments.sets:
        known = tube() if name == "tube" else currents(POINTS[name], arguments.noise)
        start = time.perf_counter()
        with tempfile.TemporaryDirectory() as folder:
            print(measure(name, known, Path(folder)), flush=True)
        print(f"{time.perf_counter() - start:.0f} s", flush=True)


if __name__ == "__main__":
    main()
