from itertools import combinations, product

import numpy as np
import pytest
from sklearn.linear_model import Lasso

from ep2sindy.library.library import named_terms
from ep2sindy.regression.bootstraps import Bootstraps, draw_resamples, pool_supports
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.search_kernels import lasso_path
from ep2sindy.regression.searches import STLSQ, AdaptiveLasso, BestSubset, Search

SEARCHES = [AdaptiveLasso(), STLSQ(), BestSubset(max_terms=8)]


def random_gram(n_terms: int, seed: int, correlation: float = 0.7) -> tuple:
    rng = np.random.default_rng(seed)
    shared = rng.normal(size=(200, 1))
    theta = correlation * shared + rng.normal(size=(200, n_terms))
    theta /= np.linalg.norm(theta, axis=0)
    target = theta[:, :3] @ [1.0, -2.0, 0.5] + 0.02 * rng.normal(size=200)
    return theta.T @ theta, theta.T @ target, float(target @ target)


def residual(xx: np.ndarray, xy: np.ndarray, yy: float, columns: list[int]) -> float:
    coef = np.linalg.solve(xx[np.ix_(columns, columns)], xy[columns])
    return yy - coef @ xy[columns]


def penalties(xx: np.ndarray, xy: np.ndarray, chosen: list[int]) -> np.ndarray:
    """Width of the range of penalties at which a support is optimal, per draw; negative for none.

    The conditions of Karush, Kuhn and Tucker, for every choice of signs: the coefficients have
    them, and the other correlations are below the penalty. Both sides are linear in the penalty.
    """
    rest = [j for j in range(xy.shape[1]) if j not in chosen]
    signs = np.array(list(product((1.0, -1.0), repeat=len(chosen)))).T
    own, cross = xx[:, chosen][:, :, chosen], xx[:, rest][:, :, chosen]
    coef = np.linalg.solve(own, xy[:, chosen, None])
    slope = np.linalg.solve(own, np.broadcast_to(signs, (len(xx), *signs.shape)))
    left, drift = xy[:, rest, None] - cross @ coef, cross @ slope
    at_zero = np.concatenate([signs * coef, -left + 0.0 * drift, left + 0.0 * drift], axis=1)
    fall = np.concatenate([signs * slope, drift - 1.0, -drift - 1.0], axis=1)
    high = np.where(fall > 0.0, at_zero / fall, np.inf).min(axis=1)
    low = np.where(fall < 0.0, at_zero / fall, 0.0).max(axis=1)
    return (high - np.maximum(low, 0.0)).max(axis=1) / np.abs(xy).max(axis=1)


def test_lasso_paths_hold_the_optimal_supports_and_no_others_if_terms_are_nearly_dependent() -> (
    None
):
    rng, n_draws, n_terms, n_false, n_missing = np.random.default_rng(0), 200, 6, 0, 0
    theta = rng.normal(size=(n_draws, 40, 2)) @ rng.normal(size=(n_draws, 2, n_terms))
    theta += 0.01 * rng.normal(size=theta.shape)
    target = theta @ rng.normal(size=(n_draws, n_terms, 1)) + 0.3 * rng.normal(size=(200, 40, 1))
    scaled = theta * np.abs(np.linalg.solve(theta.mT @ theta, theta.mT @ target)).mT
    xx, xy = scaled.mT @ scaled, (scaled.mT @ target)[:, :, 0]
    assert np.median(np.linalg.cond(xx)) > 1e5
    size = np.abs(xy).max(axis=1)
    xx, xy = xx / size[:, None, None], xy / size[:, None]
    supports = [list(c) for k in range(1, n_terms + 1) for c in combinations(range(n_terms), k)]
    widths = np.array([penalties(xx, xy, chosen) for chosen in supports]).T
    for gram, product_with, width in zip(xx, xy, widths, strict=True):
        masks = lasso_path(gram, product_with, n_terms)
        found = {tuple(np.flatnonzero(m).tolist()) for m in masks}
        there = np.array([tuple(chosen) in found for chosen in supports])
        n_false += int((there & (width < -1e-10)).sum())
        n_missing += int((~there & (width > 1e-10)).sum())
    assert (n_false, n_missing) == (0, 0)


@pytest.mark.parametrize("seed", range(4))
def test_adaptive_lasso_path_holds_the_minimisers_support(seed: int) -> None:
    xx, xy, yy = random_gram(9, seed)
    found = {m.tobytes() for m in AdaptiveLasso().supports(xx, xy, yy)}
    root = np.linalg.cholesky(xx).T
    weight = 1.0 / np.abs(np.linalg.solve(xx, xy))
    target = np.linalg.solve(root.T, xy)
    for penalty in np.geomspace(1e-5, 0.1, 15):
        lasso = Lasso(alpha=penalty / 9, fit_intercept=False, tol=1e-14, max_iter=100000)
        support = np.abs(lasso.fit(root / weight, target).coef_) > 1e-9
        assert support.tobytes() in found


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("n_best", [1, 3])
def test_best_subsets_match_exhaustive_enumeration(seed: int, n_best: int) -> None:
    xx, xy, yy = random_gram(11, seed, correlation=3.0)
    masks = BestSubset(max_terms=11, n_best=n_best).supports(xx, xy, yy)
    for size in range(1, 12):
        ranked = sorted(combinations(range(11), size), key=lambda c: residual(xx, xy, yy, list(c)))
        found = {tuple(np.flatnonzero(m)) for m in masks if m.sum() == size}
        assert found == set(ranked[:n_best])


