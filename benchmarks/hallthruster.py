"""Agreement with stored runs of HallThruster.jl v0.22: `python -m benchmarks.hallthruster`.

Its spt100 tutorial, read from an input as theirs, and LANDMARK's fluid cases at N = 200 with its
inner radius (these need EP2SINDY_DATA=folder with the benchmark's own landmark_rates.csv). Means
over 1.5 to 2 ms; what is theirs lies in tests/data, with its source. Prints the table of
docs/thruster.md; tests/test_hallthruster_agreement.py holds it.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import xarray as xr
import yaml

import ep2sindy as ep
from benchmarks.landmark import LANDMARK_POINT, landmark_thruster, read_landmark_rates

ROOT = Path(__file__).parents[1]
DATA = ROOT / "tests" / "data"
SPT100 = ROOT / "conf" / "thruster" / "spt100.yaml"
RATE_TABLE = Path(os.environ.get("EP2SINDY_DATA", ".")) / "landmark_rates.csv"
TUTORIAL = {"I_d": 6.715, "thrust": 0.1015}  # A; N, less what leaves towards the anode
LANDMARK = {1: (8.19, 0.40), 2: (8.09, 0.09), 3: (7.88, 3.34)}  # I_d: mean, deviation (A)
DECAY = -1.8e3  # 1/s, of the oscillation of LANDMARK case 2
PROFILES = ("n_i", "n_n", "T_e_eV", "E_z")


def stored(name: str) -> dict[str, np.ndarray]:
    """Columns of a file in tests/data."""
    lines = [line for line in (DATA / name).read_text().splitlines() if not line.startswith("#")]
    values = np.array([line.split(",") for line in lines[1:]], dtype=float)
    return dict(zip(lines[0].split(","), values.T, strict=True))


def late(run: xr.Dataset) -> xr.Dataset:
    """What their stored runs are means of: from 1.5 to 2 ms."""
    return run.sel(time=slice(1.5e-3, 2e-3))


def deviations(mean: xr.Dataset, reference: dict[str, np.ndarray]) -> dict[str, float]:
    """Of each profile, the norm of the difference over the norm of the reference."""
    z, found = 1e-3 * reference["z_mm"], {}
    for name in PROFILES:
        off = np.interp(z, mean["z"].values, mean[name].values) - reference[name]
        found[name] = math.sqrt(float((off @ off) / (reference[name] @ reference[name])))
    return found


def tutorial_run() -> xr.Dataset:
    """Their tutorial from an input file as theirs, its magnetic field that of thruster=spt100."""
    field = yaml.safe_load(SPT100.read_text())["magnetic_field"]
    rows = [f"{0.025 + z},{B}" for z, B in zip(field["distance"], field["B"], strict=True)]
    geometry = {"inner_radius": 0.035, "outer_radius": 0.05, "channel_length": 0.025}
    thruster = {"geometry": geometry, "magnetic_field": {"file": "bfield.csv"}}
    xenon = {"gas": "Xenon", "max_charge": 1, "flow_rate_kg_s": 5e-6}
    given = {
        "config": {
            "thruster": thruster, "domain": [0.0, 0.08], "propellants": [xenon],
            "discharge_voltage": 300,
        },
        "simulation": {"duration": 2e-3, "grid": {"type": "EvenGrid", "num_cells": 100}},
    }  # fmt: skip
    with TemporaryDirectory() as folder:
        path = Path(folder) / "spt100.json"
        path.with_name("bfield.csv").write_text("\n".join(rows) + "\n")
        path.write_text(json.dumps(given))
        return ep.thruster.simulate_hallthruster_input(
            path, cache=folder, sample_s=1.5e-6, progress=False
        )


def net_thrust(run: xr.Dataset) -> float:
    """Mean thrust in N less the momentum that ions carry into the anode."""
    parameters = json.loads(run.attrs["parameters"])["thruster"]
    area = math.pi * (parameters["outer_radius"] ** 2 - parameters["inner_radius"] ** 2)
    mean = late(run).mean("time")
    first = mean.isel(z=0)
    backwards = ep.thruster.XenonFits.mass * area * float(first["n_i"] * first["u_iz"] ** 2)
    return float(mean["thrust"]) - backwards


def landmark_run(case: int) -> xr.Dataset:
    """LANDMARK's case as theirs: N = 200, inner radius 34.5 mm, first order in case 1."""
    rates = read_landmark_rates(RATE_TABLE)
    thruster = replace(landmark_thruster(case, rates), inner_radius=0.0345)
    return ep.thruster.simulate(
        thruster, LANDMARK_POINT, duration_s=2e-3, warm_up_s=0.0, n_cells=200, stretch=1.0,
        reconstruct=case > 1, progress=False,
    )  # fmt: skip


def decay_rate(current: xr.DataArray, start: float = 0.6e-3, end: float = 1.6e-3) -> float:
    """Of an oscillation's amplitude, in 1/s, by its deviation in blocks of 0.2 ms."""
    edges = np.arange(start, end + 1e-5, 2e-4)
    parts = [current.sel(time=slice(a, b)) for a, b in pairwise(edges)]
    return float(np.polyfit(edges[:-1], [math.log(float(p.std())) for p in parts], 1)[0])


def percent(off: dict[str, float]) -> str:
    return ", ".join(f"{name} {100.0 * off[name]:.1f} %" for name in PROFILES)


def main() -> None:
    run = tutorial_run()
    current = late(run)["I_d"]
    print(
        f"spt100 tutorial: I_d {float(current.mean()):.3f} A, std {float(current.std()):.2f} "
        f"({TUTORIAL['I_d']}); thrust {1e3 * net_thrust(run):.1f} mN "
        f"({1e3 * TUTORIAL['thrust']:.1f}); "
        f"{percent(deviations(late(run).mean('time'), stored('hallthruster_spt100.csv')))}"
    )
    if not RATE_TABLE.exists():
        print("LANDMARK: name the folder of landmark_rates.csv with EP2SINDY_DATA")
        return
    for case, theirs in LANDMARK.items():
        run = landmark_run(case)
        part = late(run)["I_d"]
        line = f"LANDMARK case {case}: I_d {float(part.mean()):.2f} / {float(part.std()):.2f} A"
        line += f" ({theirs[0]} / {theirs[1]})"
        if case == 2:
            off = deviations(late(run).mean("time"), stored("hallthruster_landmark_2.csv"))
            line += f"; {percent(off)}; decays at {decay_rate(run['I_d']):.0f} 1/s ({DECAY:.0f})"
        print(line)


if __name__ == "__main__":
    main()
