"""The JSON input of HallThruster.jl, versions 0.18 to 0.22, as a thruster and its operating point.

Layout and defaults: https://um-pepl.github.io/HallThruster.jl (Use JSON for input and output;
Configuration; Simulation parameters).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ep2sindy.runtime.files import read_json
from ep2sindy.thruster.anode import AnodeSheath, FixedAnode
from ep2sindy.thruster.constants import K_BOLTZMANN
from ep2sindy.thruster.hallthruster_models import conduction_of, field_of, transport_of, wall_of
from ep2sindy.thruster.hallthruster_nodes import Node
from ep2sindy.thruster.parameters import OperatingPoint, Thruster
from ep2sindy.thruster.propellant_files import propellant
from ep2sindy.thruster.propellants import PropellantTable

GASES = {"Xenon": "xenon", "Krypton": "krypton", "Argon": "argon"}
GASES |= {"Xe": "xenon", "Kr": "krypton", "Ar": "argon"}
# What their stored runs ionise xenon by is not the finer table that later versions brought.
RATES_OF = {"xenon": "xenon_5eV", "krypton": "krypton", "argon": "argon"}
# Keys that are taken at this value alone; any other would change what is simulated.
CONFIG_AT_REST: dict[str, Any] = {
    "background_pressure_Torr": 0.0,
    "solve_plume": False,
    "anom_smoothing_iters": 0,
    "LANDMARK": False,
    "ionization_model": "Lookup",
    "excitation_model": "Lookup",
    "electron_neutral_model": "Lookup",
    "reaction_rate_directories": [],
    "propellant_config": "",
    "implicit_energy": 1.0,
}
# Keys that change nothing here: they act on what is not there, or on the other code's output.
CONFIG_IDLE = (
    "background_temperature_K", "neutral_ingestion_multiplier", "initial_condition",
    "apply_thrust_divergence_correction",
)  # fmt: skip
SIMULATION_IDLE = (
    "dt", "adaptive", "CFL", "min_dt", "max_dt", "max_small_steps", "verbose", "print_errors",
)  # fmt: skip


@dataclass(frozen=True)
class RunSettings:
    """How the file would be run: what `simulate` takes, and numerics that it says besides.

    reconstruct: second-order reconstruction at the faces, or none. coldest_T_e_eV: the floor
    that HallThruster.jl holds T_e above (min_Te).
    """

    n_cells: int = 200
    even_grid: bool = True
    duration_s: float = 1e-3
    n_samples: int = 100
    reconstruct: bool = True
    coldest_T_e_eV: float = 1.5

    @property
    def sample_s(self) -> float:
        """Time between two of the frames that the file asks for."""
        return self.duration_s / max(self.n_samples - 1, 1)


@dataclass(frozen=True)
class HallThrusterInput:
    """A file's thruster, operating point and run."""

    thruster: Thruster
    operating_point: OperatingPoint
    run: RunSettings


def read_hallthruster_input(path: str | Path) -> HallThrusterInput:
    """Read an input file of HallThruster.jl, or an output file, which holds its input.

    What a file leaves out has HallThruster.jl's default. The file of the magnetic field is looked
    for beside the JSON, then where one stands. Their one loss_scale of a wall sets both of
    ours; their conductivity acts on the gradient of 1.5 T_e, so that our factor is 1.5 of theirs.
    Raises ValueError for a key that is not known, and for one that is known but would ask for
    physics that is not here (background gas, plume expansion, three charges, mixtures, a
    shielded wall, LANDMARK), naming it.
    """
    path = Path(path)
    if not path.is_file():
        raise ValueError(f"no such input of HallThruster.jl: {path.absolute()}")
    try:
        content = read_json(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} must be JSON: {error}") from error
    content = content.get("input", content) if isinstance(content, dict) else {}
    if "config" not in content:
        raise ValueError(
            f"{path} must have the key 'config', at the top or below 'input', as HallThruster.jl "
            f"has it since 0.18: it has {sorted(content)}"
        )
    try:
        config = Node(content["config"], "config")
        simulation = Node(content.get("simulation", {}), "simulation")
        return _input_of(config, simulation, path.parent)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def _input_of(config: Node, simulation: Node, folder: Path) -> HallThrusterInput:
    floor = config.number("min_Te", 1.5)
    reconstruct = bool(config.take("reconstruct", True))
    gas = _flow(config)
    config.at_rest(CONFIG_AT_REST)
    circuit = config.take("filter_circuit", None)
    if isinstance(circuit, Mapping) and circuit.get("type") != "NoCircuit":
        raise ValueError("config.filter_circuit is not supported here: leave it out")
    config.idle(*CONFIG_IDLE)
    thruster = _thruster(config, gas, folder)
    point = OperatingPoint(
        config.number("discharge_voltage"), 1e6 * gas["flow_rate_kg_s"], gas["velocity_m_s"]
    )
    config.end()
    return HallThrusterInput(thruster, point, _run(simulation, reconstruct, floor))


