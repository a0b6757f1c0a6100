"""What a method is asked: records that agree, a library, and what is known of the equations."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.discovery.result import DiscoveryMethod
from ep2sindy.runtime.values import check_kind

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
    "repeated": (RUN, "every sample must come once: 200 samples in a row stand in"),
}


@METHODS
@pytest.mark.parametrize("wrong", WRONG)
def test_runs_that_do_not_agree_are_refused_by_every_method(method, wrong: str) -> None:
    other, message = WRONG[wrong]
    with pytest.raises(ValueError, match=message):
        ep.discover([RUN, other], LIBRARY, method)


ASKED = [
    ({"library": LIBRARY.only({"z": ["x"]})}, r"unknown state 'z'; there are \['x', 'y'\]"),
    ({"library": ep.polynomial(["x", "u"], degree=1)}, r"the library needs \['u'\]: sample it as"),
]


@pytest.mark.parametrize(("asked", "message"), ASKED)
def test_what_cannot_be_asked_is_not_estimated(asked: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        ep.estimate(**({"runs": [RUN], "library": LIBRARY} | asked))


def test_an_estimate_takes_runs_and_relations_as_discover_does() -> None:
    whole = ep.estimate([RUN], LIBRARY.relate("x: x*y == -1 * y: x*y"))
    terms = whole.model.terms("x"), whole.model.terms("y")
    assert terms[0]["x*y"] == pytest.approx(-terms[1]["x*y"], rel=1e-12)
    alone = ep.estimate(RUN, LIBRARY.relate("x: x*y == -1 * y: x*y"))
    assert np.array_equal(alone.model.coef, whole.model.coef)


def test_a_task_keeps_its_values_and_takes_a_tuple_of_runs() -> None:
    terms = {"x": ["x", "x*y"]}
    task = DiscoveryProblem([RUN, OTHER], LIBRARY.relate("y: y == 1").only(terms))
    terms["x"].append("y")
    assert task.states == ("x", "y")
    assert task.facts.only == {"x": ("x", "x*y")}
    assert [each.text for each in task.relations] == ["y: y == 1"]
    assert replace(task, library=LIBRARY).runs == task.runs == (RUN, OTHER)
    with pytest.raises(TypeError):
        task.facts.only["y"] = ["y"]


def test_a_library_keeps_what_is_known_through_a_sum_and_a_model_does_not() -> None:
    known = LIBRARY.relate("y: y == 1") + ep.polynomial(["x", "y"], degree=3).exclude({"x": ["y"]})
    assert known.facts.lines == ["y: y == 1", "x' has no y"]
    model = ep.SparseModel(known, ["x", "y"], np.ones((len(known), 2)))
    assert (model.library.facts.lines, known.take(np.arange(3)).facts.lines) == ([], [])
    assert LIBRARY.facts.lines == []


def test_a_coefficient_known_of_the_point_is_a_number_at_each() -> None:
    runs = [replace(RUN, parameters={"a": 2.0}), replace(OTHER, parameters={"a": 3.0})]
    library = LIBRARY.known({"x": {"x": {"a": 0.25}}})
    found = ep.discover(runs, library, ep.Regression())
    assert [own.model.terms("x")["x"] for own in found.points.values()] == [0.5, 0.75]
    with pytest.raises(ValueError, match="known coefficients differ between"):
        ep.estimate(runs, library)


def driven(x0: float, f_Hz: float) -> ep.Trajectory:
    """x' = -x + 2 u - v with u = sin(w t) and v = cos(w t), and an input that no term uses."""
    t, w = np.linspace(0.0, 12.0, 241), 2.0 * np.pi * f_Hz
    u, v = np.sin(w * t), np.cos(w * t)
    forced = ((2.0 - w) * u - (1.0 + 2.0 * w) * v) / (1.0 + w**2)
    x = forced + (x0 - forced[0]) * np.exp(-t)
    return ep.Trajectory(t, x[:, None], ["x"], np.column_stack([u, v, t]), ["u", "v", "extra"])


@METHODS
def test_inputs_are_taken_by_name_in_every_run(method) -> None:
    first, second = driven(1.0, 0.2), driven(-2.0, 0.35)
    swapped = replace(second, inputs=second.inputs[:, [1, 0]], input_names=["v", "u"])
    library = ep.polynomial(["x", "u", "v"], degree=1)
    found = ep.discover([first, swapped], library, method)
    assert found.model.terms("x") == pytest.approx({"x": -1.0, "u": 2.0, "v": -1.0}, rel=1e-2)
    other = ep.discover([first, second], library, method)
    assert np.array_equal(found.model.coef, other.model.coef)


class Smallest:
    """A method of one's own, which asks another one."""

    selection = ep.discovery.Evidence()

    def identify(self, task, *, rng, progress):
        return ep.TrajectorySearch(max_terms=2).identify(task, rng=rng, progress=progress)


def test_a_method_needs_no_more_than_a_rule_and_an_answer() -> None:
    found = ep.discover(RUN, LIBRARY, Smallest())
    assert set(found.model.terms("x")) == {"x", "x*y"}
    assert "chosen by Evidence()" in repr(found)


@pytest.mark.parametrize(
    ("value", "lacking"),
    [
        (ep.BestSubset(), "which has no selection and no identify"),
        (ep.Regression, "got the class Regression; call it to make a value$"),
    ],
)
def test_what_is_no_method_is_refused_with_what_it_lacks(value: object, lacking: str) -> None:
    message = f"(?s)^method must be a DiscoveryMethod, such as ep.Regression.*{lacking}"
    with pytest.raises(ValueError, match=message):
        check_kind("method", value, DiscoveryMethod, "ep.Regression()")
