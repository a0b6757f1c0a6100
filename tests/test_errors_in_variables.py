from types import SimpleNamespace

import numpy as np
import pytest

from benchmarks.intervals import held
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import reweight
from ep2sindy.library.library import named_terms, polynomial
from ep2sindy.regression import whitening
from ep2sindy.regression.bootstraps import Bootstraps, pool_supports
from ep2sindy.regression.formulations import RandomSplit, Weak, WeightedWeak
from ep2sindy.regression.front import Candidate, fit_support, pareto_front
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import BestSubset
from ep2sindy.regression.whitening import whiten_rows
from ep2sindy.regression.windows import Bumps
from ep2sindy.systems.draws import realization
from ep2sindy.systems.systems import System, lorenz, lotka_volterra

EVERY_ROW = Weak(split=RandomSplit(0.0))


def problems_of(system: System, runs: list[Trajectory]) -> tuple[RegressionRows, ...]:
    return EVERY_ROW.assemble(runs, system.model.library, rng=np.random.default_rng(0))


def noisy_runs(system: System, noise: float, n: int = 1) -> list[Trajectory]:
    return [system.trajectory(noise=noise, rng=np.random.default_rng(k)) for k in range(n)]


def fitted(system: System, problem: RegressionRows) -> Candidate:
    (state,) = problem.equations
    return reweight(problem, fit_support(problem, state, list(system.model.terms(state))))


def test_whitened_residuals_of_the_truth_are_white_with_unit_variance() -> None:
    system = lotka_volterra()
    squares, products = [], []
    for k, problem in enumerate(problems_of(system, noisy_runs(system, 0.02, n=6))):
        coef = system.model.coef[:, k] / problem.coef_scale(0)
        rows = whiten_rows(problem, coef != 0.0, coef, n_steps=0)
        residual = rows.target - rows.theta @ coef
        squares.append(np.square(residual).mean())
        products.append((residual[1:] * residual[:-1]).mean())
    # About 2000 rows each: five standard errors of the mean square and of the product.
    assert squares == pytest.approx([1.0, 1.0], abs=5 * np.sqrt(2 / 2000))
    assert products == pytest.approx([0.0, 0.0], abs=5 / np.sqrt(2000))


def test_noise_in_a_linear_term_does_not_shrink_its_coefficient() -> None:
    """Plain least squares on raw samples attenuates; following the noise does not."""
    rng = np.random.default_rng(1)
    t = np.arange(3000) * 0.01
    exact = np.stack([np.sin(3 * t), 3 * np.cos(3 * t)], axis=1)  # x' = v, v' = -9 x
    ratios = {"plain": [], "followed": []}
    raw = Weak(Bumps(half_width_s=0.06), smooth_library=False, split=RandomSplit(0.0))
    for _ in range(8):
        states = exact + rng.standard_normal(exact.shape) * [0.3, 0.9]
        run = Trajectory(t=t, states=states, state_names=["x", "v"])
        problem = raw.assemble([run], polynomial(["x", "v"], degree=1), rng=rng)[1]
        plain = fit_support(problem, "v", ["x"])
        ratios["plain"].append(plain.coef[0] / -9.0)
        ratios["followed"].append(reweight(problem, plain).coef[0] / -9.0)
    assert np.mean(ratios["plain"]) < 0.97
    assert np.mean(ratios["followed"]) == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    "system",
    [lotka_volterra(), pytest.param(lorenz(), marks=pytest.mark.slow)],
    ids=lambda s: s.name,
)
def test_errors_are_of_the_size_that_the_covariance_says(system: System) -> None:
    scores = []
    for k in range(5):
        rng = np.random.default_rng(100 + k)
        run = system.trajectory(noise=0.05, rng=rng)
        for problem in problems_of(system, [run]):
            candidate = fitted(system, problem)
            truth = system.model.terms(candidate.equation)
            error = candidate.coef - [truth[name] for name in candidate.terms]
            scores.append(error @ np.linalg.solve(candidate.covariance, error) / len(error))
    # Mean of chi-square per coefficient: standard error sqrt(2 / n), n = 5 x 4 or 5 x 7.
    assert np.mean(scores) == pytest.approx(1.0, abs=3 * np.sqrt(2 / (5 * 4)))


def test_two_trajectories_narrow_the_intervals_like_independent_data() -> None:
    system = lotka_volterra()
    runs = noisy_runs(system, 0.05, n=4)
    one = fitted(system, problems_of(system, runs[:1])[0]).covariance
    four = fitted(system, problems_of(system, runs)[0]).covariance
    assert np.sqrt(np.diag(one) / np.diag(four)) == pytest.approx([2.0, 2.0], rel=0.1)


def test_a_noise_free_signal_keeps_its_exact_coefficients() -> None:
    system = lotka_volterra()
    problem = problems_of(system, [system.trajectory()])[0]
    candidate = fitted(system, problem)
    assert candidate.coef == pytest.approx([2 / 3, -1.0], rel=1e-5)


