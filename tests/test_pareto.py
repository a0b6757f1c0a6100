import numpy as np
import pytest

from ep2sindy.library import named_terms
from ep2sindy.pareto import Candidate, Knee, ParetoFront, pareto_front, r2
from ep2sindy.regression import RandomSplit, Regression
from ep2sindy.search import (
    STLSQ,
    AdaptiveLasso,
    BestSubset,
    Bootstraps,
    Search,
    Supports,
    pooled_supports,
)
from ep2sindy.systems import System, damped_oscillator, lorenz, lotka_volterra, van_der_pol

SYSTEMS = [damped_oscillator(), lotka_volterra(), van_der_pol(), lorenz()]
SEARCHES = [AdaptiveLasso(), STLSQ(), BestSubset()]


def exact_problem(system: System) -> Regression:
    """Rows with the true derivative in place of a numerical one."""
    run = system.trajectory()
    nothing = np.empty((run.n_samples, 0))
    return Regression(
        theta=system.model.library.evaluate(run.states),
        target=system.model.derivative(run.states, nothing),
        library=system.model.library,
        equations=run.state_names,
        groups=np.arange(run.n_samples),
        test=RandomSplit().held_out(run.n_samples, np.random.default_rng(0)),
    )


@pytest.mark.parametrize("search", SEARCHES, ids=lambda s: type(s).__name__)
@pytest.mark.parametrize("system", SYSTEMS, ids=lambda s: s.name)
def test_known_systems_come_back_from_exact_derivatives(system: System, search: Search) -> None:
    problem = exact_problem(system)
    found = pooled_supports(problem, search, Bootstraps(), rng=np.random.default_rng(1))
    for supports in found:
        front = pareto_front(problem, supports)
        truth = system.model.terms(front.equation)
        (hit,) = [c for c in front.candidates if set(c.terms) == set(truth)]
        recovered = dict(zip(hit.terms, hit.coef, strict=True))
        for name, value in truth.items():
            assert recovered[name] == pytest.approx(value, rel=1e-8)
        assert hit.r2_test == pytest.approx(1.0, abs=1e-14)


def front_of(errors: list[float], n_library: int) -> ParetoFront:
    candidates = [
        Candidate(
            equation="x",
            terms=tuple(f"t{i}" for i in range(k)),
            coef=np.ones(k),
            r2_train=1.0 - error,
            r2_test=1.0 - error,
            share=1.0,
            inclusion=np.ones(k),
        )
        for k, error in enumerate(errors)
    ]
    return ParetoFront("x", candidates, n_library)


def test_knee_distance_is_equation_9_of_the_thesis() -> None:
    # Table I: R2 0.63 with two of six terms has d = 0.49 (0.498), 0.69 with three 0.59.
    front = front_of([1.0, 0.9, 0.37, 0.31], 6)
    distances = Knee("library").distances(front)
    assert distances[2:] == pytest.approx([0.498, 0.588], abs=1e-3)
    assert Knee("library").select(front).n_terms == 2


def test_knee_can_be_normalised_by_the_largest_candidate() -> None:
    # Table II: R2 0.92 with two terms has d = 0.41, 0.95 with three 0.60: n_norm is 5.
    front = front_of([1.0, 0.9, 0.08, 0.05, 0.04], 20)
    assert Knee("max_terms").distances(front)[2:4] == pytest.approx([0.41, 0.60], abs=5e-3)
    assert Knee("library").select(front).n_terms == 2


def test_normalisations_disagree_where_a_term_costs_less() -> None:
    front = front_of([1.0, 0.30, 0.10, 0.02], 40)
    assert Knee("library").select(front).n_terms == 3
    assert Knee("max_terms").select(front).n_terms == 1


def test_nothing_is_selected_when_nothing_helps() -> None:
    assert Knee().select(front_of([1.0, 0.999], 2)).terms == ()


def test_unknown_normalisation_is_refused() -> None:
    with pytest.raises(ValueError, match="'library' or 'max_terms': 'libary' came"):
        Knee("libary")


def test_r2_takes_the_data_as_truth() -> None:
    truth = np.array([0.0, 1.0, 2.0, 3.0])
    prediction = np.array([truth, np.full(4, 1.5), np.zeros(4)])
    assert r2(truth=truth, prediction=prediction) == pytest.approx([1.0, 0.0, 1 - 14 / 5])


def test_r2_of_a_constant_is_refused() -> None:
    with pytest.raises(ValueError, match="constant on these rows"):
        r2(truth=np.ones(4), prediction=np.ones((1, 4)))


def test_a_front_scores_on_training_rows_when_none_are_held_out() -> None:
    problem = exact_problem(damped_oscillator())
    object.__setattr__(problem, "test", np.zeros(len(problem.theta), dtype=bool))
    supports = pooled_supports(problem, BestSubset(), Bootstraps(n=0), rng=np.random.default_rng(0))
    front = pareto_front(problem, supports[1])
    assert np.isnan(front.candidates[-1].r2_test)
    assert front.errors[-1] == pytest.approx(0.0, abs=1e-14)


def test_candidate_scores_are_those_of_the_rows() -> None:
    problem = exact_problem(lorenz())
    supports = pooled_supports(
        problem, AdaptiveLasso(), Bootstraps(), rng=np.random.default_rng(1)
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
    problem = Regression(
        theta=theta,
        target=(theta @ truth)[:, None],
        library=named_terms(names, names),
        equations=["y"],
        groups=np.arange(400),
        test=np.zeros(400, dtype=bool),
    )
    every = np.ones((1, 5), dtype=bool)
    supports = Supports("y", every, np.ones(1), np.ones((6, 5)))
    fitted = pareto_front(problem, supports).candidates[-1].coef
    by_qr = np.linalg.lstsq(theta, theta @ truth, rcond=None)[0]
    assert np.abs(fitted - truth).max() < 10 * max(np.abs(by_qr - truth).max(), 1e-9)
