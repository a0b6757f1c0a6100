"""Stability selection: the largest support whose terms most bootstraps include."""

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.regression.front import Candidate, ParetoFront
from ep2sindy.selection.criteria import Stability


def candidate(inclusion: list[float]) -> Candidate:
    """Of x and as many terms as shares of bootstraps, its error falling with every term."""
    n_terms = len(inclusion)
    return Candidate(
        equation="x",
        terms=("1", "x", "v")[:n_terms],
        coef=np.ones(n_terms),
        r2_train=1.0 - 0.1**n_terms,
        r2_test=float("nan"),
        share=0.5,
        inclusion=np.array(inclusion),
    )


@pytest.mark.parametrize(
    ("inclusions", "n_terms"),
    [
        (([0.9], [0.8, 0.7], [0.9, 0.9, 0.6]), 2),
        (([0.6], [0.8, 0.7], [0.9, 0.9, 0.69]), 2),  # a smaller one need not be stable
        (([0.6], [0.8, 0.6], [0.9, 0.9, 0.6]), 0),  # the empty model always is
    ],
)
def test_the_largest_candidate_of_stable_terms_is_selected(
    inclusions: tuple[list[float], ...], n_terms: int
) -> None:
    front = ParetoFront("x", [candidate(list(each)) for each in ((), *inclusions)])
    (scores,) = Stability(threshold=0.7).scores([front])
    assert front.with_scores(scores).best.n_terms == n_terms
    expected = [-len(i) if min(i, default=1.0) >= 0.7 else 1.0 - min(i) for i in ([], *inclusions)]
    assert scores == pytest.approx(expected)


def test_stability_of_one_search_is_refused() -> None:
    method = ep.Regression(ep.Weak(), bootstraps=ep.Bootstraps(n=0), selection=Stability())
    with pytest.raises(ValueError, match="none stands behind a candidate; search with"):
        ep.discover(ep.lotka_volterra().trajectory(), method=method)


def test_a_stability_threshold_of_a_half_or_less_is_refused() -> None:
    with pytest.raises(ValueError, match="threshold must lie in"):
        Stability(threshold=0.5)


def test_stable_terms_of_lorenz_are_found_in_exact_samples() -> None:
    system = ep.lorenz()
    method = ep.Regression(ep.Weak(), ep.BestSubset(), Stability(), ep.Bootstraps(n=32, n_culled=1))
    found = ep.discover(system.trajectory(), system.model.library, method)
    for state in system.model.states:
        assert found.model.terms(state) == pytest.approx(system.model.terms(state), rel=1e-4)