def _thruster(config: Node, gas: dict[str, Any], folder: Path) -> Thruster:
    node = config.node("thruster")
    node.idle("name")
    node.at_rest({"shielded": False})
    geometry = node.node("geometry")
    length = geometry.number("channel_length")
    radii = geometry.number("inner_radius"), geometry.number("outer_radius")
    geometry.idle("channel_area")
    geometry.end()
    start, stop = config.take("domain")
    if start != 0.0:
        raise ValueError(f"config.domain must begin at the anode, 0: it begins at {start!r}")
    magnetic_field = field_of(
        node.node("magnetic_field"), length, folder, config.number("magnetic_field_scale", 1.0)
    )
    node.end()
    transition = config.number("transition_length", 0.1 * length)
    factor, coulomb = conduction_of(config.node("conductivity_model", {"type": "Mitchner"}))
    cathode_T_e_eV = config.number("cathode_Tev", 2.0)
    return Thruster(
        channel_length=length,
        domain_length=float(stop),
        inner_radius=radii[0],
        outer_radius=radii[1],
        magnetic_field=magnetic_field,
        transport=transport_of(
            config.node("anom_model", {"type": "TwoZoneBohm"}), length, transition
        ),
        propellant=gas["propellant"],
        charge_states=gas["charge_states"],
        wall=wall_of(
            config.node("wall_loss_model", {"type": "WallSheath"}),
            transition=transition,
            plume_power=config.number("electron_plume_loss_scale", 1.0),
            ion_losses=bool(config.take("ion_wall_losses", False)),
        ),
        ion_temperature=gas["ion_temperature_K"],
        anode=_anode(config, cathode_T_e_eV),
        cathode_T_e_eV=cathode_T_e_eV,
        cathode_potential=config.number("cathode_coupling_voltage", 0.0),
        series_resistance=0.0,
        conduction_factor=factor,
        conduction_coulomb=coulomb,
    )


def _anode(config: Node, cathode_T_e_eV: float) -> FixedAnode | AnodeSheath:
    T_e_eV = config.number("anode_Tev", cathode_T_e_eV)
    kind = config.take("anode_boundary_condition", "sheath")
    if kind == "sheath":
        return AnodeSheath(T_e_eV, potential_weight=2.0)
    if kind == "dirichlet":
        return FixedAnode(T_e_eV)
    raise ValueError(f"config.anode_boundary_condition must be sheath or dirichlet: {kind!r} came")


def _flow(config: Node) -> dict[str, Any]:
    """The one propellant: given in a list of one (from 0.19), or by keys of the config."""
    flows = config.take("propellants", None)
    if flows is None:
        names = {
            "gas": "propellant", "flow_rate_kg_s": "anode_mass_flow_rate",
            "velocity_m_s": "neutral_velocity", "temperature_K": "neutral_temperature_K",
            "ion_temperature_K": "ion_temperature_K", "max_charge": "ncharge",
        }  # fmt: skip
        given = {key: config.take(name, None) for key, name in names.items()}
        flow = Node({key: value for key, value in given.items() if value is not None}, "config")
    else:
        if len(flows) != 1:
            raise ValueError(
                f"config.propellants must be one: a mixture of {len(flows)} is not supported here"
            )
        flow = Node(flows[0], "config.propellants[0]")
    gas = _gas(flow, bool(config.take("electron_ion_collisions", True)))
    charge = flow.take("max_charge", None)
    charges = flow.take("allowed_charges", None)
    if charges is None:
        charges = list(range(1, int(charge or 1) + 1))
    if list(charges) not in ([1], [1, 2]):
        raise ValueError(
            f"{flow.place} must ask for one or two charges: {list(charges)} is not supported here"
        )
    found = {
        "propellant": gas,
        "charge_states": len(charges),
        "flow_rate_kg_s": flow.number("flow_rate_kg_s"),
        "ion_temperature_K": flow.number("ion_temperature_K", 1000.0),
        "velocity_m_s": _speed(flow, gas),
    }
    flow.end()
    return found


def _gas(flow: Node, coulomb: bool) -> PropellantTable:
    gas = flow.take("gas", "Xenon")
    name = gas.get("formula") if isinstance(gas, Mapping) else gas
    if name not in GASES:
        raise ValueError(
            f"{flow.place}.gas must be one of {sorted(GASES)}: {name!r} is not supported here"
        )
    return propellant(RATES_OF[GASES[name]], coulomb_weight=1.0 if coulomb else 0.0)


def _speed(flow: Node, gas: PropellantTable) -> float:
    """Neutrals' speed: given, or a quarter of the mean thermal speed of their temperature."""
    speed, temperature = flow.take("velocity_m_s", None), flow.take("temperature_K", None)
    for name, value in (("velocity_m_s", speed), ("temperature_K", temperature)):
        if isinstance(value, Mapping):
            raise ValueError(f"{flow.place}.{name} must be a number: profiles are not supported")
    if speed is not None or temperature is None:
        return float(150.0 if speed is None else speed)
    return 0.25 * math.sqrt(8.0 * K_BOLTZMANN * temperature / (math.pi * gas.mass))


def _run(simulation: Node, reconstruct: bool, floor: float) -> RunSettings:
    grid = simulation.node("grid", {})
    kind = grid.take("type", "EvenGrid")
    n_cells = int(grid.number("num_cells", 200))
    grid.end()
    control = simulation.take("current_control", {"type": "NoController"})
    if control.get("type") != "NoController":
        raise ValueError("simulation.current_control is not supported here: leave it out")
    simulation.idle(*SIMULATION_IDLE)
    settings = RunSettings(
        n_cells=n_cells,
        even_grid=kind == "EvenGrid",
        duration_s=simulation.number("duration", 1e-3),
        n_samples=int(simulation.number("num_save", 1000)),
        reconstruct=reconstruct,
        coldest_T_e_eV=floor,
    )
    simulation.end()
    return settings
