"""Models run freely, evaluated at samples and scored: what a user does with one at hand."""

import numpy as np
import pytest
from scipy.linalg import expm

import ep2sindy as ep
from ep2sindy.data.trajectory import ConstantStateError, Trajectory

A = np.array([[-0.5, 2.0], [-2.0, -0.1]])


def linear() -> ep.SparseModel:
    library = ep.named_terms(["x", "y"], ["x", "y"])
    return ep.SparseModel(library, ["x", "y"], A.T, {"x": "m", "y": "m/s"})


def chain() -> ep.SparseModel:
    """n' = 1e18, m' = n - m."""
    library = ep.polynomial(["n", "m"], degree=1)
    return ep.SparseModel(
        library, ["n", "m"], ep.model.coef_matrix(library, [{"1": 1e18}, {"n": 1.0, "m": -1.0}])
    )


def driven() -> ep.SparseModel:
    """x' = -2 x + u + 3 w, whose variables stand in no special order."""
    library = ep.named_terms(["w", "x", "u"], ["w", "x", "u"])
    return ep.SparseModel(library, ["x"], np.array([[3.0], [-2.0], [1.0]]), {"u": "V"})


def exact(t: np.ndarray) -> np.ndarray:
    """x(0) = 1, u = sin t, w = 0."""
    return np.exp(-2 * t) * 1.2 + (2 * np.sin(t) - np.cos(t)) / 5


def test_a_linear_system_follows_its_exponential() -> None:
    t, x0 = np.linspace(0.5, 6.5, 25), np.array([1.0, -0.5])
    found = linear().simulate(t, x0)
    expected = np.array([expm(A * (now - t[0])) @ x0 for now in t])
    assert not found.diverged
    # The solver keeps 1e-8 per step, over about 40 steps.
    np.testing.assert_allclose(found.states, expected, atol=1e-6)
    run = found.trajectory(label="free")
    assert (run.state_names, dict(run.units), run.label) == (
        ("x", "y"),
        {"x": "m", "y": "m/s"},
        "free",
    )
    assert np.array_equal(run.t, t)


@pytest.mark.parametrize("kind", ["functions", "samples", "array"])
def test_inputs_come_as_functions_samples_or_an_array(kind: str) -> None:
    t = np.linspace(0.0, 5.0, 201)
    inputs = {
        "functions": {"u": np.sin, "w": 0.0},
        "samples": {"u": np.sin(t), "w": 0 * t},
        "array": np.stack([0 * t, np.sin(t)], axis=1),
    }[kind]
    assert driven().inputs == ("w", "u")
    found = driven().simulate(t, [1.0], inputs)
    # A function is exact; the error of a spline is below dt^4 * 5/384, here 5e-9.
    np.testing.assert_allclose(
        found.states[:, 0], exact(t), atol=1e-6 if kind == "functions" else 2e-6
    )
    assert found.trajectory().units["u"] == "V"
    np.testing.assert_allclose(found.trajectory().columns(["u"])[:, 0], np.sin(t))


def test_sampled_inputs_are_of_fourth_order_at_least() -> None:
    """Splines are; within a step their errors cancel in part, which a slow system integrates."""
    errors = []
    for n in (11, 21, 41):
        t = np.linspace(0.0, 5.0, n)
        found = driven().simulate(t, [1.0], {"u": np.sin(t), "w": 0.0}, rtol=1e-12)
        errors.append(np.abs(found.states[:, 0] - exact(t)).max())
    slope = np.polyfit(np.log([10, 20, 40]), np.log(errors), 1)[0]
    assert 4.0 < -slope < 5.5


def test_what_starts_at_zero_has_a_scale_of_its_own() -> None:
    """x' = 1e-15: an absolute tolerance of one unit would see nothing."""
    model = ep.SparseModel(ep.polynomial(["x"], degree=1), ["x"], np.array([[1e-15], [-1.0]]))
    t = np.linspace(0.0, 4.0, 9)
    found = model.simulate(t, [0.0]).states[:, 0]
    np.testing.assert_allclose(found, 1e-15 * (1 - np.exp(-t)), rtol=1e-6)


@pytest.mark.parametrize("start", [0.0, 1.0])
def test_a_chain_from_zero_runs_in_any_unit(start: float) -> None:
    """n' = 1e18, m' = n - m: m starts at zero, or at nothing next to 1e18, as its rate does."""
    t = np.linspace(0.0, 6.0, 25)
    states = chain().simulate(t, [start, start]).states
    exact = np.stack([t, t - 1.0 + np.exp(-t)], axis=1)
    np.testing.assert_allclose(states, 1e18 * exact, rtol=1e-6, atol=10.0)


def test_what_an_input_sets_off_has_the_scale_of_that_input() -> None:
    """n' = u with u = 1e18 sin t: at the start, state, rate and input are all zero."""
    model = ep.SparseModel(ep.named_terms(["n", "u"], ["u"]), ["n"], np.array([[1.0]]))
    t = np.linspace(0.0, 6.0, 301)
    states = model.simulate(t, [0.0], {"u": lambda t: 1e18 * np.sin(t)}).states[:, 0]
    np.testing.assert_allclose(states, 1e18 * (1.0 - np.cos(t)), atol=1e11)


