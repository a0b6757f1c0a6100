"""Cells along the axis and the compiled loop's arrays, from a thruster's parameters.

Cells have equal lengths, or are longer in the plume, where ions are fast. Arrays that follow the
plasma, in little steps from sample to sample, are set outside the loop: the cross-section as a
plume spreads, and the transport if it is a function.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster.axial.state_kernels import TANGENT, AxialModel, AxialState
from ep2sindy.thruster.closures import (
    DRIFT_EVENTS,
    TABLE_STEP_EV,
    closure_table,
    further_transitions,
)
from ep2sindy.thruster.constants import E_CHARGE, K_BOLTZMANN, M_ELECTRON
from ep2sindy.thruster.parameters import OperatingPoint, Thruster
from ep2sindy.thruster.plume import ThermalPlume, relative_area
from ep2sindy.thruster.propellants import PropellantTable
from ep2sindy.thruster.transport import FunctionTransport, Plasma
from ep2sindy.thruster.walls import AnodeSheath
from ep2sindy.trust.memory import check_memory

CFL = 0.8
MIN_CELLS = 10
SUPPLY_STEP_S = 1e-7  # linear between them: a modulation of 40 kHz is within 1e-4 of its amplitude
CENTRE_M, WIDTH_M = 12e-3, 4e-3  # beyond the exit; from short to long cells
# Called before each sample with its length in s; changes the model's arrays in place.
Follower = Callable[[float], None]
DELAY_S = 1e-5  # a plume's angle follows its plasma in about the time that ions need to leave


def cell_faces(thruster: Thruster, n_cells: int, stretch: float) -> Float[np.ndarray, " faces"]:
    """Positions of the faces in m, from the anode to the cathode plane.

    stretch: length of the plume's cells relative to the channel's; 1 makes all equal. The time step
    is limited by the ions' fastest passage through a cell. Longer cells in the plume therefore need
    fewer steps for the same number of cells.
    Raises ValueError for fewer than ten cells, or a stretch below 1.
    """
    if n_cells < MIN_CELLS:
        raise ValueError(
            f"n_cells must be {MIN_CELLS} or more to resolve the channel, got {n_cells}"
        )
    if not 1.0 <= stretch <= 10.0:
        raise ValueError(f"stretch must be between 1 (cells of one length) and 10, got {stretch!r}")
    if stretch == 1.0:
        return np.linspace(0.0, thruster.domain_length, n_cells + 1)
    z = np.linspace(0.0, thruster.domain_length, 20 * n_cells + 1)
    beyond = 0.5 * (z[1:] + z[:-1]) - thruster.channel_length - CENTRE_M
    length = 1.0 + (stretch - 1.0) * 0.5 * (1.0 + np.tanh(beyond / WIDTH_M))
    number = np.concatenate([[0.0], np.cumsum(np.diff(z) / length)])
    return np.interp(np.linspace(0.0, number[-1], n_cells + 1), number, z)


def build_model(
    thruster: Thruster,
    point: OperatingPoint,
    faces: Float[np.ndarray, " faces"],
    *,
    end_s: float,
    cfl: float = CFL,
    reconstruct: bool = True,
    coldest_eV: float = 0.0,
) -> AxialModel:
    """Gather all constants of one run; arrays hold one ghost cell at each end.

    end_s: end of the record, to which the supply's voltage must be known.
    """
    distance = lengths_and_centres(faces)[1] - thruster.channel_length
    born = (0.0 if thruster.ions_born_at_rest else 1.0) * point.neutral_speed_at(distance)
    omega_ce = E_CHARGE * thruster.magnetic_field.at(distance) / M_ELECTRON
    mass, anode, wall = thruster.propellant.mass, thruster.anode, thruster.wall
    table = closure_table(thruster)
    return AxialModel(
        **_lengths(faces),
        slope_weight=1.0 if reconstruct else 0.0,
        area=thruster.area,
        ion_mass=mass,
        sound_speed_squared=K_BOLTZMANN * thruster.ion_temperature / mass,
        neutral_speed=point.neutral_speed_at(faces - thruster.channel_length),
        neutral_wave=0.0,
        birth_speed=born,
        neutral_inflow=1e-6 * point.inflow_mg_s(thruster) / (mass * thruster.area),
        **_circuit(thruster, point, end_s),
        pressure_factor=thruster.pressure_factor,
        conduction_factor=thruster.conduction_factor,
        conduction_coulomb=thruster.conduction_coulomb,
        drift_weight=thruster.propellant.drift_weight,
        drift_credit=bool(thruster.propellant.drift_weight > 0.0 and table[:, DRIFT_EVENTS].any()),
        sheath=isinstance(anode, AnodeSheath),
        sheath_weight=anode.potential_weight if isinstance(anode, AnodeSheath) else 0.0,
        anode_T_e_eV=anode.T_e_eV,
        cathode_T_e_eV=thruster.cathode_T_e_eV,
        coldest_eV=coldest_eV,
        cfl=cfl,
        omega_ce=omega_ce,
        anomalous=thruster.transport_at(distance, point.background) * omega_ce,
        wall_ion_weight=wall.ion_weight(distance),
        wall_collision_weight=wall.collision_weight(distance),
        wall_power_weight=wall.power_weight(distance),
        table=table,
        table_step_eV=TABLE_STEP_EV,
        **_further(thruster),
    )


def _circuit(thruster: Thruster, point: OperatingPoint, end_s: float) -> dict[str, Any]:
    """Supply and circuit of a model; a voltage that varies is taken at steps of SUPPLY_STEP_S."""
    volts, rate = np.array([point.voltage]), 0.0
    if point.supply is not None:
        n_steps = math.ceil(end_s / SUPPLY_STEP_S)
        check_memory(8.0 * n_steps, f"duration_s = {end_s:g} s", hint="simulate less of it")
        volts = point.supply.at(SUPPLY_STEP_S * np.arange(n_steps + 2.0), point.voltage)
        rate = 1.0 / SUPPLY_STEP_S
    circuit = thruster.circuit
    return {
        "supply": volts - thruster.cathode_potential,
        "supply_rate": rate,
        "resistance": thruster.series_resistance,
        "inductance": 0.0 if circuit is None else circuit.inductance,
        "capacitance": 0.0 if circuit is None else circuit.capacitance,
    }


def _lengths(faces: Float[np.ndarray, " faces"]) -> dict[str, Any]:
    """The length arrays of a model: of its cells and between their centres."""
    dz, z = lengths_and_centres(faces)
    between, before, behind = np.diff(z), 1.0 / dz, 1.0 / dz
    return {
        "dz": dz,
        "inverse_dz": 1.0 / dz,
        "spread": np.ones(dz.size),
        "spread_at": np.ones(dz.size - 1),
        "per_spread": np.ones(dz.size),
        "per_spread_at": np.ones(dz.size - 1),
        "per_before": before,
        "per_behind": behind,
        "neutral_before": before,
        "neutral_behind": behind,
        "per_between": 1.0 / between,
        "per_span": np.pad(1.0 / (between[1:] + between[:-1]), 1, mode="edge"),
        "to_left": np.append(1.0, dz[1:] / between),
        "to_right": np.append(dz[:-1] / between, 1.0),
    }


def lengths_and_centres(
    faces: Float[np.ndarray, " faces"],
) -> tuple[Float[np.ndarray, " cells"], Float[np.ndarray, " cells"]]:
    """Lengths and centres of all cells; ghost cells mirror the outermost cells."""
    dz = np.diff(faces)
    dz = np.concatenate([dz[:1], dz, dz[-1:]])
    ends = [faces[0] - dz[0], *faces, faces[-1] + dz[-1]]
    return dz, 0.5 * (np.array(ends[1:]) + np.array(ends[:-1]))


def _further(thruster: Thruster) -> dict[str, Any]:
    """Transitions beyond X -> X+ in the order of the closure table, with their energies."""
    pairs, propellant = further_transitions(thruster), thruster.propellant
    if not pairs:
        return {"further": np.zeros((0, 2), np.int64), "further_eV": np.zeros(0)}
    assert isinstance(propellant, PropellantTable)  # the thruster checks this
    energies = [propellant.further_energy(*pair) for pair in pairs]
    return {"further": np.array(pairs), "further_eV": np.array(energies)}


def followers_of(
    thruster: Thruster, model: AxialModel, state: AxialState, faces: Float[np.ndarray, " faces"]
) -> list[Follower]:
    """What is set anew before each sample, from the state. Sets the first areas of a plume."""
    followers: list[Follower] = []
    if thruster.plume is not None:
        spreading = Spreading(thruster, model, state, faces - thruster.channel_length)
        if isinstance(thruster.plume, ThermalPlume):
            followers.append(spreading.follow)
        else:
            state.tangent[:] = spreading.target()
        spreading.set_areas()
    transport = thruster.transport
    if isinstance(transport, FunctionTransport):
        distance = lengths_and_centres(faces)[1][1:-1] - thruster.channel_length
        B = thruster.magnetic_field.at(distance)

        def set_collisions(sample_s: float) -> None:
            """Anomalous collisions by a user's function of the plasma, which gets copies."""
            cells = (state.n_e, state.T_e_eV, state.E, state.n_n)
            n_e, T_e_eV, E, n_n = (values[1:-1].copy() for values in cells)
            u_i = (state.flux_i.sum(axis=0) / state.n_i.sum(axis=0))[1:-1]
            plasma = Plasma(n_e=n_e, T_e_eV=T_e_eV, E=E, n_n=n_n, u_i=u_i, B=B.copy())
            c = transport.at(distance.copy(), float(state.clock[0]), plasma)
            model.anomalous[:] = np.pad(c, 1, mode="edge") * model.omega_ce

        followers.append(set_collisions)
    return followers