def test_best_subsets_stop_at_max_terms() -> None:
    masks = BestSubset(max_terms=3).supports(*random_gram(8, 0))
    assert masks.sum(axis=1).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("search", SEARCHES, ids=lambda s: type(s).__name__)
def test_dependent_columns_never_share_a_support(search: Search) -> None:
    xx, xy, yy = random_gram(5, 1)
    mix = np.zeros((6, 5))
    mix[:5] = np.eye(5)
    mix[5, :2] = [0.6, 0.8]
    scale = 1.0 / np.sqrt(np.diag(mix @ xx @ mix.T))
    xx, xy = (mix @ xx @ mix.T) * np.outer(scale, scale), mix @ xy * scale
    masks = search.supports(xx, xy, yy)
    assert len(masks) > 1
    assert not masks[:, [0, 1, 5]].all(axis=1).any()


@pytest.mark.parametrize("search", SEARCHES, ids=lambda s: type(s).__name__)
def test_a_target_of_zeros_gives_only_empty_supports(search: Search) -> None:
    xx, _, _ = random_gram(4, 0)
    assert not search.supports(xx, np.zeros(4), 0.0)[0].any()


def noisy_problem() -> RegressionRows:
    rng = np.random.default_rng(3)
    theta = rng.normal(size=(300, 6))
    target = theta[:, :2] @ [1.5, -0.8] + 0.3 * rng.normal(size=300)
    names = list("abcdef")
    return RegressionRows(
        theta=theta,
        target=target[:, None] * 1e20,
        library=named_terms(names, names),
        equations=["y"],
        groups=np.arange(300) // 3,
        test=np.arange(300) < 60,
    )


def test_bootstraps_draw_whole_groups() -> None:
    problem = noisy_problem()
    seen: list[np.ndarray] = []

    def record(weights: np.ndarray) -> np.ndarray:
        seen.append(weights)
        return np.ones((len(weights), 7, 7))

    object.__setattr__(problem, "resampled_products", record)
    Bootstraps(n=5).draw(problem, np.ones(6, dtype=bool), np.random.default_rng(0))
    assert len(seen[0]) == 5
    for drawn in seen[0]:
        assert np.all(np.ptp(drawn.reshape(-1, 3), axis=1) == 0)
        assert 0.2 * 240 <= drawn.sum() <= 0.8 * 240


def test_culled_terms_are_missing_from_their_bootstrap_alone() -> None:
    problem = noisy_problem()
    _, kept = Bootstraps(n=40, n_culled=2).draw(
        problem, np.array([True] * 5 + [False]), np.random.default_rng(0)
    )
    assert np.all(kept.sum(axis=1) == 3)
    assert not kept[:, 5].any()
    assert np.all(kept[:, :5].any(axis=0))


def test_columns_have_unit_norm_in_every_draw() -> None:
    problem = noisy_problem()
    draws = draw_resamples(problem, Bootstraps(n=4), rng=np.random.default_rng(0))
    rng = np.random.default_rng(0)
    products, kept = Bootstraps(n=4).draw(problem, np.ones(6, dtype=bool), rng)
    np.testing.assert_allclose(draws.xx.diagonal(axis1=1, axis2=2), kept, rtol=1e-14)
    for k, mask in enumerate(kept):
        norms = np.sqrt(products[k].diagonal()[:6])[mask]
        np.testing.assert_allclose(draws.scale[k, mask], 1.0 / norms, rtol=1e-14)
        np.testing.assert_allclose(draws.xy[k, 0, mask], products[k, 6, :6][mask] / norms)
        assert draws.yy[k, 0] == products[k, 6, 6]


def test_shares_count_bootstraps() -> None:
    search, boots = BestSubset(max_terms=6), Bootstraps(n=50, n_culled=1)
    pooled = pool_supports(noisy_problem(), search, boots, rng=np.random.default_rng(0))[0]
    sizes = pooled.masks.sum(axis=1)
    assert pooled.fraction[sizes == 0].tolist() == [1.0]
    assert pooled.fraction[sizes == 2].sum() == pytest.approx(1.0)
    # The true pair is found unless one of its two terms was culled (a third of the draws).
    truth = (pooled.masks == [True, True, False, False, False, False]).all(axis=1)
    assert pooled.fraction[truth][0] == pytest.approx(2 / 3, abs=3 * np.sqrt(2 / 9 / 50))
    # Where it was at hand, each true term stood in every support of two terms.
    assert pooled.inclusion[2, :2].tolist() == [1.0, 1.0]
    assert pooled.inclusion[2, 2:].max() < 0.5


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: AdaptiveLasso(gamma=0.0), "gamma must be positive"),
        (lambda: STLSQ(lowest=1.0, highest=0.5), "0 < lowest < highest"),
    ],
)
def test_impossible_settings_are_refused(build: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()  # type: ignore[operator]
