"""Laws fitted to coefficients that data determine well in some directions and poorly in others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import column_norms, zero_to_one
from ep2sindy.runtime.values import read_only

# Directions of a basis or of the information weaker than this share of the strongest are dropped.
RANK = 1e-10


@dataclass(frozen=True, eq=False)
class Basis:
    """Functions of the operating parameters at the points, with an orthonormal basis of them.

    A solution in the orthonormal basis does not depend on the units of the parameters.
    Raises ValueError if the points cannot tell the functions apart.
    """

    values: Float[np.ndarray, "points terms"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", read_only(self.values))
        n_points, n_terms = self.values.shape
        if not np.isfinite(self.values).all():
            raise ValueError(f"a basis must be finite: {self.values.tolist()} came")
        if n_points < n_terms:
            raise ValueError(
                f"a law of {n_terms} terms needs as many points: {n_points} came; use one of "
                "fewer terms"
            )
        strength = np.linalg.svd(self.values / column_norms(self.values), compute_uv=False)
        if strength[-1] <= RANK * strength[0]:
            raise ValueError(
                f"{n_points} points do not tell the {n_terms} terms of a law apart: let every "
                "parameter take more values, or use a law of fewer terms"
            )

    @cached_property
    def _factors(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        size = column_norms(self.values)
        return *np.linalg.qr(self.values / size), size

    @property
    def orthonormal(self) -> Float[np.ndarray, "points terms"]:
        return self._factors[0]

    @property
    def back(self) -> Float[np.ndarray, "terms terms"]:
        """Matrix back to the given functions: orthonormal @ a = values @ (back @ a)."""
        _, triangle, size = self._factors
        inverse: np.ndarray = np.linalg.inv(triangle)
        return inverse / size[:, None]


def weighted_law(
    coefficients: Float[np.ndarray, "points coefs"],
    information: Float[np.ndarray, "points coefs coefs"] | None,
    basis: Float[np.ndarray, "points terms"],
) -> Float[np.ndarray, "coefs terms"]:
    """Law whose coefficients are closest to those of the points, weighted by their information.

    With the deviation miss at each point, the sum over the points of miss @ information @ miss is
    minimised. Each information (an inverse covariance) is divided by its trace in relative
    coefficients, so that points have equal weight. The solution has the least norm in directions
    that no data determine. information: None weights all coefficients equally.
    Raises ValueError for a basis whose functions the points cannot tell apart.
    """
    known = Basis(basis)
    n_coefs, n_terms = coefficients.shape[1], basis.shape[1]
    size = zero_to_one(np.sqrt(np.square(coefficients).mean(axis=0)))
    relative = coefficients / size
    if information is None:
        information = np.broadcast_to(np.eye(n_coefs), (len(basis), n_coefs, n_coefs))
    else:
        information = information * np.outer(size, size)
    roots = np.stack([_root(each) for each in information])
    # Unknowns are ordered by coefficient: row (p, i) holds root_p[i, k] q_p[m] in column (k, m).
    columns = np.einsum("pik,pm->pikm", roots, known.orthonormal)
    target = np.einsum("pik,pk->pi", roots, relative)
    flat = columns.reshape(-1, n_coefs * n_terms)
    solution = np.linalg.lstsq(flat, target.ravel(), rcond=RANK)[0].reshape(n_coefs, n_terms)
    return (solution @ known.back.T) * size[:, None]


def information_of(
    covariance: Float[np.ndarray, "coefs coefs"],
) -> Float[np.ndarray, "coefs coefs"]:
    """Inverse of a covariance; directions with variance below rounding get no weight."""
    size = zero_to_one(np.sqrt(np.diag(covariance)))
    return np.linalg.pinv(covariance / np.outer(size, size), hermitian=True) / np.outer(size, size)


def _root(information: np.ndarray) -> np.ndarray:
    """Root R with R^T R = information / trace; R is not triangular."""
    values, vectors = np.linalg.eigh(information / zero_to_one(np.array(np.trace(information))))
    root: np.ndarray = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return root
