"""Given models fitted to every operating point, the quantities that they mean, and their trends."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lfilter

import ep2sindy as ep
from ep2sindy.operating.law import constrain_law
from ep2sindy.operating.point_fits import FAILED, PointFits, fit_rows, fit_trajectories
from ep2sindy.operating.quantities import Quantity, control_functions, estimate_quantities, lines_of
from ep2sindy.regression.constrained import solve_constrained
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.signals.spectrum import oscillation
from tests.models import plain_rows

LIBRARY = ep.named_terms(["x", "y", "R", "u"], ["1", "x*u", "x*y*R"])
TERMS = {"x": ["x*u", "x*y*R"], "y": ["1", "x*y*R"]}
SHARED = "x: x*y*R == -1 * y: x*y*R"
UNITS = {"x": "m^-3", "y": "m^-3", "R": "m^3/s", "u": "m/s"}
LENGTH, INJECTED = Quantity("x: x*u", -1.0, -1), Quantity("y: 1")
PARAMETERS = ("V", "m")
SHARES = {"eps_x": Quantity("x: x*y*R"), "eps_y": Quantity("y: x*y*R", -1.0)}
QUANTITIES = {
    "free": {"L": LENGTH, "g": INJECTED} | SHARES,
    "constrained": {"L": LENGTH, "g": INJECTED, "eps": Quantity("x: x*y*R")},
}
RELATIONS = {
    name: constrain_law(LIBRARY.relate(*relations), TERMS, parameters=PARAMETERS)
    for name, relations in {"free": [], "constrained": [SHARED]}.items()
}
EVERY = ep.regression.RandomSplit(0.0)
WEAK = ep.Weak(split=EVERY)


def forced(
    *, L: float, g: float, eps: float, dt: float = 0.01, periods: float = 20
) -> ep.Trajectory:
    """x' = -x u / L + eps x y R, y' = g - eps x y R, R and u waves of period one."""
    t = np.arange(0.0, periods, dt)

    def inputs(t: np.ndarray | float) -> tuple:
        return 1 + 0.5 * np.sin(2 * np.pi * t), 1 + 0.2 * np.sin(2 * np.pi * t + 1)

    def slope(t: float, states: np.ndarray) -> list[float]:
        (x, y), (R, u) = states, inputs(t)
        return [-x * u / L + eps * x * y * R, g - eps * x * y * R]

    whole = solve_ivp(
        slope, (-20.0, t[-1]), [g * L, 1 / (L * eps)], t_eval=t, rtol=1e-10, atol=1e-12
    )
    return ep.Trajectory(
        t=t,
        states=whole.y.T,
        state_names=["x", "y"],
        inputs=np.stack(inputs(t), axis=1),
        input_names=["R", "u"],
        units=UNITS,
    )


TRUTHS = [
    {"L": 0.5, "g": 3.0, "eps": 2.0},
    {"L": 0.6, "g": 4.0, "eps": 1.8},
    {"L": 0.7, "g": 5.0, "eps": 1.5},
]


@pytest.fixture(scope="module")
def runs() -> list[ep.Trajectory]:
    """Three points with sampling of their own."""
    sampling = zip(TRUTHS, (0.01, 0.013, 0.008), (20, 25, 15), strict=True)
    return [
        replace(
            forced(**truth, dt=dt, periods=periods), parameters={"V": 100.0 * (k + 1), "m": 2.0**k}
        )
        for k, (truth, dt, periods) in enumerate(sampling)
    ]


def fitted(
    runs: Sequence[ep.Trajectory], formulation: ep.Weak | ep.Differential = WEAK
) -> dict[str, PointFits]:
    """Every model by rows, and refined."""
    points = np.array([[*run.parameters.values()] for run in runs])
    rows = [formulation.assemble([r], LIBRARY, rng=np.random.default_rng(0)) for r in runs]
    fits = {
        name: fit_rows(PARAMETERS, points, rows, held, provenance={})
        for name, held in RELATIONS.items()
    }
    windows = ep.refinement.RefinementSettings(n_windows=10, periods=0.5)
    refined = fit_trajectories([*fits.values()], [[run] for run in runs], windows)
    return fits | {f"{name}_refined": own for name, own in zip(fits, refined, strict=True)}


@pytest.fixture(scope="module")
def fits(runs: list[ep.Trajectory]) -> dict[str, PointFits]:
    return fitted(runs)


def test_quantities_of_every_point_come_back(fits: dict[str, PointFits]) -> None:
    # The data were integrated to 1e-10 and cubics of the inputs are as good: windows leave 1e-5,
    # steps of Runge-Kutta (omega dt)^4 / 120 = 1e-6 of waves with harmonics.
    for name, own in fits.items():
        quantities = QUANTITIES[name.removesuffix("_refined")]
        for truth, model in zip(TRUTHS, own.models, strict=True):
            values = truth | {"eps_x": truth["eps"], "eps_y": truth["eps"]}
            found = {k: each.value for k, each in estimate_quantities(model, quantities).items()}
            assert found == pytest.approx({key: values[key] for key in quantities}, rel=1e-4)
        assert not {*own.statuses} & {*FAILED}
    assert max(fits["free_refined"].losses) < 1e-8


def test_one_search_over_all_points_finds_the_terms_that_made_the_data(
    runs: list[ep.Trajectory],
) -> None:
    library = ep.polynomial(["x", "y", "R", "u"], degree=2, products=["x*y*R"])
    method = ep.Regression(WEAK, ep.BestSubset(max_terms=3), ep.Knee(n_norm="max_terms"))
    found = ep.discover(runs, library, method, law=ep.polynomial(["V"], degree=2))
    assert found.law is not None
    for truth, run, point in zip(TRUTHS, runs, found.points.values(), strict=True):
        eps = truth["eps"]
        # Three points fix three functions: the law passes through all of them.
        for model in (point.model, found.law.at(V=run.parameters["V"])):
            x = {"x*u": -1.0 / truth["L"], "x*y*R": eps}
            assert model.terms("x") == pytest.approx(x, rel=1e-4)
            assert model.terms("y") == pytest.approx({"1": truth["g"], "x*y*R": -eps}, rel=1e-4)


def test_a_relation_holds_exactly_in_fits_and_refinements(fits: dict[str, PointFits]) -> None:
    for model in [*fits["constrained"].models, *fits["constrained_refined"].models]:
        assert model.terms("x")["x*y*R"] == -model.terms("y")["x*y*R"]
        # Coefficients by equation: x*u, x*y*R, 1, x*y*R.
        assert model.covariance is not None
        assert model.covariance[1, 1] == pytest.approx(-model.covariance[1, 3])


def test_a_point_does_not_depend_on_the_others(
    runs: list[ep.Trajectory], fits: dict[str, PointFits]
) -> None:
    for name, alone in fitted(runs[:1]).items():
        assert alone.models[0] == fits[name].models[0]


def test_intervals_that_cannot_be_had_end_no_fit() -> None:
    """Three periods hold one block of two."""
    run = replace(forced(**TRUTHS[0], periods=3.0), parameters={"V": 1.0, "m": 1.0})
    found = fitted([run], ep.Differential(split=EVERY))["free"].models[0]
    assert found.covariance is None
    assert found.terms("x")["x*y*R"] == pytest.approx(TRUTHS[0]["eps"], rel=0.02)


def wave(t: np.ndarray) -> np.ndarray:
    return np.sin(2 * np.pi * t)


@pytest.mark.parametrize(
    ("signal", "status"),
    [
        (lambda t: 2 + wave(t), "oscillating"),
        (lambda t: 2 + wave(t) + 3 * wave(7 * t + 0.3 * wave(t)), "oscillating"),
        (lambda t: 2 + 0.01 * wave(t), "steady"),
        (lambda t: 2 + np.exp(-t) * wave(t), "steady"),
        (lambda t: 2 + np.exp(-0.1 * t) * wave(t), "decaying"),
        (lambda t: 2 + wave(t / 10), "no dominant frequency"),
        (lambda t: 2 + np.random.default_rng(0).normal(size=len(t)), "no dominant frequency"),
    ],
)
def test_records_say_whether_they_oscillate(signal: object, status: str) -> None:
    t = np.linspace(0.0, 20.0, 2001)
    x = signal(t)  # type: ignore[operator]
    assert oscillation(t, np.stack([x, 2 + wave(t)], axis=1)) == status


def test_the_covariance_of_blocks_is_a_sandwich_of_their_scores() -> None:
    """By hand, from the rows of both equations in units of their residuals."""
    run, rng = forced(**TRUTHS[0]), np.random.default_rng(1)
    noisy = replace(run, states=run.states * (1 + 0.01 * rng.normal(size=run.states.shape)))
    problems = ep.Differential(split=ep.regression.RandomSplit(0.25)).assemble(
        [noisy], LIBRARY, rng=rng
    )
    (constraint,) = RELATIONS["constrained"].at(np.array([[100.0, 1.0]]))
    root = solve_constrained(problems, constraint).clustered_root(50)
    (problem,) = problems
    n = int((~problem.test).sum())
    rows, targets = [], []
    for k, (terms, places) in enumerate(zip(TERMS.values(), ([0, 1], [2, 3]), strict=True)):
        theta = problem.theta[~problem.test][:, [LIBRARY.index(name) for name in terms]]
        target = problem.target[~problem.test, k]
        residual = target - theta @ np.linalg.lstsq(theta, target)[0]
        std = np.sqrt(np.sum(residual**2) / (n - 2))
        rows.append(theta @ constraint.C[places] / std)
        targets.append(target / std)
    bread = np.linalg.inv(sum(each.T @ each for each in rows))
    z = bread @ sum(each.T @ target for each, target in zip(rows, targets, strict=True))
    n_groups = len(np.unique(problem.groups[~problem.test]))
    n_blocks = n_groups // 50
    _, group = np.unique(problem.groups[~problem.test], return_inverse=True)
    meat = np.zeros((3, 3))
    for block in range(n_blocks):
        own = group * n_blocks // n_groups == block
        score = sum(
            each[own].T @ (target[own] - each[own] @ z)
            for each, target in zip(rows, targets, strict=True)
        )
        meat += np.outer(score, score)
    whole = constraint.C @ bread @ meat @ bread @ constraint.C.T * n_blocks / (n_blocks - 1)
    np.testing.assert_allclose(root @ root.T, whole, rtol=1e-6, atol=1e-12 * np.abs(whole).max())


def correlated_problem(rng: np.random.Generator, *, n_rows: int) -> RegressionRows:
    """z' = 2 a - 3 b, with columns and errors that are AR(1), each row 0.8 of the one before."""
    a, b, error = lfilter([0.6], [1.0, -0.8], rng.normal(size=(3, n_rows + 50)))[:, 50:]
    theta = np.stack([a, b], axis=1)
    return plain_rows(theta, (theta @ [2.0, -3.0] + 0.3 * error)[:, None], ["a", "b"], ["z"])


