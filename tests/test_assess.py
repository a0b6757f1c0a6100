"""The test of a regression's residuals: fast forms against plain ones, and blocks of records."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import diags_array

import ep2sindy as ep
from ep2sindy.data.trajectory import spread_blocks
from ep2sindy.discovery import choice
from ep2sindy.discovery.choice import reweight
from ep2sindy.regression.front import Candidate
from ep2sindy.regression.rows import NoisyRows, RegressionRows
from ep2sindy.regression.whitening import NEGLIGIBLE, _covariance, _Sums
from ep2sindy.regression.windows import spectral_change_point
from tests.models import slopes_of


def plain_covariance(rows: NoisyRows, sensitivity: np.ndarray, target_scale: float) -> np.ndarray:
    """The sum over variables of M M', where M is the rows' change per unit noise of a variable."""
    total, mean, slope = np.zeros((len(rows.windows),) * 2), rows.windows.mean, rows.windows.slope
    for v, std in enumerate(rows.noise_std.T):
        change = mean @ diags_array(sensitivity[v])
        if v == rows.state:
            change = change - slope @ diags_array(std) / target_scale
        total += (change @ change.T).toarray()
    return total


def rows_of_lorenz(steps: str, functions: Sequence[str] = ()) -> RegressionRows:
    rng = np.random.default_rng(0)
    run = ep.lorenz().trajectory(noise=0.02, rng=0).window(0, 400)
    if steps == "uneven":
        kept = np.sort(rng.choice(400, size=300, replace=False))
        run = ep.Trajectory(run.t[kept], run.states[kept], run.state_names)
    library = ep.polynomial(run.state_names, degree=2, functions=functions)
    return ep.Weak(split=ep.regression.RandomSplit(0.0)).assemble([run], library, rng=rng)[1]


@pytest.mark.parametrize("order", ["as they come", "shuffled"])
@pytest.mark.parametrize("steps", ["even", "uneven"])
def test_the_banded_covariance_is_that_of_sparse_products(steps: str, order: str) -> None:
    rng, rows = np.random.default_rng(0), rows_of_lorenz(steps).noisy
    assert rows is not None
    if order == "shuffled":
        rows = replace(rows, windows=rows.windows.taken(rng.permutation(len(rows.windows))))
    sensitivity = rng.normal(size=rows.noise_std.T.shape)
    band, plain = _covariance(rows, sensitivity, 3.0), plain_covariance(rows, sensitivity, 3.0)
    n = len(plain)
    for k in range(n):
        below = np.diagonal(plain, -k)
        found = band[k, : n - k] if k < len(band) else np.zeros(n - k)
        np.testing.assert_allclose(found, below, atol=1e-12 * plain.max())


@pytest.mark.parametrize("kept", [[0, 4, 7, 9, 12], list(range(13))])
def test_sums_of_products_and_their_slopes_are_those_of_the_library(kept: list[int]) -> None:
    problem, rng = rows_of_lorenz("even", functions=["sin"]), np.random.default_rng(0)
    library, scale = problem.library, problem.theta_scale
    x, moved, coef = rng.normal(size=(3, 700)), rng.normal(size=(3, 700)), np.zeros(len(library))
    coef[kept] = rng.normal(size=len(kept))
    slopes = slopes_of(library, x.T) / scale
    plain = library.evaluate(x.T) / scale
    change = np.einsum("vst,vs->st", slopes, moved)
    sums = _Sums.of(problem, np.isin(np.arange(len(library)), kept))
    terms, sensitivity = sums.linearise(x, moved, coef[kept])
    np.testing.assert_allclose(terms[0], plain.T[kept], rtol=1e-12, atol=1e-15)
    np.testing.assert_allclose(terms[1], (plain + change).T[kept], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(sensitivity, slopes @ coef, rtol=1e-12, atol=1e-12)


def test_long_records_are_tested_in_blocks_spread_over_them() -> None:
    t, rng = np.arange(50_000.0), np.random.default_rng(0)
    long = ep.Trajectory(t, np.cumsum(rng.normal(size=(50_000, 1)), axis=0), ["x"])
    short = long.window(0, 20_000)
    assert spread_blocks([short], most=20_000, block=4_000) == [short]
    blocks = spread_blocks([long, short, short], most=20_000, block=4_000)
    assert sum(block.n_samples for block in blocks) <= 20_000
    assert len(blocks) == 5
    assert {block.n_samples for block in blocks} == {3846, 3847, 4000}
    assert blocks[0].t[0] == 0.0
    assert blocks[-1].t[-1] == 19_999.0


def test_blocks_in_which_a_state_rests_are_left_out() -> None:
    x = np.append(np.zeros(30_000), np.sin(0.01 * np.arange(30_000.0)))
    run = ep.Trajectory(np.arange(60_000.0), x[:, None], ["x"])
    blocks = spread_blocks([run], most=20_000, block=4_000)
    assert len(blocks) == 3
    assert all(block.t[0] >= 28_000.0 for block in blocks)


@pytest.mark.parametrize("right", [True, False])
def test_blocks_give_the_verdict_of_the_whole_record(
    monkeypatch: pytest.MonkeyPatch, right: bool
) -> None:
    run = ep.lotka_volterra().trajectory(noise=0.05, rng=0)
    library = ep.polynomial(run.state_names, degree=2 if right else 1)
    method = ep.Regression(search=ep.BestSubset(max_terms=3))
    whole = ep.discover(run, library, method=method, seed=0)
    monkeypatch.setattr(choice, "MOST_TESTED", run.n_samples // 2)
    monkeypatch.setattr(choice, "BLOCK", run.n_samples // 8)
    method = ep.Regression(ep.Weak(), ep.BestSubset(max_terms=3))
    blocks = ep.discover(run, library, method=method, seed=0)
    assert bool(whole.lack_of_fit) == bool(blocks.lack_of_fit) == (not right)


def test_the_change_point_is_the_corner_of_least_squares() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        x = np.sin(rng.uniform(0.05, 0.5) * np.arange(500)) + 0.1 * rng.normal(size=500)
        total = np.cumsum(np.abs(np.fft.rfft(x - x.mean())))
        bins = np.arange(len(total))
        corners = np.unique(np.geomspace(1, len(bins) - 2, 200).astype(int))
        left = [
            np.square(total - np.interp(bins, [0, c, bins[-1]], total[[0, c, -1]])).sum()
            for c in corners
        ]
        assert spectral_change_point(x) == corners[np.argmin(left)]


def test_steps_that_are_left_out_hardly_change_the_residuals() -> None:
    """Least squares at the coefficients, so their last digits do not show in chi-squared."""
    run = ep.lorenz().trajectory(noise=0.1, rng=1).window(0, 1500)
    library = ep.named_terms(run.state_names, ["x", "y", "x*z"])
    form, rng = ep.Weak(split=ep.regression.RandomSplit(0.0)), np.random.default_rng(0)
    for problem in form.assemble([run], library, rng=rng):
        (state,) = problem.equations
        fit = Candidate.of(state, dict(zip(library.names, [10.0, 28.0, -1.0], strict=True)))
        near, exact = (reweight(problem, fit, negligible=n).left for n in (NEGLIGIBLE, 0.0))
        assert near is not None
        assert exact is not None
        assert abs(near.chi_squared / exact.chi_squared - 1.0) < 1e-5
        assert abs(near.autocorrelation - exact.autocorrelation) < 1e-5
