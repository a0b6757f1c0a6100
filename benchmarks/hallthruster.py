"""Agreement with stored runs of HallThruster.jl v0.22: `python -m benchmarks.hallthruster`.

Its spt100 tutorial and its two calibrated SPT-100, read from inputs as theirs, and LANDMARK's fluid
cases at N = 200 with its inner radius (these need EP2SINDY_DATA=folder with the benchmark's own
landmark_rates.csv). Means over 1.5 to 2 ms; what is theirs lies in tests/data, with its source.
Prints the table of docs/thruster.md; tests/test_hallthruster_agreement.py holds it.
"""

from __future__ import annotations

import json
import math
import os
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any
from unittest.mock import patch

import numpy as np
import xarray as xr
import yaml

import ep2sindy as ep
from benchmarks.hallthruster_input import simulate_hallthruster_input
from benchmarks.landmark import LANDMARK_POINT, landmark_thruster, read_landmark_rates
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.thruster.axial import simulate as axial
from ep2sindy.thruster.axial.model import build_model as axial_model
from ep2sindy.thruster.axial.state_kernels import AxialModel
from ep2sindy.thruster.constants import K_BOLTZMANN, M_XENON

ROOT = Path(__file__).parents[1]
DATA = ROOT / "tests" / "data"
SPT100 = ROOT / "conf" / "thruster" / "spt100.yaml"
RATE_TABLE = Path(os.environ.get("EP2SINDY_DATA", ".")) / "landmark_rates.csv"
TUTORIAL = {"I_d": 6.715, "thrust": 0.1015}  # A; N, less what leaves towards the anode
# Means of test/regression/output/ref_*.json of their version of August 2026. beam: A; T_e: eV, the
# highest of the mean profile; thrust: mN.
STORED = {
    "baseline": {"I_d": 4.97, "beam": 3.99, "T_e": 24.5, "thrust": 95.3},
    "withplume": {"I_d": 5.47, "beam": 4.12, "T_e": 35.8, "thrust": 118.5},
}
# Singly charged ions of "withplume" over mm from the anode, in 1e17 m^-3.
STORED_N_I = {5.07: 1.9499, 10.4: 4.3175, 15.73: 7.1716, 18.93: 6.9584, 20.53: 6.7747,
              22.13: 24.785, 24.27: 28.001, 26.93: 16.227, 29.6: 2.6895, 30.67: 2.1607,
              31.73: 2.0106, 37.07: 1.7629, 42.4: 1.6212, 53.07: 1.4087}  # fmt: skip
NEUTRAL_SOUND = math.sqrt(5.0 / 3.0 * K_BOLTZMANN * 500.0 / M_XENON)  # 230 m/s
LANDMARK_RUNS = ((1, NEUTRAL_SOUND), (2, 0.0), (3, 0.0))  # case, wave speed of the neutrals
CASE_1_HZ = 10.4e3  # of the residual oscillation of LANDMARK case 1
LANDMARK = {1: (8.19, 0.16), 2: (8.09, 0.09), 3: (7.88, 3.34)}  # I_d: mean, deviation (A)
DECAY = -1.8e3  # 1/s, of the oscillation of LANDMARK case 2
PROFILES = ("n_i", "n_n", "T_e_eV", "E_z")


def _calibrated(
    voltage: float, coupling_V: float, loss_scale: float, ingestion: float, **gaussian: float
) -> dict[str, Any]:
    """A calibrated input of theirs, whose transport the background's pressure shifts."""
    return {
        "discharge_voltage": voltage, "cathode_coupling_voltage": coupling_V,
        "propellants": [{"gas": "Xenon", "max_charge": 3, "flow_rate_kg_s": 5e-6}],
        "transition_length": 4.174e-3, "cathode_Tev": 3.26173, "anode_Tev": 3.26173,
        "ion_wall_losses": True, "electron_ion_collisions": True, "solve_plume": True,
        "background_pressure_Torr": 1e-5, "background_temperature_K": 300.0,
        "neutral_ingestion_multiplier": ingestion,
        "wall_loss_model": {"type": "WallSheath", "material": "BNSiO2", "loss_scale": loss_scale},
        "anom_model": {
            "type": "LogisticPressureShift", "model": {"type": "GaussianBohm", **gaussian},
            "z0": -0.17682, "dz": 0.3594, "pstar": 4.735361e-05, "alpha": 15.0,
        },
    }  # fmt: skip


CALIBRATED = {
    "baseline": _calibrated(
        300.0, 30.0, 0.86904, 6.23341,
        hall_min=0.007015845, hall_max=0.0702476, center=0.02506, width=0.0065,
    ),
    "withplume": _calibrated(
        400.0, 35.0, 0.5, 6.0, hall_min=0.00625, hall_max=0.0625, center=0.026, width=0.005,
    ) | {"apply_thrust_divergence_correction": True},
}  # fmt: skip


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
    """Their tutorial from an input file as theirs."""
    xenon = {"gas": "Xenon", "max_charge": 1, "flow_rate_kg_s": 5e-6}
    return spt100_run({"propellants": [xenon], "discharge_voltage": 300}, n_cells=100)


