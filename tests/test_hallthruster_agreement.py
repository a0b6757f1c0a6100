"""Against stored runs of HallThruster.jl that solve the same equations: LANDMARK, an SPT-100."""

import math
import os
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import yaml

import ep2sindy as ep
from ep2sindy.thruster.landmark import read_landmark_rates

DATA = Path(__file__).parent / "data"
SPT100 = Path(__file__).parents[1] / "conf" / "thruster" / "spt100.yaml"
RATE_TABLE = Path(os.environ.get("EP2SINDY_DATA", ".")) / "landmark_rates.csv"
POINT = ep.OperatingPoint(300.0, 5.0, neutral_speed=150.0)

pytestmark = pytest.mark.slow


def columns(name: str) -> dict[str, np.ndarray]:
    lines = [line for line in (DATA / name).read_text().splitlines() if not line.startswith("#")]
    values = np.array([line.split(",") for line in lines[1:]], dtype=float)
    return dict(zip(lines[0].split(","), values.T, strict=True))


def late_mean(run: xr.Dataset) -> xr.Dataset:
    """What HallThruster.jl stores: the mean over 1.5 to 2 ms."""
    return run.sel(time=slice(1.5e-3, 2e-3)).mean("time")


def deviations(mean: xr.Dataset, reference: dict[str, np.ndarray]) -> dict[str, float]:
    """Of each profile, the norm of the difference over the norm of the reference."""
    z = 1e-3 * reference["z_mm"]
    found = {}
    for name in ("n_i", "n_n", "T_e_eV", "E_z"):
        ours = np.interp(z, mean["z"].values, mean[name].values)
        off = ours - reference[name]
        found[name] = math.sqrt(float((off @ off) / (reference[name] @ reference[name])))
    return found


def tutorial_thruster() -> ep.Thruster:
    field = yaml.safe_load(SPT100.read_text())["magnetic_field"]
    return ep.Thruster(
        domain_length=0.08,
        magnetic_field=ep.MagneticFieldTable(
            distance=tuple(field["distance"]), B=tuple(field["B"])
        ),
        transport=ep.AnomalousTransport(1 / 160, 1 / 16, 2.5e-3),
        propellant=ep.propellant("xenon_5eV"),
        wall=ep.wall_material(
            name="BN-SiO2", electron_scale=1.0, ion_scale=0.0, plume_collisions=0.0,
            transition=2.5e-3,
        ),
        anode=ep.AnodeSheath(T_e_eV=2.0, potential_weight=2.0),
        cathode_T_e_eV=2.0,
        cathode_potential=0.0,
        series_resistance=0.0,
        conduction_factor=3.6,
        conduction_coulomb=2**-0.5,
    )  # fmt: skip


def test_spt100_tutorial_has_their_current_thrust_and_profiles():
    thruster = tutorial_thruster()
    run = ep.simulate(
        thruster,
        POINT,
        duration_s=2e-3,
        warm_up_s=0.0,
        stretch=1.0,
        coldest_T_e_eV=1.5,
        progress=False,
    )
    mean = late_mean(run)
    first = mean.isel(z=0)
    backwards = float(first["n_i"] * first["u_iz"] ** 2) * thruster.area * thruster.propellant.mass
    off = deviations(mean, columns("hallthruster_spt100.csv"))
    assert float(mean["I_d"]) == pytest.approx(6.715, rel=0.02)
    assert float(mean["thrust"]) - backwards == pytest.approx(0.1015, rel=0.02)
    assert float(run["I_d"].sel(time=slice(1.5e-3, 2e-3)).std()) < 0.25
    assert off["T_e_eV"] < 0.015  # 0.008: heat conducted through a face is upwinded there
    assert off["n_i"] < 0.05  # 0.030
    assert off["n_n"] < 0.03  # 0.014
    assert off["E_z"] < 0.015  # 0.008


@pytest.mark.skipif(not RATE_TABLE.exists(), reason="needs EP2SINDY_DATA with landmark_rates.csv")
def test_landmark_case_2_has_their_profiles_and_decays_as_fast():
    thruster = replace(
        ep.landmark_thruster(2, read_landmark_rates(RATE_TABLE)), inner_radius=0.0345
    )
    run = ep.simulate(
        thruster,
        ep.LANDMARK_POINT,
        duration_s=2e-3,
        warm_up_s=0.0,
        n_cells=200,
        stretch=1.0,
        progress=False,
    )
    mean = late_mean(run)
    off = deviations(mean, columns("hallthruster_landmark_2.csv"))
    assert float(mean["I_d"]) == pytest.approx(8.09, rel=0.005)
    assert max(off[name] for name in ("n_i", "n_n", "T_e_eV")) < 0.012  # 0.007, 0.004, 0.004
    assert off["E_z"] < 0.03  # 0.018, of the steep field at the exit
    assert decay_rate(run["I_d"], 0.6e-3, 1.6e-3) == pytest.approx(-1.8e3, rel=0.25)


def decay_rate(current: xr.DataArray, start: float, end: float) -> float:
    """Of an oscillation's amplitude, in 1/s, by its deviation in blocks of 0.2 ms."""
    edges = np.arange(start, end + 1e-5, 2e-4)
    parts = [current.sel(time=slice(a, b)) for a, b in pairwise(edges)]
    slope = np.polyfit(edges[:-1], [math.log(float(part.std())) for part in parts], 1)[0]
    return float(slope)
