"""Right-hand sides with forward sensitivities, for many models of the same states in one batch."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ep2sindy.library.library import Library, library_of
from ep2sindy.refinement.ode import ODE, Drive


@dataclass(frozen=True, eq=False)
class Augmented:
    """Right-hand sides of many points with their derivatives by state and scaling, in one batch.

    One gather and product gives every distinct product of `library`; one matmul of them gives the
    rate, its derivative by the states and its derivative by the scalings, column by column.
    factors: (degree, products); basis: (points, rows, products, free); offset: the same without
    `free`, for rows = n_states * columns.
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
    def n_columns(self) -> int:
        """The rate, its derivatives by each state, then by each scaling."""
        return 1 + self.n_states + self.n_free

    def take(self, points: torch.Tensor) -> Augmented:
        return replace(self, basis=self.basis[points], offset=self.offset[points])

    def weights(self, scaling: torch.Tensor) -> torch.Tensor:
        """(points, rows, products) of scaling (points, free)."""
        return (self.basis @ scaling[:, None, :, None])[..., 0] + self.offset

    def fields(self, weights: torch.Tensor, x: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
        """(points, n_states, columns, batch) of x (points, n_states, batch)."""
        columns = torch.cat([x, inputs, torch.ones_like(x[:, :1])], dim=1)
        columns = self.library.with_functions(columns, axis=1)
        products = columns.index_select(1, self.factors[0])
        for rows in self.factors[1:]:
            products = products * columns.index_select(1, rows)
        return torch.bmm(weights, products).view(len(x), self.n_states, -1, x.shape[-1])

    def rhs(
        self, scaling: torch.Tensor, drive: Drive
    ) -> Callable[[torch.Tensor, torch.Tensor], torch.Tensor]:
        """d/dt of the state and its derivatives by its start and by the scalings.

        The function takes and gives (points, n_states, columns, batch).
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
        """d/dt of the state alone, (points, n_states, batch)."""
        weights = self.weights(scaling)[:, :: self.n_columns]

        def rate(t: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
            steps, inputs = drive.at(t)
            out = self.fields(weights, x, inputs)[:, :, 0]
            return out if steps is None else out * steps

        return rate


def augmented(odes: Sequence[ODE]) -> Augmented:
    """Modules of the same variables as one batch of points, on the device of the first.

    Terms may differ: products are those that any module needs, and columns of zeros stand for
    the scalings that a module has fewer of than the others.
    Raises ValueError for modules that differ in variables, or hold a correction, whose
    derivatives only autograd knows.
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
    terms = library_of(first.variables, (term for ode in odes for term in ode.library.terms))
    products, transfer = terms.with_derivatives(n)
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