def test_terms_that_cannot_explain_the_data_still_give_finite_rows() -> None:
    system = lorenz()
    problem = problems_of(system, noisy_runs(system, 0.2))[1]
    candidate = reweight(problem, fit_support(problem, "y", ["1", "z^2"]))
    assert np.isfinite(candidate.coef).all()
    assert candidate.left.chi_squared > 2.0
    assert candidate.covariance is None  # it would not hold the truth


def test_weighted_rows_leave_exact_data_their_exact_coefficients() -> None:
    system = lorenz()
    rng = np.random.default_rng(0)
    for problem in WeightedWeak().assemble([system.trajectory()], system.model.library, rng=rng):
        (state,) = problem.equations
        truth = system.model.terms(state)
        fit = fit_support(problem, state, list(truth))
        assert fit.coef_by_term == pytest.approx(truth, rel=1e-5)


def test_weighted_rows_let_the_truth_lead_its_size_in_noise() -> None:
    """A fast jump under 20 % noise: plain rows lose the truth, see docs/benchmark.md."""
    led = {"plain": 0, "weighted": 0}
    for number in range(6):
        system, runs = realization("van_der_pol", 0.2, number)
        for name, formulation in (("plain", EVERY_ROW), ("weighted", WeightedWeak())):
            rng = np.random.default_rng(0)
            problem = formulation.assemble(runs, system.model.library, rng=rng)[0]
            (found,) = pool_supports(problem, BestSubset(), Bootstraps(n=0), rng=rng)
            front = pareto_front(problem, found)
            led[name] += any(set(c.terms) == set(system.model.terms("x")) for c in front.candidates)
    assert led["plain"] <= 4
    assert led["weighted"] == 6


def test_weighted_rows_may_be_searched_again_with_weights_of_their_own() -> None:
    """The last fit goes back to the samples: it does not weigh weighted rows once more."""
    system = lotka_volterra()
    runs = noisy_runs(system, 0.05)
    rng = np.random.default_rng(0)
    plain = problems_of(system, runs)[0]
    weighted = WeightedWeak().assemble(runs, system.model.library, rng=rng)[0]
    first, second = fitted(system, plain), fitted(system, weighted)
    assert second.coef == pytest.approx(first.coef, rel=1e-6)
    np.testing.assert_allclose(second.covariance, first.covariance, rtol=1e-4)


def test_weighted_rows_cannot_be_held_out() -> None:
    system = lotka_volterra()
    formulation = WeightedWeak(weak=Weak(split=RandomSplit(0.25)))
    with pytest.raises(ValueError, match="set weak.split.test_fraction to 0"):
        formulation.assemble(
            [system.trajectory()], system.model.library, rng=np.random.default_rng(0)
        )
    with pytest.raises(ValueError, match="weak.errors_in_variables"):
        WeightedWeak(weak=Weak(errors_in_variables=False))


def test_an_input_may_be_noisy_too() -> None:
    """x' = -x + u, with noise on both; u is no state, and its noise is followed all the same."""
    rng = np.random.default_rng(2)
    t = np.arange(4000) * 0.005
    u = np.sin(2 * t)
    x = 0.2 * np.sin(2 * t) - 0.4 * np.cos(2 * t) + 0.4 * np.exp(-t)
    noise = 0.05 * rng.standard_normal((2, len(t)))
    run = Trajectory(t, (x + noise[0])[:, None], ["x"], (u + noise[1])[:, None], ["u"])
    library = named_terms(["x", "u"], ["x", "u"])
    (problem,) = EVERY_ROW.assemble([run], library, rng=rng)
    candidate = reweight(problem, fit_support(problem, "x", ["x", "u"]))
    error = np.abs(candidate.coef - [-1.0, 1.0]) / np.sqrt(np.diag(candidate.covariance))
    assert error.max() < 3.5
    assert np.sqrt(np.diag(candidate.covariance)).max() < 0.05


@pytest.mark.parametrize(
    ("lowest", "limit", "n_tried", "cost"),
    [(5.0, 0.0, 4, 0.0), (0.0, 8.9, 1 + whitening.MAX_HALVED, None), (0.0, 9.0, 1, 9.0)],
)
def test_a_step_is_halved_until_the_cost_falls(
    monkeypatch: pytest.MonkeyPatch, lowest: float, limit: float, n_tried: int, cost: float | None
) -> None:
    tried = []

    def at(problem: object, sums: object, x: np.ndarray, coef: np.ndarray) -> SimpleNamespace:
        tried.append((x.item(), coef.item()))
        return SimpleNamespace(cost=9.0 if x.item() > lowest else 0.0)

    monkeypatch.setattr(whitening._Linearised, "at", at)
    x, coef = np.full((1, 1), 3.0), np.array([5.0])
    rows = SimpleNamespace(x=x, coef=coef, cost=9.0, correct=lambda coef: x + 16.0)
    problem = SimpleNamespace(library=polynomial(["x"]))
    step = whitening._step(problem, None, rows, coef + 32.0, limit=limit)
    assert (step and step.cost) == cost
    assert tried == [(3.0 + 16.0 * 0.5**k, 5.0 + 32.0 * 0.5**k) for k in range(n_tried)]


