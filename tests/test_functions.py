"""Functions as factors of terms: names, values, scaling, search, free runs, storage."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch

import ep2sindy as ep
from ep2sindy.data.coerce import keep_inside, noise_inside
from ep2sindy.library import functions as registry
from ep2sindy.library.equations import equation_text, latex_term_name, sum_sympy
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.model.solve import edges_of
from ep2sindy.refinement.refine import refine
from ep2sindy.regression.ambiguity import ambiguities, usable_terms
from tests.models import model_of, slopes_of

T = np.linspace(0.0, 5.0, 501)
EVERY = ["sin(2*x)", "cos(x)", "exp(-0.5*x)", "log(1+x)", "sqrt(x)", "abs(v)", "1/x"]
EVERY += ["v/(0.5+x)^2", "x*sin(2*x)*v^2", "1"]


@pytest.fixture
def kinds(monkeypatch: pytest.MonkeyPatch) -> dict[str, registry.Kind]:
    """Functions that are known, as before when the test ends."""
    monkeypatch.setattr(registry, "_kinds", dict(registry._kinds))
    return registry._kinds


@pytest.fixture
def tanh(kinds: dict[str, registry.Kind]) -> str:
    ep.register_function("tanh", np.tanh, lambda x: 1.0 - np.tanh(x) ** 2)
    return "tanh"


def points() -> np.ndarray:
    rng = np.random.default_rng(4)
    return np.stack([rng.uniform(0.3, 2.0, 40), rng.normal(size=40)], axis=1)


def every() -> Library:
    return named_terms(["x", "v"], EVERY)


@pytest.mark.parametrize(
    ("written", "name"),
    [
        ("v*sin( 2 * x )", "sin(2*x)*v"),
        ("1/(x + 0.5)", "1/(0.5+x)"),
        ("v / x^2", "v/x^2"),
        ("log(1 - 2*x)", "log(1-2*x)"),
        ("sqrt(1e-18*x)*sin(x)^2", "sin(x)^2*sqrt(1e-18*x)"),
        ("sin(<x*v>)*x", "x*sin(<x*v>)"),
    ],
)
def test_names_are_read_in_any_way_and_written_in_one(written: str, name: str) -> None:
    variables = ["x", "v", "<x*v>"]
    library = named_terms(variables, [written])
    assert library.names == (name,)
    assert named_terms(variables, [name]).terms == library.terms


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("sine(x)", r"unknown function 'sine' in 'sine\(x\)'; there are \['sin', 'cos'.*register"),
        ("sin(q)", r"unknown variable 'q' in term 'sin\(q\)'"),
        *((bad, "a term is variables joined by") for bad in ("sin(x*v)", "sin()", "1/sin(x)")),
    ],
)
def test_bad_functions_are_refused_by_name(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        named_terms(["x", "v"], [name])


def test_derivatives_are_those_of_differences_and_of_autograd(tanh: str) -> None:
    library = every() + named_terms(["x", "v"], ["x*tanh(2*x)*v"])
    jacobian, h = slopes_of(library, points()), 1e-6
    for k, step in enumerate(h * np.eye(2)):
        ahead, behind = (library.evaluate(points() + s * step) for s in (1, -1))
        np.testing.assert_allclose(jacobian[k], (ahead - behind) / (2 * h), rtol=1e-7, atol=1e-8)
    values = torch.from_numpy(points()).requires_grad_()
    library.evaluate(values).sum().backward()
    assert values.grad is not None
    np.testing.assert_allclose(values.grad.numpy().T, jacobian.sum(axis=-1), rtol=1e-12)


def test_terms_of_scaled_variables_give_back_the_values_and_slopes() -> None:
    scale = np.array([3e17, 0.02])
    library = named_terms(["x", "v"], [*EVERY, "sqrt(2e17+x)", "exp(-1e-18*x)", "log(x)*v"])
    values = points() * scale
    scaled, numbers = library.scaled(scale)
    np.testing.assert_allclose(
        scaled.evaluate(points()) * numbers, library.evaluate(values), rtol=1e-9
    )
    slopes = slopes_of(library, values) * scale[:, None, None]
    np.testing.assert_allclose(slopes_of(scaled, points()) * numbers, slopes, rtol=1e-9)
    assert numbers[EVERY.index("1/x")] == 1 / 3e17  # of order one where a power allows it
    assert numbers[EVERY.index("abs(v)")] == 0.02


def test_units_are_those_of_the_numbers_functions_take() -> None:
    units = dict(zip(EVERY, every().units({"x": "m", "v": "m/s"}), strict=True))
    assert units["sin(2*x)"] == units["log(1+x)"] == "1"
    assert units["sqrt(x)"] == "m^0.5"
    assert units["abs(v)"] == "m s^-1"
    assert units["v/(0.5+x)^2"] == "m^-1 s^-1"
    assert units["x*sin(2*x)*v^2"] == "m^3 s^-2"


def test_a_library_takes_functions_of_every_variable_or_of_one() -> None:
    library = polynomial(["x", "v"], degree=1, functions=["sin", "1/(0.5+v)"])
    assert library.names == ("1", "x", "v", "sin(x)", "sin(v)", "1/(0.5+v)")
    products = polynomial(["x", "v"], degree=1, functions=["cos(x)"], function_degree=2)
    assert products.names == ("1", "x", "v", "cos(x)", "x*cos(x)", "cos(x)*v", "cos(x)^2")
    named = polynomial(["x", "v"], degree=1, products=["v*sin(x)"])
    assert named.names[-1] == "sin(x)*v"


def test_a_share_of_the_terms_keeps_only_the_functions_it_needs() -> None:
    some = every().take(np.array([1, 7]))
    assert [f.name for f in some.functions] == ["cos(x)", "1/(0.5+x)"]
    np.testing.assert_array_equal(some.evaluate(points()), every().evaluate(points())[:, [1, 7]])


def test_equations_are_written_in_every_language() -> None:
    terms = {"x": 1.0, "x*sin(2*v)/(0.5+n_i)^2": -2.0, "1/x": 3.0}
    assert equation_text("x", terms) == "x' = x - 2 x sin(2 v)/(0.5+n_i)^2 + 3/x"
    latex = r"\frac{x \, \sin(2 \, v)}{(0.5+n_{i})^{2}}"
    assert latex_term_name("x*sin(2*v)/(0.5+n_i)^2") == latex
    sympy = pytest.importorskip("sympy")
    (own,) = sum_sympy({"tanh(x)": 1.0}).atoms(sympy.Function)
    assert (str(own), own == sympy.tanh(sympy.Symbol("x"))) == ("tanh(x)", False)  # the user's


def test_relations_name_terms_with_functions() -> None:
    library = named_terms(["x", "v"], ["1", "1/x", "sin(2*x)*v"])
    both = {"x": ["1", "1/x", "sin(2*x)*v"], "v": ["1/x"]}
    held = ep.library.constraint(library, both, ["x: 1/x == -2 * v: 1/x", "x: v*sin(2*x) == 1.5"])
    coef = dict(zip(held.coefficients, held.coef(np.array([7.0, 3.0])), strict=True))
    assert coef[("x", "1/x")] == -2 * coef[("v", "1/x")]
    assert coef[("x", "sin(2*x)*v")] == 1.5


# A user's own function


def test_a_function_of_ones_own_is_stored_by_name_and_read_when_registered(
    tanh: str, kinds: dict[str, registry.Kind]
) -> None:
    model = model_of({"x": {"tanh(2*x)": -1.5, "x": 0.1}})
    text = model.to_json()
    assert json.loads(text)["library"] == ["tanh(2*x)", "x"]
    assert ep.SparseModel.from_json(text).to_json() == text
    del kinds[tanh]
    with pytest.raises(ValueError, match=r"^unknown function 'tanh' in 'tanh\(2\*x\)'; .*regis"):
        ep.SparseModel.from_json(text)


def test_an_unknown_function_is_never_looked_up_as_code() -> None:
    text = model_of({"x": {"sin(x)": 1.0}}).to_json().replace("sin(x)", "system(x)")
    with pytest.raises(ValueError, match="unknown function 'system'"):
        ep.SparseModel.from_json(text)


def _square(x: np.ndarray) -> np.ndarray:
    return x * x


def _double(x: np.ndarray) -> np.ndarray:
    return 2.0 * x


def test_a_function_of_ones_own_travels_with_its_derivative(
    kinds: dict[str, registry.Kind],
) -> None:
    ep.register_function("own_square", _square, _double)
    sent = pickle.dumps(named_terms(["x"], ["own_square(x)", "sin(x)"]))
    del kinds["own_square"]
    library = pickle.loads(sent)  # as in a worker, where nobody registered it
    assert library.evaluate(np.array([[3.0]]))[0, 0] == 9.0
    assert slopes_of(library, np.array([[3.0]]))[0, 0, 0] == pytest.approx(6.0)
    assert named_terms(["x"], ["own_square(2*x)"]).evaluate(np.array([[3.0]]))[0, 0] == 36.0


@pytest.mark.parametrize(
    ("name", "value", "slope", "message"),
    [
        ("sin", np.sin, np.cos, "'sin' is built in: give your function another name"),
        ("wrong", np.sin, np.sin, "derivative of 'wrong' must be that of its value: at"),
        ("sums", np.sum, np.cos, "value of 'sums' must give a finite number for each"),
    ],
)
def test_functions_that_cannot_be_are_refused(
    name: str, value: object, slope: object, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        ep.register_function(name, value, slope)
    assert name == "sin" or name not in registry._kinds


# Domains


def signal(x: np.ndarray, label: str = "") -> ep.Trajectory:
    return ep.Trajectory(T, np.column_stack([x, np.sin(T)]), ["x", "v"], label=label)


@pytest.mark.parametrize(
    "method",
    [ep.Regression(ep.Weak()), ep.Regression(ep.Differential()), ep.TrajectorySearch()],
    ids=["weak", "differential", "joint"],
)
def test_a_sample_outside_a_domain_is_named(method: ep.Regression | ep.TrajectorySearch) -> None:
    x = 1.5 + np.cos(T)
    x[412] = -0.03
    library = polynomial(["x", "v"], degree=1, functions=["log(x)"])
    message = r"log\(x\) needs x > 0: x\[412\] = -0.03 at t = 4.12 s of 'probe'; name functions"
    with pytest.raises(ValueError, match=message):
        ep.discover(signal(x, "probe"), library, method)


def test_each_run_may_stay_on_a_side_of_its_own_of_a_pole() -> None:
    """x' = -1/x + v from both sides."""
    truth = model_of({"x": {"1/x": -0.1, "v": 1.0}, "v": {"x": -1.0, "v": -0.3}})
    runs = [truth.simulate(T[:300], [x, 0.0]).trajectory() for x in (2.0, -2.0)]
    library = polynomial(["x", "v"], degree=1, functions=["1/x"])
    found = ep.discover(runs, library).model
    assert found.terms("x") == pytest.approx({"v": 1.0, "1/x": -0.1}, rel=1e-3)


