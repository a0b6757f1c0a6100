"""JSON input of HallThruster.jl, versions 0.18 to 0.22, as a thruster and its operating point.

Layout and defaults: https://um-pepl.github.io/HallThruster.jl (Use JSON for input and output;
Configuration; Simulation parameters). In the tables of keys, a value is the default, a type stands
for a required value, and a type or None for an optional one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import Any

import xarray as xr

import ep2sindy as ep
from benchmarks.landmark import ExponentialWall
from ep2sindy.runtime.files import read_json
from ep2sindy.runtime.progress import Progress
from ep2sindy.thruster.constants import K_BOLTZMANN
from ep2sindy.thruster.propellants import PropellantTable
from ep2sindy.thruster.transport import BohmTransport, Transport
from ep2sindy.thruster.walls import Wall

Values = dict[str, Any]
TORR = 101325.0 / 760.0  # Pa
IDLE = object | None  # of keys without effect here
# Keys of the propellant before 0.19; next to `propellants` HallThruster.jl reads none of them.
OLDER_FLOW = {
    "gas": "propellant", "flow_rate_kg_s": "anode_mass_flow_rate",
    "velocity_m_s": "neutral_velocity", "temperature_K": "neutral_temperature_K",
    "ion_temperature_K": "ion_temperature_K", "max_charge": "ncharge",
}  # fmt: skip
CONFIG = {
    **dict.fromkeys([*OLDER_FLOW.values(), "initial_condition"], IDLE),
    "thruster": dict, "domain": list, "discharge_voltage": float, "propellants": list | None,
    "anom_model": {"type": "TwoZoneBohm"}, "wall_loss_model": {"type": "WallSheath"},
    "conductivity_model": {"type": "Mitchner"}, "filter_circuit": {"type": "NoCircuit"},
    "magnetic_field_scale": 1.0, "transition_length": float | None,
    "anode_boundary_condition": "sheath", "anode_Tev": float | None, "cathode_Tev": 2.0,
    "cathode_coupling_voltage": float | None, "cathode_potential": 0.0,  # its older name
    "electron_ion_collisions": True, "electron_plume_loss_scale": 1.0, "ion_wall_losses": False,
    "solve_plume": False, "apply_thrust_divergence_correction": False,
    "background_pressure_Torr": 0.0, "background_temperature_K": 100.0,
    "neutral_ingestion_multiplier": 1.0, "min_Te": 1.5, "reconstruct": True,
}  # fmt: skip
# Keys that are supported at this value only; any other would change the simulation.
CONFIG_AT_REST = {
    "anom_smoothing_iters": 0, "LANDMARK": False, "ionization_model": "Lookup",
    "excitation_model": "Lookup", "electron_neutral_model": "Lookup", "propellant_config": "",
    "reaction_rate_directories": [], "implicit_energy": 1.0,
}  # fmt: skip
GEOMETRY = {
    "channel_length": float, "inner_radius": float, "outer_radius": float, "channel_area": IDLE,
}  # fmt: skip
PROPELLANT = {
    "gas": str | dict | None, "flow_rate_kg_s": float, "velocity_m_s": float | None,
    "temperature_K": float | None, "ion_temperature_K": 1000.0, "max_charge": 1.0,
    "allowed_charges": list | None,
}  # fmt: skip
SIMULATION = {
    **dict.fromkeys(["dt", "adaptive", "CFL", "min_dt", "max_dt", "max_small_steps"], IDLE),
    **dict.fromkeys(["verbose", "print_errors"], IDLE),
    "duration": 1e-3, "num_save": 1000.0, "grid": {}, "current_control": {"type": "NoController"},
}  # fmt: skip
BOHM: dict[str, Values] = {
    "TwoZoneBohm": {"c1": 1 / 160, "c2": 1 / 16, "coeffs": list | None},
    "Bohm": {"c": float},
    "GaussianBohm": {"hall_max": float, "hall_min": float, "center": float, "width": float},
    "MultiLogBohm": {"zs": list, "cs": list},
}
SHIFT = {"model": dict, "z0": float, "dz": float, "pstar": float, "alpha": float}
WALLS: dict[str, Values] = {
    "NoWallLosses": {},
    "ConstantSheathPotential": {
        "inner_loss_coeff": float, "outer_loss_coeff": float, "sheath_potential": 20.0,
    },
    "WallSheath": {"material": "BNSiO2", "loss_scale": 1.0},
}  # fmt: skip
MATERIALS = {
    "BNSiO2": "BN-SiO2", "BoronNitride": "BN", "Alumina": "alumina", "SiliconCarbide": "SiC",
    "SiliconDioxide": "SiO2",
}  # fmt: skip
# All releases of HallThruster.jl have this table of xenon; that of 1 eV steps is a side branch's.
GASES = {
    "Xenon": "xenon_5eV", "Krypton": "krypton", "Argon": "argon",
    "Xe": "xenon_5eV", "Kr": "krypton", "Ar": "argon",
}  # fmt: skip
# Conduction factor and Coulomb weight of `Thruster`; 1.5, since HallThruster.jl's conductivities
# multiply the gradient of 1.5 T_e. Mitchner & Kruger, Partially Ionized Gases (1973), p. 94:
# 2.4/(1 + nu_ei/(sqrt(2) nu)); Braginskii: 4.66 for one charge.
CONDUCTION = {"Mitchner": (1.5 * 2.4, 2.0**-0.5), "Braginskii": (1.5 * 4.66, 0.0)}
WORDS = {float: "a number", bool: "true or false", str: "a word", list: "a list", dict: "a mapping"}


def take(given: Any, place: str, keys: Values, at_rest: Mapping[str, Any] | None = None) -> Values:
    """The values of keys, given or, where they are missing or null, by default; integers as floats.

    at_rest: keys that may have this value only. Raises ValueError for a key that is missing or in
    neither table, and for a value of another type.
    """
    only, values = at_rest or {}, {}
    if not isinstance(given, dict):
        raise ValueError(f"{place} must be a mapping, got {given!r}")
    if unknown := sorted(set(given) - {*keys, *only}):
        raise ValueError(f"{place} has keys that are not supported: {unknown}")
    for key, rest in only.items():
        if (value := given.get(key, rest)) != rest:
            raise ValueError(f"{place}.{key} is not supported here but at {rest!r}, got {value!r}")
    for key, default in keys.items():
        value, kind = given.get(key), default
        if not isinstance(default, UnionType):
            kind = default if isinstance(default, type) else type(default)
            value = default if value is None and kind is not default else value
        values[key] = float(value) if type(value) is int else value
        if not isinstance(values[key], kind):
            words = WORDS[kind.__args__[0] if isinstance(kind, UnionType) else kind]
            raise ValueError(f"{place}.{key} must be {words}, got {value!r}")
    return values


def take_model(given: Values, place: str, kinds: Mapping[str, Values]) -> tuple[str, Values]:
    """The type of a model and the values of its keys."""
    if (kind := str(given.get("type"))) not in kinds:
        raise ValueError(f"{place}.type must be one of {', '.join(kinds)}, got {kind}")
    return kind, take(given, place, {"type": str, **kinds[kind]})


@dataclass(frozen=True)
class HallThrusterInput:
    """Thruster and operating point of a file, and its run settings as `simulate` names them.

    even_grid: whether all cells are equal. coldest_T_e_eV: the lower bound of T_e, min_Te there.
    """

    thruster: ep.thruster.Thruster
    operating_point: ep.thruster.OperatingPoint
    n_cells: int
    even_grid: bool
    duration_s: float
    sample_s: float
    reconstruct: bool
    coldest_T_e_eV: float


def read_hallthruster_input(path: str | Path) -> HallThrusterInput:
    """Read an input file of HallThruster.jl, or an output file, which holds its input.

    Missing entries have HallThruster.jl's defaults. The file of the magnetic field is looked for
    next to the JSON file, then in the current folder. The single loss_scale of a wall in
    HallThruster.jl sets both of ours. The channel ingests background gas as it does there, where a
    pressure in Torr counts as if it were in Pa: 133 times less than at that pressure.
    Raises ValueError for an unknown key, and for one that asks for physics that is missing here
    (mixtures, a shielded wall, LANDMARK), naming it.
    """
    path = Path(path)
    try:
        content = read_json(path.read_text(encoding="utf-8"))
        content = content.get("input", content) if isinstance(content, dict) else {}
        if "config" not in content:
            raise ValueError("it must have the key 'config', at the top or below 'input'")
        config = take(content["config"], "config", CONFIG, CONFIG_AT_REST)
        simulation = take(content.get("simulation", {}), "simulation", SIMULATION)
        return _input_of(config, simulation, path.parent)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is no input that can run here: {error}") from error


def _input_of(config: Values, simulation: Values, folder: Path) -> HallThrusterInput:
    take_model(config["filter_circuit"], "config.filter_circuit", {"NoCircuit": {}})
    take_model(simulation["current_control"], "simulation.current_control", {"NoController": {}})
    grid = take(simulation["grid"], "simulation.grid", {"type": "EvenGrid", "num_cells": 200.0})
    flow, gas = _flow(config)
    voltage, flow_mg_s = config["discharge_voltage"], 1e6 * flow["flow_rate_kg_s"]
    return HallThrusterInput(
        _thruster(config, flow, gas, folder),
        ep.thruster.OperatingPoint(
            voltage, flow_mg_s, _speed(flow, gas), background=_background(config)
        ),
        n_cells=int(grid["num_cells"]), even_grid=grid["type"] == "EvenGrid",
        duration_s=simulation["duration"],
        sample_s=simulation["duration"] / max(simulation["num_save"] - 1.0, 1.0),
        reconstruct=config["reconstruct"], coldest_T_e_eV=config["min_Te"],
    )  # fmt: skip


def _thruster(
    config: Values, flow: Values, gas: PropellantTable, folder: Path
) -> ep.thruster.Thruster:
    keys = {"name": IDLE, "geometry": dict, "magnetic_field": dict}
    device = take(config["thruster"], "config.thruster", keys, {"shielded": False})
    geometry = take(device["geometry"], "config.thruster.geometry", GEOMETRY)
    length = geometry["channel_length"]
    start, stop = config["domain"]
    if start != 0.0:
        raise ValueError(f"config.domain must begin at the anode, 0: it begins at {start!r}")
    transition = _given(config["transition_length"], 0.1 * length)
    conductivity, place = config["conductivity_model"], "config.conductivity_model"
    conduction, _ = take_model(conductivity, place, {kind: {} for kind in CONDUCTION})
    plume = ep.thruster.ThermalPlume(axial_thrust=config["apply_thrust_divergence_correction"])
    return ep.thruster.Thruster(
        channel_length=length, domain_length=float(stop),
        inner_radius=geometry["inner_radius"], outer_radius=geometry["outer_radius"],
        magnetic_field=_field(
            device["magnetic_field"], length, folder, config["magnetic_field_scale"]
        ),
        transport=_transport(config["anom_model"], length, transition),
        propellant=gas, charge_states=_charge_states(flow, gas),
        ion_temperature=flow["ion_temperature_K"],
        wall=_wall(config, transition), anode=_anode(config), cathode_T_e_eV=config["cathode_Tev"],
        cathode_potential=_given(config["cathode_coupling_voltage"], config["cathode_potential"]),
        series_resistance=0.0,
        conduction_factor=CONDUCTION[conduction][0], conduction_coulomb=CONDUCTION[conduction][1],
        plume=plume if config["solve_plume"] else None,
    )  # fmt: skip


def _given(value: Any, default: Any) -> Any:
    return default if value is None else value


def _field(
    given: Values, length: float, folder: Path, scale: float
) -> ep.thruster.MagneticFieldTable:
    """The magnetic field in m and T, from points in the file or in the file that it names."""
    place = "config.thruster.magnetic_field"
    name, z, B = take(given, place, {"file": "", "z": [], "B": []}).values()
    if z and B:
        return ep.thruster.MagneticFieldTable([x - length for x in z], [scale * x for x in B])
    for path in (folder / name, Path.cwd() / name):
        if path.is_file():
            return ep.thruster.read_magnetic_field(
                path, exit_m=length, z_unit="m", B_unit="T", scale=scale
            )
    raise ValueError(f"{place}.file must be in {folder.absolute()} or {Path.cwd()}, got {name!r}")


def _transport(given: Values, length: float, transition: float) -> Transport:
    """A Bohm-like model, or one that the background's pressure shifts."""
    place = "config.anom_model"
    kind, model = take_model(given, place, {**BOHM, "LogisticPressureShift": SHIFT})
    if kind != "LogisticPressureShift":
        return _bohm(kind, model, length, transition)
    inner = _bohm(*take_model(model["model"], f"{place}.model", BOHM), length, transition)
    pressure_Pa = TORR * model["pstar"]
    return ep.thruster.PressureShift(inner, model["z0"], model["dz"], pressure_Pa, model["alpha"])


