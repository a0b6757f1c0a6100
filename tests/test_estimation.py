"""Estimating states and coefficients together: exact marginals, supports, noise, bad input."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import ep2sindy as ep
from benchmarks.estimation import LORENZ, SHORT
from benchmarks.known_systems import noisy
from ep2sindy.data.sensor import Bounds
from ep2sindy.estimation import cost, explanation, kernels, likelihood
from ep2sindy.estimation.kernels import filter_states, marginalise, smooth_corrections
from ep2sindy.estimation.likelihood import (
    Gram,
    TrajectoryFit,
    divergence_rate,
    fit_paths,
    flow_by,
    gram,
    innovations,
)
from ep2sindy.estimation.noise import _shown_by_samples
from ep2sindy.estimation.observation import LackOfFit, Solution
from ep2sindy.estimation.problem import EstimationProblem, scale_problem
from ep2sindy.estimation.solver import EXACT, from_smooth
from ep2sindy.estimation.supports import alternatives, best_support, penalise, term_penalties
from ep2sindy.trust import memory
from ep2sindy.trust.interruption import is_interruption
from tests.test_exact_inputs import SWITCH, driven


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def linear_case(
    rng: np.random.Generator, *, n: int = 6, d: int = 2, p: int = 3
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    flow = rng.normal(size=(n - 1, d, d + p))
    residuals = rng.normal(size=(n, d))
    residuals[2, 0] = np.nan  # a sample is missing
    variance, process = rng.uniform(0.2, 2.0, (n, d)), rng.uniform(0.1, 0.3, (n - 1, d))
    return flow, rng.normal(size=(n - 1, d)), residuals, variance, process


def dense_rows(
    flow: np.ndarray,
    defects: np.ndarray,
    residuals: np.ndarray,
    variance: np.ndarray,
    process: np.ndarray,
    free_start: float,
) -> tuple[np.ndarray, np.ndarray]:
    """The same squares as one least-squares problem over all states, then coefficients."""
    n, d = residuals.shape
    unit, seen = np.eye(n * d + flow.shape[2] - d), np.isfinite(residuals)
    states, own = unit[: n * d].reshape(n, d, -1), unit[n * d :]
    steps = states[1:] - flow[:, :, :d] @ states[:-1] - flow[:, :, d:] @ own
    rows = [
        states[0] / np.sqrt(free_start),
        (states / np.sqrt(variance)[..., None])[seen],
        (steps / np.sqrt(process)[..., None]).reshape(defects.size, -1),
    ]
    targets = [
        np.zeros(d),
        (residuals / np.sqrt(variance))[seen],
        (defects / np.sqrt(process)).ravel(),
    ]
    return np.concatenate(rows), np.concatenate(targets)


def test_marginal_squares_are_those_of_the_dense_problem(
    rng: np.random.Generator,
) -> None:
    case = linear_case(rng)
    rows, targets = dense_rows(*case, 10.0)
    hessian, gradient, least, _ = marginalise(*case, 10.0)
    n_states = rows.shape[1] - len(gradient)
    states, own = rows[:, :n_states], rows[:, n_states:]
    off = np.eye(len(rows)) - states @ np.linalg.pinv(states)
    np.testing.assert_allclose(hessian, own.T @ off @ own, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(gradient, own.T @ off @ targets, rtol=1e-9, atol=1e-12)
    assert least == pytest.approx(targets @ off @ targets)


@pytest.mark.parametrize(("n", "size"), [(4, 1.0), (200, 1e-7)])
def test_the_spread_of_innovations_is_the_determinant_of_the_samples(
    rng: np.random.Generator, n: int, size: float
) -> None:
    """Products of many small variances would leave the range of numbers."""
    flow, defects, residuals, variance, process = linear_case(rng, n=n, p=0)
    flow, variance, process = flow / 3.0, size * variance, size * process
    _, _, _, log_spread = marginalise(flow, defects, residuals, variance, process, 10.0)
    n, d = residuals.shape
    # Covariance of all states, from the first one's and the steps'.
    to = np.zeros((n * d, n * d))
    for start in range(n):
        block = np.eye(d)
        for k in range(start, n):
            to[k * d : (k + 1) * d, start * d : (start + 1) * d] = block
            if k < n - 1:
                block = flow[k, :, :d] @ block
    own = np.concatenate([np.full(d, 10.0), process.reshape(-1)])
    cov = to @ np.diag(own) @ to.T + np.diag(variance.reshape(-1))
    seen = np.isfinite(residuals).reshape(-1)
    assert log_spread == pytest.approx(np.linalg.slogdet(cov[np.ix_(seen, seen)])[1])


def test_squares_add_up_over_pieces_of_a_record(
    rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    flow, *case = linear_case(rng, n=50)
    whole = marginalise(flow / 3.0, *case, 10.0)
    monkeypatch.setattr(kernels, "FEWEST", 14)  # seven samples of two states
    monkeypatch.setattr(kernels, "PIECE", 0)
    for found, expected in zip(marginalise(flow / 3.0, *case, 10.0), whole, strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_the_last_state_of_the_filter_is_that_of_the_dense_problem(
    rng: np.random.Generator,
) -> None:
    case = linear_case(rng, p=0)
    rows, targets = dense_rows(*case, 10.0)
    innovations, mean, cov = filter_states(*case, 10.0)
    d = len(mean)
    np.testing.assert_allclose(mean, np.linalg.lstsq(rows, targets, rcond=None)[0][-d:], rtol=1e-9)
    np.testing.assert_allclose(cov, np.linalg.inv(rows.T @ rows)[-d:, -d:], rtol=1e-9)
    assert np.array_equal(np.isnan(innovations), np.isnan(case[2]))
    assert np.nansum(innovations**2) == pytest.approx(marginalise(*case, 10.0)[2])


def test_smooth_corrections_are_those_of_the_dense_problem(rng: np.random.Generator) -> None:
    flow, defects, residuals, variance, process = linear_case(rng, p=0)
    rows, targets = dense_rows(flow, defects, residuals, variance, process, 10.0)
    expected = np.linalg.lstsq(rows, targets, rcond=None)[0].reshape(residuals.shape)
    found = smooth_corrections(flow, defects, residuals, variance, process, 10.0)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def lorenz_problem(*relations: str) -> tuple[EstimationProblem, ep.Trajectory]:
    run = ep.lorenz().trajectory(noise=0.05, rng=0).window(0, 200)
    return scale_problem([run], ep.lorenz().model.library.relate(*relations)), run


def truth(problem: EstimationProblem, model: ep.SparseModel) -> np.ndarray:
    """Scaled coefficients of a model, where the problem has no relations."""
    return model.coef[problem.column, problem.equation] / problem.to_SI


def test_the_flow_is_the_models_integral_between_samples() -> None:
    system = ep.lorenz()
    problem, run = lorenz_problem()
    (record,) = problem.records
    ends = problem.ends(record.samples[:-1], truth(problem, system.model), 8)
    for k in (0, 50, 198):
        exact = solve_ivp(
            lambda _, x: system.model.derivative(x, np.empty(0)),
            (run.t[k], run.t[k + 1]),
            run.states[k],
            rtol=1e-12,
            atol=1e-12,
        ).y[:, -1]
        np.testing.assert_allclose(ends[k] * problem.scale, exact, rtol=1e-9)


def test_the_flow_converges_with_the_fourth_order() -> None:
    problem, _ = lorenz_problem()
    (record,) = problem.records
    free = truth(problem, ep.lorenz().model)
    fine = problem.ends(record.samples[:-1], free, 64)
    errors = [np.abs(problem.ends(record.samples[:-1], free, n) - fine).max() for n in (1, 2, 4)]
    slopes = -np.diff(np.log2(errors))
    np.testing.assert_allclose(slopes, 4.0, atol=0.2)


@pytest.mark.parametrize("relations", [(), ("x: x == -1 * x: y",)])
def test_sensitivities_are_derivatives_of_the_flow(relations: Sequence[str]) -> None:
    problem, _ = lorenz_problem(*relations)
    (record,) = problem.records
    free = np.random.default_rng(0).normal(scale=1e-2, size=problem.n_free)
    support = np.zeros(len(free), dtype=np.bool_)
    support[[1, 4, 12, -1]] = True
    states = record.samples[:-1]
    ones = np.ones_like(record.samples)
    fit = TrajectoryFit(problem, ones, 1.0, record.samples, free, support, n_substeps=2)
    flow = flow_by(fit, support)
    np.testing.assert_allclose(flow.ends, problem.ends(states, free, 2), rtol=1e-12)
    h = 1e-6
    for column, j in enumerate(np.flatnonzero(support)):
        step = h * (np.arange(len(free)) == j)
        up, down = (problem.ends(states, free + s * step, 2) for s in (1, -1))
        np.testing.assert_allclose(flow.slopes[:, :, 3 + column], (up - down) / (2 * h), atol=1e-7)
    for i in range(3):
        step = h * (np.arange(3) == i)
        up, down = (problem.ends(states + s * step, free, 2) for s in (1, -1))
        np.testing.assert_allclose(flow.slopes[:, :, i], (up - down) / (2 * h), atol=1e-7)


def fit_of_truth(
    problem: EstimationProblem, model: ep.SparseModel, process: float
) -> TrajectoryFit:
    free, path = truth(problem, model), problem.all_records.samples.copy()
    return TrajectoryFit(problem, np.full(path.shape, 0.05), process, path, free, free != 0.0)


def fitted_lorenz(process: float) -> tuple[EstimationProblem, TrajectoryFit]:
    problem, _ = lorenz_problem()
    return problem, fit_paths(fit_of_truth(problem, ep.lorenz().model, process))


def test_a_fit_is_where_the_squares_have_no_slope() -> None:
    _, fit = fitted_lorenz(0.01)
    step = np.where(fit.support, 1e-4 * np.abs(fit.free), 0.0)
    for j in np.flatnonzero(fit.support):
        change = step * (np.arange(len(step)) == j)
        tried = [replace(fit, free=fit.free + s * change).total for s in (1, -1)]
        curvature = (tried[0] + tried[1] - 2 * fit.total) / 2.0
        assert abs(tried[0] - tried[1]) < 0.05 * np.sqrt(max(curvature, 0.0))


def test_paths_of_the_same_record_twice_part_as_fast_as_of_one() -> None:
    found = []
    run = ep.lorenz().trajectory(noise=0.05, rng=0).window(0, 200)
    for runs in ([run], [run, run]):
        problem = scale_problem(runs, ep.lorenz().model.library)
        found.append(divergence_rate(fit_of_truth(problem, ep.lorenz().model, 0.01)))
    assert found[0] > 0.001
    assert found[1] == pytest.approx(found[0], rel=1e-9)


def test_the_gram_pair_foretells_what_a_dropped_term_costs() -> None:
    _, fit = fitted_lorenz(0.1)
    pair = gram(fit)
    nothing = np.zeros(len(fit.free))
    assert penalise(pair, fit.support, nothing).score == pytest.approx(fit.total, abs=0.01)
    for j in np.flatnonzero(fit.support):
        support = fit.support & (np.arange(len(nothing)) != j)
        foretold = penalise(pair, support, nothing)
        start = replace(fit, free=foretold.free, support=support)
        if foretold.score < fit.total + 30.0:  # within the reach of a line
            refit = fit_paths(start)
            assert refit.total == pytest.approx(foretold.score, rel=0.05)


def test_block_by_block_finds_the_best_support_of_all() -> None:
    problem, fit = fitted_lorenz(0.1)
    pair, penalties = gram(fit), term_penalties(problem, 200.0)
    full = best_support(problem, pair, penalties, np.ones_like(fit.support))
    empty = best_support(problem, pair, penalties, np.zeros_like(fit.support))
    assert full.score == pytest.approx(empty.score)
    for j in range(len(penalties)):
        changed = full.support ^ (np.arange(len(penalties)) == j)
        assert penalise(pair, changed, penalties).score >= full.score - 1e-6


def test_alternatives_hold_an_exchange_between_equations_that_neither_wants_alone() -> None:
    problem, _ = lorenz_problem()
    n = len(problem.block)
    first, other = 0, int(np.flatnonzero(problem.block == 1)[0])
    columns = np.eye(n + 1, n)
    columns[:, first], columns[:, other] = 0.0, 0.0
    columns[first, first] = 1.0
    columns[[first, other], other] = np.sqrt([0.99, 0.01])  # nearly the other equation's term
    target = 10.0 * columns[:, other]
    pair = Gram(columns.T @ columns, columns.T @ target, float(target @ target))
    penalties = np.full(n, 3.0)
    chosen, true = np.arange(n) == first, np.arange(n) == other
    assert np.array_equal(best_support(problem, pair, penalties, chosen).support, chosen)
    found = alternatives(problem, pair, penalties, chosen, within=3.0)
    assert np.array_equal(found[0].support, true)
    assert found[0].score == pytest.approx(3.0)
    assert all(each.score <= 4.0 + 3.0 for each in found)


def test_a_near_miss_of_the_search_is_polished() -> None:
    system, run = noisy("van_der_pol", 0.4, 45)  # by continuation alone, y^3 and x^2*y stand for x
    assert is_right(ep.estimate([run], system.model.library).model, system)


def test_penalties_count_what_a_term_is_chosen_from() -> None:
    problem, _ = lorenz_problem()
    names = [problem.library.names[c] for c in problem.column[:10]]
    penalties = dict(zip(names, term_penalties(problem, 100.0)[:10], strict=True))
    assert penalties["1"] == penalties["x"] == pytest.approx(np.log(100.0) + 2 * np.log(12.0))
    assert penalties["x*y"] == pytest.approx(np.log(100.0) + 2 * np.log(30.0) + 2 * np.log(2.0))


def is_right(model: ep.SparseModel, system: object) -> bool:
    return bool(((model.coef != 0) == (system.model.coef != 0)).all())  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("system", "noise"),
    [
        (ep.systems.damped_oscillator(), 0.2),
        (ep.systems.van_der_pol(), 0.0),
        (ep.systems.van_der_pol(), 0.2),
        (ep.lorenz(), 0.05),
        (ep.lorenz(), 0.2),
    ],
)
def test_known_equations_are_found_in_noise(system: ep.systems.System, noise: float) -> None:
    found = ep.estimate([system.trajectory(noise=noise, rng=3)], system.model.library)
    assert is_right(found.model, system)
    assert found.lack_of_fit == ""


def test_intervals_hold_the_truth_as_often_as_they_say() -> None:
    system, inside = ep.lotka_volterra(), []
    for seed in range(20):
        run = system.trajectory(noise=0.2, rng=seed)
        found = ep.estimate([run], system.model.library.only(terms_of(system.model)))
        for state in ("x", "y") if not found.lack_of_fit else ():
            true = system.model.terms(state)
            for term, (low, high) in found.model.intervals(state).items():
                inside.append(low <= true[term] <= high)
    assert len(inside) >= 60
    # 95 % of some 80, correlated within a model: three standard errors are 0.1.
    assert 0.85 <= np.mean(inside) <= 1.0


def lasting(run: ep.Trajectory, size: float, memory: float, seed: int) -> ep.Trajectory:
    rng = np.random.default_rng(seed)
    noise = rng.standard_normal(run.states.shape)
    for k in range(1, len(noise)):
        noise[k] = memory * noise[k - 1] + np.sqrt(1 - memory**2) * noise[k]
    rms = np.sqrt(np.square(run.states).mean(axis=0))
    return ep.Trajectory(run.t, run.states + size * rms * noise, run.state_names)


def test_samples_that_a_fit_follows_exactly_show_no_noise_of_any_size() -> None:
    samples = np.square(np.arange(40.0))[:, None]
    nothing = np.zeros_like(samples)
    with np.errstate(all="raise", under="ignore"):
        shown = _shown_by_samples([samples], [nothing], np.array([1e9]), np.array([0.5]), 40.0)
    assert not shown.any()


def test_lasting_noise_is_told_from_signal_and_buys_no_terms() -> None:
    system = ep.lorenz()
    found = ep.estimate([lasting(system.trajectory(), 0.05, 0.7, 0)], system.model.library)
    assert is_right(found.model, system)
    assert found.lack_of_fit == ""
    np.testing.assert_allclose(found.memory, 0.7, atol=0.06)


def test_the_noise_is_measured_next_to_the_model() -> None:
    system = ep.systems.van_der_pol()
    run = system.trajectory(noise=0.2, rng=1)
    clean = system.trajectory()
    found = ep.estimate([run], system.model.library)
    np.testing.assert_allclose(found.noise_std, (run.states - clean.states).std(axis=0), rtol=0.02)
    # The states come closer to the truth than the samples by far.
    left = np.sqrt(np.square(found.paths[0] - clean.states).mean(axis=0))
    assert (left < 0.2 * found.noise_std).all()


def test_noise_that_grows_with_the_state_is_weighed_so() -> None:
    system, rng = ep.systems.damped_oscillator(), np.random.default_rng(0)
    clean = system.trajectory()
    noise = 0.05 * clean.states * rng.standard_normal(clean.states.shape)
    run = ep.Trajectory(clean.t, clean.states + noise, clean.state_names)
    found = ep.estimate([run], system.model.library)
    assert is_right(found.model, system)
    assert found.lack_of_fit == ""


def test_what_fits_comes_before_what_scores_lower(monkeypatch: pytest.MonkeyPatch) -> None:
    """The score of states that leave the flow is no likelihood."""

    def leaves(*given: object) -> Solution:
        found = from_smooth(*given)
        error = LackOfFit(np.full(2, 0.1), 0.0, "the states leave the model")
        return replace(found, deviance=found.deviance - 1e4, tests=(error,), flow_error=0.1)

    monkeypatch.setattr(explanation, "from_smooth", leaves)
    system = ep.lotka_volterra()
    found = ep.estimate([system.trajectory(noise=0.05, rng=0)], system.model.library)
    assert found.lack_of_fit == ""
    assert found.flow_error == 0.0
    assert is_right(found.model, system)


def test_a_linear_library_of_what_is_not_linear_is_called_a_lack_of_fit() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.05, rng=0).window(0, 300)
    found = ep.estimate([run], ep.named_terms(["x", "y"], ["x", "y"]))
    assert found.lack_of_fit.startswith("this library lacks terms: with products up to degree 2")
    assert "libraries.model.degree=2" in found.lack_of_fit


def test_an_equation_with_all_the_terms_that_it_may_have_is_a_lack_of_fit() -> None:
    system = ep.lorenz()
    run, library = system.trajectory(noise=0.05, rng=0), system.model.library
    found = ep.estimate([run], library, max_terms=3)
    assert found.lack_of_fit.startswith(
        "y' with as many terms as are allowed (max_terms=3): they may stand"
    )
    assert found.model.covariance is None
    known = {"y": ["x", "y", "x*z"]}
    assert ep.estimate([run], library.only(known), max_terms=3).lack_of_fit == ""


def test_random_times_serve_as_well() -> None:
    system = ep.lorenz()
    run = system.trajectory(noise=0.05, rng=0)
    kept = np.random.default_rng(0).random(run.n_samples) > 0.3
    thinned = ep.Trajectory(run.t[kept], run.states[kept], run.state_names)
    assert is_right(ep.estimate([thinned], system.model.library).model, system)


def test_few_samples_of_a_period_serve_as_well() -> None:
    system = ep.lotka_volterra()
    run = system.trajectory(noise=0.05, rng=0)
    few = ep.Trajectory(run.t[::20], run.states[::20], run.state_names)  # seven a turn
    assert is_right(ep.estimate([few], system.model.library).model, system)


def test_runs_share_their_coefficients() -> None:
    system = ep.lotka_volterra()
    starts = ([1.0, 0.5], [0.3, 0.3], [1.5, 1.2])
    runs = [
        system.trajectory(initial=np.array(s), noise=0.2, rng=k).window(0, 150)
        for k, s in enumerate(starts)
    ]
    found = ep.estimate(runs, system.model.library)
    assert is_right(found.model, system)
    assert [len(path) for path in found.paths] == [150, 150, 150]
    alone = ep.estimate(runs[:1], system.model.library.only(terms_of(system.model)))
    both = ep.estimate(runs, system.model.library.only(terms_of(system.model)))
    spread = [np.sqrt(np.diag(e.model.covariance)).sum() for e in (alone, both)]
    assert spread[1] < spread[0]


def terms_of(model: ep.SparseModel) -> dict[str, list[str]]:
    return {state: list(model.terms(state)) for state in model.states}


def test_relations_and_known_equations_hold() -> None:
    system = ep.lorenz()
    run = system.trajectory(noise=0.1, rng=0)
    found = ep.discover(
        run,
        ep.polynomial(run.names)
        .relate("x: x == -1 * x: y", "y: y == -1")
        .only({"z": ["z", "x*y"]}),
    )
    x, y = found.model.terms("x"), found.model.terms("y")
    assert x["x"] == pytest.approx(-x["y"], rel=1e-12)
    assert y["y"] == pytest.approx(-1.0, rel=1e-12)
    assert set(found.model.terms("z")) == {"z", "x*y"}
    assert is_right(found.model, system)


def test_a_switched_input_is_exact_and_its_multiples_are_no_terms() -> None:
    """x' = -x + 2 u, where u^2 = 30 u."""
    found = ep.estimate([driven(SWITCH, noise=0.05)], ep.polynomial(["x", "u"], degree=2))
    assert set(found.model.terms("x")) in ({"x", "u"}, {"x", "u^2"})
    assert np.abs(found.model.coef).max() < 3.0