def beside_a_pole(noise: float) -> ep.Trajectory:
    """x' = v, v' = 1/x - x - 0.02 v: x comes near zero, and with noise it passes there."""
    truth = model_of({"x": {"v": 1.0}, "v": {"1/x": 1.0, "x": -1.0, "v": -0.02}})
    clean = truth.simulate(np.arange(0.0, 30.0, 0.05), [2.5, 0.0]).trajectory()
    spread = noise * np.sqrt(np.square(clean.states).mean(axis=0))
    errors = spread * np.random.default_rng(0).standard_normal(clean.states.shape)
    return replace(clean, states=clean.states + errors)


def test_noise_that_carries_samples_past_a_pole_hides_no_law() -> None:
    run, library = beside_a_pole(0.2), named_terms(["x", "v"], ["1", "x", "v", "1/x", "x*v"])
    assert (run.states[:, 0] < 0.0).sum() > 10
    found = ep.discover(run, library).model
    assert {state: set(found.terms(state)) for state in "xv"} == {
        "x": {"v"},
        "v": {"1/x", "x", "v"},
    }


@pytest.mark.parametrize("rows", [ep.Weak(), ep.Differential()], ids=["weak", "differential"])
def test_rows_of_smoothed_states_take_noise_past_a_pole(rows: ep.Weak | ep.Differential) -> None:
    run, library = beside_a_pole(0.05), named_terms(["x", "v"], ["x", "v", "1/x"])
    found = ep.discover(run, library, ep.Regression(rows)).model
    assert found.terms("v").keys() >= {"x", "1/x"}
    assert np.isfinite(found.score(run))
    with pytest.raises(ValueError, match="1/x needs x to stay on one side of 0"):
        ep.discover(run, library, ep.Regression(replace(rows, smooth_library=False)))


