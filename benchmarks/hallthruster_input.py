"""JSON input of HallThruster.jl, versions 0.18 to 0.22, as a thruster and its operating point.

Layout and defaults: https://um-pepl.github.io/HallThruster.jl (Use JSON for input and output;
Configuration; Simulation parameters).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from benchmarks.landmark import ExponentialWall
from ep2sindy.runtime.files import read_json
from ep2sindy.runtime.progress import Progress
from ep2sindy.thruster.axial.simulate import simulate
from ep2sindy.thruster.constants import K_BOLTZMANN
from ep2sindy.thruster.magnetic_field import MagneticFieldTable, read_magnetic_field
from ep2sindy.thruster.parameters import Background, OperatingPoint, Thruster
from ep2sindy.thruster.plume import ThermalPlume
from ep2sindy.thruster.propellant_files import propellant
from ep2sindy.thruster.propellants import PropellantTable
from ep2sindy.thruster.transport import (
    AnomalousTransport,
    BohmTransport,
    GaussianTransport,
    MultiLogTransport,
    PressureShift,
    Transport,
)
from ep2sindy.thruster.walls import (
    AnodeSheath,
    FixedAnode,
    SheathWall,
    Wall,
    wall_material,
)

NEEDED: Any = object()


class Node:
    """A mapping and its place in the file. `end()` refuses the keys that were not taken."""

    def __init__(self, values: Any, place: str) -> None:
        if not isinstance(values, Mapping):
            raise ValueError(f"{place} must be a mapping, got {values!r}")
        self.place = place
        self._left = dict(values)

    def take(self, key: str, default: Any = NEEDED) -> Any:
        """The value of a key, or the default; raises ValueError if a required key is missing."""
        if key in self._left:
            return self._left.pop(key)
        if default is NEEDED:
            raise ValueError(f"{self.place} must have the key {key!r}: it is not there")
        return default

    def number(self, key: str, default: Any = NEEDED) -> float:
        """Take a number."""
        value = self.take(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise ValueError(f"{self.place}.{key} must be a number, got {value!r}")
        return float(value)

    def node(self, key: str, default: Any = NEEDED) -> Node:
        """Take a nested mapping."""
        return Node(self.take(key, default), f"{self.place}.{key}")

    def at_rest(self, values: Mapping[str, Any]) -> None:
        """Take keys that are supported at a single value only."""
        for key, value in values.items():
            if (given := self.take(key, value)) != value:
                raise ValueError(
                    f"{self.place}.{key} is not supported here but at {value!r}, got {given!r}"
                )

    def idle(self, *keys: str) -> None:
        """Take keys that have no effect here."""
        for key in keys:
            self.take(key, None)

    def end(self) -> None:
        """Raise ValueError for the remaining keys."""
        if self._left:
            raise ValueError(f"{self.place} has keys that are not supported: {sorted(self._left)}")


TORR = 101325.0 / 760.0  # Pa

MATERIALS = {
    "BNSiO2": "BN-SiO2",
    "BoronNitride": "BN",
    "Alumina": "alumina",
    "SiliconCarbide": "SiC",
    "SiliconDioxide": "SiO2",
}


def field_of(node: Node, length: float, folder: Path, scale: float) -> MagneticFieldTable:
    """The magnetic field in m and T, from points in the file or in the file that it names."""
    name, z, B = node.take("file", ""), node.take("z", []), node.take("B", [])
    node.end()
    if len(z) and len(B):
        return MagneticFieldTable(
            tuple((np.array(z) - length).tolist()), tuple((scale * np.array(B)).tolist())
        )
    places = (folder / name, Path.cwd() / name)
    found = next((place for place in places if place.is_file()), None)
    if found is None:
        raise ValueError(
            f"{node.place}.file must be there: {name!r} is neither in {folder.absolute()} nor in "
            f"{Path.cwd()}"
        )
    return read_magnetic_field(found, exit_m=length, z_unit="m", B_unit="T", scale=scale)


def transport_of(node: Node, length: float, transition: float) -> Transport:
    """A Bohm-like model, or one that the background's pressure shifts."""
    kind = node.take("type")
    if kind != "LogisticPressureShift":
        return bohm_of(kind, node, length, transition)
    inner = node.node("model")
    shifted = PressureShift(
        bohm_of(inner.take("type"), inner, length, transition),
        z0=node.number("z0"),
        dz=node.number("dz"),
        pressure_Pa=TORR * node.number("pstar"),
        alpha=node.number("alpha"),
    )
    node.end()
    return shifted


