"""The equations that a refinement fits, as one torch module over all its points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
import torch
from jaxtyping import Float
from torch import nn

from ep2sindy.library.library import Library, library_of
from ep2sindy.library.relations import Constraint
from ep2sindy.library.relations import constraint as build_constraint
from ep2sindy.library.terms import Term
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.constrained import read_coefficients


@dataclass(frozen=True, eq=False)
class Drive:
    """Step lengths and inputs of a batch, whose own time runs from 0 to the number of segments.

    steps: (segments, points, batch), length of each segment in the scaled time of the equations.
    inputs: (segments, 4, points, n_inputs, batch), cubics in the elapsed fraction of a segment,
    highest power first, in units of each input's scale.
    """

    steps: torch.Tensor
    inputs: torch.Tensor

    @cached_property
    def _uniform(self) -> bool:
        return bool((self.steps == 1.0).all())

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

    def take(self, points: torch.Tensor) -> Drive:
        return Drive(self.steps[:, points], self.inputs[:, :, points])


@dataclass(frozen=True, eq=False)
class ScaledEquations:
    """One model in the units of its windows, linear in the scalings of its free coefficients.

    The coefficients in SI are C (scaling * free0) + d, so relations between them always hold. In
    scaled variables and time the rates are terms(x, u) @ (by_scaling @ scaling + fixed).
    variables: states, then inputs. by_scaling: (terms, equations, free); fixed: (terms, equations).
    """

    variables: tuple[str, ...]
    n_states: int
    library: Library
    relations: Constraint
    free0: Float[np.ndarray, " free"]
    by_scaling: Float[np.ndarray, "terms equations free"]
    fixed: Float[np.ndarray, "terms equations"]

    @staticmethod
    def of(
        model: SparseModel,
        *,
        scale: Float[np.ndarray, " variables"],
        step_s: float,
        constraint: Constraint | None = None,
    ) -> ScaledEquations:
        """States and inputs are in units of `scale` (states, then inputs), time of `step_s`.

        Raises ValueError for a model without terms, a relation that leaves out one of its terms or
        names an unknown one, or a free coefficient of zero, which no scaling can change.
        """
        relations = unconstrained(model) if constraint is None else constraint
        coef = _coef(model, relations)
        rows = [model.library.index(name) for _, name in relations.coefficients]
        used, terms = np.unique(rows, return_inverse=True)
        equations = np.array([model.states.index(state) for state, _ in relations.coefficients])
        variables = (*model.states, *model.inputs)
        library, values = model.library.take(used).over(variables).scaled(scale)
        # SI coefficient times this is the coefficient in scaled variables and time.
        unit = step_s * values[terms] / scale[equations]
        free0 = coef[np.asarray(relations.free)]
        by_scaling = np.zeros((len(library), len(model.states), len(free0)))
        by_scaling[terms, equations] = relations.C * free0 * unit[:, None]
        fixed = np.zeros(by_scaling.shape[:2])
        fixed[terms, equations] = relations.d * unit
        n = len(model.states)
        return ScaledEquations(variables, n, library, relations, free0, by_scaling, fixed)

    @property
    def n_free(self) -> int:
        return len(self.free0)

    def matrix(self, scaling: Float[np.ndarray, " free"]) -> Float[np.ndarray, "terms equations"]:
        """Coefficients in scaled variables and time."""
        return self.by_scaling @ scaling + self.fixed

    def coef(self, scaling: Float[np.ndarray, " free"]) -> Float[np.ndarray, " coefs"]:
        """Coefficients in SI, in the order of the relations."""
        return self.relations.coef(self.free0 * scaling)


class ODE(nn.Module):
    """Right-hand side of all points of a refinement, in scaled states and time, with tangents.

    The rates of a point are W m(x, u), with the distinct products m of its terms and of their
    derivatives, and W = basis @ scaling + offset. The scalings, (points, free), are what is fitted,
    and begin at one; a point with fewer of them ignores the excess.
    basis: (points, columns * n_states, products, free), with a column for the rates, one for their
    derivatives by each state, and one for those by each scaling; offset: the same without `free`.
    correction: a term of a single point, from scaled states and inputs (batch, variables) to rates
    (batch, n_states), whose parameters are trained together with the scalings.
    drive: steps and inputs on the way, which must be set before an integration.
    """

    basis: torch.Tensor
    offset: torch.Tensor
    drive: Drive

    def __init__(
        self,
        library: Library,
        n_states: int,
        basis: torch.Tensor,
        offset: torch.Tensor,
        correction: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.library, self.n_states = library, n_states
        self.register_buffer("basis", basis)
        self.register_buffer("offset", offset)
        self.scaling = nn.Parameter(basis.new_ones((len(basis), basis.shape[-1])))
        self.correction = correction

    @staticmethod
    def of(points: Sequence[ScaledEquations], correction: nn.Module | None = None) -> ODE:
        """Module of some points, whose terms may differ.

        Raises ValueError for points that differ in their variables.
        """
        if len({(point.variables, point.n_states) for point in points}) > 1:
            raise ValueError(
                "models refined in one batch must share their states and inputs, got "
                f"{sorted({point.variables for point in points})}"
            )
        products, basis, offset = _weights(points)
        return ODE(
            products, points[0].n_states, torch.tensor(basis), torch.tensor(offset), correction
        )

    @property
    def n_free(self) -> int:
        return self.basis.shape[-1]

    @property
    def n_columns(self) -> int:
        """Number of columns: the rate, its derivatives by each state, then by each scaling."""
        return 1 + self.n_states + self.n_free

    @cached_property
    def _factors(self) -> torch.Tensor:
        """Columns that every product multiplies, (degree, products), on the module's device."""
        return torch.tensor(self.library.table.T, device=self.basis.device)

    @cached_property
    def _of_rates(self) -> tuple[Library, torch.Tensor, torch.Tensor]:
        """The products that the rates alone need: library, factors, and places among all."""
        rows = slice(self.n_states)
        used = (self.basis[:, rows] != 0.0).any(dim=-1) | (self.offset[:, rows] != 0.0)
        places = torch.nonzero(used.any(dim=0).any(dim=0))[:, 0]
        library = self.library.take(places.cpu().numpy())
        return library, torch.tensor(library.table.T, device=self.basis.device), places

    def take(self, points: torch.Tensor) -> ODE:
        """Module of some of the points, with scalings of one, without drive or correction."""
        return ODE(self.library, self.n_states, self.basis[points], self.offset[points])

    def set(self, scaling: Float[np.ndarray, "points free"], drive: Drive) -> None:
        """Set the scalings, and what the next integration goes through."""
        with torch.no_grad():
            self.scaling.copy_(torch.tensor(scaling))
        self.drive = drive

    def weights(self, n_columns: int) -> torch.Tensor:
        """Weights of the products in the first columns, (points, rows, products)."""
        rows = n_columns * self.n_states
        by_scaling = self.basis[:, :rows] @ self.scaling[:, None, :, None]
        return by_scaling[..., 0] + self.offset[:, :rows]

    def fields(self, x: torch.Tensor, inputs: torch.Tensor, n_columns: int) -> torch.Tensor:
        """Rates, then their derivatives, (points, n_columns, n_states, batch).

        x: (points, n_states, batch). One gather and product evaluates every distinct product that
        is needed, one matmul all columns.
        """
        library, factors, weights = self.library, self._factors, self.weights(n_columns)
        if n_columns == 1:
            library, factors, places = self._of_rates
            weights = weights[:, :, places]
        columns = torch.cat([x, inputs, torch.ones_like(x[:, :1])], dim=1)
        columns = library.with_functions(columns, axis=1)
        products = columns.index_select(1, factors[0])
        for rows in factors[1:]:
            products = products * columns.index_select(1, rows)
        found = torch.bmm(weights, products)
        return found.view(len(x), n_columns, self.n_states, x.shape[-1])

    def forward(self, t: torch.Tensor, z: torch.Tensor) -> torch.Tensor:
        """d/dt of states and tangents z, (points, columns, n_states, batch).

        The first column is the state x, with x' = f(x, s). The others are, as far as they are
        given, its derivatives S by each of its initial values, with S' = (df/dx) S, then those by
        each scaling s, with S' = (df/dx) S + df/ds.
        """
        steps, inputs = self.drive.at(t)
        n, x = self.n_states, z[:, 0]
        found = self.fields(x, inputs, z.shape[1])
        if z.shape[1] > 1:
            whole = torch.empty_like(z)
            whole[:, 0] = found[:, 0]
            tangents = torch.mul(found[:, 1:2], z[:, 1:, :1], out=whole[:, 1:])
            for v in range(1, n):
                tangents.addcmul_(found[:, 1 + v : 2 + v], z[:, 1:, v : v + 1])
            tangents[:, n:] += found[:, 1 + n :]
            found = whole
        if self.correction is not None:
            assert z.shape[1] == 1, "a correction has no tangents, which only autograd could give"
            found = found + self._correct(x, inputs)
        return found if steps is None else found * steps[:, None]

    def _correct(self, x: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        assert self.correction is not None
        rates: torch.Tensor = self.correction(torch.cat([x, inputs], dim=1)[0].T)
        return rates.T[None, None]


@lru_cache(maxsize=256)  # every fold of a selection refines the same terms
def _products(
    variables: tuple[str, ...], terms: tuple[Term, ...], n: int
) -> tuple[Library, Library, np.ndarray]:
    """A library of the terms, and their derivatives as by `Library.with_derivatives`."""
    library = library_of(variables, terms)
    return library, *library.with_derivatives(n)


def _weights(points: Sequence[ScaledEquations]) -> tuple[Library, np.ndarray, np.ndarray]:
    """The products that any point needs, and the basis and the offset of their weights."""
    first = points[0]
    n, n_free = first.n_states, max(point.n_free for point in points)
    distinct = tuple(dict.fromkeys(term for point in points for term in point.library.terms))
    terms, products, transfer = _products(first.variables, distinct, n)
    size = (len(points), 1 + n + n_free, n, len(products))
    basis, offset = np.zeros((*size, n_free)), np.zeros(size)
    for point, by_point, fixed_point in zip(points, basis, offset, strict=True):
        spread, own = transfer[terms.places(point.library)], point.n_free
        by_point[: 1 + n, :, :, :own] = np.einsum("tcm,tji->cjmi", spread, point.by_scaling)
        fixed_point[: 1 + n] = np.einsum("tcm,tj->cjm", spread, point.fixed)
        fixed_point[1 + n : 1 + n + own] = np.einsum("tm,tji->ijm", spread[:, 0], point.by_scaling)
    rows = (size[0], size[1] * n, len(products))
    return products, basis.reshape(*rows, n_free), offset.reshape(rows)


def unconstrained(model: SparseModel) -> Constraint:
    """Constraint that leaves every nonzero coefficient of a model free."""
    return build_constraint(model.library, {s: tuple(model.terms(s)) for s in model.states})


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
    coef = read_coefficients(model, relations)
    still = [relations.coefficients[i] for i in np.asarray(relations.free) if coef[i] == 0.0]
    if still:
        raise ValueError(
            f"a free coefficient must start away from zero: {still} are zero, and a scaling "
            "cannot move them; start from a small value"
        )
    return coef