def test_samples_past_the_end_of_a_domain_are_put_back_by_their_noise() -> None:
    rng, library = np.random.default_rng(0), named_terms(["x"], ["log(x)"])
    x = np.abs(np.sin(T)) + 0.1 * rng.standard_normal(len(T))
    kept = noise_inside(library, x[:, None])[:, 0]
    outside = x <= 0.0
    assert outside.any()
    np.testing.assert_array_equal(kept[~outside], x[~outside])
    np.testing.assert_allclose(kept[outside], 0.1, rtol=0.1)


def test_what_a_smoother_moves_out_of_a_domain_stays_with_its_sample() -> None:
    library = named_terms(["x", "v"], ["log(x)", "v"])
    samples, moved = np.array([[0.1, 1.0], [0.2, 2.0]]), np.array([[-0.1, 1.5], [0.3, 2.5]])
    expected = [[0.1, 1.5], [0.3, 2.5]]
    np.testing.assert_array_equal(keep_inside(library, moved, samples), expected)


@pytest.mark.parametrize(
    ("equations", "outside", "t_end_s"),
    [
        ({"x": {"sqrt(x)": -1.0}}, "sqrt(x)", 2.0),  # x = (1 - t/2)^2
        ({"x": {"1/x": -1.0}}, "1/x", 0.5),  # x^2 = 1 - 2 t
        ({"x": {"1": -1.0, "log(x)": 1e-9}}, "log(x)", 1.0),
        ({"x": {"1": -1.0, "abs(x)": 1e-9, "sin(x)": 1e-9}}, "", 5.0),
    ],
)
def test_a_run_that_leaves_a_domain_ends_there_and_says_so(
    equations: dict, outside: str, t_end_s: float
) -> None:
    run = model_of(equations).simulate(T, [1.0])
    assert run.outside == outside
    assert run.diverged == bool(outside)
    assert run.t[-1] == pytest.approx(t_end_s, abs=0.011)  # a sample's step
    assert np.isfinite(run.states).all()
    if outside:
        assert f"left the domain of {outside}, which needs" in run.message


