import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.regression.bootstraps import pool_supports
from ep2sindy.regression.front import Candidate, ParetoFront, pareto_front
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.selection.criteria import Selection, log_supports
from tests.models import plain_rows

BIC, LOG_KNEE = ep.EBIC(gamma=0.0, coarsening=None), ep.Knee(scale="log")
RULES = [ep.Knee(), LOG_KNEE, BIC, ep.EBIC(), ep.EBIC(coarsening=None)]
CRITERIA = [BIC, ep.EBIC(), ep.EBIC(coarsening=None)]


def front_of(errors: list[float], n_library: int) -> ParetoFront:
    """One candidate per size with these errors, on rows that do not matter."""
    candidates = [
        Candidate(
            equation="x",
            terms=tuple(f"t{i}" for i in range(k)),
            coef=np.ones(k),
            r2_train=1.0 - error,
            r2_test=1.0 - error,
            fraction=1.0,
            inclusion=np.ones(k),
        )
        for k, error in enumerate(errors)
    ]
    names = [f"t{i}" for i in range(n_library)]
    rows = plain_rows(np.eye(n_library), np.ones((n_library, 1)), names, ["x"])
    return ParetoFront("x", candidates, rows)


def n_selected(rule: Selection, front: ParetoFront) -> int:
    (scores,) = rule.decide([front]).scores
    return front.with_scores(scores).best.n_terms


def test_knee_distance_is_equation_9_of_the_thesis() -> None:
    # Table I: R2 0.63 with two of six terms has d = 0.49 (0.498), 0.69 with three 0.59.
    front = front_of([1.0, 0.9, 0.37, 0.31], 6)
    (distances,) = ep.Knee("library").decide([front]).scores
    assert distances[2:] == pytest.approx([0.498, 0.588], abs=1e-3)
    assert n_selected(ep.Knee("library"), front) == 2


def test_knee_can_be_normalised_by_the_largest_candidate() -> None:
    # Table II: R2 0.92 with two terms has d = 0.41, 0.95 with three 0.60: n_norm is 5.
    front = front_of([1.0, 0.9, 0.08, 0.05, 0.04], 20)
    (distances,) = ep.Knee("max_terms").decide([front]).scores
    assert distances[2:4] == pytest.approx([0.41, 0.60], abs=5e-3)
    assert n_selected(ep.Knee("library"), front) == 2


def test_normalisations_disagree_where_a_term_costs_less() -> None:
    front = front_of([1.0, 0.30, 0.10, 0.02], 40)
    assert n_selected(ep.Knee("library"), front) == 3
    assert n_selected(ep.Knee("max_terms"), front) == 1


def test_nothing_is_selected_when_nothing_helps() -> None:
    assert n_selected(ep.Knee(), front_of([1.0, 0.999], 2)) == 0


def test_the_log_knee_keeps_a_small_term_of_an_exact_law() -> None:
    # The third term lowers the error by 1 % of the whole, but by a factor of a thousand.
    front = front_of([1.0, 0.5, 0.01, 1e-5, 0.9e-5], 10)
    assert n_selected(ep.Knee(), front) == 2
    assert n_selected(LOG_KNEE, front) == 3
    (scores,) = LOG_KNEE.decide([front]).scores
    height = np.log([1e5, 0.5e5, 1e3, 1.0, 0.9]) - np.log(0.9)
    height[3:] = [np.log(1e-5 / 0.9e-5), 0.0]
    expected = np.hypot(height / np.log(1.0 / 0.9e-5), np.arange(5) / 10)
    assert scores == pytest.approx(expected, rel=1e-12)


def test_of_equal_scores_the_smallest_candidate_is_selected() -> None:
    front = front_of([1.0, 0.5, 0.4], 5)
    assert front.with_scores(np.array([2.0, 1.0, 1.0])).best.n_terms == 1


def noisy_front(n_rows: int = 200, *, seed: int = 0, scale: float = 1.0) -> ParetoFront:
    """A front of two true terms of six, with white noise in the target."""
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=(n_rows, 6))
    target = theta[:, :2] @ [1.5, -0.8] + 0.5 * rng.normal(size=n_rows)
    names = [f"t{i}" for i in range(6)]
    return fronts_from(plain_rows(theta, scale * target[:, None], names, ["x"]))[0]


def fronts_from(problem: RegressionRows) -> list[ParetoFront]:
    rng = np.random.default_rng(0)
    pooled = pool_supports(problem, ep.BestSubset(max_terms=6), ep.Bootstraps(n=0), rng=rng)
    return [pareto_front(problem, supports) for supports in pooled]