def bohm_of(kind: Any, node: Node, length: float, transition: float) -> BohmTransport:
    """Bohm-like models; their positions count from the anode, ours from the exit."""
    if kind == "TwoZoneBohm":
        c = node.take("coeffs", None) or (
            node.number("c1", 1 / 160),
            node.number("c2", 1 / 16),
        )
        model: BohmTransport = AnomalousTransport(float(c[0]), float(c[1]), transition)
    elif kind == "Bohm":
        c_everywhere = node.number("c")
        model = AnomalousTransport(c_everywhere, c_everywhere, 0.0)
    elif kind == "GaussianBohm":
        model = GaussianTransport(
            c_far=node.number("hall_max"),
            trough=node.number("hall_min"),
            center=node.number("center") - length,
            width=node.number("width"),
        )
    elif kind == "MultiLogBohm":
        z = np.array(node.take("zs"), dtype=float) - length
        model = MultiLogTransport(tuple(z.tolist()), tuple(map(float, node.take("cs"))))
    else:
        raise ValueError(
            f"{node.place}.type must be TwoZoneBohm, Bohm, GaussianBohm, MultiLogBohm or "
            f"LogisticPressureShift of one of these: {kind!r} is not supported here"
        )
    node.end()
    return model


def wall_of(node: Node, *, transition: float, plume_power: float, ion_losses: bool) -> Wall:
    """The wall; its single loss_scale acts on electrons and, with ion_wall_losses, on ions."""
    kind = node.take("type")
    if kind == "NoWallLosses":
        node.end()
        return SheathWall(electron_scale=0.0, ion_scale=0.0)
    if kind == "ConstantSheathPotential":
        if ion_losses:
            raise ValueError("config.ion_wall_losses needs a WallSheath here")
        wall: Wall = ExponentialWall(
            (node.number("inner_loss_coeff"), node.number("outer_loss_coeff")),
            sheath_V=node.number("sheath_potential", 20.0),
            transition=transition,
        )
    elif kind == "WallSheath":
        material: Any = node.take("material", "BNSiO2")
        scale = node.number("loss_scale", 1.0)
        if material not in MATERIALS:
            raise ValueError(
                f"{node.place}.material must be one of {list(MATERIALS)}, got {material!r}"
            )
        wall = wall_material(
            MATERIALS[material],
            electron_scale=scale,
            ion_scale=scale if ion_losses else 0.0,
            plume_collisions=0.0,
            plume_power=plume_power,
            transition=transition,
        )
    else:
        raise ValueError(
            f"{node.place}.type must be WallSheath, ConstantSheathPotential or NoWallLosses: "
            f"{kind!r} is not supported here"
        )
    node.end()
    return wall


def conduction_of(node: Node) -> tuple[float, float]:
    """Conduction factor and Coulomb weight of `Thruster`, which multiply the gradient of T_e.

    Mitchner & Kruger, Partially Ionized Gases (1973), p. 94: 2.4/(1 + nu_ei/(sqrt(2) nu));
    Braginskii: 4.66 for one charge. Both are multiplied by 1.5, since HallThruster.jl's
    conductivities multiply the gradient of 1.5 T_e.
    """
    kind = node.take("type")
    node.end()
    known = {"Mitchner": (1.5 * 2.4, 2.0**-0.5), "Braginskii": (1.5 * 4.66, 0.0)}
    if kind not in known:
        raise ValueError(f"{node.place}.type must be one of {list(known)}, got {kind!r}")
    return known[kind]


GASES = {"Xenon": "xenon", "Krypton": "krypton", "Argon": "argon"}
GASES |= {"Xe": "xenon", "Kr": "krypton", "Ar": "argon"}
# All releases of HallThruster.jl have this table of xenon; that of 1 eV steps is a side branch's.
RATES_OF = {"xenon": "xenon_5eV", "krypton": "krypton", "argon": "argon"}
# Keys that are supported at this value only; any other would change the simulation.
CONFIG_AT_REST: dict[str, Any] = {
    "anom_smoothing_iters": 0,
    "LANDMARK": False,
    "ionization_model": "Lookup",
    "excitation_model": "Lookup",
    "electron_neutral_model": "Lookup",
    "reaction_rate_directories": [],
    "propellant_config": "",
    "implicit_energy": 1.0,
}
# Keys of the propellant before 0.19; next to `propellants` HallThruster.jl reads none of them.
FLOW = {
    "gas": "propellant", "flow_rate_kg_s": "anode_mass_flow_rate",
    "velocity_m_s": "neutral_velocity", "temperature_K": "neutral_temperature_K",
    "ion_temperature_K": "ion_temperature_K", "max_charge": "ncharge",
}  # fmt: skip
# Keys without effect here.
CONFIG_IDLE = ("initial_condition",)
SIMULATION_IDLE = (
    "dt", "adaptive", "CFL", "min_dt", "max_dt", "max_small_steps", "verbose", "print_errors",
)  # fmt: skip


