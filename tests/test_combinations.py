"""Combinations of candidates: the most promising first, within bounded memory."""

from dataclasses import replace
from itertools import islice, product

import numpy as np
import pytest

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.discovery.method import Regression
from ep2sindy.library.library import polynomial
from ep2sindy.library.relations import relations_of
from ep2sindy.regression.formulations import Weak, WeightedWeak
from ep2sindy.regression.front import Candidate, ParetoFront
from ep2sindy.regression.searches import BestSubset
from ep2sindy.selection.criteria import best_first, combinations, describe_left_out, support_of
from ep2sindy.systems.systems import lorenz


def front(state: str, deviances: list[float]) -> ParetoFront:
    """Front of an empty candidate, then one for each of the terms a, b, c, ..."""
    candidates = []
    for term, deviance in zip(["", *"abcdefg"], deviances, strict=False):
        one = np.ones(len(term))
        candidates.append(Candidate(state, tuple(term), one, 0.0, 0.0, 0.0, one, deviance))
    return ParetoFront(state, candidates)


@pytest.mark.parametrize("seed", range(3))
def test_choices_come_by_their_summed_cost_and_none_twice(seed: int) -> None:
    rng = np.random.default_rng(seed)
    costs = [np.sort(rng.integers(0, 4, size=n).astype(float)) for n in (3, 1, 4, 2)]
    every = list(product(*(range(len(row)) for row in costs)))
    every.sort(key=lambda c: (sum(row[k] for row, k in zip(costs, c, strict=True)), c))
    assert list(best_first(costs)) == every


def test_the_first_of_eight_to_the_twelfth_choices_need_no_others() -> None:
    costs = [np.arange(8.0)] * 12
    found = list(islice(best_first(costs), 14))
    assert found[0] == (0,) * 12
    assert sorted(map(sum, found)) == [0] + [1] * 12 + [2]
    fronts = [front(f"s{k}", [float(n) for n in range(8)]) for k in range(12)]
    places = combinations(fronts, 13)
    assert places.sum() == 12
    note = "; the 13 most promising of 68719476736 combinations were tried"
    assert describe_left_out(fronts, 13, 13) == note


def test_below_the_cap_every_combination_is_there_in_order() -> None:
    fronts = [front("x", [3.0, 0.0]), front("y", [0.0, 1.0, 2.0])]
    expected = [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [1, 2]]
    assert combinations(fronts, 6).tolist() == expected
    assert not describe_left_out(fronts, 6, 6)


def test_a_cap_keeps_the_best_by_deviance() -> None:
    fronts = [front("x", [3.0, 0.0]), front("y", [5.0, 1.0, 2.0])]
    assert combinations(fronts, 3).tolist() == [[0, 1], [1, 1], [1, 2]]


@pytest.mark.parametrize("formulation", [WeightedWeak(), Weak()], ids=["all fitted", "held out"])
def test_a_cap_keeps_the_true_terms_after_a_regression(formulation: Weak | WeightedWeak) -> None:
    """R2 would rank the largest supports first if no rows are held out, and NaN the smallest."""
    system = lorenz()
    run = system.trajectory(noise=0.02, rng=0).window(0, 1000)
    search = BestSubset(max_terms=5, n_best=3)
    method = Regression(formulation, search, depth=3)
    task = DiscoveryProblem([run], polynomial(run.state_names, degree=2))
    fronts = [each.front for each in method.search_equations(task, rng=0)]
    assert all(front.held_out == isinstance(formulation, Weak) for front in fronts)
    (first,) = combinations(fronts, 1)
    found = support_of(fronts, first)
    assert found == {state: tuple(system.model.terms(state)) for state in run.state_names}


def test_without_rows_the_best_by_r2_come_first() -> None:
    scores = [(0.1, np.nan), (0.8, np.nan), (0.9, 0.2)]
    ranked = [
        replace(candidate, deviance=None, r2_train=train, r2_test=test)
        for candidate, (train, test) in zip(front("x", [0.0] * 3).candidates, scores, strict=True)
    ]
    assert combinations([ParetoFront("x", ranked)], 1).tolist() == [[1]]


def test_relations_hold_in_every_combination_that_a_cap_leaves() -> None:
    fronts = [front("x", [0.0, 1.0, 2.0]), front("y", [0.0, 1.0, 2.0])]
    coupled = relations_of(["x: b == -1 * y: b"])
    assert combinations(fronts, 2, coupled).tolist() == [[0, 0], [0, 1]]
    known = relations_of(["x: b == -1 * y: b", "y: b == 3"])
    assert combinations(fronts, 1, known).tolist() == [[2, 2]]
    with pytest.raises(ValueError, match="name terms that no combination of candidates has"):
        combinations(fronts, 1, relations_of(["x: h == 1"]))
