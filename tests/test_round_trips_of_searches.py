"""Regressions, searches and rules say the same in any unit and order, and of any damaged column."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import ep2sindy as ep
from ep2sindy.regression.bootstraps import Bootstraps, pool_supports
from ep2sindy.regression.front import ParetoFront, pareto_front
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import Search

FEW = settings(max_examples=15, deadline=None, derandomize=True)
SEARCHES = [ep.AdaptiveLasso(), ep.STLSQ(), ep.BestSubset(max_terms=4)]
BIC = ep.EBIC(gamma=0.0, coarsening=None)
RULES = [BIC, ep.EBIC(), ep.Knee(), ep.Knee(scale="log")]
NAMES = ["a", "b", "c", "d", "e"]
SIZES = st.sampled_from([1e-18, 1e-3, 1.0, 7.0, 1e19])
COEF = st.sampled_from([-3.0, -0.5, 0.7, 2.0])


@dataclass(frozen=True)
class Rows:
    """Terms and a target that is a sum of few of them, with noise of a fraction of its size."""

    theta: np.ndarray
    target: np.ndarray
    coef: np.ndarray

    def problem(self, sizes: np.ndarray | float = 1.0, size: float = 1.0) -> RegressionRows:
        """In other units: columns and target times these."""
        return RegressionRows(
            theta=self.theta * sizes,
            target=(self.target * size)[:, None],
            library=ep.named_terms(NAMES, NAMES),
            equations=["a"],
            groups=np.arange(len(self.theta)),
            test=np.arange(len(self.theta)) % 5 == 0,
        )


@st.composite
def rows(draw: st.DrawFn, noise: float = 0.0) -> Rows:
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    theta = rng.normal(size=(60, 5)) + 0.3 * rng.normal(size=(60, 1))
    coef = np.zeros(5)
    used = draw(st.lists(st.integers(0, 4), min_size=1, max_size=3, unique=True))
    coef[used] = [draw(COEF) for _ in used]
    target = theta @ coef
    return Rows(theta, target + noise * target.std() * rng.normal(size=60), coef)


def front_of(problem: RegressionRows, search: Search) -> ParetoFront:
    (found,) = pool_supports(problem, search, Bootstraps(n=0), rng=np.random.default_rng(0))
    return pareto_front(problem, found)


def chosen(problem: RegressionRows, search: Search, rule: Any) -> dict[str, float]:
    front = front_of(problem, search)
    (scores,) = rule.decide([front]).scores
    assert scores.shape == (len(front.candidates),)
    assert not np.isnan(scores).any()
    return front.with_scores(scores).best.coef_by_term


@pytest.mark.parametrize("search", SEARCHES, ids=lambda s: type(s).__name__)
@FEW
@given(rows(), st.lists(SIZES, min_size=5, max_size=5), SIZES)
def test_exact_rows_give_exact_coefficients_in_any_unit(
    search: Search, exact: Rows, sizes: list[float], size: float
) -> None:
    found = [
        c.coef_by_term for c in front_of(exact.problem(np.array(sizes), size), search).candidates
    ]
    true = {NAMES[k]: exact.coef[k] / sizes[k] * size for k in np.flatnonzero(exact.coef)}
    assert any(set(each) == set(true) and each == pytest.approx(true, rel=1e-8) for each in found)


@pytest.mark.parametrize("search", SEARCHES, ids=lambda s: type(s).__name__)
@FEW
@given(rows(noise=0.05), st.sampled_from(RULES), st.lists(SIZES, min_size=5, max_size=5), SIZES)
def test_units_leave_the_choice_of_a_rule(
    search: Search, noisy: Rows, rule: Any, sizes: list[float], size: float
) -> None:
    wanted = chosen(noisy.problem(), search, rule)
    found = chosen(noisy.problem(np.array(sizes), size), search, rule)
    back = {name: c * sizes[NAMES.index(name)] / size for name, c in found.items()}
    assert back == pytest.approx(wanted, rel=1e-8)


@pytest.mark.parametrize("search", SEARCHES, ids=lambda s: type(s).__name__)
@FEW
@given(rows(noise=0.05), st.sampled_from(RULES), st.permutations(range(5)), st.randoms())
def test_the_order_of_rows_and_terms_leaves_the_choice_of_a_rule(
    search: Search, noisy: Rows, rule: Any, order: list[int], chance: Any
) -> None:
    problem = noisy.problem()
    turned = list(range(60))
    chance.shuffle(turned)
    other = RegressionRows(
        theta=problem.theta[turned][:, order],
        target=problem.target[turned],
        library=ep.named_terms(NAMES, [NAMES[k] for k in order]),
        equations=["a"],
        groups=problem.groups[turned],
        test=problem.test[turned],
    )
    assert chosen(other, search, rule) == pytest.approx(chosen(problem, search, rule), rel=1e-8)


@pytest.mark.parametrize("search", SEARCHES, ids=lambda s: type(s).__name__)
@FEW
@given(rows(), st.integers(0, 4), st.sampled_from(["zero", "double", "constant"]))
def test_a_column_that_says_nothing_new_is_in_no_candidate(
    search: Search, exact: Rows, where: int, kind: str
) -> None:
    """Zeros, a multiple of the next column, or one number throughout, next to exact rows."""
    theta = exact.theta.copy()
    theta[:, where] = {"zero": 0.0, "double": 2.0 * theta[:, where - 1], "constant": 4.0}[kind]
    damaged = Rows(theta, theta @ exact.coef, exact.coef)
    assume(np.ptp(damaged.target) > 0.0)  # R2 needs a target that varies
    front = front_of(damaged.problem(), search)
    twins = {NAMES[where], NAMES[where - 1]}
    for candidate in front.candidates:
        assert np.isfinite(candidate.coef).all()
        if kind == "zero":
            assert NAMES[where] not in candidate.terms
        if kind == "double":
            assert not twins <= set(candidate.terms)
    assert max(c.r2_test for c in front.candidates) == pytest.approx(1.0, abs=1e-9)


@FEW
@given(rows(), st.integers(0, 59), st.integers(0, 4), st.sampled_from([np.nan, np.inf]))
def test_a_number_that_is_none_is_named(exact: Rows, row: int, column: int, value: float) -> None:
    theta = exact.theta.copy()
    theta[row, column] = value
    message = f"'{NAMES[column]}' is not on row {row}"
    with pytest.raises(ValueError, match=message):
        Rows(theta, exact.target, exact.coef).problem()