def test_the_search_is_the_same_in_other_units() -> None:
    system = ep.lotka_volterra()
    run = system.trajectory(noise=0.1, rng=0)
    scaled = ep.Trajectory(run.t * 1e-6, run.states * [1e18, 1e19], run.state_names)
    one, other = (ep.estimate([r], system.model.library).model for r in (run, scaled))
    assert np.array_equal(one.coef != 0, other.coef != 0)
    size = np.array([1e18, 1e19])
    factor = 1e6 * size / system.model.library.evaluate(size)[:, None]
    np.testing.assert_allclose(other.coef, one.coef * factor, rtol=1e-6)


def test_what_cannot_be_estimated_is_refused() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.05, rng=0)
    with pytest.raises(ValueError, match=r"the library needs \['z'\]"):
        ep.estimate([run], ep.polynomial(["x", "y", "z"], degree=1))
    with pytest.raises(ValueError, match="needs more samples than terms, got 6"):
        ep.estimate([run.window(0, 6)], ep.polynomial(["x", "y"], degree=2))


@pytest.mark.slow
def test_a_library_without_the_constant_where_a_state_drifts_is_a_lack_of_fit() -> None:
    rng = np.random.default_rng(0)
    t = np.linspace(0.0, 20.0, 100)
    states = np.column_stack([0.5 * t, np.cos(t)]) + 0.05 * rng.standard_normal((100, 2))
    library = ep.named_terms(["x", "y"], ["y", "x*y", "y^2"])
    found = ep.estimate([ep.Trajectory(t, states, ["x", "y"])], library)
    assert "no law of this library explains y: a term or a state is missing" in found.lack_of_fit