def coverage(*, block: int, n_seeds: int) -> float:
    """Fraction of 95 % intervals that hold the true coefficient."""
    library = ep.named_terms(["a", "b"], ["a", "b"])
    relations = ep.library.constraint(library, {"z": ["a", "b"]})
    quantities = {"p": Quantity("z: a"), "q": Quantity("z: b", -1.0)}
    inside = []
    for rng in np.random.default_rng(0).spawn(n_seeds):
        solution = solve_constrained([correlated_problem(rng, n_rows=1000)], relations)
        root = solution.clustered_root(block)
        model = solution.model(library, units={}, provenance={}, root=root)
        estimates = estimate_quantities(model, quantities)
        inside += [e.low <= t <= e.high for e, t in zip(estimates.values(), (2, 3), strict=True)]
    return float(np.mean(inside))


def test_intervals_hold_the_truth_where_rows_depend_on_each_other() -> None:
    # 800 intervals: two standard deviations of a fraction of 0.95 are 0.015; blocks of twenty keep
    # most of the memory of five rows, and fifty of them are few, which costs some more.
    assert 0.88 < coverage(block=20, n_seeds=400) < 0.99
    # Row by row the variance is (1 + 0.64) / (1 - 0.64) = 4.6 times too small: 0.95 becomes 0.64.
    assert coverage(block=1, n_seeds=400) < 0.7


