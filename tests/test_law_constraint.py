"""Laws under relations: exact in every fit, weighted and pooled, at points fitted and not."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.operating.fit import SETTINGS, OperatingFit, leave_one_out, operating_fit
from ep2sindy.operating.law import Known, constrain_law
from tests.test_operating_law import GRID, LIBRARY, SHORT, STATES, STRUCTURE

# What leaves x enters y, and the growth of x is known; its square is beyond a law of degree one.
RELATIONS = ["x: y == -1 * y: x"]
KNOWN = {"x": {"x": {"1": 0.7, "a^2": 0.2}}}
EXACT = ("x: y == -1 * y: x", "x: x == 0.7 + 0.2 * a^2")
BETWEEN = {"a": 0.8, "b": 0.3}


def model_at(a: float, b: float) -> ep.SparseModel:
    turn = 1.0 + 0.2 * a + 0.1 * b
    terms = [{"x": 0.7 + 0.2 * a**2, "y": -turn, "x^3": -0.4 + 0.1 * b}, {"x": turn}]
    return ep.SparseModel(LIBRARY, STATES, ep.coef_matrix(LIBRARY, terms))


@cache
def records() -> tuple[ep.operating.OperatingRecord, ...]:
    t = np.arange(0.0, 50.0, 0.1)
    rng = np.random.default_rng(0)
    found = []
    for point in GRID:
        states = model_at(**point).simulate(np.append(0.0, 40.0 + t), [1.0, 0.0]).states[1:]
        # A little noise: relations hold where the data do not obey them by themselves.
        states = states + 1e-3 * rng.normal(size=states.shape)
        found.append(ep.operating.OperatingRecord.of(point, ep.Trajectory(t, states, STATES)))
    return tuple(found)


@cache
def fit() -> OperatingFit:
    return operating_fit(
        records(), LIBRARY, STRUCTURE, relations=RELATIONS, known=KNOWN,
        settings=SHORT,
    )  # fmt: skip


@cache
def pooled() -> ep.operating.OperatingLaw:
    return fit().refine_law(fit().functions(1))[0]


def laws() -> list[ep.operating.OperatingLaw]:
    return [fit().fit_law(fit().functions(1)), pooled()]


def check_exact(model: ep.SparseModel, a: float) -> None:
    assert model.terms("x")["y"] == -model.terms("y")["x"]
    assert model.terms("x")["x"] == pytest.approx(0.7 + 0.2 * a**2, rel=1e-15)


def test_relations_and_known_values_are_exact_in_every_fit() -> None:
    for record, each in zip(records(), fit().fits, strict=True):
        check_exact(each.model, record.parameters["a"])
    assert fit().n_free == 2
    assert fit().coefficients.shape == (9, 2)
    assert fit().information.shape == (9, 2, 2)


def test_relations_and_known_values_are_exact_in_laws_at_every_point() -> None:
    for law in laws():
        for point in [*GRID, BETWEEN, {"a": 3.0, "b": -1.0}]:
            check_exact(law.model_at(point, extrapolate=True), point["a"])
    _, refinement = fit().refine_law(fit().functions(1))
    for record, model in zip(records(), refinement.models, strict=True):
        check_exact(model, record.parameters["a"])


def test_the_law_under_relations_is_the_true_one() -> None:
    for law in laws():
        assert law.coefficients == (("x", "x"), ("x", "y"), ("x", "x^3"), ("y", "x"))
        assert list(law.functions.names) == ["1", "a", "b", "a^2"]
        truth = [[0.7, 0, 0, 0.2], [-1, -0.2, -0.1, 0], [-0.4, 0, 0.1, 0], [1, 0.2, 0.1, 0]]
        # Noise of a thousandth, on 9 records of some hundred samples in windows.
        np.testing.assert_allclose(law.coef, truth, atol=2e-3)
        np.testing.assert_array_equal(law.coef[0], truth[0])
        np.testing.assert_array_equal(law.coef[1], -law.coef[3])


def test_a_known_number_has_no_interval_and_a_shared_one_has_the_same_twice() -> None:
    bounds = pooled().intervals()
    assert bounds["x", "x"] == {"1": (0.7, 0.7), "a": (0, 0), "b": (0, 0), "a^2": (0.2, 0.2)}
    low, high = bounds["x", "y"]["a"]
    assert low < high
    assert bounds["y", "x"]["a"] == pytest.approx((-high, -low))
    model = pooled().model_at(BETWEEN)
    low, high = model.intervals("x")["x"]
    assert low == high == model.terms("x")["x"]


def test_points_left_out_live_by_laws_under_relations() -> None:
    functions = fit().functions(1)
    for found in (leave_one_out(fit(), functions), leave_one_out(fit(), functions, start=pooled())):
        assert [each.run.verdict for each in found] == [ep.Verdict.LIVES] * 9


def test_a_file_and_the_text_hold_the_relations() -> None:
    again = ep.operating.OperatingLaw.from_json(pooled().to_json())
    np.testing.assert_array_equal(again.coef, pooled().coef)
    assert again.provenance["exact"] == "; ".join(EXACT)
    lines = pooled().text().splitlines()
    assert lines[0] == "x: x = 0.7 + 0.2 a^2"
    assert tuple(lines[4:]) == tuple(f"exact: {text}" for text in EXACT)
    check_exact(again.model_at(BETWEEN), BETWEEN["a"])


def test_without_known_values_relations_are_the_same_everywhere() -> None:
    alone = operating_fit(
        records(), LIBRARY, STRUCTURE, relations=[*RELATIONS, "x: x^3 == -0.3"],
        settings=SHORT,
    )  # fmt: skip
    assert alone.n_free == 2
    law = alone.fit_law(alone.functions(1))
    assert law.coefficients[2] == ("x", "x^3")
    assert law.coef[2].tolist() == [-0.3, 0.0, 0.0]


@pytest.mark.parametrize(
    ("relations", "known", "message"),
    [
        (["x: y == -1 * y: y"], {}, "'y' is not in the support of 'y'"),
        (["x: x == 1"], KNOWN, r"relation 'x: x == 0.7 \+ 0.2 \* a\^2' contradicts"),
        ([], {"x": {"x": {"c": 1.0}}}, r"x: x must be a sum of functions of \['a', 'b'\]"),
        (["x: x == 1", "x: x^3 == -1", "y: x == 1", "x: y == -1"], {}, "a law needs a free"),
        ([], {"x": {"x": {"b": 1.0}}}, r"must be finite and not zero.* \[0.0\] came at .*'b': 0"),
    ],
)
def test_relations_that_cannot_hold_are_refused(
    relations: list[str], known: Known, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        operating_fit(records(), LIBRARY, STRUCTURE, relations=relations, known=known)


def test_constraints_of_the_points_of_a_law_must_be_alike() -> None:
    held = constrain_law(LIBRARY, STRUCTURE, RELATIONS, KNOWN, parameters=["a", "b"])
    own = held.at(np.array([[0.5, 0.0], [1.0, 0.0], [1.5, 0.0]]))
    assert [each.d[0] for each in own] == pytest.approx([0.75, 0.9, 1.15])
    models = [model_at(a, 0.0) for a in (0.5, 1.0, 1.5)]
    runs = [[record.run] for record in records()[::3]]
    basis = np.ones((3, 1))
    other = [*own[:2], ep.constraint(LIBRARY, STRUCTURE)]
    for wrong, message in ((own[:2], "one entry per model.* 2 came for 3"), (other, "not alike")):
        with pytest.raises(ValueError, match=message):
            ep.refinement.refine_law(models, runs, basis, constraints=wrong, seed=0)
    settings = replace(SETTINGS, constraint=own[0])
    with pytest.raises(ValueError, match="beside a common one"):
        ep.refinement.refine_law(models, runs, basis, settings, constraints=own, seed=0)