def many_states(n_states: int) -> ep.Trajectory:
    t = np.linspace(0.0, 20.0, 400)
    states = np.stack([np.sin((1.0 + 0.1 * k) * t) for k in range(n_states)], axis=1)
    return ep.Trajectory(t, states, [f"x{k}" for k in range(n_states)])


def three_runs(rng: np.random.Generator) -> TrajectoryFit:
    """Runs with an input, of which one lacks samples and one has limits, about some paths."""
    runs = []
    for k, n in enumerate((30, 12, 21)):
        t = np.sort(rng.uniform(0.0, 1.0, n)) + 0.1 * np.arange(n)
        states, missing = rng.normal(size=(n, 2)), rng.random((n, 2)) < 0.3
        runs.append(
            ep.Trajectory(
                t, states, ["x", "y"], inputs=np.sin(t)[:, None], input_names=["u"],
                missing=missing if k == 1 else None,
            )
        )  # fmt: skip
    problem = scale_problem(runs, ep.polynomial(["x", "y", "u"], degree=2))
    first, second, last = problem.records
    upper = np.where(rng.random(last.samples.shape) < 0.3, np.inf, last.samples)
    last = replace(last, limits=Bounds(last.samples, upper, ()))
    problem = replace(problem, records=(first, second, last))
    samples = problem.all_records.samples
    path, noise = samples + 0.1 * rng.normal(size=samples.shape), rng.uniform(0.2, 0.5, (63, 2))
    free = 0.1 * rng.normal(size=problem.n_free)
    support = np.ones(len(free), dtype=bool)
    return TrajectoryFit(problem, noise, 0.3, path, free, support, n_substeps=2)