@dataclass(frozen=True, eq=False)
class Spreading:
    """Areas of a model, from the tangents of its plume's half-angle in the state.

    Those of a `ThermalPlume` follow the plasma from sample to sample, with a delay of DELAY_S.
    from_exit: places of the faces beyond the exit in m.
    """

    thruster: Thruster
    model: AxialModel
    state: AxialState
    from_exit: Float[np.ndarray, " faces"]

    def target(self) -> Float[np.ndarray, " cells"]:
        """Tangents that belong to the present plasma."""
        state, plume = self.state, self.thruster.plume
        assert plume is not None
        exit_T_e = float(np.interp(0.0, self.from_exit, state.T_e_eV[:-1]))
        mean = state.flux_i.sum(axis=0) / state.n_i.sum(axis=0)
        return plume.tangents(mean, exit_T_e_eV=exit_T_e, ion_mass=self.model.ion_mass)

    def set_areas(self) -> None:
        """Set the areas of the model by the tangents of the state."""
        state, model = self.state, self.model
        at_faces = 0.5 * (state.tangent[1:] + state.tangent[:-1])
        inner, outer = self.thruster.inner_radius, self.thruster.outer_radius
        area = relative_area(self.from_exit, at_faces, inner_radius=inner, outer_radius=outer)
        model.spread_at[:] = area
        model.spread[1:-1] = 0.5 * (area[1:] + area[:-1])
        model.spread[[0, -1]] = area[[0, -1]]
        model.per_spread[:], model.per_spread_at[:] = 1.0 / model.spread, 1.0 / area
        model.per_before[1:] = area / (model.spread[1:] * model.dz[1:])
        model.per_behind[:-1] = area / (model.spread[:-1] * model.dz[:-1])
        state.instant[TANGENT] = at_faces[-1]

    def follow(self, sample_s: float) -> None:
        """Let the areas follow the plasma by one sample; what a cell holds spreads over them."""
        state, before = self.state, self.model.spread.copy()
        fraction = -np.expm1(-sample_s / DELAY_S)
        state.tangent[:] += fraction * (self.target() - state.tangent)
        self.set_areas()
        thinner = before / self.model.spread
        for each in (state.n_i, state.flux_i, state.n_n, state.energy):
            each *= thinner
