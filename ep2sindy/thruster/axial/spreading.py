"""The plasma's cross-section along the axis, as its plume spreads."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster.axial.state_kernels import TANGENT, AxialModel, AxialState
from ep2sindy.thruster.parameters import Thruster
from ep2sindy.thruster.plume import ThermalPlume

FOLLOWS_IN_S = 1e-5  # a plume's angle follows its plasma in about the time that ions need to leave


class Spreading:
    """Areas of a model, from the tangents of its plume's half-angle in the state.

    Those of a `ThermalPlume` follow the plasma from sample to sample, with a delay of FOLLOWS_IN_S.
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
        if thruster.plume is not None:
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
        if not self.follows:
            return
        state, before = self.state, self.model.spread.copy()
        share = -np.expm1(-sample_s / FOLLOWS_IN_S)
        state.tangent[:] += share * (self._target() - state.tangent)
        self._set_areas()
        thinner = before / self.model.spread
        for each in (state.n_i, state.flux_i, state.n_n, state.energy):
            each *= thinner