def _bohm(kind: str, model: Values, length: float, transition: float) -> BohmTransport:
    """Bohm-like models; their positions count from the anode, ours from the exit."""
    if kind == "Bohm":
        return ep.thruster.AnomalousTransport(model["c"], model["c"], 0.0)
    if kind == "TwoZoneBohm":
        c_channel, c_plume = model["coeffs"] or (model["c1"], model["c2"])
        return ep.thruster.AnomalousTransport(c_channel, c_plume, transition)
    if kind == "MultiLogBohm":
        return ep.thruster.MultiLogTransport([z - length for z in model["zs"]], model["cs"])
    c, center = (model["hall_max"], model["hall_min"]), model["center"] - length
    return ep.thruster.GaussianTransport(*c, center, model["width"])


def _wall(config: Values, transition: float) -> Wall:
    """The wall; its single loss_scale acts on electrons and, with ion_wall_losses, on ions."""
    place, ions = "config.wall_loss_model", config["ion_wall_losses"]
    kind, model = take_model(config["wall_loss_model"], place, WALLS)
    if kind == "NoWallLosses":
        return ep.thruster.SheathWall(electron_scale=0.0, ion_scale=0.0)
    if kind == "ConstantSheathPotential":
        if ions:
            raise ValueError("config.ion_wall_losses needs a WallSheath here")
        alpha = model["inner_loss_coeff"], model["outer_loss_coeff"]
        return ExponentialWall(alpha, model["sheath_potential"], transition)
    material, scale = model["material"], model["loss_scale"]
    if material not in MATERIALS:
        raise ValueError(f"{place}.material must be one of {list(MATERIALS)}, got {material!r}")
    return ep.thruster.wall_material(
        MATERIALS[material], electron_scale=scale, ion_scale=scale if ions else 0.0,
        plume_collisions=0.0, plume_power=config["electron_plume_loss_scale"],
        transition=transition,
    )  # fmt: skip