def test_an_oscillation_from_rest_keeps_its_accuracy_over_a_long_time() -> None:
    """x'' = 1 - x: over a thousand radians, rate times duration would be a thousandfold scale."""
    library = ep.polynomial(["x", "v"], degree=1)
    coef = ep.model.coef_matrix(library, [{"v": 1.0}, {"1": 1.0, "x": -1.0}])
    found = ep.SparseModel(library, ["x", "v"], coef).simulate([0.0, 1000.0], [0.0, 0.0])
    assert found.states[-1, 0] == pytest.approx(1.0 - np.cos(1000.0), abs=1e-5)


def test_draws_reach_as_far_as_the_run_they_surround() -> None:
    """x' = x - x^2 grows a thousandfold from 1e-3, and rests at one."""
    library = ep.polynomial(["x"], degree=2)
    coef = ep.model.coef_matrix(library, [{"x": 1.0, "x^2": -1.0}])
    model = ep.SparseModel(library, ["x"], coef, covariance=np.diag([1e-4, 1e-4]))
    run = model.simulate(np.linspace(0.0, 15.0, 61), [1e-3], draws=50)
    low, high = run.band()
    assert 0.9 < low[-1, 0] < run.states[-1, 0] < high[-1, 0] < 1.1


def test_a_run_that_rests_is_no_trajectory() -> None:
    found = linear().simulate([0.0, 1.0], [0.0, 0.0])
    assert found.states.tolist() == [[0.0, 0.0], [0.0, 0.0]]
    with pytest.raises(ConstantStateError, match="a state must vary"):
        found.trajectory()


@pytest.mark.parametrize(
    ("t", "x0", "inputs", "message"),
    [
        ([0.0, 1.0], [1.0, 2.0], {"u": 0.0, "w": 0.0}, r"a finite number for each of \['x'\]"),
        ([0.0, 1.0], [1.0], None, r"driven by \['w', 'u'\]: \['w', 'u'\] are missing"),
        ([0.0, 1.0], [1.0], {"u": [1.0, 2.0, 3.0], "w": 0.0}, r"input 'u' must have shape \(2,\)"),
    ],
)
def test_what_cannot_be_run_says_why(t, x0, inputs, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        driven().simulate(t, x0, inputs)


def test_predictions_take_samples_one_or_many_and_trajectories() -> None:
    rng = np.random.default_rng(0)
    x, u, w = rng.normal(size=(3, 7))
    expected = (-2.0 * x + u + 3.0 * w)[:, None]
    model = driven()
    np.testing.assert_allclose(model.predict(x[:, None], {"u": u, "w": w}), expected, rtol=1e-14)
    np.testing.assert_allclose(
        model.predict(x[:, None], np.stack([w, u], axis=1)), expected, rtol=1e-14
    )
    np.testing.assert_allclose(
        model.predict([x[0]], {"u": u[0], "w": w[0]}), expected[0], rtol=1e-14
    )
    run = Trajectory(
        t=np.arange(7.0), states=x[:, None], state_names=["x"],
        inputs=np.stack([u, w], axis=1), input_names=["u", "w"],
    )  # fmt: skip
    np.testing.assert_allclose(model.predict(run), expected, rtol=1e-14)
    np.testing.assert_allclose(linear().predict([1.0, 2.0]), A @ [1.0, 2.0])
    with pytest.raises(ValueError, match="a Trajectory brings its own inputs"):
        model.predict(run, {"u": u, "w": w})


def test_the_true_model_scores_one_and_a_constant_zero() -> None:
    t = np.linspace(0.0, 6.0, 601)
    model = linear()
    run = model.simulate(t, [1.0, -0.5]).trajectory()
    assert model.score(run) == pytest.approx(1.0, abs=1e-12)
    assert model.score(run, x_dot=run.states @ A.T) == pytest.approx(1.0, abs=1e-15)
    assert model.score(run, horizon_s=2.0) == pytest.approx(1.0, abs=1e-12)
    x_dot = run.states @ A.T
    library = ep.polynomial(["x", "y"], degree=1)
    still = ep.SparseModel(library, ["x", "y"], np.array([x_dot.mean(axis=0), [0, 0], [0, 0]]))
    assert still.score(run, x_dot=x_dot) == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(ValueError, match=r"x_dot must have shape \(601, 2\)"):
        model.score(run, x_dot=x_dot[:-1])


def test_a_score_is_the_mean_over_the_states() -> None:
    t = np.linspace(0.0, 6.0, 301)
    run = linear().simulate(t, [1.0, -0.5]).trajectory()
    x_dot = run.states @ A.T
    half = ep.SparseModel(
        linear().library,
        ["x", "y"],
        ep.model.coef_matrix(linear().library, [{"x": -0.5, "y": 2.0}, {}]),
    )
    lost = 1.0 - np.square(x_dot[:, 1]).sum() / np.square(x_dot[:, 1] - x_dot[:, 1].mean()).sum()
    assert half.score(run, x_dot=x_dot) == pytest.approx((1.0 + lost) / 2, rel=1e-12)
