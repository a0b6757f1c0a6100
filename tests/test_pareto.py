import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.model.scores import r2
from ep2sindy.regression.bootstraps import Supports, pool_supports
from ep2sindy.regression.front import order_front, pareto_front
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import Search
from ep2sindy.systems.systems import System, damped_oscillator, van_der_pol

SYSTEMS = [damped_oscillator(), ep.lotka_volterra(), van_der_pol(), ep.lorenz()]
SEARCHES = [ep.AdaptiveLasso(), ep.STLSQ(), ep.BestSubset()]


def exact_problem(system: System) -> RegressionRows:
    """Rows with the true derivative in place of a numerical one."""
    run = system.trajectory()
    nothing = np.empty((run.n_samples, 0))
    return RegressionRows(
        theta=system.model.library.evaluate(run.states),
        target=system.model.derivative(run.states, nothing),
        library=system.model.library,
        equations=run.state_names,
        groups=np.arange(run.n_samples),
        test=ep.regression.RandomSplit().held_out(run.n_samples, np.random.default_rng(0)),
    )


@pytest.mark.parametrize("search", SEARCHES, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("system", SYSTEMS, ids=lambda s: s.name)
def test_known_systems_come_back_from_exact_derivatives(system: System, search: Search) -> None:
    problem = exact_problem(system)
    found = pool_supports(problem, search, ep.Bootstraps(), rng=np.random.default_rng(1))
    for supports in found:
        front = pareto_front(problem, supports)
        truth = system.model.terms(front.equation)
        (hit,) = [c for c in front.candidates if set(c.terms) == set(truth)]
        recovered = dict(zip(hit.terms, hit.coef, strict=True))
        for name, value in truth.items():
            assert recovered[name] == pytest.approx(value, rel=1e-8)
        assert hit.r2_test == pytest.approx(1.0, abs=1e-14)


def test_depth_keeps_runners_up_behind_the_best_of_each_size() -> None:
    system = ep.lorenz()
    run = system.trajectory(noise=0.05, rng=np.random.default_rng(0))
    (problem,) = ep.Differential().assemble(
        [run], system.model.library, rng=np.random.default_rng(1)
    )
    search = ep.BestSubset(max_terms=3, n_best=4)
    supports = pool_supports(problem, search, ep.Bootstraps(n=0), rng=np.random.default_rng(2))[1]
    front, deep = pareto_front(problem, supports), pareto_front(problem, supports, depth=3)
    assert front.leading.all()
    assert deep.sizes.tolist() == [0, 1, 1, 1, 2, 2, 2, 3, 3, 3]
    assert np.flatnonzero(deep.leading).tolist() == [0, 1, 4, 7]
    for start in (1, 4, 7):
        assert np.all(np.diff(deep.errors[start : start + 3]) > 0)
    best = [c for c, leads in zip(deep.candidates, deep.leading, strict=True) if leads]
    assert [c.terms for c in best] == [c.terms for c in front.candidates]
    assert np.array_equal(deep.errors[deep.leading], front.errors)
    assert len({c.terms for c in deep.candidates}) == len(deep.candidates)


def test_a_size_whose_best_does_not_beat_smaller_ones_is_left_out() -> None:
    sizes = np.array([2, 1, 0, 1, 3, 2, 4])
    errors = np.array([0.4, 0.3, 1.0, 0.5, 0.2, 0.3, 0.2])
    assert order_front(sizes, errors, depth=1) == [2, 1, 4]
    assert order_front(sizes, errors, depth=2) == [2, 1, 3, 4]


def test_r2_takes_the_data_as_truth() -> None:
    truth = np.array([0.0, 1.0, 2.0, 3.0])
    prediction = np.array([truth, np.full(4, 1.5), np.zeros(4)])
    assert r2(truth=truth, prediction=prediction) == pytest.approx([1.0, 0.0, 1 - 14 / 5])


def test_a_front_scores_on_training_rows_when_none_are_held_out() -> None:
    problem = exact_problem(damped_oscillator())
    object.__setattr__(problem, "test", np.zeros(len(problem.theta), dtype=bool))
    supports = pool_supports(
        problem, ep.BestSubset(), ep.Bootstraps(n=0), rng=np.random.default_rng(0)
    )
    front = pareto_front(problem, supports[1])
    assert np.isnan(front.candidates[-1].r2_test)
    assert front.errors[-1] == pytest.approx(0.0, abs=1e-14)


def test_candidate_scores_are_those_of_the_rows() -> None:
    problem = exact_problem(ep.lorenz())
    supports = pool_supports(
        problem, ep.AdaptiveLasso(), ep.Bootstraps(), rng=np.random.default_rng(1)
    )[1]
    for candidate in pareto_front(problem, supports).candidates:
        columns = [problem.library.index(t) for t in candidate.terms]
        rows = problem.test
        prediction = problem.theta[rows][:, columns] @ candidate.coef
        (expected,) = r2(truth=problem.target[rows, 1], prediction=prediction[None])
        assert candidate.r2_test == pytest.approx(expected, abs=1e-12)


def test_ill_conditioned_supports_are_fitted_as_well_as_by_qr() -> None:
    t = np.linspace(1.0, 1.2, 400)
    theta = t[:, None] ** np.arange(5)  # the condition number of these columns is 1e7
    truth = np.array([1.0, -2.0, 3.0, -4.0, 5.0])
    names = [f"t{k}" for k in range(5)]
    problem = RegressionRows(
        theta=theta,
        target=(theta @ truth)[:, None],
        library=ep.named_terms(names, names),
        equations=["y"],
        groups=np.arange(400),
        test=np.zeros(400, dtype=bool),
    )
    every = np.ones((1, 5), dtype=bool)
    supports = Supports("y", every, np.ones(1), np.ones((6, 5)))
    fitted = pareto_front(problem, supports).candidates[-1].coef
    by_qr = np.linalg.lstsq(theta, theta @ truth, rcond=None)[0]
    assert np.abs(fitted - truth).max() < 10 * max(np.abs(by_qr - truth).max(), 1e-9)