def _background(config: Values) -> ep.thruster.Background | None:
    """The facility's gas. HallThruster.jl takes the number in Torr for one in Pa as it ingests."""
    pressure_Pa = TORR * config["background_pressure_Torr"]
    ingestion = config["neutral_ingestion_multiplier"] / TORR
    gas = ep.thruster.Background(pressure_Pa, config["background_temperature_K"], ingestion)
    return gas if pressure_Pa else None


def _anode(config: Values) -> ep.thruster.FixedAnode | ep.thruster.AnodeSheath:
    T_e_eV = _given(config["anode_Tev"], config["cathode_Tev"])
    if (kind := config["anode_boundary_condition"]) == "sheath":
        return ep.thruster.AnodeSheath(T_e_eV, potential_weight=2.0)
    if kind == "dirichlet":
        return ep.thruster.FixedAnode(T_e_eV)
    raise ValueError(f"config.anode_boundary_condition must be sheath or dirichlet, got {kind!r}")


def _flow(config: Values) -> tuple[Values, PropellantTable]:
    """The flow and its gas: in a list of one (from version 0.19), or by keys of the config."""
    flows, place = config["propellants"], "config.propellants[0]"
    if flows is None:
        flows, place = [{key: config[name] for key, name in OLDER_FLOW.items()}], "config"
    if len(flows) != 1:
        raise ValueError(f"config.propellants: a mixture of {len(flows)} is not supported here")
    flow = take(flows[0], place, PROPELLANT)
    gas = flow["gas"] or "Xenon"
    name = gas.get("formula") if isinstance(gas, dict) else gas
    if name not in GASES:
        raise ValueError(f"{place}.gas must be one of {', '.join(GASES)}, got {name!r}")
    weight = 1.0 if config["electron_ion_collisions"] else 0.0
    return flow, ep.thruster.propellant(GASES[name], coulomb_weight=weight)


