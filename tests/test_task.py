"""What a method is asked: records that agree, a library, and what is known of the equations."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.data.coerce import Task
from ep2sindy.library.relations import parse_relation

PREY = ep.lotka_volterra()
RUN = PREY.trajectory(noise=0.02, rng=0).window(0, 200)
OTHER = PREY.trajectory(noise=0.02, initial=np.array([0.3, 1.2]), rng=1).window(0, 200)
LIBRARY = ep.polynomial(["x", "y"], degree=2)
METHODS = pytest.mark.parametrize(
    "method", [ep.TrajectorySearch(), ep.Regression()], ids=["trajectories", "rows"]
)

WRONG = {
    "units": (
        replace(OTHER, units={"x": "m^-3"}),
        r"units must agree: 'x' is in 1 in trajectory 0 and in m\^-3 in trajectory 1; convert",
    ),
    "order": (
        replace(OTHER, states=OTHER.states[:, ::-1], state_names=["y", "x"]),
        r"trajectory 1 has states \['y', 'x'\] and inputs \[\]; give all of them the same states",
    ),
    "fewer": (
        ep.Trajectory(OTHER.t, OTHER.states[:, :1], ["x"]),
        r"trajectory 1 has states \['x'\] and inputs \[\]; give all of them the same states",
    ),
    "more": (
        ep.Trajectory(OTHER.t, np.column_stack([OTHER.states, np.sin(OTHER.t)]), ["x", "y", "z"]),
        r"trajectory 1 has states \['x', 'y', 'z'\] and inputs \[\]; give all of them",
    ),
    "repeated": (RUN, "every sample must come once: 200 samples in a row stand in"),
}


@METHODS
@pytest.mark.parametrize("wrong", WRONG)
def test_runs_that_do_not_agree_are_refused_by_every_method(method, wrong: str) -> None:
    other, message = WRONG[wrong]
    with pytest.raises(ValueError, match=message):
        ep.discover([RUN, other], LIBRARY, method)


@pytest.mark.parametrize("wrong", WRONG)
def test_runs_that_do_not_agree_are_not_estimated(wrong: str) -> None:
    other, message = WRONG[wrong]
    with pytest.raises(ValueError, match=message):
        ep.estimate([RUN, other], LIBRARY)


ASKED = [
    ({"terms": {"z": ["x"]}}, r"unknown state 'z'; there are \['x', 'y'\]"),
    ({"terms": {"z": []}}, r"unknown state 'z'; there are \['x', 'y'\]"),
    ({"terms": {"x": []}}, r"an equation whose terms are given must have some: \['x'\]"),
    ({"terms": {"x": ["x^3"]}}, "unknown term 'x\\^3'; this library has"),
    ({"relations": ["z: x == 1"]}, r"unknown state 'z'; there are \['x', 'y'\]"),
    ({"relations": ["x: w == 1"]}, "unknown variable 'w'"),
    ({"runs": []}, "needs at least one run: an empty list came"),
    ({"library": ep.polynomial(["x", "u"], degree=1)}, r"the library needs \['u'\]: sample it as"),
]


@pytest.mark.parametrize(("asked", "message"), ASKED)
def test_what_cannot_be_asked_is_not_estimated(asked: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ep.estimate(**({"runs": [RUN], "library": LIBRARY} | asked))


def test_an_estimate_takes_runs_and_relations_as_discover_does() -> None:
    whole = ep.estimate([RUN], LIBRARY, relations=["x: x*y == -1 * y: x*y"])
    terms = whole.model.terms("x"), whole.model.terms("y")
    assert terms[0]["x*y"] == pytest.approx(-terms[1]["x*y"], rel=1e-12)
    alone = ep.estimate(RUN, LIBRARY, relations=["x: x*y == -1 * y: x*y"])
    assert np.array_equal(alone.model.coef, whole.model.coef)


def test_a_task_keeps_its_values_and_takes_a_tuple_of_runs() -> None:
    terms = {"x": ["x", "x*y"]}
    task = Task([RUN, OTHER], LIBRARY, [parse_relation("y: y == 1")], terms)
    terms["x"].append("y")
    assert task.states == ("x", "y")
    assert task.terms == {"x": ("x", "x*y")}
    assert [each.text for each in task.relations] == ["y: y == 1"]
    assert replace(task, relations=()).runs == task.runs == (RUN, OTHER)
    with pytest.raises(TypeError):
        task.terms["y"] = ["y"]