def lack_of_fit(front: ParetoFront) -> np.ndarray:
    """n log(RSS / n) of every candidate by plain least squares on unscaled rows."""
    problem, found = front.problem, []
    target = problem.target[:, 0]
    for candidate in front.candidates:
        columns = problem.theta[:, [problem.library.index(t) for t in candidate.terms]]
        residual = target - columns @ np.linalg.lstsq(columns, target, rcond=None)[0]
        found.append(len(target) * np.log(residual @ residual / len(target)))
    return np.array(found)


def test_criteria_are_their_formulas() -> None:
    front = noisy_front(n_rows=60)
    k = front.sizes
    ways = np.array([log_supports(front.problem.library, c.terms) for c in front.candidates])
    for rule, penalty in (
        (BIC, k * np.log(60)),
        (ep.EBIC(gamma=0.5, coarsening=None), k * np.log(60) + ways),
    ):
        (scores,) = rule.decide([front]).scores
        expected = lack_of_fit(front) + penalty
        # Up to a constant, since scores are of scaled targets.
        assert np.diff(scores) == pytest.approx(np.diff(expected), rel=1e-9)


def test_coarsening_counts_fewer_rows() -> None:
    front = noisy_front(n_rows=60)
    n = 60 / (1 + 60 / 40)
    ways = np.array([log_supports(front.problem.library, c.terms) for c in front.candidates])
    (scores,) = ep.EBIC(coarsening=40.0).decide([front]).scores
    expected = n / 60 * lack_of_fit(front) + front.sizes * np.log(n) + 2 * ways
    assert np.diff(scores) == pytest.approx(np.diff(expected), rel=1e-9)


@pytest.mark.parametrize("rule", [BIC, ep.EBIC(), ep.EBIC(coarsening=None)], ids=repr)
def test_criteria_find_two_true_terms_in_white_noise(rule: Selection) -> None:
    found = []
    for seed in range(40):
        front = noisy_front(seed=seed)
        (scores,) = rule.decide([front]).scores
        found.append(front.with_scores(scores).best.terms)
    assert all({"t0", "t1"} <= set(terms) for terms in found)
    # A needless term costs log 200 = 5.3 at the least, and chi-square exceeds that in 2.1 % of
    # cases: for four such terms in 40 fronts 3.4 times, give or take 1.8.
    assert sum(terms != ("t0", "t1") for terms in found) <= 3.4 + 3 * 1.8


@pytest.fixture(scope="module")
def exact_fronts() -> list[ParetoFront]:
    """Of the Lorenz system, with the true derivative in place of a numerical one."""
    system = ep.lorenz()
    run, library = system.trajectory(), system.model.library
    target = system.model.derivative(run.states, np.empty((run.n_samples, 0)))
    return fronts_from(plain_rows(library.evaluate(run.states), target, library, run.state_names))


@pytest.mark.parametrize("rule", CRITERIA, ids=repr)
def test_criteria_keep_no_term_that_explains_rounding(
    rule: Selection, exact_fronts: list[ParetoFront]
) -> None:
    truth = ep.lorenz().model
    for front, scores in zip(exact_fronts, rule.decide(exact_fronts).scores, strict=True):
        assert set(front.with_scores(scores).best.terms) == set(truth.terms(front.equation))


@pytest.mark.parametrize("rule", RULES, ids=repr)
def test_every_front_has_its_own_scores(rule: Selection) -> None:
    fronts = [noisy_front(seed=seed) for seed in range(2)]
    both = rule.decide(fronts).scores
    for front, scores in zip(fronts, both, strict=True):
        assert np.array_equal(scores, rule.decide([front]).scores[0])
        assert len(scores) == len(front.candidates)


def test_supports_are_counted_among_terms_of_no_higher_degree() -> None:
    library = ep.polynomial(["x", "y"], degree=3)  # 1, 3, 6 and 10 terms up to degrees 0 to 3
    assert log_supports(library, []) == 0.0
    assert log_supports(library, ["1"]) == 0.0
    assert log_supports(library, ["x"]) == pytest.approx(np.log(3))
    assert log_supports(library, ["x", "x*y"]) == pytest.approx(np.log(15))
    assert log_supports(library, ["x", "y", "x^2*y"]) == pytest.approx(np.log(120))


@pytest.mark.parametrize(
    ("rule", "setting", "message"),
    [
        (ep.EBIC, {"gamma": -1.0}, "gamma must be zero or more, got -1.0"),
        (ep.Knee, {"n_norm": "libary"}, "'library' or 'max_terms', got 'libary'"),
    ],
)
def test_impossible_settings_are_refused(rule: type, setting: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rule(**setting)
