"""Whitening of rows by the covariance that the noise of the samples causes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg.lapack import dpbtrf, dtbtrs
from scipy.sparse import csr_array

from ep2sindy.data.coerce import keep_inside
from ep2sindy.data.numbers import zero_to_one
from ep2sindy.library.library import Library
from ep2sindy.regression.gram_kernels import banded_covariance
from ep2sindy.regression.rows import NoisyRows, RegressionRows

# Largest correction of a sample, in standard deviations of its noise; with a wrong model the
# corrections would otherwise grow without limit.
LARGEST_CORRECTION = 4.0

# Added to the variance of every row: RIDGE times the mean variance, since rows of overlapping
# windows are nearly dependent, and the square of the rounding error of the target.
RIDGE = 1e-8

ROUNDING = 1e-8

# Largest rise of the cost per row above the least so far. At 20 % noise whole steps have raised
# it by 6, and the next step brought it back; diverging steps raise it by 14 to 1600.
RISE = 10.0

MAX_HALVED = 6

# Change of the scaled coefficients, as a fraction of them, after which no step follows.
SETTLED = 1e-8

# Change of them by a step that is not worth making if only the residuals are wanted: these are
# least there, so chi-squared changes by its square.
NEGLIGIBLE = 1e-3

Coef = Float[np.ndarray, " terms"]
KeptCoef = Float[np.ndarray, " kept"]
BySample = Float[np.ndarray, "variables samples"]
Band = Float[np.ndarray, "band rows"]


@dataclass(frozen=True, eq=False)
class WhitenedRows:
    """Training rows of one equation, linearised about corrected samples, with unit variance.

    theta: (rows, terms) and target: (rows,), combined so that target - theta coef is white
    with variance 1 for the true coefficients. Columns and target are scaled by the regression's
    theta_scale and target_scale; columns of terms that were not asked for are zero.
    corrected: (samples, variables), the samples minus the noise estimated from the residuals.
    """

    theta: Float[np.ndarray, "rows terms"]
    target: Float[np.ndarray, " rows"]
    corrected: Float[np.ndarray, "samples variables"]


def whiten_rows(
    problem: RegressionRows,
    terms: Bool[np.ndarray, " terms"],
    coef: Coef,
    *,
    n_steps: int = 2,
    negligible: float = 0.0,
    kept: Bool[np.ndarray, " terms"] | None = None,
) -> WhitenedRows:
    """Whiten the rows of one equation by their covariance under the model with these terms.

    The residuals depend on the noise of the samples through both target and terms; to first
    order they are M e, with covariance M Sigma M^T. Each step is a Gauss-Newton step to the jointly
    most likely coefficients and samples: fit the coefficients with weights, correct the samples by
    the most likely noise, linearise again. Without the correction, the noise in the terms would
    bias the coefficients. A step that raises the cost too far is halved.
    coef: (terms,), a first guess in scaled columns. negligible: change of the coefficients, as a
    fraction of them, for which no step is made. kept: terms whose columns are wanted, at least
    those of the model; None for all. Source: Bortz, Messenger & Dukic 2023,
    doi:10.1007/s11538-023-01208-6, for the covariance; Britt & Luecke 1973, Technometrics 15, 233,
    for the steps.
    """
    assert problem.noisy is not None
    kept = np.ones_like(terms) if kept is None else kept
    sums, terms = _Sums.of(problem, kept), terms[kept]
    rows = _Linearised.at(problem, sums, problem.noisy.columns[1], coef[kept], noisy=False)
    least = rows.cost
    for _ in range(n_steps):
        before, coef = rows.coef, rows.fit(terms)
        if _is_near(before, coef, negligible):
            break
        following = _step(problem, sums, rows, coef, limit=least + RISE * len(rows.target))
        if following is None:
            break
        rows, least = following, min(least, following.cost)
        if _is_near(before, rows.coef, SETTLED):
            break
    theta = np.zeros((len(rows.target), len(kept)))
    theta[:, kept] = rows.theta
    return WhitenedRows(
        theta=theta,
        target=rows.target - (rows.drifted - rows.theta) @ rows.coef,
        corrected=rows.x.T,
    )


def whiten_terms(
    problem: RegressionRows,
    terms: Int[np.ndarray, " own"],
    coef: Float[np.ndarray, " own"],
    *,
    n_steps: int,
    negligible: float = 0.0,
) -> WhitenedRows:
    """`whiten_rows` for terms given by their indices, and their coefficients; no other is kept."""
    mask, full = np.zeros(len(problem.library), dtype=np.bool_), np.zeros(len(problem.library))
    mask[terms], full[terms] = True, coef
    return whiten_rows(problem, mask, full, n_steps=n_steps, negligible=negligible, kept=mask)


def _is_near(before: Coef, after: Coef, fraction: float) -> bool:
    """Whether coefficients differ by less than a fraction of the latter; never for 0."""
    change = after - before
    return bool(change @ change < fraction**2 * (after @ after))


def _step(
    problem: RegressionRows, sums: _Sums, rows: _Linearised, coef: KeptCoef, *, limit: float
) -> _Linearised | None:
    """One Gauss-Newton step to coefficients, halved until the cost decreases; None if never.

    limit: largest cost allowed after a whole step.
    """
    x = np.ascontiguousarray(keep_inside(problem.library, rows.correct(coef).T, rows.x.T).T)
    whole = _Linearised.at(problem, sums, x, coef)
    if whole.cost <= limit:
        return whole
    for n_halved in range(1, MAX_HALVED + 1):
        fraction = 0.5**n_halved
        part = _Linearised.at(
            problem,
            sums,
            rows.x + fraction * (x - rows.x),
            rows.coef + fraction * (coef - rows.coef),
        )
        if part.cost < rows.cost:
            return part
    return None


class _Sums(NamedTuple):
    """Some scaled terms and their derivatives, as sums of products.

    kept: (library terms,), mask of the terms. products: library of the products, of which the rows
    of `table` are used. weights: (kept, products), of the terms, then of their derivatives by
    each variable.
    """

    kept: Bool[np.ndarray, " terms"]
    products: Library
    table: Int[np.ndarray, "products factors"]
    weights: Sequence[csr_array]

    @staticmethod
    def of(problem: RegressionRows, kept: Bool[np.ndarray, " terms"]) -> _Sums:
        library = problem.library
        products, weights = library.with_derivatives(len(library.variables))
        weights = weights[kept] / problem.theta_scale[kept, None, None]
        used = weights.any(axis=(0, 1))
        parts = [csr_array(weight) for weight in weights[:, :, used].transpose(1, 0, 2)]
        return _Sums(kept, products, products.table[used], parts)

    def linearise(
        self, x: BySample, perturbation: BySample, coef: KeptCoef
    ) -> tuple[Float[np.ndarray, "two kept samples"], BySample]:
        """Terms at x, terms moved along their derivatives, and slopes of the model.

        The slopes are those of the sum of coef times term, by each variable.
        """
        columns = self.products.with_functions(np.vstack([x, np.ones(x.shape[1])]), axis=0)
        values = columns[self.table[:, 0]]
        for factor in self.table.T[1:]:
            values *= columns[factor]
        own, *derivatives = self.weights
        terms, sensitivity = np.stack([own @ values] * 2), np.empty(x.shape)
        for v, weight in enumerate(derivatives):
            slopes = weight @ values
            terms[1] += slopes * perturbation[v]
            sensitivity[v] = coef @ slopes
        return terms, sensitivity


@dataclass(frozen=True, eq=False)
class _Linearised:
    """Whitened rows, linearised about samples x and coefficients, with their noise model.

    x: (variables, samples). coef: (kept,), in scaled columns.
    drifted: the terms at x plus their change from x to the raw samples, to first order.
    sensitivity: (variables, samples), change of the model's rate per unit noise of each variable.
    """

    x: BySample
    coef: KeptCoef
    theta: Float[np.ndarray, "rows kept"]
    drifted: Float[np.ndarray, "rows kept"]
    target: Float[np.ndarray, " rows"]
    sensitivity: BySample
    factor: Band
    target_scale: float
    source: NoisyRows

    @staticmethod
    def at(
        problem: RegressionRows, sums: _Sums, x: BySample, coef: KeptCoef, *, noisy: bool = True
    ) -> _Linearised:
        """Linearise and whiten the rows about samples x and coefficients.

        noisy: true if x still holds the noise that the rows cannot determine, unlike smoothed
        samples.
        """
        rows, library = problem.noisy, problem.library
        assert rows is not None
        (values, _, noise_std), n, n_samples = rows.columns, len(library.variables), x.shape[1]
        sensitivity = np.zeros(x.shape)
        terms, sensitivity[:n] = sums.linearise(x[:n], values[:n] - x[:n], coef)
        if noisy and library.functions:
            terms -= (_lift(problem, x[:n].T) / problem.theta_scale).T[sums.kept]
        sensitivity *= noise_std
        target_scale = float(problem.target_scale[0])
        factor = _banded_cholesky(_covariance(rows, sensitivity, target_scale))
        means = rows.windows.mean @ terms.reshape(2 * len(coef), n_samples).T
        white = _solve(factor, np.column_stack([means, rows.target / target_scale]))
        theta, drifted, target = white[:, : len(coef)], white[:, len(coef) : -1], white[:, -1]
        return _Linearised(x, coef, theta, drifted, target, sensitivity, factor, target_scale, rows)

    @property
    def cost(self) -> float:
        """-2 log likelihood of the rows, up to a constant.

        The residuals alone are not sufficient: large coefficients amplify the modelled noise, and
        thereby reduce the whitened residuals.
        """
        residual = self.target - self.drifted @ self.coef
        return float(residual @ residual + 2.0 * np.log(self.factor[0]).sum())

    def fit(self, terms: Bool[np.ndarray, " terms"]) -> Coef:
        """Coefficients of the chosen terms; the terms at x are instruments for the noisy terms."""
        coef = np.zeros(len(terms))
        theta, drifted = self.theta[:, terms], self.drifted[:, terms]
        scale = zero_to_one(np.sqrt(np.einsum("rc,rc->c", theta, theta)))
        instruments = theta / scale
        coef[terms] = (
            np.linalg.lstsq(instruments.T @ (drifted / scale), instruments.T @ self.target)[0]
            / scale
        )
        return coef

    def correct(self, coef: Coef) -> BySample:
        """Samples minus their most likely noise."""
        weighted = _solve(self.factor, self.drifted @ coef - self.target, transposed=True)
        rows = self.source
        values, _, noise_std = rows.columns
        noise = (rows.windows.mean.T @ weighted) * self.sensitivity
        by_slope = rows.windows.slope.T @ weighted
        noise[rows.state] -= by_slope / self.target_scale * noise_std[rows.state]
        np.clip(noise, -LARGEST_CORRECTION, LARGEST_CORRECTION, out=noise)
        return values - noise * noise_std


def _lift(
    problem: RegressionRows, x: Float[np.ndarray, "samples variables"]
) -> Float[np.ndarray, "samples terms"]:
    """Mean change of terms with functions by the noise left in the samples, to second order.

    For example, sin(x + e) is on average sin(x) exp(-s^2/2), a bias that weighting does not
    correct. Products of variables are not changed. The fraction of the noise variance s^2 that is
    left in the samples is one minus the number of rows per sampled value.
    """
    rows, library = problem.noisy, problem.library
    assert rows is not None
    n = len(library.variables)
    curved = np.flatnonzero(library.exponents[:, n:].any(axis=1))
    some, lift = library.take(curved), np.zeros((len(x), len(library)))
    left = max(1.0 - len(rows.windows) / rows.values.size, 0.0)
    here = some.evaluate(x)
    for v in range(n):
        step = np.zeros_like(x)
        step[:, v] = np.sqrt(left) * rows.noise_std[:, v]
        ahead, behind = (keep_inside(some, x + s * step, x) for s in (1.0, -1.0))
        both = (ahead[:, v] != x[:, v]) & (behind[:, v] != x[:, v])
        mean = 0.5 * (some.evaluate(ahead) + some.evaluate(behind))
        lift[:, curved] += np.where(both[:, None], mean - here, 0.0)
    return lift


def _covariance(rows: NoisyRows, sensitivity: BySample, target_scale: float) -> Band:
    """Covariance of the rows by the samples' noise, from its diagonal downwards."""
    windows = rows.windows
    own, std = sensitivity[rows.state], rows.columns[2][rows.state] / target_scale
    band = np.zeros((len(windows), windows.width))
    banded_covariance(
        windows.mean.indptr.astype(np.int64), windows.first, windows.mean.data, windows.slope.data,
        np.square(sensitivity).sum(axis=0), own * std, np.square(std), band,
    )  # fmt: skip
    return band.T


def _banded_cholesky(band: Band) -> Band:
    """Lower Cholesky factor of the covariance, banded since distant windows do not overlap."""
    band[0] += RIDGE * band[0].mean() + ROUNDING**2 / len(band[0])
    factor, info = dpbtrf(band, lower=True, overwrite_ab=True)
    if info or not np.isfinite(factor[0]).all():
        raise np.linalg.LinAlgError(
            "the covariance of the rows must be positive definite, and is not to rounding: scale "
            "the variables to similar sizes, or take wider windows"
        )
    return factor


def _solve(factor: np.ndarray, values: np.ndarray, *, transposed: bool = False) -> np.ndarray:
    """Solve with the banded factor L: returns L^-1 values, or L^-T values if transposed.

    The values may be overwritten.
    """
    columns, trans = values.reshape(len(values), -1), "T" if transposed else "N"
    solution, info = dtbtrs(factor, columns, uplo="L", trans=trans, overwrite_b=True)
    assert info == 0
    return solution.reshape(values.shape)
