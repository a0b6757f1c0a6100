"""What follows the plasma from sample to sample, outside the compiled loop.

The cross-section along the axis, as a plume spreads, and the transport, if it is a function.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster.axial.model import lengths_and_centres
from ep2sindy.thruster.axial.state_kernels import TANGENT, AxialModel, AxialState
from ep2sindy.thruster.parameters import Thruster
from ep2sindy.thruster.plume import ThermalPlume
from ep2sindy.thruster.transport import FunctionTransport, Plasma

# Called before each sample with its length in s; changes the model's arrays in place.
Follower = Callable[[float], None]

DELAY_S = 1e-5  # a plume's angle follows its plasma in about the time that ions need to leave


def followers_of(
    thruster: Thruster, model: AxialModel, state: AxialState, faces: Float[np.ndarray, " faces"]
) -> list[Follower]:
    """What is set anew before each sample, from the state. Sets the first areas of a plume."""
    followers: list[Follower] = []
    if thruster.plume is not None:
        spreading = Spreading(thruster, model, state, faces)
        followers += [spreading.follow] if spreading.follows else []
    if isinstance(thruster.transport, FunctionTransport):
        followers.append(_transport(thruster.transport, thruster, model, state, faces))
    return followers


def _transport(
    transport: FunctionTransport,
    thruster: Thruster,
    model: AxialModel,
    state: AxialState,
    faces: Float[np.ndarray, " faces"],
) -> Follower:
    """Anomalous collisions by a user's function of the plasma, which gets copies."""
    distance = lengths_and_centres(faces)[1][1:-1] - thruster.channel_length
    B = thruster.magnetic_field.at(distance)

    def follow(sample_s: float) -> None:
        cells = (state.n_e, state.T_e_eV, state.E, state.n_n)
        n_e, T_e_eV, E, n_n = (values[1:-1].copy() for values in cells)
        u_i = (state.flux_i.sum(axis=0) / state.n_i.sum(axis=0))[1:-1]
        plasma = Plasma(n_e=n_e, T_e_eV=T_e_eV, E=E, n_n=n_n, u_i=u_i, B=B.copy())
        c = transport.at(distance.copy(), float(state.clock[0]), plasma)
        model.anomalous[:] = np.pad(c, 1, mode="edge") * model.omega_ce

    return follow


class Spreading:
    """Areas of a model, from the tangents of its plume's half-angle in the state.

    Those of a `ThermalPlume` follow the plasma from sample to sample, with a delay of DELAY_S.
    """

    def __init__(
        self,
        thruster: Thruster,
        model: AxialModel,
        state: AxialState,
        faces: Float[np.ndarray, " faces"],
    ) -> None:
        self.thruster, self.model, self.state = thruster, model, state
        self.from_exit = faces - thruster.channel_length
        self.follows = isinstance(thruster.plume, ThermalPlume)
        if not self.follows:
            state.tangent[:] = self._target()
        self._set_areas()

    def _target(self) -> Float[np.ndarray, " cells"]:
        """Tangents that belong to the present plasma."""
        state, plume = self.state, self.thruster.plume
        assert plume is not None
        exit_T_e = float(np.interp(0.0, self.from_exit, state.T_e_eV[:-1]))
        mean = state.flux_i.sum(axis=0) / state.n_i.sum(axis=0)
        return plume.tangents(mean, exit_T_e_eV=exit_T_e, ion_mass=self.model.ion_mass)

    def _set_areas(self) -> None:
        state, model = self.state, self.model
        at_faces = 0.5 * (state.tangent[1:] + state.tangent[:-1])
        area = self.thruster.relative_area(self.from_exit, at_faces)
        model.spread_at[:] = area
        model.spread[1:-1] = 0.5 * (area[1:] + area[:-1])
        model.spread[[0, -1]] = area[[0, -1]]
        model.per_before[1:] = area / (model.spread[1:] * model.dz[1:])
        model.per_behind[:-1] = area / (model.spread[:-1] * model.dz[:-1])
        state.instant[TANGENT] = at_faces[-1]

    def follow(self, sample_s: float) -> None:
        """Let the areas follow the plasma by one sample; what a cell holds spreads over them."""
        state, before = self.state, self.model.spread.copy()
        share = -np.expm1(-sample_s / DELAY_S)
        state.tangent[:] += share * (self._target() - state.tangent)
        self._set_areas()
        thinner = before / self.model.spread
        for each in (state.n_i, state.flux_i, state.n_n, state.energy):
            each *= thinner
