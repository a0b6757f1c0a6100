"""Elimination on trajectories: terms that are not there go, and relations hold on the way."""

import numpy as np
import pytest

import ep2sindy as ep
from benchmarks.many_states import cases, record
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel
from ep2sindy.systems.systems import lotka_volterra

PREY = lotka_volterra()
LIBRARY = polynomial(["x", "y"], degree=2)
SETTINGS = ep.RefinementSettings(n_windows=10)


def widened(truth: SparseModel, n_spurious: int, rng: np.random.Generator) -> SparseModel:
    """The truth, off by up to 10 %, with spurious quadratic terms of small coefficients."""
    names = dict.fromkeys([*truth.library.names, *polynomial(truth.states, degree=2).names])
    library = ep.named_terms(truth.states, list(names))
    coef = ep.coef_matrix(library, [truth.terms(state) for state in truth.states])
    coef *= 1.0 + 0.1 * rng.uniform(-1.0, 1.0, coef.shape)
    for column in coef.T:
        column[rng.choice(np.flatnonzero(column == 0.0), n_spurious, replace=False)] = 0.02
    return SparseModel(library, truth.states, coef)


def support(model: SparseModel) -> dict[str, set[str]]:
    return {state: set(model.terms(state)) for state in model.states}


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_spurious_terms_go_and_the_truth_is_recommended(noise: float) -> None:
    runs = [PREY.trajectory(noise=noise, rng=0)]
    model = widened(PREY.model, 2, np.random.default_rng(1))
    found = ep.eliminate(model, runs, SETTINGS, min_free=2, seed=0)
    assert support(found.model) == support(PREY.model)
    assert found.best == 4
    assert [np.count_nonzero(r.model.coef) for r in found.refinements] == [8, 7, 6, 5, 4, 3, 2]
    assert all(len(terms) == 1 for terms in found.dropped)
    assert found.refinement.status == "converged"


def test_eighteen_terms_of_four_states_come_down_to_the_truth() -> None:
    case = cases()[0]
    run = record(case)
    fitted, later = run.window(0, 700), run.window(700, run.n_samples)
    model = widened(case.truth, 2, np.random.default_rng(1))
    found = ep.eliminate(model, [fitted], SETTINGS, min_free=9, run_over=later, seed=0)
    assert len(found.verdicts) == len(found.refinements) == len(found.scores)
    assert support(found.model) == support(case.truth)
    assert found.verdicts[found.best] == "alike"  # two frequencies: no cycle
    assert f"-> {np.count_nonzero(case.truth.coef):3d} terms" in repr(found)


def test_relations_hold_on_the_way_and_bound_terms_go_together() -> None:
    truth = PREY.model
    terms = {s: [*truth.terms(s)] for s in truth.states}
    both = {"x": [*terms["x"], "x^2"], "y": [*terms["y"], "x^2"]}
    equations = [{**truth.terms("x"), "x^2": 0.02}, {**truth.terms("y"), "x^2": -0.02}]
    model = SparseModel(LIBRARY, truth.states, ep.coef_matrix(LIBRARY, equations))
    known = truth.terms("x")[terms["x"][0]]
    relations = ep.constraint(
        LIBRARY, both, ["x: x^2 == -1 * y: x^2", f"x: {terms['x'][0]} == {known}"]
    )
    settings = ep.RefinementSettings(n_windows=10, constraint=relations)
    runs = [PREY.trajectory(noise=0.02, rng=0)]
    found = ep.eliminate(model, runs, settings, min_free=3, seed=0)
    assert found.dropped == ((("x", "x^2"), ("y", "x^2")),)
    assert found.best == 1
    for each in found.refinements:
        assert each.model.terms("x")[terms["x"][0]] == known
    first = found.refinements[0].model
    assert first.terms("x")["x^2"] == pytest.approx(-first.terms("y")["x^2"], rel=1e-12)
    assert support(found.model) == support(truth)


def test_the_path_ends_where_a_state_would_lose_its_last_term() -> None:
    t = np.linspace(0.0, 3.0, 200)
    states = np.column_stack([np.exp(-t), np.exp(-2.0 * t)])
    states += 1e-3 * np.random.default_rng(0).normal(size=states.shape)
    run = Trajectory(t, states, ["x", "y"])
    coef = ep.coef_matrix(LIBRARY, [{"x": -1.0}, {"y": -2.0}])
    model = SparseModel(LIBRARY, ["x", "y"], coef)
    found = ep.eliminate(model, [run], SETTINGS, seed=0)
    assert len(found.refinements) == 1
    with pytest.raises(ValueError, match="min_free must be a whole number, one or more: 0 came"):
        ep.eliminate(model, [run], min_free=0, seed=0)
