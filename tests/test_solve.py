"""The compiled integrator against SciPy's, whose steps it takes, and the ends of a run."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count

import numpy as np
import pytest
from scipy.interpolate import make_interp_spline

import ep2sindy as ep
from ep2sindy.model import kernels
from ep2sindy.model.inputs import curve_through, driven
from ep2sindy.model.many import WindowSteps, run_many
from ep2sindy.model.model import SparseModel
from ep2sindy.model.runge_kutta import dormand_prince, step
from ep2sindy.model.solve import Driven, Integration, _first_step, solve_stages
from ep2sindy.model.vector_field import VectorField
from tests.models import model_of


def run(rates: Callable, t: np.ndarray, y: np.ndarray, **settings: object) -> Integration:
    given = {"blow_up": 1e6, "bound": "one", "rtol": 1e-8, "limit_s": 300.0}
    return solve_stages(rates, t, y, **given | settings)


def products(model: SparseModel) -> Driven:
    rates = Driven(model.field)
    assert rates.is_compiled
    return rates


def through_scipy(rates: Driven) -> Callable[[float, np.ndarray], np.ndarray]:
    """The same equations as a function of which nothing is known."""
    return lambda t, y: rates(t, y)


@pytest.mark.parametrize("system", [ep.lotka_volterra(), ep.systems.van_der_pol(), ep.lorenz()])
def test_compiled_steps_are_those_of_scipy(system: ep.systems.System) -> None:
    from scipy.integrate import DOP853

    rates, y = products(system.model), np.array(system.initial, dtype=np.float64)
    solver = DOP853(through_scipy(rates), 0.0, y, 10.0, rtol=1e-8, atol=1e-8)
    slope = rates(0.0, y)
    h = _first_step(rates, 0.0, 10.0, y, slope, 1e-8)
    assert h == pytest.approx(solver.h_abs, rel=1e-12)
    at, slopes = np.empty_like(y), np.zeros((16, len(y)))
    slopes[0] = slope
    while solver.status == "running":
        before, t, y = solver.nfev, solver.t, solver.y.copy()
        slopes[0], h = solver.f, solver.h_abs  # each step by itself: rounding adds up in many
        solver.step()
        found = kernels._step(
            rates.parts, dormand_prince(), t, h, 10.0, y, at, slopes, np.ones(len(y) + 1), 1e-8
        )
        assert found[3] == solver.nfev - before
        if found[3] == 12:
            assert found[0] == solver.t
            np.testing.assert_allclose(at, solver.y, rtol=1e-12, atol=1e-13)
        else:  # shortened by its error, a small difference of slopes that rounding is seen in
            assert found[0] == pytest.approx(solver.t, rel=1e-6)


@pytest.mark.parametrize("system", [ep.lotka_volterra(), ep.systems.van_der_pol(), ep.lorenz()])
def test_a_compiled_run_is_the_one_of_scipy(system: ep.systems.System) -> None:
    """To what the tolerance leaves: rounding shifts steps, and a step's error with it."""
    rates, t = products(system.model), np.linspace(0.0, 8.0, 401)
    ours, theirs = (run(r, t, system.initial, rtol=1e-12) for r in (rates, through_scipy(rates)))
    assert ours.message == theirs.message
    np.testing.assert_allclose(ours.y, theirs.y, atol=1e-9 * theirs.y.std(axis=0).min())


def test_the_dense_output_is_of_seventh_order() -> None:
    """Of the circle, between steps: half the step, an error of 2^-8, of which 2^-7 are asked."""
    rates = products(ep.systems.damped_oscillator(zeta=0.0, omega=1.0).model)
    errors = []
    for step_s in (0.8, 0.4):
        y, at, room, slopes = np.array([1.0, 0.0]), np.empty(2), np.empty(2), np.zeros((16, 2))
        columns, shape = np.ones(3), np.empty((7, 2))
        slopes[0] = rates(0.0, y)
        parts, scheme = rates.parts, dormand_prince()
        t, *_ = kernels._step(parts, scheme, 0.0, step_s, 9.0, y, at, slopes, columns, 1.0)
        assert t == step_s
        kernels._polynomial(parts, scheme, 0.0, step_s, y, at, slopes, room, columns, shape)
        fractions = np.linspace(0.1, 0.9, 9)
        paths = []
        for fraction in fractions:
            kernels._between(shape, y, fraction, room)
            paths.append(room.copy())
        angle = fractions * step_s
        truth = np.column_stack([np.cos(angle), -np.sin(angle)])
        errors.append(np.abs(np.array(paths) - truth).max())
    assert errors[0] > 2.0**7 * errors[1]