def spt100_run(config: dict[str, Any], n_cells: int, duration_s: float = 2e-3) -> xr.Dataset:
    """An SPT-100 from an input file as theirs, its magnetic field that of thruster=spt100."""
    field = yaml.safe_load(SPT100.read_text())["magnetic_field"]
    table = {"z": [0.025 + distance for distance in field["distance"]], "B": field["B"]}
    geometry = {"inner_radius": 0.035, "outer_radius": 0.05, "channel_length": 0.025}
    thruster = {"geometry": geometry, "magnetic_field": table}
    given = {
        "config": {"thruster": thruster, "domain": [0.0, 0.08], **config},
        "simulation": {"duration": duration_s, "grid": {"type": "EvenGrid", "num_cells": n_cells}},
    }
    with TemporaryDirectory() as folder:
        path = Path(folder) / "spt100.json"
        path.write_text(json.dumps(given))
        return simulate_hallthruster_input(path, sample_s=1.5e-6, progress=False)


def calibrated_run(
    name: str, *, neutrals_stay: bool = False, duration_s: float = 2e-3, n_cells: int = 150
) -> xr.Dataset:
    """One of their calibrated SPT-100 as it is: three charges, the plume's area, the background.

    neutrals_stay: as in HallThruster.jl, where the plume's area is in the equations of the ions
    alone. Neutrals then stay dense where ions spread, and ions are born of them over the plume's
    whole area, some 6 % more than neutrals are consumed.
    """

    def build_model(*given: Any, **settings: Any) -> AxialModel:
        model = axial_model(*given, **settings)
        before, behind = model.inverse_dz.copy(), model.inverse_dz.copy()
        return model._replace(neutral_before=before, neutral_behind=behind)

    with patch.object(axial, "build_model", build_model if neutrals_stay else axial_model):
        return spt100_run(CALIBRATED[name], n_cells, duration_s)


def figures(run: xr.Dataset) -> dict[str, float]:
    """Mean current and beam in A, the highest mean T_e in eV, and thrust in mN, as in `STORED`."""
    mean = late(run).mean("time")
    return {
        "I_d": float(mean["I_d"]),
        "beam": float(mean["I_beam"]),
        "T_e": float(mean["T_e_eV"].max()),
        "thrust": 1e3 * float(mean["thrust"]),
    }


def n_i_over_theirs(run: xr.Dataset) -> np.ndarray:
    """Mean density of singly charged ions over theirs, at the places of `STORED_N_I`."""
    n_i = late(run)["n_i"].mean("time").interp(z=1e-3 * np.array(list(STORED_N_I)))
    return 1e-17 * n_i.values / np.array(list(STORED_N_I.values()))


def net_thrust(run: xr.Dataset) -> float:
    """Mean thrust in N less the momentum that ions carry into the anode."""
    parameters = json.loads(run.attrs["parameters"])["thruster"]
    area = math.pi * (parameters["outer_radius"] ** 2 - parameters["inner_radius"] ** 2)
    mean = late(run).mean("time")
    first = mean.isel(z=0)
    backwards = ep.thruster.XenonFits.mass * area * float(first["n_i"] * first["u_iz"] ** 2)
    return float(mean["thrust"]) - backwards


def landmark_run(case: int, *, neutral_wave: float = 0.0) -> xr.Dataset:
    """LANDMARK's case as theirs: N = 200, inner radius 34.5 mm, first order in case 1.

    neutral_wave: speed of sound of the neutrals in m/s that enters their flux. HallThruster.jl
    takes that of 500 K, NEUTRAL_SOUND; the neutrals' equation alone needs none.
    """
    rates = read_landmark_rates(RATE_TABLE)
    thruster = replace(landmark_thruster(case, rates), inner_radius=0.0345)

    def build_model(*given: Any, **settings: Any) -> AxialModel:
        return axial_model(*given, **settings)._replace(neutral_wave=neutral_wave)

    with patch.object(axial, "build_model", build_model):
        return ep.thruster.simulate(
            thruster, LANDMARK_POINT, duration_s=2e-3, warm_up_s=0.0, n_cells=200, stretch=1.0,
            reconstruct=case > 1, progress=False,
        )  # fmt: skip


def line_Hz(run: xr.Dataset) -> float:
    """Frequency of the current from 0.5 ms on."""
    current = run["I_d"].sel(time=slice(0.5e-3, 2e-3))
    return dominant_frequency(current["time"].values, current.values)


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
    for name, theirs in STORED.items():
        for kind, run in (
            ("as it is", calibrated_run(name)),
            ("as it is, neutrals stay", calibrated_run(name, neutrals_stay=True)),
        ):
            ours = figures(run)
            line = ", ".join(f"{k} {ours[k]:.2f} ({v})" for k, v in theirs.items())
            line += f"; mass balance {run.attrs['mass_balance']:.4f}"
            if name == "withplume":
                line += f"; n_i over theirs {', '.join(f'{f:.2f}' for f in n_i_over_theirs(run))}"
            print(f"{name}, {kind}: {line}")
    if not RATE_TABLE.exists():
        print("LANDMARK: name the folder of landmark_rates.csv with EP2SINDY_DATA")
        return
    for case, wave in LANDMARK_RUNS:
        run, (mean, std) = landmark_run(case, neutral_wave=wave), LANDMARK[case]
        part = late(run)["I_d"]
        line = f"LANDMARK case {case}, N = 200{', their wave speed' if wave else ''}: "
        line += f"I_d {float(part.mean()):.2f} / {float(part.std()):.2f} A"
        line += f" ({mean} / {std}), {1e-3 * line_Hz(run):.1f} kHz"
        if case < 3:
            off = deviations(late(run).mean("time"), stored(f"hallthruster_landmark_{case}.csv"))
            line += f"; {percent(off)}"
        if case == 2:
            line += f"; decays at {decay_rate(run['I_d']):.0f} 1/s ({DECAY:.0f})"
        print(line)


if __name__ == "__main__":
    main()