def test_a_quantity_is_a_coefficient_or_its_reciprocal() -> None:
    assert LENGTH.evaluate(np.array([-40.0, -50.0])) == pytest.approx([0.025, 0.02])
    units = [q.unit(LIBRARY, UNITS) for q in QUANTITIES["free"].values()]
    assert units == ["m", "m^-3 s^-1", "1", "1"]


def model_of(covariance: np.ndarray | None = None) -> ep.SparseModel:
    coef = ep.model.coef_matrix(LIBRARY, [{"x*u": -40.0, "x*y*R": 0.8}, {"1": 2.0, "x*y*R": -0.6}])
    return ep.SparseModel(LIBRARY, ["x", "y"], coef, UNITS, {}, covariance)


def test_ends_of_intervals_are_carried_from_coefficients_to_quantities() -> None:
    model = model_of(np.diag([4.0, 1e-4, 0.01, 4e-4]))
    found = estimate_quantities(model, QUANTITIES["free"])
    z = 1.959964
    ends = {
        "L": (1.0 / (40.0 + 2.0 * z), 1.0 / 40.0, 1.0 / (40.0 - 2.0 * z)),
        "g": (2.0 - 0.1 * z, 2.0, 2.0 + 0.1 * z),
        "eps_x": (0.8 - 0.01 * z, 0.8, 0.8 + 0.01 * z),
        "eps_y": (0.6 - 0.02 * z, 0.6, 0.6 + 0.02 * z),
    }
    assert {name: (e.low, e.value, e.high) for name, e in found.items()} == {
        name: pytest.approx(values, rel=1e-6) for name, values in ends.items()
    }
    # A reciprocal of what may be zero may be anything, and without covariance nothing is known.
    (wide,) = estimate_quantities(model_of(np.diag([500.0, 1, 1, 1])), {"L": LENGTH}).values()
    assert (wide.low, wide.value, wide.high) == (-np.inf, 0.025, np.inf)
    (bare,) = estimate_quantities(model_of(), {"L": LENGTH}).values()
    assert bare.value == 0.025
    assert np.isnan([bare.low, bare.high]).all()


