"""The JSON input of HallThruster.jl: what it means here, and what is refused by name."""

import json
from pathlib import Path

import numpy as np
import pytest

import ep2sindy as ep
from benchmarks.hallthruster_input import read_hallthruster_input, simulate_hallthruster_input
from ep2sindy.thruster.constants import K_BOLTZMANN

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
    run = made.run
    assert (run.n_cells, run.duration_s, run.n_samples) == (100, 2e-3, 1001)
    assert run.sample_s == pytest.approx(2e-6)
    assert (run.reconstruct, run.coldest_T_e_eV) == (True, 1.5)


def test_the_field_is_read_from_next_to_the_file_in_m_and_T(folder: Path) -> None:
    field = read(folder, changed(magnetic_field_scale=2.0)).thruster.magnetic_field
    np.testing.assert_allclose(
        field.at(Z - 0.025), 0.04 * np.exp(-(((Z - 0.025) / 0.012) ** 2)), rtol=1e-12
    )


def test_a_field_within_the_file_needs_no_other(tmp_path: Path) -> None:
    within = {"file": "", "z": Z.tolist(), "B": [0.01] * Z.size}
    content = changed(thruster=THRUSTER | {"magnetic_field": within})
    field = read(tmp_path, content).thruster.magnetic_field
    np.testing.assert_allclose(field.at(np.zeros(1)), 0.01)


def test_a_temperature_alone_gives_the_neutrals_a_quarter_of_their_thermal_speed(
    folder: Path,
) -> None:
    flow = {"gas": "Xe", "flow_rate_kg_s": 5e-6, "temperature_K": 500.0, "allowed_charges": [1]}
    made = read(folder, changed(propellants=[flow]))
    speed = np.sqrt(8.0 * K_BOLTZMANN * 500.0 / (np.pi * made.thruster.propellant.mass))
    assert made.operating_point.neutral_speed == pytest.approx(0.25 * speed)


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


@pytest.mark.parametrize(("node", "expected"), MODELS, ids=lambda v: type(v).__name__)
def test_transport_is_counted_from_the_exit(folder: Path, node: dict, expected: object) -> None:
    assert read(folder, changed(anom_model=node)).thruster.transport == expected


def test_walls_conduction_and_anode_follow_the_file(folder: Path) -> None:
    made = read(
        folder,
        changed(
            wall_loss_model={"type": "WallSheath", "material": "Alumina", "loss_scale": 0.5},
            ion_wall_losses=True,
            electron_plume_loss_scale=0.2,
            transition_length=4e-3,
            conductivity_model={"type": "Braginskii"},
            anode_boundary_condition="dirichlet",
            anode_Tev=3.0,
            electron_ion_collisions=False,
        ),
    ).thruster
    assert made.wall == ep.thruster.wall_material(
        "alumina", electron_scale=0.5, ion_scale=0.5, plume_collisions=0.0, plume_power=0.2,
        transition=4e-3,
    )  # fmt: skip
    assert (made.conduction_factor, made.conduction_coulomb) == (pytest.approx(6.99), 0.0)
    assert made.anode == ep.thruster.FixedAnode(3.0)
    assert np.all(made.propellant.coulomb(np.ones(3)) == 0.0)


SHIFTED = {
    "type": "LogisticPressureShift", "model": MODELS[3][0], "z0": -0.1, "dz": 0.2, "pstar": 4e-5,
    "alpha": 15.0,
}  # fmt: skip


def test_a_pressure_shifts_the_transport_in_channel_lengths(folder: Path) -> None:
    made = read(folder, changed(anom_model=SHIFTED, background_pressure_Torr=1e-5))
    shifted = made.thruster.transport
    assert shifted.transport == MODELS[3][1]
    assert shifted.pressure_Pa == pytest.approx(4e-5 * 133.322, rel=1e-5)
    pressure_Pa = made.operating_point.background.pressure_Pa
    assert pressure_Pa == pytest.approx(1e-5 * 133.322, rel=1e-5)
    assert shifted.shift(pressure_Pa) == pytest.approx(-0.1 + 0.2 / (1.0 + 14.0**-0.5))


def test_ingestion_takes_the_number_in_Torr_for_one_in_Pa(folder: Path) -> None:
    """As their stored runs: u_n n_n at the anode of ref_spt100_baseline leaves 1e18 1/(m^2 s)."""
    gas = {"background_pressure_Torr": 1e-5, "background_temperature_K": 300.0}
    made = read(folder, changed(**gas, neutral_ingestion_multiplier=6.0))
    mass, thermal = made.thruster.propellant.mass, K_BOLTZMANN * 300.0
    flux = 6.0 * 1e-5 / thermal * 0.25 * np.sqrt(8.0 * thermal / (np.pi * mass))
    flow = made.operating_point.inflow_mg_s(made.thruster) - 5.0
    assert flow == pytest.approx(1e6 * flux * mass * made.thruster.area)
    still = read(folder, changed(neutral_ingestion_multiplier=6.0)).operating_point
    assert still.background is None


@pytest.mark.parametrize("corrected", [True, False])
def test_a_plume_that_is_solved_is_thermal(folder: Path, corrected: bool) -> None:
    content = changed(solve_plume=True, apply_thrust_divergence_correction=corrected)
    expected = ep.thruster.ThermalPlume(axial_thrust=corrected)
    assert read(folder, content).thruster.plume == expected
    assert read(folder, changed(apply_thrust_divergence_correction=True)).thruster.plume is None


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"LANDMARK": True}, r"config\.LANDMARK is not supported here but at False"),
        ({"domian": [0, 1]}, r"config has keys that are not supported: \['domian'\]"),
        ({"propellants": [{}, {}]}, r"a mixture of 2 is not supported"),
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
