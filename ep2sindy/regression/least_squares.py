"""Least squares on a support: coefficients, their covariance, and one rule of rank for all routes.

A support is fitted from its rows (`LeastSquares`), or many at once by the compiled form of the same
rule, from Gram matrices (`gram_kernels`), and refined on the rows (`fit_masks_to_rows`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.numbers import column_norms
from ep2sindy.regression.gram_kernels import DEPENDENT, fit_masks, solve_masks

# Correction of coefficients, as a fraction of them, after which another one would be rounding.
REFINED = 1e-9

# Fraction of the largest singular value of dependent columns below which a direction stays out.
CUTOFF = float(np.sqrt(DEPENDENT))

ROWS_AT_ONCE = 4096  # rows whose residuals, of all fits, are held at once

# Columns of terms and targets of one equation, block by block.
Blocks = Iterable[tuple[Float[np.ndarray, "terms _"], Float[np.ndarray, " _"]]]


@dataclass(frozen=True, eq=False)
class LeastSquares:
    """The coefficients b of one support that fit its rows X to the target y.

        minimise |y - X b|^2

    Assumes residuals of equal variance, independent from row to row; then the covariance of b is
    variance * root @ root.T.
    A column depends on those before it if they leave DEPENDENT of its square or less. Then the rows
    do not determine b, and of all minimisers it is the least in columns of unit norm: directions
    whose square is DEPENDENT of the largest or less stay out. Units of columns do not matter.
    squares: |y - X b|^2. rank: number of directions that the rows determine. upper:
    triangle R of the QR factors of the columns of unit norm.
    Source: Bjorck 1996, Numerical Methods for Least Squares Problems, 1.3 and 2.7.

    >>> from ep2sindy.regression.least_squares import LeastSquares
    >>> t = np.linspace(0.0, 1.0, 9)
    >>> fit = LeastSquares.of_rows(np.column_stack([t, t**2]), 3.0 * t - t**2)
    >>> fit.coef.round(9).tolist(), fit.rank
    ([3.0, -1.0], 2)
    """

    coef: Float[np.ndarray, " terms"]
    squares: float
    rank: int
    norms: Float[np.ndarray, " terms"]
    upper: Float[np.ndarray, "terms terms"]

    @staticmethod
    def of_rows(
        theta: Float[np.ndarray, "rows terms"], target: Float[np.ndarray, " rows"]
    ) -> LeastSquares:
        n, norms, size = theta.shape[1], column_norms(theta), np.linalg.norm(target) or 1.0
        columns = np.column_stack([theta / norms, target / size])
        triangle = np.asarray(np.linalg.qr(columns, mode="r"))
        triangle = np.pad(triangle, ((0, n + 1 - len(triangle)), (0, 0)))  # of fewer rows
        upper, right, beyond = triangle[:n, :n], triangle[:n, n], triangle[n:, n]
        is_whole = bool((np.square(np.diag(upper)) > DEPENDENT).all())
        coef, _, rank, _ = np.linalg.lstsq(upper, right, rcond=None if is_whole else CUTOFF)
        squares = np.square(beyond).sum() + np.square(right - upper @ coef).sum()
        return LeastSquares(
            coef=coef * size / norms,
            squares=float(squares * size**2),
            rank=n if is_whole else int(rank),
            norms=norms,
            upper=upper,
        )

    @property
    def is_determined(self) -> bool:
        """True if no column depends on those before it."""
        return self.rank == len(self.coef)

    @cached_property
    def root(self) -> Float[np.ndarray, "terms terms"]:
        """A root of the covariance of the coefficients, for rows of variance 1."""
        cutoff = 1e-15 if self.is_determined else CUTOFF
        return np.linalg.pinv(self.upper, rcond=cutoff) / self.norms[:, None]

    @property
    def dependent(self) -> Bool[np.ndarray, " terms"]:
        """Mask of the terms that take part in a direction which the rows do not determine."""
        directions = np.linalg.svd(self.upper)[2][self.rank :]
        return (np.abs(directions) > 1e-3).any(axis=0)


def fit_masks_to_rows(
    xx: Float[np.ndarray, "terms terms"],
    xy: Float[np.ndarray, " terms"],
    masks: Bool[np.ndarray, "supports terms"],
    blocks: Callable[[], Blocks],
) -> tuple[Float[np.ndarray, "supports terms"], Float[np.ndarray, " supports"]]:
    """Coefficients of every support and the squares that they leave; NaN for dependent terms.

    The Gram matrix squares the condition number of the rows, so its solution is refined with the
    residuals of the rows themselves (Bjorck 1996, Numerical Methods for Least Squares, 2.9.3).
    blocks: returns the rows, which are gone through once per step.
    """
    coef = fit_masks(xx, xy, masks)
    for _ in range(2):
        squares, left = sum_residuals(coef, blocks())
        step = solve_masks(xx, left, masks)
        coef += step
        squares = squares - (step * (2.0 * left - step @ xx)).sum(axis=1)  # what the step explains
        if not (np.abs(step) > REFINED * np.abs(coef).max(axis=1, keepdims=True)).any():
            break  # the next step would be as much smaller again
    return coef, squares


def sum_residuals(
    coef: Float[np.ndarray, "supports terms"], blocks: Blocks
) -> tuple[Float[np.ndarray, " supports"], Float[np.ndarray, "supports terms"]]:
    """Squares of every support's residual, and the products of the residuals and the terms."""
    squares, products = np.zeros(len(coef)), np.zeros_like(coef)
    for columns, target in blocks:
        for start in range(0, len(target), ROWS_AT_ONCE):
            rows = slice(start, start + ROWS_AT_ONCE)
            left = target[rows] - coef @ columns[:, rows]
            squares += np.einsum("sr,sr->s", left, left)
            products += left @ columns[:, rows].T
    return squares, products