@dataclass(frozen=True)
class RunSettings:
    """Run settings of the file: arguments of `simulate`, and further numerical settings.

    reconstruct: whether the faces have second-order reconstruction. coldest_T_e_eV: the lower bound
    of T_e in HallThruster.jl (min_Te).
    """

    n_cells: int = 200
    even_grid: bool = True
    duration_s: float = 1e-3
    n_samples: int = 100
    reconstruct: bool = True
    coldest_T_e_eV: float = 1.5

    @property
    def sample_s(self) -> float:
        """Time between two output frames of the file."""
        return self.duration_s / max(self.n_samples - 1, 1)


@dataclass(frozen=True)
class HallThrusterInput:
    """Thruster, operating point and run settings of a file."""

    thruster: Thruster
    operating_point: OperatingPoint
    run: RunSettings


def read_hallthruster_input(path: str | Path) -> HallThrusterInput:
    """Read an input file of HallThruster.jl, or an output file, which holds its input.

    Missing entries have HallThruster.jl's defaults. The file of the magnetic field is looked for
    next to the JSON file, then in the current folder. The single loss_scale of a wall in
    HallThruster.jl sets both of ours. Its conductivity multiplies the gradient of 1.5 T_e, so that
    our factor is 1.5 times its own. Raises ValueError for an unknown key, and for one that asks for
    physics that is missing here (mixtures, a shielded wall, LANDMARK), naming it.
    The channel ingests background gas as it does there, where a pressure in Torr counts as if it
    were in Pa: 133 times less than at that pressure.
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
        config.number("discharge_voltage"),
        1e6 * gas["flow_rate_kg_s"],
        gas["velocity_m_s"],
        background=_background(config),
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
    coupling = config.number("cathode_potential", 0.0)  # its older name
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
        cathode_potential=config.number("cathode_coupling_voltage", coupling),
        series_resistance=0.0,
        conduction_factor=factor,
        conduction_coulomb=coulomb,
        plume=_plume(config),
    )


def _background(config: Node) -> Background | None:
    """The facility's gas. HallThruster.jl takes the number in Torr for one in Pa as it ingests."""
    pressure = config.number("background_pressure_Torr", 0.0)
    temperature = config.number("background_temperature_K", 100.0)
    multiplier = config.number("neutral_ingestion_multiplier", 1.0)
    if pressure == 0.0:
        return None
    return Background(TORR * pressure, temperature, ingestion=multiplier / TORR)


def _plume(config: Node) -> ThermalPlume | None:
    corrected = bool(config.take("apply_thrust_divergence_correction", False))
    return ThermalPlume(axial_thrust=corrected) if config.take("solve_plume", False) else None


def _anode(config: Node, cathode_T_e_eV: float) -> FixedAnode | AnodeSheath:
    T_e_eV = config.number("anode_Tev", cathode_T_e_eV)
    kind = config.take("anode_boundary_condition", "sheath")
    if kind == "sheath":
        return AnodeSheath(T_e_eV, potential_weight=2.0)
    if kind == "dirichlet":
        return FixedAnode(T_e_eV)
    raise ValueError(f"config.anode_boundary_condition must be sheath or dirichlet, got {kind!r}")


def _flow(config: Node) -> dict[str, Any]:
    """The propellant: in a list of one (from version 0.19), or by keys of the config."""
    flows = config.take("propellants", None)
    if flows is None:
        given = {key: config.take(name, None) for key, name in FLOW.items()}
        flow = Node({key: value for key, value in given.items() if value is not None}, "config")
    else:
        if len(flows) != 1:
            raise ValueError(
                f"config.propellants must be one: a mixture of {len(flows)} is not supported here"
            )
        flow = Node(flows[0], "config.propellants[0]")
        config.idle(*FLOW.values())
    gas = _gas(flow, bool(config.take("electron_ion_collisions", True)))
    charge = flow.take("max_charge", None)
    charges = flow.take("allowed_charges", None)
    if charges is None:
        charges = list(range(1, int(charge or 1) + 1))
    if not 1 <= len(charges) <= gas.charge_states or list(charges) != [1, 2, 3][: len(charges)]:
        raise ValueError(
            f"{flow.place} must ask for the charges of {gas.name} from 1 to at most "
            f"{gas.charge_states}: {list(charges)} is not supported here"
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
    """Speed of the neutrals: given, or a quarter of the mean thermal speed at their temperature."""
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
    if n_cells is None and not given.run.even_grid:
        raise ValueError(
            f"{path}: simulation.grid must be an EvenGrid here; n_cells={given.run.n_cells} takes "
            "one of as many cells"
        )
    return simulate(
        given.thruster,
        given.operating_point,
        cache=cache,
        duration_s=given.run.duration_s if duration_s is None else duration_s,
        warm_up_s=warm_up_s,
        sample_s=given.run.sample_s if sample_s is None else sample_s,
        n_cells=given.run.n_cells if n_cells is None else n_cells,
        stretch=1.0,  # EvenGrid of HallThruster.jl
        reconstruct=given.run.reconstruct,
        coldest_T_e_eV=given.run.coldest_T_e_eV,
        progress=progress,
    )