@pytest.mark.parametrize("process_noise", [None, np.array([0.1, 0.2])])
def test_runs_are_joined_without_a_way_from_one_to_the_next(
    rng: np.random.Generator, process_noise: np.ndarray | None
) -> None:
    fit = three_runs(rng)
    problem, fit = fit.problem, replace(fit, process_noise=process_noise)
    change = 0.1 * rng.normal(size=problem.n_free)

    def parts_of(fit: TrajectoryFit) -> tuple:
        pair, (_, least, logs) = gram(fit), innovations(fit)
        return pair.quadratic, pair.linear, least, logs, fit.squares

    def move_of(fit: TrajectoryFit) -> np.ndarray:
        about = likelihood.hessian_on(fit, fit.support)[3]
        defects = about.defects + about.slopes[:, :, 2:] @ change
        return smooth_corrections(*about.of_states._replace(defects=defects))

    totals = [0.0] * 5
    for record, path, noise, move in zip(
        problem.records, fit.paths, problem.split(fit.noise), problem.split(move_of(fit)),
        strict=True,
    ):  # fmt: skip
        alone = replace(problem, records=(record,))
        own = replace(fit, problem=alone, noise=noise, path=path)
        np.testing.assert_allclose(move, move_of(own), rtol=1e-9, atol=1e-12)
        totals = [total + part for total, part in zip(totals, parts_of(own), strict=True)]
    joined = parts_of(fit)
    for one, other in zip(joined, totals, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9 * np.abs(other).max())