def test_a_run_may_start_outside_a_domain_or_be_driven_out_of_it() -> None:
    fall = model_of({"x": {"log(x)": 1.0}}).simulate(T, [-1.0])
    assert (fall.diverged, fall.outside, len(fall.t)) == (True, "log(x)", 1)
    driven = model_of({"x": {"log(u)": 1.0}}, ("u",))
    run = driven.simulate(T, [-1.0], {"u": lambda t: 2.0 - t})
    assert run.outside == "log(u)"
    assert run.t[-1] == pytest.approx(2.0, abs=0.011)


def test_leaving_a_domain_is_a_verdict() -> None:
    model = model_of({"x": {"1": -1.0, "log(x)": 0.1}})
    run = ep.Trajectory(T, (np.cos(T) + 1.2)[:, None], ["x"])
    assessed = ep.evaluate(model, run)
    assert assessed.status is ep.model.Status.LEAVES_DOMAIN
    assert assessed.text.startswith("leaves the domain of log(x) after 2.1")


def test_only_functions_that_end_somewhere_have_edges() -> None:
    library = named_terms(["x", "u"], ["sin(x)", "exp(x)", "1/(1+u)", "log(u)"])
    edges = edges_of(library.functions, ["u", "x"], np.array([-0.5, 2.0]))
    assert [(edge.function.name, edge.interval) for edge in edges] == [
        ("exp(x)", (-np.inf, 709.0)),
        ("1/(1+u)", (0.0, np.inf)),
        ("log(u)", None),
    ]