def test_inputs_are_the_spline_through_their_samples() -> None:
    t = np.sort(np.random.default_rng(0).uniform(0.0, 1.0, 40))
    samples = np.column_stack([np.sin(9.0 * t), t**3])
    spline, drive = make_interp_spline(t, samples, k=3), curve_through(t, samples, [None, "smooth"])
    # x' = u, y' = v: the slope is the input.
    library = ep.named_terms(["x", "y", "u", "v"], ["u", "v"])
    rates = Driven(VectorField(library, np.eye(2)), drive)
    for at in np.linspace(t[0], t[-1], 301).tolist():
        np.testing.assert_allclose(drive(at), spline(at), rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(rates(at, np.zeros(2)), drive(at), rtol=1e-12, atol=1e-12)


def test_functions_of_ones_own_stay_with_scipy() -> None:
    t, model = np.array([0.0, 1.0]), model_of({"x": {"u": 1.0}}, inputs=["u"])
    drive, _ = driven(["u"], {"u": np.sin}, t, {})
    assert not Driven(model.field, drive).is_compiled


@pytest.mark.parametrize("compiled", [True, False])
def test_a_run_ends_after_its_time(compiled: bool) -> None:
    """A clock that continues by a second each time that it is read."""
    fast = products(ep.systems.damped_oscillator(zeta=0.0, omega=1e6).model)
    ticks = count()
    found = run(
        fast if compiled else through_scipy(fast),
        np.linspace(0.0, 10.0, 101),
        np.array([1.0, 0.0]),
        limit_s=2.0,
        clock=lambda: float(next(ticks)),
    )
    assert found.ended_early
    assert found.t[-1] < 0.1
    assert found.message.endswith("after 4 s of work")


def test_the_limit_of_a_model_reaches_the_clock() -> None:
    model = ep.systems.damped_oscillator(zeta=0.0, omega=1e6).model
    found = model.simulate(np.linspace(0.0, 10.0, 101), [1.0, 0.0], limit_s=0.0)
    assert found.diverged
    assert "s of work" in found.message


@pytest.mark.parametrize("compiled", [True, False])
def test_a_run_that_grows_keeps_the_samples_below_its_bound(compiled: bool) -> None:
    """x' = x^2 from one is 1/(1 - t), fifty at t = 0.98, a sample's time but for rounding."""
    model = SparseModel(ep.named_terms(["x"], ["x^2"]), ("x",), np.array([[1.0]]), {"x": "1"})
    rates = products(model)
    t = np.arange(0.0, 2.0, 0.015)
    found = run(rates if compiled else through_scipy(rates), t, np.ones(1), blow_up=50.0)
    assert found.ended_early
    assert found.message == "a state grew past 50 times one at t = 0.975 s"
    np.testing.assert_array_equal(found.t, t[t < 0.98])
    np.testing.assert_allclose(found.y[:, 0], 1.0 / (1.0 - found.t), rtol=1e-6)


@pytest.mark.parametrize("compiled", [True, False])
def test_what_falls_back_below_its_bound_ends_there_too(compiled: bool) -> None:
    rates = products(
        SparseModel(ep.named_terms(["x"], ["x"]), ("x",), np.array([[-1.0]]), {"x": "1"})
    )
    t = np.linspace(0.0, 5.0, 51)
    found = run(rates if compiled else through_scipy(rates), t, np.array([3.0]), blow_up=1.0)
    assert found.ended_early
    np.testing.assert_array_equal(found.t, t[t < np.log(3.0)])


@pytest.mark.parametrize("compiled", [True, False])
def test_evaluations_are_counted_alike(compiled: bool) -> None:
    fast = products(ep.systems.damped_oscillator(zeta=0.0, omega=1e6).model)
    rates, y = (fast if compiled else through_scipy(fast)), np.array([1.0, 0.0])
    message = run(rates, np.linspace(0.0, 10.0, 101), y).message
    calls = int(message.split(" evaluations")[0].split()[-1])
    assert 40_200 < calls <= 40_200 + 15  # the budget, and one step with its dense output


def test_many_compiled_runs_are_runge_kutta_steps_to_the_last_digit() -> None:
    """Against the scheme written for arrays; one start leaves the bounds, and stays there."""
    system, rng = ep.lotka_volterra(), np.random.default_rng(0)
    coef = system.model.coef[..., None] * (1.0 + 0.1 * rng.standard_normal((1, 1, 5)))
    start = np.array([[1.0, 0.5, 40.0], [0.5, 1.0, 3.0]])
    steps = WindowSteps(np.full((3, 158), 0.05), np.empty((3, 158, 0, 3)), n_substeps=2)
    field = VectorField.of(system.model.library, system.model.states, coef.transpose(2, 0, 1))
    paths = run_many(field, start.T, steps, centre=np.zeros(2), reach=np.full(2, 20.0))
    for m in range(5):

        def slope(x: np.ndarray, _: np.ndarray, m: int = m) -> np.ndarray:
            terms = system.model.library.evaluate(x.T).T
            return sum(c[:, m, None] * term for c, term in zip(coef, terms, strict=True))

        x = start.copy()
        for k in range(80):
            far = (np.abs(x) > 20.0).any(axis=0)
            np.testing.assert_array_equal(np.isnan(paths[m, :, k]).any(axis=1), far & (k > 0))
            np.testing.assert_array_equal(paths[m, ~far, k], x[:, ~far].T)
            for _ in range(2):
                x = step(slope, x, (np.empty(0),) * 3, 0.05)
                x[:, far] = 100.0  # beyond the bounds, and finite
