"""The JSON input of HallThruster.jl: what it means here, and what is refused by name."""

import json
from pathlib import Path

import numpy as np
import pytest

import ep2sindy as ep
from benchmarks.hallthruster_input import read_hallthruster_input, simulate_hallthruster_input
from benchmarks.landmark import ExponentialWall

Z = np.linspace(0.0, 0.08, 41)
FIELD = "\n".join(f"{z}, {0.02 * np.exp(-(((z - 0.025) / 0.012) ** 2))}" for z in Z)
# test/regression/spt100_tutorial.json of HallThruster.jl v0.22
THRUSTER = {
    "name": "SPT-100",
    "geometry": {"inner_radius": 0.035, "outer_radius": 0.05, "channel_length": 0.025},
    "magnetic_field": {"file": "bfield.csv"},
}
TUTORIAL = {
    "config": {
        "thruster": THRUSTER,
        "domain": [0.0, 0.08],
        "propellants": [{"gas": "Xenon", "max_charge": 1, "flow_rate_kg_s": 5e-6}],
        "discharge_voltage": 300,
    },
    "simulation": {
        "dt": 5e-9, "adaptive": True, "duration": 2e-3, "num_save": 1001,
        "grid": {"type": "EvenGrid", "num_cells": 100},
    },
}  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "bfield.csv").write_text(FIELD + "\n")
    return tmp_path


def read(folder: Path, content: object):
    path = folder / "input.json"
    path.write_text(json.dumps(content))
    return read_hallthruster_input(path)


def changed(**config: object) -> dict:
    return TUTORIAL | {"config": TUTORIAL["config"] | config}


def test_the_tutorial_has_the_defaults_that_its_stored_run_names(folder: Path) -> None:
    """As resolved in test/regression/output/ref_spt100_tutorial.json, v0.22."""
    made = read(folder, TUTORIAL)
    thruster = made.thruster
    assert (thruster.channel_length, thruster.domain_length) == (0.025, 0.08)
    assert (thruster.inner_radius, thruster.outer_radius) == (0.035, 0.05)
    assert thruster.area == pytest.approx(0.0040055306333269865)
    assert thruster.transport == ep.thruster.AnomalousTransport(1 / 160, 1 / 16, 0.1 * 0.025)
    assert thruster.wall == ep.thruster.wall_material(
        "BN-SiO2", electron_scale=1.0, ion_scale=0.0, plume_collisions=0.0, transition=0.1 * 0.025
    )
    assert thruster.propellant == ep.thruster.propellant("xenon_5eV")
    assert thruster.propellant.mass == pytest.approx(2.1801715574645584e-25)
    assert thruster.anode == ep.thruster.AnodeSheath(2.0, potential_weight=2.0)
    assert (thruster.cathode_T_e_eV, thruster.cathode_potential) == (2.0, 0.0)
    assert (thruster.ion_temperature, thruster.series_resistance) == (1000.0, 0.0)
    assert thruster.conduction_factor == pytest.approx(3.6)  # 2.4 on the gradient of 1.5 T
    assert thruster.conduction_coulomb == pytest.approx(2.0**-0.5)
    assert made.operating_point == ep.thruster.OperatingPoint(300.0, 5.0, 150.0)
    assert (made.n_cells, made.even_grid, made.duration_s) == (100, True, 2e-3)
    assert made.sample_s == pytest.approx(2e-6)
    assert (made.reconstruct, made.coldest_T_e_eV) == (True, 1.5)


TWO_ZONES = ep.thruster.AnomalousTransport(0.01, 0.05, 0.1 * 0.025)
MODELS = [
    ({"type": "Bohm", "c": 0.02}, ep.thruster.AnomalousTransport(0.02, 0.02, 0.0)),
    ({"type": "TwoZoneBohm", "c1": 0.01, "c2": 0.05}, TWO_ZONES),
    ({"type": "TwoZoneBohm", "coeffs": [0.01, 0.05]}, TWO_ZONES),
    (
        {"type": "GaussianBohm", "hall_min": 0.1, "hall_max": 0.07, "center": 0.025, "width": 5e-3},
        ep.thruster.GaussianTransport(c_far=0.07, trough=0.1, center=0.0, width=5e-3),
    ),
    (
        {"type": "MultiLogBohm", "zs": [0.0, 0.025, 0.05], "cs": [0.1, 0.01, 0.1]},
        ep.thruster.MultiLogTransport([-0.025, 0.0, 0.025], [0.1, 0.01, 0.1]),
    ),
]
SHIFT = {"z0": -0.1, "dz": 0.2, "pstar": 4e-5, "alpha": 15.0}
SHIFTED = {"type": "LogisticPressureShift", "model": MODELS[3][0], **SHIFT}
PRESSURE_PA = 4e-5 * (101325.0 / 760.0)
MODELS.append((SHIFTED, ep.thruster.PressureShift(MODELS[3][1], -0.1, 0.2, PRESSURE_PA, 15.0)))


@pytest.mark.parametrize(("model", "transport"), MODELS)
def test_transport_counts_from_the_exit(folder: Path, model: dict, transport: object) -> None:
    assert read(folder, changed(anom_model=model)).thruster.transport == transport


def test_the_wall_and_the_propellant_of_older_files(folder: Path) -> None:
    wall = {"type": "ConstantSheathPotential", "inner_loss_coeff": 0.5, "outer_loss_coeff": 1}
    flow = {"propellant": "Kr", "anode_mass_flow_rate": 3e-6, "ncharge": 2}
    made = read(folder, changed(propellants=None, wall_loss_model=wall, **flow))
    assert made.thruster.wall == ExponentialWall((0.5, 1.0), 20.0, 0.1 * 0.025)
    assert made.thruster.propellant == ep.thruster.propellant("krypton")
    assert (made.thruster.charge_states, made.operating_point.mass_flow_mg_s) == (2, 3.0)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"LANDMARK": True}, r"config\.LANDMARK is not supported here but at False"),
        ({"domian": [0, 1]}, r"config has keys that are not supported: \['domian'\]"),
        ({"propellants": [{}, {}]}, r"a mixture of 2 is not supported"),
        ({"discharge_voltage": "300"}, r"config\.discharge_voltage must be a number, got '300'"),
        ({"filter_circuit": {"type": "RLC"}}, r"filter_circuit\.type must be one of NoCircuit"),
    ],
)
def test_what_is_not_here_is_refused_by_name(folder: Path, config: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read(folder, changed(**config))


def test_a_file_is_simulated_as_it_says(folder: Path) -> None:
    content = changed(
        anode_boundary_condition="dirichlet", conductivity_model={"type": "Braginskii"}
    )
    read(folder, content)
    field = simulate_hallthruster_input(
        folder / "input.json", cache=folder, duration_s=4e-5, n_cells=20, progress=False
    )
    assert dict(field.sizes) == {"time": 21, "z": 20}  # 2 us, as the file's frames
    assert json.loads(field.attrs["parameters"])["thruster"]["propellant"]["name"] == "xenon_5eV"