def test_trends_go_along_the_longest_line_of_each_parameter() -> None:
    cross = [(200, 5), (300, 2), (300, 4), (300, 5), (300, 6), (400, 5)]
    points = [{"V": float(V), "m": float(m)} for V, m in cross]
    assert lines_of(points) == [("V", {"m": 5.0}), ("m", {"V": 300.0})]
    assert lines_of(points, least=4) == [("m", {"V": 300.0})]
    assert lines_of([{"V": 1.0, "m": 1.0}, {"V": 2.0, "m": 2.0}]) == []
    assert lines_of([{"V": 1.0}, {"V": 2.0}]) == [("V", {})]


def test_control_laws_may_hold_reciprocals_of_what_is_never_zero() -> None:
    products = ("1", "V", "m", "V^2", "V*m", "m^2")
    both = control_functions(PARAMETERS, np.array([[-1.0, 2.0], [-3.0, 4.0]]))
    assert both.names == (*products, "1/V", "1/m")
    one = control_functions(PARAMETERS, np.array([[0.0, 2.0], [3.0, 4.0]]))
    assert one.names == (*products, "1/m")
    none = control_functions(PARAMETERS, np.array([[-1.0, 0.0], [3.0, 4.0]]))
    assert none.names == products


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Quantity("x: x", power=2),
            "the factor not zero and the power 1 or -1, got factor=1",
        ),
        (
            lambda: Quantity("x: 1").place(RELATIONS["free"].common, LIBRARY),
            "the quantity of 'x: 1': '1' is not in the support of 'x'",
        ),
    ],
)
def test_settings_that_cannot_work_are_refused(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        make()  # type: ignore[operator]


def test_smoothing_biases_least_squares_and_not_refinements() -> None:
    run = replace(forced(**TRUTHS[0], dt=1.0 / 25), parameters={"V": 1.0, "m": 1.0})
    both = fitted([run], ep.Differential(split=EVERY))
    rows, refined = (
        estimate_quantities(both[f"constrained{end}"].models[0], QUANTITIES["constrained"])
        for end in ("", "_refined")
    )
    for name, value in TRUTHS[0].items():
        assert abs(rows[name].value / value - 1.0) == pytest.approx(0.012, rel=0.15)
        assert not rows[name].low < value < rows[name].high
        assert refined[name].value == pytest.approx(value, rel=1e-5)