def _charge_states(flow: Values, gas: PropellantTable) -> int:
    charges = flow["allowed_charges"] or list(range(1, int(flow["max_charge"]) + 1))
    if not 1 <= len(charges) <= gas.charge_states or charges != [1, 2, 3][: len(charges)]:
        raise ValueError(f"charges of {gas.name} must be 1 to {gas.charge_states}, got {charges}")
    return len(charges)


def _speed(flow: Values, gas: PropellantTable) -> float:
    """Speed of the neutrals: given, or a quarter of the mean thermal speed at their temperature."""
    speed, temperature = flow["velocity_m_s"], flow["temperature_K"]
    if speed is None and temperature is not None:
        return 0.25 * math.sqrt(8.0 * K_BOLTZMANN * temperature / (math.pi * gas.mass))
    return _given(speed, 150.0)


def simulate_hallthruster_input(
    path: str | Path,
    *,
    cache: str | Path | None = None,
    duration_s: float | None = None,
    warm_up_s: float = 0.0,
    sample_s: float | None = None,
    n_cells: int | None = None,
    progress: Progress | bool = True,
) -> xr.Dataset:
    """Run the thruster of an input file in this package's own simulator, or read the kept run.

    Arguments that are None take the file's values for the duration, the frames and the cells.
    Raises ValueError if the file asks for features that this simulator lacks; see
    `read_hallthruster_input`.
    """
    given = read_hallthruster_input(path)
    if n_cells is None and not given.even_grid:
        cells = f"n_cells={given.n_cells} takes one of as many cells"
        raise ValueError(f"{path}: simulation.grid must be an EvenGrid here; {cells}")
    return ep.thruster.simulate(
        given.thruster, given.operating_point, cache=cache, warm_up_s=warm_up_s,
        duration_s=_given(duration_s, given.duration_s), sample_s=_given(sample_s, given.sample_s),
        n_cells=_given(n_cells, given.n_cells), stretch=1.0,  # EvenGrid of HallThruster.jl
        reconstruct=given.reconstruct, coldest_T_e_eV=given.coldest_T_e_eV, progress=progress,
    )  # fmt: skip
