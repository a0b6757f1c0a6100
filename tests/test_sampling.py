from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.whitening import whiten_rows
from ep2sindy.regression.windows import even_grid, is_even, keep_one_per_sample
from ep2sindy.systems.systems import System, van_der_pol

EVERY_ROW = ep.Weak(split=ep.regression.RandomSplit(0.0))
RANDOM = np.cumsum(np.random.default_rng(3).exponential(size=400))


def thinned(run: ep.Trajectory, rng: np.random.Generator, fraction: float = 0.7) -> ep.Trajectory:
    """What is left of a trajectory that has lost samples at random."""
    kept = np.sort(rng.permutation(run.n_samples)[: round(fraction * run.n_samples)])
    return replace(run, t=run.t[kept], states=run.states[kept])


def assembled(system: System, runs: list[ep.Trajectory]) -> tuple[RegressionRows, ...]:
    return EVERY_ROW.assemble(runs, system.model.library, rng=np.random.default_rng(0))


def test_rounded_times_count_as_even() -> None:
    t = np.arange(200) * 0.0314159
    assert is_even(np.round(t, 3))  # by half a millisecond, a sixtieth of a step
    assert not is_even(np.round(t, 2))
    assert not is_even(np.delete(t, 100))
    x = np.sin(t)
    exact, rounded = (
        ep.regression.Bumps().windows(s, x, rng=np.random.default_rng(0)) for s in (t, t.round(3))
    )
    np.testing.assert_allclose(exact.mean.toarray(), rounded.mean.toarray())


def test_straight_lines_pass_unequal_steps_unchanged() -> None:
    grid, lines = even_grid(RANDOM)
    assert np.ptp(np.diff(grid)) < 1e-9
    assert np.diff(grid)[0] == pytest.approx(np.median(np.diff(RANDOM)), rel=0.01)
    assert lines @ RANDOM == pytest.approx(grid, rel=1e-12)
    assert lines.data.min() > 0.0
    x = np.sin(0.05 * RANDOM)
    windows = ep.regression.Bumps(half_width_s=8.0).windows(RANDOM, x, rng=np.random.default_rng(0))
    n = len(windows)
    assert windows.slope @ (2.0 - 3.0 * RANDOM) == pytest.approx(np.full(n, -3.0), rel=1e-9)
    assert windows.mean @ np.ones(400) == pytest.approx(np.ones(n), rel=1e-12)
    assert np.all(np.diff(windows.first) >= 0)


def test_no_two_windows_stand_about_one_sample() -> None:
    t = np.array([0.0, 1.0, 5.0, 6.0])
    middle = np.array([0.0, 1.0, 2.0, 3.5, 4.0, 5.0, 6.0])
    assert keep_one_per_sample(t, middle).tolist() == [0, 1, 3, 6]
    windows = ep.regression.Bumps(half_width_s=3.0).windows(
        RANDOM, np.sin(RANDOM), rng=np.random.default_rng(0)
    )
    assert len(windows) < len(RANDOM)


def test_windows_never_cross_a_gap() -> None:
    t = np.concatenate([np.arange(100.0), 150.0 + np.arange(8.0), 200.0 + np.arange(60.0)])
    states = np.stack([np.sin(0.2 * t), np.cos(0.2 * t)], axis=1)
    run = ep.Trajectory(t=t, states=states, state_names=["x", "y"])
    halves = [run.window(0, 100), run.window(108, 168)]  # 8 samples say nothing of their noise
    system = ep.lotka_volterra()
    whole, apart = assembled(system, [run]), assembled(system, halves)
    for problem, other in zip(whole, apart, strict=True):
        assert np.array_equal(problem.theta, other.theta)
        assert np.array_equal(problem.target, other.target)
        assert problem.trajectories == (run,)
    t = np.arange(200.0).reshape(20, 10) + 40.0 * np.arange(20)[:, None]
    with pytest.raises(ValueError, match="20 samples without a gap: 19 steps are over 10 times"):
        ep.Trajectory(t.ravel(), np.sin(t).reshape(-1, 1), ["x"]).segments()
    short = ep.Trajectory(np.arange(8.0), np.sin(np.arange(8.0))[:, None], ["x"])
    assert short.segments() == [short]


def test_residuals_of_the_truth_are_white_where_samples_are_missing() -> None:
    system, rng = ep.lotka_volterra(), np.random.default_rng(0)
    runs = [thinned(system.trajectory(noise=0.02, rng=rng), rng) for _ in range(6)]
    for problem in assembled(system, runs):
        truth = system.model.terms(problem.equations[0])
        mask = np.isin(problem.library.names, list(truth))
        coef = np.array([truth.get(name, 0.0) for name in problem.library.names])
        coef /= problem.coef_scale(0)
        rows = whiten_rows(problem, mask, coef, n_steps=0)
        residual = rows.target - rows.theta @ coef
        # About 2000 rows each: five standard errors of the mean square and of the product.
        assert np.square(residual).mean() == pytest.approx(1.0, abs=5 * np.sqrt(2 / 2000))
        assert (residual[1:] * residual[:-1]).mean() == pytest.approx(0.0, abs=5 / np.sqrt(2000))


@pytest.mark.parametrize(
    "system", [ep.lotka_volterra(), van_der_pol(), ep.lorenz()], ids=lambda s: s.name
)
def test_known_systems_are_found_with_30_percent_of_the_samples_missing(system: System) -> None:
    rng = np.random.default_rng(1)
    run = thinned(system.trajectory(noise=0.05, rng=rng), rng)
    found = ep.discover(run, system.model.library, ep.Regression(ep.WeightedWeak()))
    for state in system.model.states:
        truth = system.model.terms(state)
        assert found.model.terms(state) == pytest.approx(truth, rel=0.2)
