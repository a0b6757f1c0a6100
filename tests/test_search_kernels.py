"""Steps of a search, compiled ones among them, against the same step in plain NumPy."""

from itertools import groupby, pairwise

import numpy as np
import pytest

from ep2sindy.regression.bootstraps import (
    Bootstraps,
    Resamples,
    count_block_draws,
    pool,
)
from ep2sindy.regression.gram_kernels import DEPENDENT, fit_masks, invert_gram, solve_masks
from ep2sindy.regression.least_squares import LeastSquares
from ep2sindy.regression.searches import STLSQ


def random_masks(n_masks: int, n_terms: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.random((n_masks, n_terms)) < rng.random((n_masks, 1))


def random_grams(n_draws: int, n_terms: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Gram matrices of draws; the last column depends on the first two in the second draw."""
    rng = np.random.default_rng(1)
    columns = rng.normal(size=(n_draws, 40, n_terms + 1)) + rng.normal(size=(40, 1))
    columns[1, :, -2] = columns[1, :, :2] @ [1.0, 2.0]
    columns /= np.linalg.norm(columns, axis=1, keepdims=True)
    products = columns.transpose(0, 2, 1) @ columns
    return products[:, :-1, :-1].copy(), products[:, -1, :-1].copy(), products[:, -1, -1].copy()


@pytest.mark.parametrize("block", [1, 7])
def test_draws_are_those_of_plain_calls_of_the_generator(block: int) -> None:
    boots = Bootstraps(n=6, n_culled=2, smallest=0.3, largest=0.9, block=block)
    terms, rng = np.array([True, True, False, True, True]), np.random.default_rng(4)
    counts, kept = boots.draw_groups(60, terms, np.random.default_rng(4))
    for count, own in zip(counts, kept, strict=True):
        size = round(rng.uniform(0.3, 0.9) * 60)
        first = rng.integers(60 - block + 1, size=-(-size // block))
        rows = (first[:, None] + np.arange(block)).ravel()[:size]
        np.testing.assert_array_equal(count, np.bincount(rows, minlength=60))
        culled = rng.permutation([0, 1, 3, 4])[:2]
        assert own.tolist() == [t and k not in culled for k, t in enumerate(terms.tolist())]
    one = count_block_draws(60, n_drawn=13, block=block, rng=np.random.default_rng(5))
    first = np.random.default_rng(5).integers(60 - block + 1, size=-(-13 // block))
    rows = (first[:, None] + np.arange(block)).ravel()[:13]
    np.testing.assert_array_equal(one, np.bincount(rows, minlength=60))


def test_supports_in_any_order_are_fitted_alone() -> None:
    (xx, _), xy, _ = random_grams(2, 6)
    masks, rhs = random_masks(30, 6), np.random.default_rng(2).normal(size=(30, 6))
    shared, own = fit_masks(xx, xy[0], masks), solve_masks(xx, rhs, masks)
    for one, other, y, mask in zip(shared, own, rhs, masks, strict=True):
        for fit, right in ((one, xy[0]), (other, y)):
            plain = np.zeros(6)
            plain[mask] = np.linalg.solve(xx[np.ix_(mask, mask)], right[mask])
            np.testing.assert_allclose(fit, plain, atol=1e-11)


def test_a_draw_is_fitted_by_its_own_best_support_of_the_size() -> None:
    (xx, _), (xy, _), (yy, _) = random_grams(2, 6)
    masks = np.array([[k in (i, j) for k in range(6)] for j in range(6) for i in range(j)])
    found = [np.vstack([~masks[0], masks]), masks[:0]]  # none of the size in the second draw
    scale = np.array([[2.0] * 6, [3.0] * 5 + [0.0]])  # which lacks the last term
    draws = Resamples(
        ["x"], np.array([xx] * 2), np.array([[xy]] * 2), np.full((2, 1), yy), scale, scale > 0.0,
        True, 6,
    )  # fmt: skip
    coef = draws.fits(0, found, masks[-1])
    fits = fit_masks(xx, xy, masks)
    best = int(np.argmin([yy - 2.0 * fit @ xy + fit @ xx @ fit for fit in fits]))
    assert best > 0
    np.testing.assert_allclose(coef[0], 2.0 * fits[best], rtol=1e-12)
    np.testing.assert_allclose(coef[1], [0.0] * 4 + [3.0 * xy[4] / xx[4, 4], 0.0], rtol=1e-12)


@pytest.mark.parametrize("fraction", [0.5, 2.0])
def test_all_routes_of_least_squares_have_one_rule_of_rank(fraction: float) -> None:
    """A column leaves half of the threshold, or twice; the rows, the Gram matrix and the kernel."""
    basis = np.linalg.qr(np.random.default_rng(3).normal(size=(40, 5)))[0]
    theta, target = basis[:, :4] * [1.0, 1e5, 1.0, 1e-7], basis @ np.arange(1.0, 6.0)
    theta[:, 3] = (basis[:, :2] @ [0.6, 0.8] + np.sqrt(fraction * DEPENDENT) * basis[:, 3]) * 1e-7
    xx, xy = theta.T @ theta, theta.T @ target
    rows = LeastSquares.of_rows(theta, target)
    (kernel,) = fit_masks(xx, xy, np.ones((1, 4), dtype=bool))
    if fraction > 1.0:
        assert rows.is_determined
        assert rows.rank == 4
        for coef in (kernel, invert_gram(xx) @ xy):  # the Gram matrix has 5 digits left
            np.testing.assert_allclose(coef, rows.coef, rtol=1e-4)
        assert rows.squares == pytest.approx(25.0)
        return
    assert np.isnan(kernel).all()
    assert rows.rank == 3
    assert rows.dependent.tolist() == [True, True, False, True]
    np.testing.assert_allclose(theta @ invert_gram(xx) @ xy, theta @ rows.coef, atol=1e-4)
    # Of equal fits the one of least norm in unit columns, which shares the two directions.
    assert np.linalg.norm(rows.coef * rows.norms) < np.linalg.norm([1.0, 2.0, 3.0])


def test_least_squares_on_rows_is_that_of_numpy() -> None:
    rng = np.random.default_rng(5)
    theta, target = rng.normal(size=(30, 3)) * [1e-12, 1.0, 1e9], rng.normal(size=30)
    fit = LeastSquares.of_rows(theta, target)
    plain, squares = np.linalg.lstsq(theta / fit.norms, target, rcond=None)[:2]
    np.testing.assert_allclose(fit.coef, plain / fit.norms, rtol=1e-12)
    np.testing.assert_allclose(fit.squares, squares, rtol=1e-12)
    covariance = np.linalg.inv((theta / fit.norms).T @ (theta / fit.norms))
    unit = fit.root * fit.norms[:, None]
    np.testing.assert_allclose(unit @ unit.T, covariance, rtol=1e-10)


def plain_thresholding(xx: np.ndarray, xy: np.ndarray, start: np.ndarray, limit: float) -> list:
    """The support at which thresholded least squares ends."""
    mask = start.copy()
    while True:
        coef = np.zeros(len(xy))
        coef[mask] = np.linalg.solve(xx[np.ix_(mask, mask)], xy[mask])
        kept = mask & (np.abs(coef) > limit)
        if (kept == mask).all():
            return mask.tolist()
        mask = kept


def test_thresholds_are_iterated_alone() -> None:
    xx, xy, yy = random_grams(4, 6)
    search, limits = STLSQ(n_thresholds=30, lowest=1e-3), np.geomspace(1e-3, 10.0, 30)
    small = STLSQ(n_thresholds=30, lowest=1e-3, max_terms=2)
    for k, case in enumerate(zip(xx, xy, yy, strict=True)):
        masks, start = search.supports(*case), np.array([True] * 5 + [k != 1])
        plain = [plain_thresholding(*case[:2], start, s * np.sqrt(case[2])) for s in limits]
        assert masks.tolist() == [mask for mask, _ in groupby(plain)]
        assert small.supports(*case).tolist() == masks[masks.sum(axis=1) <= 2].tolist()


@pytest.mark.parametrize("n_terms", [5, 70])
def test_masks_are_pooled_as_sets(n_terms: int) -> None:
    some = random_masks(12, n_terms, seed=3)
    masks = some[np.random.default_rng(0).integers(12, size=90)]
    ends = np.array([20, 20, 55, 90])
    whole, part = np.empty((4, 0, 0)), np.empty((4, 0))
    kept = np.ones((4, n_terms), dtype=bool)
    draws = Resamples(["x"], whole, whole, part, part, kept, True, n_terms)
    supports = pool(draws, 0, np.split(masks, ends[:-1]))
    of_draws = [{tuple(m) for m in masks[a:b].tolist()} for a, b in pairwise([0, *ends.tolist()])]
    pooled = sorted(set().union(*of_draws), key=lambda m: (sum(m), m))
    assert [tuple(m) for m in supports.masks.tolist()] == pooled
    assert supports.fraction.tolist() == [np.mean([m in draw for draw in of_draws]) for m in pooled]
    for size in range(n_terms + 1):
        for j in range(n_terms):
            found = [any(m[j] and sum(m) == size for m in draw) for draw in of_draws]
            assert supports.inclusion[size, j] == np.mean(found)
