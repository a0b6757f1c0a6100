"""Where laws say that a cycle begins, and which structure they are told to have."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.model.fixed_point import rest_point
from ep2sindy.operating.branch import (
    BranchSettings,
    StructureCase,
    StructureTrial,
    candidate_structures,
    choose,
    try_structures,
)
from ep2sindy.operating.map import Fate, law_map
from tests.models import model_of
from tests.test_operating_law import LIBRARY, SHORT, STATES, STRUCTURE, recorded, records
from tests.test_stability import HOPF

ONES = np.ones(2)
HOW = BranchSettings(LIBRARY, (), 3, degrees=[1, 2], settings=SHORT, n_map=3, seed=0)


@cache
def line() -> tuple[ep.operating.OperatingRecord, ...]:
    """Records of the known family along one parameter."""
    values = (0.5, 0.75, 1.0, 1.25, 1.5)
    return tuple(replace(recorded(a, 0.0), parameters={"a": a}) for a in values)


@cache
def tries() -> list[StructureTrial]:
    """Three structures, the true one first."""
    structures = [STRUCTURE, {**STRUCTURE, "y": ["x", "y"]}, {**STRUCTURE, "x": ["x", "y"]}]
    cases = [StructureCase(LIBRARY, structure) for structure in structures]
    return try_structures(line(), cases, HOW)


def hopf() -> ep.operating.OperatingLaw:
    """r' = r (a - r^2), phase' = 1: a cycle of radius sqrt(a) and period 2 pi where a > 0."""
    pairs = tuple((state, term) for state, terms in HOPF.items() for term in terms)
    coef = np.array([[0.0, 1.0] if s == t else [HOPF[s][t], 0.0] for s, t in pairs])
    return ep.operating.OperatingLaw(
        functions=ep.polynomial(["a"], degree=1),
        library=model_of(HOPF).library,
        states=("x", "y"),
        coefficients=pairs,
        coef=coef,
        points=np.array([[0.5], [1.5]]),
    )


def test_a_cycle_begins_where_the_fixed_point_turns_unstable() -> None:
    near = replace(recorded(1.0, 0.0), parameters={"a": 1.0})
    found = law_map(hopf(), [near], [{"a": a} for a in (-0.5, -0.1, 0.1, 1.0)])
    assert [p.fate for p in found] == [Fate.RESTS, Fate.RESTS, Fate.OSCILLATES, Fate.OSCILLATES]
    np.testing.assert_allclose([p.growth_per_s for p in found], [-0.5, -0.1, 0.1, 1.0], atol=1e-6)
    assert [p.inside for p in found] == [False, False, False, True]
    for point in found[2:]:
        assert point.frequency_Hz == pytest.approx(0.5 / np.pi, rel=1e-6)
        # A departure along the radius decays by exp(-2 a t).
        expected = np.exp(-4.0 * np.pi * point.parameters["a"])
        assert point.second == pytest.approx(expected, rel=1e-3, abs=1e-6)
    assert np.isnan(found[0].frequency_Hz)


def test_a_start_where_a_state_passes_through_zero_ends_no_run() -> None:
    near = replace(recorded(1.0, 0.0), parameters={"a": 1.0})
    states = near.run.states.copy()
    states[near.slowest] = [1.0, 1e-9]
    near = replace(near, trajectory=replace(near.run, states=states))
    (found,) = law_map(hopf(), [near], [{"a": 1.0}])
    assert found.fate is Fate.OSCILLATES


def test_a_model_that_runs_away_has_no_cycle() -> None:
    wild = replace(hopf(), coef=np.abs(hopf().coef))
    near = replace(recorded(1.0, 0.0), parameters={"a": 1.0})
    (found,) = law_map(wild, [near], [{"a": 1.0}])
    assert found.fate is Fate.DIVERGES
    assert np.isnan(found.relative_amplitude)


def test_fixed_points_and_their_eigenvalues_are_exact() -> None:
    model = model_of({"x": {"x": 2.0, "x*y": -1.0}, "y": {"x*y": 1.0, "y": -3.0}})
    rest = rest_point(model, np.array([2.5, 2.5]), ONES, ONES > 0.0)
    assert rest is not None
    np.testing.assert_allclose(rest.state, [3.0, 2.0], rtol=1e-8)
    assert rest.growth_per_s == pytest.approx(0.0, abs=1e-8)
    assert 2.0 * np.pi * rest.frequency_Hz == pytest.approx(6**0.5, abs=1e-8)
    drift = model_of({"x": {"1": 1.0}, "y": {"1": 1.0}})
    assert rest_point(drift, ONES, ONES, ONES > 0.0) is None


def test_the_structure_and_degree_of_a_known_family_are_chosen() -> None:
    # Five points bear three functions; every structure has both degrees.
    assert [each.degree for each in tries()] == [1, 2] * 3
    best = choose(tries())
    assert best.fit.structure == STRUCTURE
    assert (best.degree, best.n_numbers) == (1, 8)
    assert best.errors.max() < 1.0


def test_candidates_are_the_best_supports_of_every_size() -> None:
    found = candidate_structures(records(), ep.polynomial(STATES, degree=3), max_terms=3)
    assert len(found) == 4
    assert {len(each.structure["x"]) for each in found} == {2, 3}
    assert any(set(each.structure["x"]) == {"x", "y", "x^3"} for each in found)


def test_too_few_points_for_every_degree_are_refused() -> None:
    few = [records()[k] for k in (0, 1, 4)]
    with pytest.raises(ValueError, match="3 operating points suffice for no law of degree 1"):
        try_structures(few, [StructureCase(LIBRARY, STRUCTURE)], HOW)


def test_relations_that_hold_save_numbers_and_others_cost_error() -> None:
    known = {"x": {"x": {"1": 0.8, "a": 0.3}}}
    held = StructureCase(LIBRARY, STRUCTURE, ["x: y == -1"], known, "held")
    wrong = StructureCase(LIBRARY, STRUCTURE, ["x: y == -1 * y: x"], name="wrong")
    found = try_structures(line(), [held, wrong], replace(HOW, degrees=[1]))
    assert [trial.n_numbers for trial in found] == [4, 6]
    assert found[0].errors.mean() < found[1].errors.mean()
    assert choose([*tries(), *found]).case.name == "held"


def test_of_equals_the_one_of_fewest_numbers_is_chosen() -> None:
    first, second = tries()[:2]
    assert choose([replace(first, fit=second.fit, degree=2), first]).degree == 1
