"""Least squares over the rows of several points, with coefficients that are functions of the point.

A law says coef(p) = W f(p), with f the functions of the operating parameters. Whatever a law is
fitted to (rows of a regression, coefficients that were fitted to each point, one measured quantity)
it minimises the same sum of squares over the points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from ep2sindy.data.numbers import column_norms, zero_to_one
from ep2sindy.regression.least_squares import CUTOFF, LeastSquares
from ep2sindy.runtime.values import read_only

# Functions whose columns of unit norm have a singular value below this fraction of the largest
# cannot be distinguished at the points. They are exact numbers, so this is far below what rows
# allow.
RANK = 1e-10

# A point with this leverage alone determines some coefficient: without it there is no fit.
FULL_LEVERAGE = 1.0 - 1e-9

# A violation of a limit weighs STRICT times the residuals of rows whose point weighs one. Number of
# steps in a fit within limits, halved ones included, and the shortest of these.
STRICT, N_STEPS, SHORTEST = 1e4, 200, 0.01


@dataclass(frozen=True, eq=False)
class Basis:
    """Functions of the operating parameters at the points, with an orthonormal basis of them.

    A solution in the orthonormal basis does not depend on the units of the parameters.
    Raises ValueError if the points cannot tell the functions apart.
    """

    values: Float[np.ndarray, "points functions"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", read_only(self.values))
        n_points, n_terms = self.values.shape
        if not np.isfinite(self.values).all():
            raise ValueError(f"a basis must be finite, got {self.values.tolist()}")
        if n_points < n_terms:
            raise ValueError(
                f"a law of {n_terms} terms needs as many points, got {n_points}; use one of "
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
    def orthonormal(self) -> Float[np.ndarray, "points functions"]:
        return self._factors[0]

    def to_law(self, size: Float[np.ndarray, " coefs"]) -> Float[np.ndarray, "unknowns unknowns"]:
        """Matrix from the unknowns of a fit to the law W.ravel().

        The unknowns are factors of the orthonormal basis, coefficient by coefficient, in units of
        the coefficient's size.
        """
        _, triangle, norms = self._factors
        return np.kron(np.diag(size), np.linalg.inv(triangle) / norms[:, None])

    def predict_left_out(
        self, values: Float[np.ndarray, "points ..."]
    ) -> Float[np.ndarray, "points ..."]:
        """Values at every point by the least-squares fit to all other points.

        They are y - r / (1 - h), with r the residual and h the diagonal of the hat matrix; infinite
        if one point is indispensable.
        Source: Allen 1974, doi:10.1080/00401706.1974.10489157.
        """
        q = self.orthonormal
        leverage = np.square(q).sum(axis=1)
        if leverage.max() > FULL_LEVERAGE:
            return np.full_like(values, np.inf)
        left = values - q @ (q.T @ values)
        return values - (left.T / (1.0 - leverage)).T


def fewest_of_least(trials: Sequence[tuple[Float[np.ndarray, " points"], int]]) -> int:
    """Index of the trial with fewest numbers whose mean error is not above the least.

    trials: errors at each point, and a count of numbers. The difference of the errors from the
    least, point by point, must be within one standard error.
    """
    means = [float(errors.mean()) for errors, _ in trials]
    best = min(range(len(trials)), key=lambda k: (means[k], trials[k][1]))
    near = []
    for k, (errors, _) in enumerate(trials):
        apart = errors - trials[best][0]
        reach = apart.std(ddof=1) / np.sqrt(len(apart)) if len(apart) > 1 else 0.0
        if apart.mean() <= reach:
            near.append(k)
    return min(near, key=lambda k: (trials[k][1], means[k]))


Rows = Sequence[tuple[Float[np.ndarray, "_ coefs"], Float[np.ndarray, " _"]]]  # of each point


def pool_rows(
    rows: Rows, basis: Basis, size: Float[np.ndarray, " coefs"]
) -> Float[np.ndarray, "coefs functions"]:
    """Fit one law to the rows (theta_p, y_p) of all points p.

    The law W minimises the sum over p of |theta_p W f(p) - y_p|^2 (`LeastSquares`). Assumes that
    all rows have equal variances: divide each point's by its own. size: of the coefficients.
    """
    fit, _ = _fit(rows, basis, size)
    return (basis.to_law(size) @ fit.coef).reshape(-1, basis.values.shape[1])


# At a law W, values that must not be positive, and their derivatives by W.ravel().
Limits = Callable[
    [Float[np.ndarray, "coefs functions"]],
    tuple[Float[np.ndarray, " limits"], Float[np.ndarray, "limits numbers"]],
]


def pool_within(
    rows: Rows, basis: Basis, size: Float[np.ndarray, " coefs"], limits: Limits
) -> Float[np.ndarray, "coefs functions"]:
    """Fit one law to the rows of all points as `pool_rows` does, within limits g(W) <= 0.

    A law of `pool_rows` that is within the limits is returned as it is. Otherwise

        minimise  sum_p |theta_p W f(p) - y_p|^2 + STRICT^2 |max(g(W), 0)|^2

    by steps that linearise g, each solved exactly and halved until the objective decreases. The law
    thus moves where the rows determine it least. Limits that contradict each other or the form of
    the law are met as far as steps lead: the best law on the way is returned.
    Source: Lawson & Hanson 1995, Solving Least Squares Problems, ch. 23, for limits by nonnegative
    least squares.
    """
    fit, _ = _fit(rows, basis, size)
    # The unknowns are fit.coef + root v, where |v|^2 is what a change v adds to the squares.
    _, strengths, axes = np.linalg.svd(fit.upper * fit.norms)
    # Directions that they do not determine may be followed, but not far.
    root = axes.T / np.maximum(strengths, CUTOFF * zero_to_one(strengths[0]))
    to_law = basis.to_law(size)

    def at(v: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        law = (to_law @ (fit.coef + root @ v)).reshape(-1, basis.values.shape[1])
        values, slopes = limits(law)
        beyond = np.maximum(values, 0.0)
        return float(v @ v + STRICT**2 * beyond @ beyond), v, law, values, slopes @ to_law @ root

    best = now = at(np.zeros(len(fit.coef)))
    if now[0] == 0.0:
        return now[2]
    fraction = 1.0
    for _ in range(N_STEPS):
        cost, v, _, values, slopes = now
        step = _least_within(slopes, slopes @ v - values) - v
        trial = at(v + fraction * step)
        if trial[0] >= cost and fraction > SHORTEST:
            fraction *= 0.5
            continue
        # Where no step is downhill, as where two modes of growth meet, a whole one leads on.
        now, fraction = trial if trial[0] < cost else at(v + step), 1.0
        best = min(best, now, key=lambda each: each[0])
        if (1.0 - 1e-9) * cost < now[0] <= cost:
            break
    return best[2]


def _least_within(
    slopes: Float[np.ndarray, "limits unknowns"], ends: Float[np.ndarray, " limits"]
) -> Float[np.ndarray, " unknowns"]:
    """The v that minimises |v|^2 + STRICT^2 |max(slopes v - ends, 0)|^2, by its multipliers."""
    # The multipliers m >= 0 minimise |slopes^T m|^2 + |m|^2 / STRICT^2 + 2 ends^T m.
    stacked = np.concatenate([slopes.T, np.eye(len(slopes)) / STRICT])
    triangle = np.asarray(np.linalg.qr(stacked, mode="r"))
    multipliers = nnls(triangle, -np.linalg.solve(triangle.T, ends))[0]
    v: np.ndarray = -slopes.T @ multipliers
    return v


def residuals_left_out(
    rows: Rows, basis: Basis, size: Float[np.ndarray, " coefs"]
) -> list[Float[np.ndarray, " _"]]:
    """Residuals of every point's rows by the law that `pool_rows` fits to the other points.

    They are (1 - H_p)^-1 r_p, with r_p the residuals of the point in the fit of all points and
    H_p its block of the hat matrix.
    Raises ValueError if a point is indispensable: without it the others do not tell the
    functions apart.
    """
    found, (fit, blocks) = [], _fit(rows, basis, size)
    for block, (_, y) in zip(blocks, rows, strict=True):
        hat = block @ fit.root
        kept = np.eye(len(y)) - hat @ hat.T
        if np.linalg.eigvalsh(kept).min(initial=1.0) < 1.0 - FULL_LEVERAGE:
            raise ValueError(
                "a law that is tested by leaving out points must not hang on one of them: "
                "without it the others do not tell its functions apart; add points, or take a "
                "law of fewer functions"
            )
        found.append(np.linalg.solve(kept, y - block @ fit.coef))
    return found


def _fit(
    rows: Rows, basis: Basis, size: Float[np.ndarray, " coefs"]
) -> tuple[LeastSquares, list[Float[np.ndarray, "_ unknowns"]]]:
    """Fit the unknowns of `Basis.to_law` to the rows; and the design of each point."""
    # Row r of point p holds theta_p[r, k] q_p[m] in the column of coefficient k and function m.
    pairs = zip(rows, basis.orthonormal, strict=True)
    blocks = [np.kron(theta * size, q[None]) for (theta, _), q in pairs]
    target = np.concatenate([y for _, y in rows])
    return LeastSquares.of_rows(np.concatenate(blocks), target), blocks


def invert_covariance(
    covariance: Float[np.ndarray, "coefs coefs"],
) -> Float[np.ndarray, "coefs coefs"]:
    """Inverse of a covariance; directions with variance below rounding get no weight."""
    size = zero_to_one(np.sqrt(np.diag(covariance)))
    return np.linalg.pinv(covariance / np.outer(size, size), hermitian=True) / np.outer(size, size)


def root_of(information: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n n"]:
    """Root R with R^T R = information / trace, so that all have one weight; R is no triangle."""
    values, vectors = np.linalg.eigh(information / zero_to_one(np.array(np.trace(information))))
    root: np.ndarray = np.sqrt(np.maximum(values, 0.0))[:, None] * vectors.T
    return root