def test_terms_that_a_model_does_not_have_need_no_domain() -> None:
    """A library may hold log(x) where the model that was chosen runs below zero."""
    library = polynomial(["x"], degree=1, functions=["log"])
    model = ep.SparseModel(library, ["x"], ep.model.coef_matrix(library, [{"x": -1.0}]))
    below = np.array([[-2.0], [0.0]])
    np.testing.assert_array_equal(model.predict(below), -below)
    run = model.simulate(T, [-1.0])
    assert not run.diverged
    assert model.score(run.trajectory(), x_dot=-run.states) == 1.0
    nothing = ep.SparseModel(library, ["x"], np.zeros((3, 1)))
    np.testing.assert_array_equal(nothing.predict(below), 0 * below)


# Searches


def test_of_dependent_products_one_is_left_out_and_named() -> None:
    run = ep.pendulum().trajectory(noise=0.05, rng=0)
    library = polynomial(["theta", "w"], degree=1, functions=["sin", "cos"], function_degree=2)
    for problem in ep.WeightedWeak().assemble([run], library, rng=np.random.default_rng(0)):
        left_out = {name: f for f in ambiguities(problem) if f.exact for name in f.terms[:1]}
        for v in ("theta", "w"):
            finding = left_out[f"cos({v})^2"]
            assert finding.terms == (f"cos({v})^2", "1", f"sin({v})^2")
            assert finding.message.endswith("on every row and is left out")
            assert not usable_terms(problem)[library.index(f"cos({v})^2")]


@pytest.mark.parametrize(
    ("recipe", "noise"),
    [
        (None, 0.1),
        (ep.TrajectorySearch(), 0.0),
        pytest.param(ep.TrajectorySearch(), 0.1, marks=pytest.mark.slow),
    ],
)
def test_a_pendulum_is_found_in_noise_and_runs_on_its_own(
    recipe: ep.TrajectorySearch | None, noise: float
) -> None:
    """theta' = w, w' = -g/L sin(theta); its energy w^2/2 - g/L cos(theta) stays."""
    system = ep.pendulum()
    run = system.trajectory(noise=noise, rng=3)
    library = polynomial(run.names, degree=3, functions=["sin", "cos"])
    found = ep.discover(run, library, recipe)
    assert {s: set(found.model.terms(s)) for s in found.model.states} == {
        "theta": {"w"},
        "w": {"sin(theta)"},
    }
    assert found.model.terms("theta")["w"] == pytest.approx(1.0, abs=0.02)
    assert found.model.terms("w")["sin(theta)"] == pytest.approx(-9.81, rel=0.03)
    truth = system.trajectory()
    free = found.model.simulate(truth.t, truth.states[0])
    assert not free.diverged
    theta, w = free.states.T
    speed, restoring = found.model.terms("theta")["w"], found.model.terms("w")["sin(theta)"]
    energy = 0.5 * speed * w**2 + restoring * np.cos(theta)
    assert np.ptp(energy) < 1e-4  # of some 4
    assessed = ep.evaluate(found.model, truth)
    status = ep.model.Status
    assert assessed.status in (status.FOLLOWS, status.NEUTRAL, status.WRONG_FREQUENCY)


@pytest.mark.slow
def test_intervals_hold_the_truth_where_functions_bend_in_noise() -> None:
    """Without what noise adds to sin on average, errors have a mean of 3.5 standard deviations."""
    library = named_terms(["theta", "w"], ["w", "sin(theta)"])
    known = {"theta": ["w"], "w": ["sin(theta)"]}
    errors = []
    for seed in range(6):
        run = ep.pendulum().trajectory(noise=0.1, rng=seed)
        model = ep.discover(run, library.only(known)).model
        ends = model.intervals("w")["sin(theta)"]
        errors.append((np.mean(ends) + 9.81) / (np.ptp(ends) / 3.92))
    # 1 / sqrt(6) by chance, three times over, and 0.2 by noise above second order.
    assert abs(np.mean(errors)) < 1.4
    assert 0.3 < np.std(errors) < 1.9


