"""Sparse models in torch: right-hand sides, derivatives by states and scalings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from ep2sindy.library.library import Library, library_of
from ep2sindy.library.relations import Constraint
from ep2sindy.library.relations import constraint as build_constraint
from ep2sindy.library.terms import Term
from ep2sindy.model.model import SparseModel


@dataclass(frozen=True, eq=False)
class Drive:
    """Step lengths and inputs of a batch, whose own time runs from 0 to the number of segments.

    steps: (segments, points, batch), length of each segment in the scaled time of the equations.
    inputs: (segments, 4, points, n_inputs, batch), cubics in the elapsed fraction of a segment,
    highest power first, in units of each input's scale.
    """

    steps: torch.Tensor
    inputs: torch.Tensor
    _uniform: bool = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "_uniform", bool((self.steps == 1.0).all()))

    def at(self, t: torch.Tensor | float) -> tuple[torch.Tensor | None, torch.Tensor]:
        """Steps (points, 1, batch), or None if all are one, and inputs (points, n_inputs, batch).

        Raises ValueError outside the segments, since nothing is extrapolated.
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
    """Equations x' = coef library(x, inputs), in scaled states and scaled time.

    States and inputs are in units of `scale` (states, then inputs), time in units of `step_s`.
    coef = C (scaling * free0) + d in SI, so relations between coefficients always hold; the
    scalings are the unknowns.
    correction: an extra term of shape (..., states + inputs) -> (..., states), in scaled
    variables, whose parameters are trained together with the scalings; only `forward` includes it.
    Raises ValueError for a model without terms, a relation that leaves out one of its terms or
    names an unknown one, or a free coefficient of zero, which no scaling can change.
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
        """Coefficients (coefs,) in SI, in the order of the constraint."""
        return self.C @ (self.scaling * self.free0) + self.d

    @property
    def matrix(self) -> torch.Tensor:
        """Coefficient matrix (terms, equations) in scaled variables and time."""
        flat = torch.zeros(
            len(self.library) * self.n_states, dtype=self.free0.dtype, device=self.free0.device
        )
        return flat.index_add(0, self.places, self.coef * self.unit).view(-1, self.n_states)

    def forward(self, t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        """Right-hand side at x (batch, n_states); t: in samples since each window's start."""
        values, steps = x, None
        if self.drive is not None:
            steps, inputs = self.drive.at(t)
            values = torch.cat([x, inputs[0].T], dim=-1)
        rate = self.library.evaluate(values) @ self.matrix
        if self.correction is not None:
            rate = rate + self.correction(values)
        return rate if steps is None else rate * steps[0].T

    def linear_parts(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Linear parts of `matrix` = first @ scaling + second.

        Returns first, (terms, equations, free), and second, (terms, equations).
        """
        shape = (len(self.library), self.n_states)
        by_scaling = self.C * self.free0 * self.unit[:, None]
        basis = self.C.new_zeros((shape[0] * shape[1], len(self.free0)))
        offset = self.C.new_zeros(shape[0] * shape[1])
        basis = basis.index_add(0, self.places, by_scaling).view(*shape, -1)
        return basis, offset.index_add(0, self.places, self.d * self.unit).view(shape)


def unconstrained(model: SparseModel) -> Constraint:
    """Constraint that leaves every nonzero coefficient of a model free."""
    return build_constraint(model.library, {s: tuple(model.terms(s)) for s in model.states})


def all_fixed(model: SparseModel) -> Constraint:
    """Constraint that fixes every nonzero coefficient of a model."""
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


@dataclass(frozen=True, eq=False)
class Augmented:
    """Right-hand sides of many points with their derivatives by state and scaling, in one batch.

    One gather and product evaluates every distinct product of `library`. One matmul of these gives
    the rate, its derivatives by the states and its derivatives by the scalings, column by column.
    factors: (degree, products). basis: (points, rows, products, free), with rows = n_states *
    columns. offset: the same without `free`.
    """

    library: Library
    factors: torch.Tensor
    basis: torch.Tensor
    offset: torch.Tensor
    n_states: int

    @property
    def n_free(self) -> int:
        return self.basis.shape[-1]

    @property
    def compiled(self) -> bool:
        """True if the kernel of `model.flow_kernels` takes the same steps."""
        return not self.library.functions and self.offset.device.type == "cpu"

    @property
    def n_columns(self) -> int:
        """Number of columns: the rate, its derivatives by each state, then by each scaling."""
        return 1 + self.n_states + self.n_free

    def take(self, points: torch.Tensor) -> Augmented:
        return replace(self, basis=self.basis[points], offset=self.offset[points])

    def held(self, scaling: torch.Tensor) -> Augmented:
        """The same with scalings (points, free) as they are, without derivatives by them."""
        shape = (len(scaling), self.n_states, self.n_columns, -1)
        weights = self.weights(scaling).view(shape)[:, :, : 1 + self.n_states].flatten(1, 2)
        return replace(self, basis=weights.new_zeros((*weights.shape, 0)), offset=weights)

    def weights(self, scaling: torch.Tensor) -> torch.Tensor:
        """Weights of the products, (points, rows, products), for scalings (points, free)."""
        return (self.basis @ scaling[:, None, :, None])[..., 0] + self.offset

    def fields(self, weights: torch.Tensor, x: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        """Rates and their derivatives, (points, n_states, columns, batch).

        x: (points, n_states, batch).
        """
        columns = torch.cat([x, inputs, torch.ones_like(x[:, :1])], dim=1)
        columns = self.library.with_functions(columns, axis=1)
        products = columns.index_select(1, self.factors[0])
        for rows in self.factors[1:]:
            products = products * columns.index_select(1, rows)
        return torch.bmm(weights, products).view(len(x), self.n_states, -1, x.shape[-1])

    def rhs(
        self, scaling: torch.Tensor, drive: Drive
    ) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
        """Function for d/dt of the state and of its derivatives by its start and the scalings.

        The function takes and returns (points, n_states, columns, batch).
        """
        weights, n = self.weights(scaling), self.n_states

        def rate(t: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
            steps, inputs = drive.at(t)
            out = self.fields(weights, z[:, :, 0], inputs)
            tangents = out[:, :, 1:2] * z[:, 0:1, 1:]
            for v in range(1, n):
                tangents.addcmul_(out[:, :, 1 + v : 2 + v], z[:, v : v + 1, 1:])
            tangents[:, :, n:] += out[:, :, 1 + n :]
            whole = torch.cat([out[:, :, :1], tangents], dim=2)
            return whole if steps is None else whole.mul_(steps[:, None])

        return rate

    def value_rhs(
        self, scaling: torch.Tensor, drive: Drive
    ) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
        """Function for d/dt of the state only, (points, n_states, batch)."""
        weights = self.weights(scaling)[:, :: self.n_columns]

        def rate(t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
            steps, inputs = drive.at(t)
            out = self.fields(weights, x, inputs)[:, :, 0]
            return out if steps is None else out * steps

        return rate


@lru_cache(maxsize=256)  # every fold of a selection refines the same terms
def _products(
    variables: tuple[str, ...], terms: tuple[Term, ...], n: int
) -> tuple[Library, Library, np.ndarray]:
    """A library of the terms, and their derivatives as by `Library.with_derivatives`."""
    library = library_of(variables, terms)
    return library, *library.with_derivatives(n)


def augment(odes: Sequence[ODE]) -> Augmented:
    """Combine modules of the same variables into one batch of points, on the first's device.

    Terms may differ: the products are those that any module needs, and modules with fewer
    scalings are padded with columns of zeros.
    Raises ValueError for modules that differ in variables, or hold a correction, whose
    derivatives are available only from autograd.
    """
    first = odes[0]
    if any(ode.correction is not None for ode in odes):
        raise ValueError("a learned correction has no tangents here; refine by GradientDescent")
    if any((ode.variables, ode.n_states) != (first.variables, first.n_states) for ode in odes):
        raise ValueError(
            "models refined in one batch must share their states and inputs: "
            f"{sorted({ode.variables for ode in odes})} came"
        )
    n, n_free = first.n_states, max(len(ode.free0) for ode in odes)
    distinct = tuple(dict.fromkeys(term for ode in odes for term in ode.library.terms))
    terms, products, transfer = _products(first.variables, distinct, n)
    size = (len(odes), n, 1 + n + n_free, len(products))
    basis, offset = np.zeros((*size, n_free)), np.zeros(size)
    for ode, by_point, fixed_point in zip(odes, basis, offset, strict=True):
        with torch.no_grad():
            by_scaling, fixed = (part.cpu().numpy() for part in ode.linear_parts())
        spread = transfer[terms.places(ode.library)]
        own = by_scaling.shape[-1]
        by_point[:, : 1 + n, :, :own] = np.einsum("tcm,tji->jcmi", spread, by_scaling)
        fixed_point[:, : 1 + n] = np.einsum("tcm,tj->jcm", spread, fixed)
        fixed_point[:, 1 + n : 1 + n + own] = np.einsum("tm,tji->jim", spread[:, 0], by_scaling)
    device = first.C.device
    factors = torch.tensor(products.table.T, device=device)
    return Augmented(
        library=products,
        factors=factors.contiguous(),
        basis=torch.tensor(basis, device=device).flatten(1, 2),
        offset=torch.tensor(offset, device=device).flatten(1, 2),
        n_states=n,
    )