def test_every_step_may_raise_the_least_cost_so_far_by_ten_per_row(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    system, costs, limits, step = lorenz(), [], [], whitening._step

    def seen(problem, sums, rows, coef, *, limit):
        costs.append(rows.cost)
        limits.append(limit - 10.0 * len(rows.target))
        return step(problem, sums, rows, coef, limit=limit)

    monkeypatch.setattr(whitening, "_step", seen)
    problem = problems_of(system, noisy_runs(system, 0.1))[1]
    coef = system.model.coef[:, 1] / problem.coef_scale(0)
    whiten_rows(problem, coef != 0.0, coef, n_steps=3)
    assert len(costs) == 3
    assert limits == pytest.approx([min(costs[: k + 1]) for k in range(3)], rel=1e-12)
    assert [whitening._is_near(coef, 1.01 * coef, by) for by in (0.0, 0.009, 0.011)] == [0, 0, 1]
    assert not whitening._is_near(coef, coef, 0.0)


def test_corrected_samples_obey_a_linear_model_exactly() -> None:
    t = np.arange(400) * 0.02
    states = np.stack([np.sin(3 * t), 3 * np.cos(3 * t)], axis=1)
    states += np.random.default_rng(0).standard_normal(states.shape) * [0.02, 0.06]
    run = Trajectory(t=t, states=states, state_names=["x", "v"])
    library = named_terms(["x", "v"], ["x", "v"])
    problem = EVERY_ROW.assemble([run], library, rng=np.random.default_rng(0))[1]
    coef = np.array([-1.0, 0.0])
    corrected = whiten_rows(problem, np.ones(2, dtype=bool), coef, n_steps=1).corrected
    windows, left = problem.noisy.windows, []
    for samples in (corrected, states):
        theta, target = windows.mean @ samples, windows.slope @ samples[:, 1]
        residual = target - theta @ np.linalg.lstsq(theta, target)[0]
        left.append(np.linalg.norm(residual) / np.linalg.norm(target))
    assert left[0] < 1e-4 < 1e-2 < left[1]  # RIDGE of the variance stays


def test_noise_bends_the_mean_of_functions_unless_a_step_leaves_their_domain() -> None:
    library = named_terms(["x", "v"], ["sin(x)", "x*v", "sqrt(v)", "sqrt(1-v)"])
    x = np.array([[0.3, 0.5], [1.2, 0.95], [2.0, 0.05]])  # v + s and v - s leave [0, 1]
    noise = {"values": np.empty((3, 2)), "noise_std": np.full((3, 2), [0.2, 0.1])}
    noisy = SimpleNamespace(windows=range(3), **noise)  # a row for two values: half is left
    lift = whitening._lift(SimpleNamespace(library=library, noisy=noisy), x)
    s, v = np.array([0.2, 0.1]) / np.sqrt(2.0), 0.5
    expected = np.zeros((3, 4))
    expected[:, 0] = np.sin(x[:, 0]) * (np.cos(s[0]) - 1.0)
    expected[0, 2:] = 0.5 * (np.sqrt(v + s[1]) + np.sqrt(v - s[1])) - np.sqrt(v)
    np.testing.assert_allclose(lift, expected, rtol=1e-12, atol=1e-15)


def test_the_lift_by_noise_is_taken_from_terms_at_noisy_samples() -> None:
    (run,), library = noisy_runs(lotka_volterra(), 0.05), named_terms(["x", "y"], ["x", "sin(2*x)"])
    problem = EVERY_ROW.assemble([run], library, rng=np.random.default_rng(0))[0]
    sums, x = whitening._Sums.of(problem, np.ones(2, dtype=bool)), problem.noisy.columns[0]
    raw, smooth = (
        whitening._Linearised.at(problem, sums, x, np.ones(2), noisy=noisy)
        for noisy in (True, False)
    )
    lift = problem.noisy.windows.mean @ (whitening._lift(problem, x.T) / problem.theta_scale)
    assert np.abs(lift[:, 1]).max() > 1e-5
    expected = smooth.theta - whitening._solve(raw.factor, lift)
    np.testing.assert_allclose(raw.theta, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lotka_volterra", "lorenz"])
def test_intervals_of_95_percent_hold_the_truth_in_90_to_98_of_100(name: str) -> None:
    inside = [held(name, number) for number in range(200)]
    assert 0.90 <= np.mean(inside) <= 0.98
