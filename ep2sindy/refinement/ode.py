"""A sparse model as a torch module: scaled states, scaled time, scalings of free coefficients."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from ep2sindy.constraints.relations import Constraint
from ep2sindy.constraints.relations import constraint as build_constraint
from ep2sindy.model.model import SparseModel


@dataclass(frozen=True, eq=False)
class Drive:
    """Clock and inputs of a batch, while its own time runs from 0 to the number of segments.

    steps: (segments, points, batch), length of each segment in the scaled time of the equations.
    inputs: (segments, 4, points, n_inputs, batch), cubics in the share of a segment that has
    passed, highest power first, in units of each input's scale.
    """

    steps: torch.Tensor
    inputs: torch.Tensor
    _uniform: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_uniform", bool((self.steps == 1.0).all()))

    def at(self, t: torch.Tensor | float) -> tuple[torch.Tensor | None, torch.Tensor]:
        """Steps (points, 1, batch), None where all are one, and inputs (points, n_inputs, batch).

        Raises ValueError past the last segment: nothing is extrapolated.
        """
        now, n_segments = float(t), len(self.steps)
        if not -1e-9 <= now <= n_segments + 1e-9:
            raise ValueError(
                f"inputs must cover the window: t = {now:.6g} was asked of {n_segments} segments"
            )
        k = min(max(int(now), 0), n_segments - 1)
        cubic, u = self.inputs[k], now - k
        inputs = cubic[0]
        if inputs.shape[1]:
            inputs = ((cubic[0] * u + cubic[1]) * u + cubic[2]) * u + cubic[3]
        return None if self._uniform else self.steps[k][:, None], inputs


class ODE(nn.Module):
    """x' = (coef of the free scalings) library(x, inputs), in scaled states and scaled time.

    States and inputs are in units of `scale`, (states then inputs), time in units of `step_s`.
    coef = C (scaling * free0) + d in SI, so relations between coefficients always hold.
    correction: an extra term of shape (..., states + inputs) -> (..., states), in scaled
    variables, whose parameters train together with the scalings; only `forward` knows it.
    Raises ValueError for a model without terms, a relation that leaves out one of its terms or
    names an unknown one, or a free coefficient of zero, which no scaling can move.
    """

    free0: torch.Tensor
    C: torch.Tensor
    d: torch.Tensor
    unit: torch.Tensor
    places: torch.Tensor

    def __init__(
        self,
        model: SparseModel,
        *,
        scale: Float[np.ndarray, " variables"],
        step_s: float,
        constraint: Constraint | None = None,
        correction: nn.Module | None = None,
    ) -> None:
        super().__init__()
        relations = unconstrained(model) if constraint is None else constraint
        coef = _coef(model, relations)
        self.variables = (*model.states, *model.inputs)
        self.n_states = len(model.states)
        rows = [model.library.index(name) for _, name in relations.coefficients]
        used, terms = np.unique(rows, return_inverse=True)
        equations = [model.states.index(state) for state, _ in relations.coefficients]
        self.library, values = model.library.take(used).over(self.variables).scaled(scale)
        # SI coefficient times this is the coefficient in scaled variables and time.
        unit = step_s * values[terms] / scale[equations]
        for name, value in {
            "free0": coef[np.asarray(relations.free)],
            "C": relations.C,
            "d": relations.d,
            "unit": unit,
        }.items():
            self.register_buffer(name, torch.tensor(np.asarray(value), dtype=torch.float64))
        self.register_buffer("places", torch.tensor(terms * self.n_states + equations))
        self.scaling = nn.Parameter(torch.ones(len(self.free0), dtype=torch.float64))
        self.correction = correction
        self.drive: Drive | None = None

    @property
    def coef(self) -> torch.Tensor:
        """(coefs,) in SI, in the order of the constraint."""
        return self.C @ (self.scaling * self.free0) + self.d

    @property
    def matrix(self) -> torch.Tensor:
        """(terms, equations) in scaled variables and time."""
        flat = torch.zeros(
            len(self.library) * self.n_states, dtype=self.free0.dtype, device=self.free0.device
        )
        return flat.index_add(0, self.places, self.coef * self.unit).view(-1, self.n_states)

    def forward(self, t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """x: (batch, n_states); t: in samples since each window's start, as `drive` counts."""
        values, steps = x, None
        if self.drive is not None:
            steps, inputs = self.drive.at(t)
            values = torch.cat([x, inputs[0].T], dim=-1)
        rate = self.library.evaluate(values) @ self.matrix
        if self.correction is not None:
            rate = rate + self.correction(values)
        return rate if steps is None else rate * steps[0].T

    def linear_parts(self) -> tuple[torch.Tensor, torch.Tensor]:
        """`matrix` = first @ scaling + second: (terms, equations, free), (terms, equations)."""
        shape = (len(self.library), self.n_states)
        by_scaling = self.C * self.free0 * self.unit[:, None]
        basis = self.C.new_zeros((shape[0] * shape[1], len(self.free0)))
        offset = self.C.new_zeros(shape[0] * shape[1])
        basis = basis.index_add(0, self.places, by_scaling).view(*shape, -1)
        return basis, offset.index_add(0, self.places, self.d * self.unit).view(shape)


def unconstrained(model: SparseModel) -> Constraint:
    """Every coefficient of a model that is not zero, each free."""
    return build_constraint(model.library, {s: tuple(model.terms(s)) for s in model.states})


def held(model: SparseModel) -> Constraint:
    """Every coefficient of a model that is not zero, none of them free."""
    every = unconstrained(model)
    values = _coef(model, every)
    nothing = np.empty(0, dtype=np.int64)
    return replace(every, C=np.empty((len(values), 0)), d=values, free=nothing)


def _coef(model: SparseModel, relations: Constraint) -> np.ndarray:
    """SI coefficients of a model in the order of the relations, checked against them."""
    named = set(relations.coefficients)
    present = [(s, name) for s in model.states for name in model.terms(s)]
    if not present:
        raise ValueError("refinement needs a model with at least one term: this one has none")
    left_out = [pair for pair in present if pair not in named]
    if left_out:
        raise ValueError(
            f"the constraint must cover every term of the model: {left_out} are missing; "
            "build it from this model's support"
        )
    for state, _ in relations.coefficients:
        if state not in model.states:
            raise ValueError(f"unknown state {state!r}; this model has {list(model.states)}")
    coef = np.array(
        [
            model.coef[model.library.index(n), model.states.index(s)]
            for s, n in relations.coefficients
        ]
    )
    still = [relations.coefficients[i] for i in np.asarray(relations.free) if coef[i] == 0.0]
    if still:
        raise ValueError(
            f"a free coefficient must start away from zero: {still} are zero, and a scaling "
            "cannot move them; start from a small value"
        )
    return coef
