"""Laws under relations: exact in every fit, weighted and pooled, at points fitted and not."""

from functools import cache

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.library.facts import Known
from ep2sindy.operating.law import LawConstraint, constrain_law
from ep2sindy.operating.point_fits import PointFits, fit_rows, fit_trajectories
from ep2sindy.operating.records import OperatingRecord
from tests.test_operating_law import GRID, LIBRARY, LINEAR, SHORT, STATES, STRUCTURE

# What leaves x enters y, and the growth of x is known; its square is beyond a law of degree one.
RELATIONS = ["x: y == -1 * y: x"]
KNOWN = {"x": {"x": {"1": 0.7, "a^2": 0.2}}}
EXACT = ("x: y == -1 * y: x", "x: x == 0.7 + 0.2 * a^2")
BETWEEN = {"a": 0.8, "b": 0.3}


def model_at(a: float, b: float) -> ep.SparseModel:
    turn = 1.0 + 0.2 * a + 0.1 * b
    terms = [{"x": 0.7 + 0.2 * a**2, "y": -turn, "x^3": -0.4 + 0.1 * b}, {"x": turn}]
    return ep.SparseModel(LIBRARY, STATES, ep.model.coef_matrix(LIBRARY, terms))


@cache
def records() -> tuple[OperatingRecord, ...]:
    t = np.arange(0.0, 50.0, 0.1)
    rng = np.random.default_rng(0)
    found = []
    for point in GRID:
        states = model_at(**point).simulate(np.append(0.0, 40.0 + t), [1.0, 0.0]).states[1:]
        # A little noise: relations hold where the data do not obey them by themselves.
        states = states + 1e-3 * rng.normal(size=states.shape)
        run = ep.Trajectory(t, states, STATES, parameters=point)
        found.append(OperatingRecord(run))
    return tuple(found)


def held(relations: list[str] = RELATIONS, known: Known = KNOWN) -> LawConstraint:
    return constrain_law(LIBRARY.relate(*relations).known(known), STRUCTURE, parameters=["a", "b"])


@cache
def fits() -> dict[str, PointFits]:
    """By rows, and refined."""
    weak, runs = ep.Weak(split=ep.regression.RandomSplit(0.0)), [[r.run] for r in records()]
    rows = [weak.assemble(own, LIBRARY, rng=np.random.default_rng(0)) for own in runs]
    points = np.array([list(point.values()) for point in GRID])
    alone = fit_rows(["a", "b"], points, rows, held(), provenance={})
    return {"rows": alone, "trajectories": fit_trajectories([alone], runs, SHORT)[0]}


@cache
def law(how: str) -> ep.operating.OperatingLaw:
    return fits()[how].law(LINEAR)


BOTH = pytest.mark.parametrize("how", ["rows", "trajectories"])


def check_exact(model: ep.SparseModel, a: float) -> None:
    assert model.terms("x")["y"] == -model.terms("y")["x"]
    assert model.terms("x")["x"] == pytest.approx(0.7 + 0.2 * a**2, rel=1e-15)


@BOTH
def test_relations_and_known_values_are_exact_in_every_fit_and_law(how: str) -> None:
    fit = fits()[how]
    for record, model in zip(records(), fit.models, strict=True):
        check_exact(model, record.parameters["a"])
    assert fit.n_free == 2
    assert fit.information.shape == (9, 2, 2)
    for point in [*GRID, BETWEEN, {"a": 3.0, "b": -1.0}]:
        check_exact(law(how).at(extrapolate=True, **point), point["a"])


@BOTH
def test_the_law_under_relations_is_the_true_one(how: str) -> None:
    own = law(how)
    assert own.coefficients == (("x", "x"), ("x", "y"), ("x", "x^3"), ("y", "x"))
    assert list(own.functions.names) == ["1", "a", "b", "a^2"]
    truth = [[0.7, 0, 0, 0.2], [-1, -0.2, -0.1, 0], [-0.4, 0, 0.1, 0], [1, 0.2, 0.1, 0]]
    # Noise of a thousandth, on 9 records of some hundred samples in windows.
    np.testing.assert_allclose(own.coef, truth, atol=2e-3)
    np.testing.assert_array_equal(own.coef[0], truth[0])
    np.testing.assert_array_equal(own.coef[1], -own.coef[3])
    assert own.provenance["exact"] == "; ".join(EXACT)
    assert own.left_out.max() < 5e-3


def test_a_known_number_has_no_interval_and_a_shared_one_has_the_same_twice() -> None:
    bounds = law("rows").intervals()
    assert bounds["x", "x"] == {"1": (0.7, 0.7), "a": (0, 0), "b": (0, 0), "a^2": (0.2, 0.2)}
    low, high = bounds["x", "y"]["a"]
    assert low < high
    assert bounds["y", "x"]["a"] == pytest.approx((-high, -low))
    model = law("rows").at(**BETWEEN)
    low, high = model.intervals("x")["x"]
    assert low == high == model.terms("x")["x"]


@pytest.mark.parametrize(
    ("relations", "known", "message"),
    [
        (["x: y == -1 * y: y"], {}, "'y' is not in the support of 'y'"),
        (["x: x == 1"], KNOWN, r"relation 'x: x == 0.7 \+ 0.2 \* a\^2' contradicts"),
        (["x: x == 1", "x: x^3 == -1", "y: x == 1", "x: y == -1"], {}, "a law needs a free"),
    ],
)
def test_relations_that_cannot_hold_are_refused(
    relations: list[str], known: Known, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        held(relations, known).at(np.array([list(point.values()) for point in GRID]))