def test_more_coefficients_than_memory_holds_are_refused_first(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(memory, "free_bytes", lambda: 3 * 10**8)
    run = many_states(10)
    library = ep.polynomial(run.state_names, degree=3)
    monkeypatch.setattr(cost, "NUMBERS", 50.0)
    message = r"2860 coefficients \(286 terms, 10 states\), of which 200 .* 400 samples, would take"
    with pytest.raises(ValueError, match=message):
        ep.estimate([run], library)
    run_of_known_terms = {name: ["x0", "x1"] for name in run.state_names}
    cost.check_size([run], library, run_of_known_terms)


def test_a_long_search_is_warned_of_unless_a_limit_ends_it_sooner() -> None:
    run, t = many_states(7), np.linspace(0.0, 900.0, 90_000)
    long = ep.Trajectory(t, np.tile(np.sin(t)[:, None], 7), run.state_names)
    large = ep.polynomial(run.state_names, degree=3)
    with pytest.warns(ep.discovery.SlowSearch, match="some 2 minutes of one core"):
        cost.check_size([long], large, {})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cost.check_size([run], large, {})
        cost.check_size([long], large, {}, limit_s=200.0)


class Clock:
    """A clock that continues by a second whenever it is read."""

    def __init__(self) -> None:
        self.read = 0

    def monotonic(self) -> float:
        self.read += 1
        return float(self.read)


@pytest.mark.parametrize("limit_s", [1e-3, 20.0, 4000.0])
def test_a_search_ends_at_its_limit_with_the_best_so_far(
    monkeypatch: pytest.MonkeyPatch, limit_s: float
) -> None:
    """However early: the model is whole, and what holds for it says that the search was ended."""
    run = ep.lorenz().trajectory(noise=0.05, rng=0)
    monkeypatch.setattr(cost, "time", Clock())
    found = ep.estimate(run, ep.polynomial(["x", "y", "z"], degree=3), limit_s=limit_s)
    assert np.isfinite(found.model.coef).all()
    assert found.model.coef.any()
    assert all(path.shape == run.states.shape for path in found.paths)
    ended = found.lack_of_fit.startswith("the search was ended by limit_s after")
    if limit_s < 1000.0:
        assert ended
        assert found.model.covariance is None
    else:
        assert not found.lack_of_fit
        assert set(found.model.terms("x")) == {"x", "y"}


@pytest.mark.parametrize(
    ("limit_s", "sizes"), [(60.0, [16_384, 65_536]), (400.0, [16_384, 65_536, 262_144, 1_000_000])]
)
def test_a_search_with_a_limit_takes_parts_of_a_long_record_first(
    limit_s: float, sizes: list[int]
) -> None:
    """Each is as much larger as the time allows, at the pace of the one before."""
    t, now, found = np.arange(1_000_000.0), 0.0, []
    run = ep.Trajectory(t, np.sin(0.01 * t)[:, None], ["x"])
    monitor = cost.SearchMonitor(limit_s=limit_s, clock=lambda: now)
    for part in cost.growing_parts([run], 1.0, monitor):
        found.append(sum(each.n_samples for each in part))
        now += 2e-4 * found[-1]
        assert part[-1].t[-1] == t[-1]  # all of the record is seen
    np.testing.assert_allclose(found, sizes, rtol=0.02)  # whole blocks
    (whole,) = cost.growing_parts([run], 1.0, cost.SearchMonitor())
    assert whole == [run]


def test_what_is_found_in_a_part_of_a_record_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    run = ep.lotka_volterra().trajectory(noise=0.05, rng=0)
    library = ep.polynomial(["x", "y"], degree=2)
    monkeypatch.setattr(cost, "PARTS", (run.n_samples // 3,))
    monkeypatch.setattr(cost, "free_bytes", lambda: 0)  # for a larger part
    found = ep.estimate(run, library, limit_s=1e6)
    assert not found.lack_of_fit
    assert set(found.model.terms("x")) == {"x", "x*y"}
    n_taken = sum(each.n_samples for each in found.runs)
    assert n_taken <= run.n_samples // 3
    assert f"the equations come from {n_taken} of {run.n_samples} samples" in found.data_warnings[0]
    assert list(ep.estimate(run, library).runs) == [run]


def test_an_interruption_ends_a_search_that_is_watched() -> None:
    """With the best so far; a search that nobody watches, or without a model yet, is ended."""
    run = ep.lotka_volterra().trajectory(noise=0.05, rng=0)
    library = ep.polynomial(["x", "y"], degree=2)
    steps = 0

    def interrupt(at: int) -> Callable[[int], None]:
        def advance(n_more: int) -> None:
            nonlocal steps
            steps += n_more
            if steps == at:
                raise KeyboardInterrupt

        return advance

    found = ep.estimate(run, library, progress=interrupt(15))
    assert "ended by an interruption after" in found.lack_of_fit + " ".join(found.data_warnings)
    assert found.model.coef.any()
    steps = 0
    with pytest.raises(KeyboardInterrupt):
        ep.estimate(run, library, progress=interrupt(1))


def test_an_interruption_within_a_kernel_is_one() -> None:
    """Numba turns it into an error of its own, once or twice."""
    once, twice = SystemError("a result with an exception set"), SystemError("again")
    once.__cause__, twice.__cause__ = KeyboardInterrupt(), once
    assert is_interruption(KeyboardInterrupt())
    assert is_interruption(once)
    assert is_interruption(twice)
    assert not is_interruption(SystemError("of another kind"))
    assert not is_interruption(ValueError())


def test_squares_whose_sum_overflows_are_infinite_and_warn_of_nothing() -> None:
    _, fit = fitted_lorenz(0.1)
    fit = replace(fit, path=np.full(fit.path.shape, 3.9e151), free=np.zeros_like(fit.free))
    assert np.isfinite(fit.squares).all()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert fit.total == np.inf


@pytest.mark.slow
def test_a_path_that_misses_the_steps_of_its_model_is_no_trajectory() -> None:
    """What the continuation lets pass may hold up a model: y' = a x - b x z, b = 5e3, z' = 0."""
    rng = np.random.default_rng([5, 300, 3])
    start = rng.uniform([-10.0, -10.0, 15.0], [10.0, 10.0, 30.0])
    run = LORENZ.trajectory(noise=0.2, rng=503, initial=start).window(0, 300)
    missing = np.zeros(run.states.shape, dtype=np.bool_)
    missing[:, 2] = np.arange(300) % 10 > 0
    found = ep.estimate(replace(run, missing=missing), LORENZ.model.library)
    assert found.flow_error > EXACT
    assert "the states leave the model" in found.lack_of_fit
    assert found.model.covariance is None


def test_right_models_meet_their_steps() -> None:
    run = LORENZ.trajectory(noise=0.2, rng=0)
    problem = scale_problem([run], LORENZ.model.library)
    found = from_smooth(problem, None)
    missed = found.fit.squared_defects
    assert found.flow_error == 0.0
    assert (np.sqrt(missed / problem.n_samples) < 1e-2 * EXACT * found.noise.std).all()


@pytest.mark.slow
def test_process_noise_alone_is_no_law() -> None:
    found = ep.estimate(SHORT["60 samples, 20 %"](3), LORENZ.model.library)
    assert found.lack_of_fit or found.model.coef.any(axis=0).all()


def test_samples_that_leave_the_terms_open_are_reported_to_tell_nothing() -> None:
    found = ep.estimate(SHORT["60 samples, 20 %"](0), LORENZ.model.library)
    assert re.match(
        r"60 samples do not tell these equations from others: the chance .* is \d+ %",
        found.too_few_samples,
    )
    assert found.note.startswith(found.too_few_samples)