def test_saturation_is_found_in_units_far_from_one() -> None:
    """Decay with feed, s' = u - b s/(K + s), of some 1e18 and over microseconds."""
    K = 4e17
    truth = model_of({"s": {"u": 1.0, "s/(4e17+s)": -3e24}}, ("u",))
    t = np.linspace(0.0, 4e-5, 2001)
    feed = 1.6e24 * (1.0 + 0.9 * np.sin(4e5 * t))
    run = truth.simulate(t, [1e18], {"u": feed}).trajectory()
    rng = np.random.default_rng(0)
    states = run.states * (1.0 + 0.01 * rng.standard_normal(run.states.shape))
    noisy = ep.Trajectory(t, states, ["s"], inputs=run.inputs, input_names=["u"])
    library = polynomial(
        ["s", "u"], degree=1, functions=["log(s)", "sqrt(s)"], products=[f"s/({K:g}+s)"]
    )
    found = ep.discover(noisy, library).model
    assert found.terms("s") == pytest.approx({"u": 1.0, "s/(4e+17+s)": -3e24}, rel=0.05)


def test_rules_that_run_models_take_functions() -> None:
    run = ep.pendulum().trajectory(noise=0.02, rng=0)
    library = polynomial(run.names, degree=1, functions=["sin(theta)"])
    recipe = ep.Regression(
        search=ep.BestSubset(max_terms=1), selection=ep.FreeRunScore(bounds=None)
    )
    found = ep.discover(run, library, recipe).model
    assert set(found.terms("w")) == {"sin(theta)"}


def test_a_pendulum_swings_on_closed_orbits() -> None:
    system = ep.pendulum()
    cycle = ep.model.limit_cycle(system.model, np.array([1.0, 3.0]), period_s=2.4)
    assert cycle is not None
    theta, w = cycle.states[0]
    furthest = np.arccos(np.cos(theta) - 0.5 * w**2 / 9.81)
    # T = 2 pi sqrt(L / g) / M(1, cos(furthest / 2)), M the arithmetic-geometric mean.
    a, b = 1.0, np.cos(furthest / 2.0)
    for _ in range(8):
        a, b = (a + b) / 2.0, np.sqrt(a * b)
    assert cycle.period_s == pytest.approx(2.0 * np.pi / a / np.sqrt(9.81), rel=1e-6)
    assert cycle.stability == "neutral"


@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("sin", {}),
        ("tanh", {}),
        pytest.param(  # torch.optim imports torch's compiler: five seconds
            "tanh",
            {"free_start": False, "method": ep.refinement.GradientDescent()},
            marks=pytest.mark.slow,
        ),
    ],
    ids=["shooting", "shooting one's own", "descent of one's own"],
)
def test_functions_are_refined_and_those_of_ones_own(name: str, way: dict, tanh: str) -> None:
    truth = model_of({"x": {"y": 1.0}, "y": {f"{name}(3*x)": -4.0}})
    t = np.linspace(0.0, 6.0, 301)
    run = truth.simulate(t, [1.5, 0.0]).trajectory()
    off = replace(truth, coef=1.03 * truth.coef)
    found = refine(off, [run], n_windows=4, window=60, seed=np.random.default_rng(0), **way)
    # Steps of 0.02 s are exact to 1e-6 where tanh(3 x) turns.
    np.testing.assert_allclose(found.model.coef, truth.coef, atol=1e-4)


def test_refinement_survives_windows_that_leave_a_domain() -> None:
    """Started so far off that trajectories leave x > 0, it ends with a status, not an exception."""
    truth = model_of({"x": {"1": 1.0, "sqrt(x)": -1.0, "u": 1.0}}, ("u",))
    t = np.linspace(0.0, 10.0, 501)
    run = truth.simulate(t, [1.0], {"u": 0.5 * np.sin(2 * t)}).trajectory()
    off = model_of({"x": {"1": -6.0, "sqrt(x)": -1.0, "u": 1.0}}, ("u",))
    for free_start in (True, False):
        found = refine(
            off, [run], n_windows=4, window=80, seed=np.random.default_rng(0), free_start=free_start
        )
        assert isinstance(found.status, str)
        assert found.status != "converged" or np.isfinite(found.model.coef).all()
