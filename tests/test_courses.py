"""How inputs go from sample to sample: held, linear or smooth, the same in every room."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.model.draws import draw_runs
from ep2sindy.model.inputs import COURSES, curve_through
from ep2sindy.model.many import WindowSteps, run_many
from ep2sindy.model.vector_field import VectorField
from tests.models import model_of

TAU_S = 0.7
LAG = model_of({"x": {"x": -1.0 / TAU_S, "u": 1.0 / TAU_S}}, inputs=["u"])
LIBRARY = ep.polynomial(["x", "u"], degree=2)


def lag(course: str, *, hold: int, seed: int, noise: float = 0.0, n: int = 400) -> ep.Trajectory:
    """x' = (u - x) / tau at unequal times, exact for an input that is held or linear."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.05, 0.15, n))
    u = rng.uniform(-1.0, 1.0, n // hold + 1).repeat(hold)[:n]
    x = np.full(n, 0.3)
    for k, h in enumerate(np.diff(t)):
        bend = (u[k + 1] - u[k]) / h if course == "linear" else 0.0
        left = x[k] - u[k] + bend * TAU_S
        x[k + 1] = u[k] + bend * (h - TAU_S) + left * np.exp(-h / TAU_S)
    x += noise * x.std() * rng.standard_normal(n)
    return ep.Trajectory(t, x[:, None], ["x"], u[:, None], ["u"])


@pytest.mark.parametrize("hold", [1, 20])
@pytest.mark.parametrize("course", ["held", "linear"])
def test_every_run_of_a_model_is_the_exact_one(course: str, hold: int) -> None:
    run = lag(course, hold=hold, seed=0)
    model, x, u = replace(LAG, courses={"u": course}), run.states, run.inputs[:, 0]
    found = model.simulate(run.t, x[0], {"u": u})
    # Tolerances of 1e-8 in each step add up; a step over a jump would be off by a thousandth.
    np.testing.assert_allclose(found.states, x, atol=1e-7)
    np.testing.assert_allclose(model.rollout(run).states, x, atol=1e-7)
    sure = replace(model, covariance=np.zeros((2, 2)))
    (drawn,) = sure.simulate(run.t, x[0], {"u": u}, draws=1).draws
    # Runge-Kutta steps, accurate to 1e-4; one that sees a jump early is off by h/6 of it, 2e-2.
    np.testing.assert_allclose(drawn, x, atol=1e-4)


def test_functions_in_a_library_stop_at_jumps_too() -> None:
    """x' = sin(u) - x, integrated by SciPy."""
    run = lag("held", hold=7, seed=1)
    model = model_of({"x": {"x": -1.0, "sin(u)": 1.0}}, inputs=["u"])
    found = replace(model, courses={"u": "held"}).simulate(run.t, [0.3], {"u": run.inputs[:, 0]})
    exact = 0.3
    for k, h in enumerate(np.diff(run.t)):
        level = np.sin(run.inputs[k, 0])
        exact = level + (exact - level) * np.exp(-h)
        assert found.states[k + 1, 0] == pytest.approx(exact, abs=1e-7)


def test_a_square_wave_of_a_model_made_by_hand_does_not_overshoot() -> None:
    t = np.arange(400) * 0.1
    u = (np.arange(400) // 50 % 2).astype(float)
    found = LAG.simulate(t, [0.0], {"u": u}).states
    assert found.min() >= 0.0
    assert found.max() < 1.0


@pytest.mark.parametrize("hold", [1, 20])
@pytest.mark.parametrize("course", ["held", "linear"])
def test_the_course_is_found_with_the_law(course: str, hold: int) -> None:
    """An input that is held is half a step late for a linear one, and no state comes late."""
    found = ep.estimate([lag(course, hold=hold, seed=2, noise=0.05, n=800)], LIBRARY)
    assert not found.lack_of_fit
    assert set(found.model.terms("x")) == {"x", "u"}
    if hold == 1 or course == "held":
        assert dict(found.model.courses) == {"u": course}
    for name, (low, high) in found.model.intervals("x", level=0.999).items():
        assert low < LAG.terms("x")[name] < high


def test_a_course_that_is_stated_is_kept() -> None:
    run = lag("held", hold=1, seed=3, noise=0.05)
    found = ep.discover(run, LIBRARY, method=ep.TrajectorySearch(courses={"u": "linear"}))
    assert dict(found.model.courses) == {"u": "linear"}
    with pytest.raises(ValueError, match=r"courses must give one of .* got 'u': 'stepped'"):
        ep.estimate([run], LIBRARY, courses={"u": "stepped"})


def test_a_model_keeps_its_courses_in_a_file() -> None:
    for course in COURSES:
        model = replace(LAG, courses={"u": course})
        assert ep.SparseModel.from_json(model.to_json()) == model != LAG


def test_refinement_follows_the_same_course() -> None:
    run = lag("held", hold=1, seed=4)
    off = replace(LAG, coef=LAG.coef * 1.1, courses={"u": "held"})
    refined = ep.refine(off, run, n_windows=4, window=50).model
    np.testing.assert_allclose(refined.coef, LAG.coef, rtol=1e-4)


def test_many_models_at_once_take_set_inputs_as_held() -> None:
    run = lag("held", hold=20, seed=5)
    starts, curve = np.array([0, 150]), curve_through(run.t, run.inputs, [None])
    steps = WindowSteps.along(run.t, curve, starts, 201, n_substeps=2)
    field = VectorField.of(LAG.library, ["x", "u"], LAG.coef[None])
    paths = run_many(field, run.states[starts], steps, centre=np.zeros(1), reach=np.full(1, 20.0))
    np.testing.assert_allclose(paths[0, 0], run.states[:201], atol=1e-6)


def test_draws_do_not_see_an_input_before_it_jumps() -> None:
    t, u = np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 5.0])
    model = model_of({"x": {"u": 1.0}}, inputs=["u"])
    drive = ep.model.inputs.driven(["u"], {"u": u}, t, {"u": "held"})[0]
    (run,) = draw_runs(model, t, np.zeros((1, 1)), model.coef[None], drive=drive, reach=np.ones(1))
    np.testing.assert_allclose(run[:, 0], [0.0, 0.0, 1.0])
