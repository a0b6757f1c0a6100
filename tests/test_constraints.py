from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import named_terms, polynomial
from ep2sindy.library.relations import (
    Constraint,
    Relation,
    constraint,
    parse_relation,
)
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.constrained import constrained_fit
from ep2sindy.regression.formulations import Differential, RandomSplit, Weak
from ep2sindy.regression.rows import Formulation, RegressionRows
from ep2sindy.systems.systems import lotka_volterra
from tests.models import plain_rows

LIBRARY = polynomial(["x", "y"], degree=2)
SUPPORT = {"x": ["x", "x*y"], "y": ["y", "y*x"]}
TIED = "x: x*y == -1 * y: y*x"
DIFFERENTIAL = Differential(split=RandomSplit(0.0))
WEAK = Weak(split=RandomSplit(0.0))
FORMULATIONS = pytest.mark.parametrize("formulation", [DIFFERENTIAL, WEAK], ids=["plain", "weak"])


def rows_of(theta: np.ndarray, target: np.ndarray) -> tuple[RegressionRows, ...]:
    """Rows of the terms x, y, x*y for the states x and y, as they are."""
    library = named_terms(["x", "y"], ["x", "y", "x*y"])
    return (plain_rows(theta, target, library, ["x", "y"]),)


def random_rows(n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(3)
    theta = rng.standard_normal((n, 3))
    noise = rng.standard_normal((n, 2)) * [0.1, 0.4]
    return theta, theta @ [[1.0, 0.0], [0.0, -2.0], [-3.0, 3.2]] + noise


@cache
def clean_run() -> Trajectory:
    return lotka_volterra().trajectory()


def noisy_run(seed: int = 0) -> Trajectory:
    states, rng = clean_run().states, np.random.default_rng(seed)
    rms = np.sqrt(np.square(states).mean(axis=0))
    return replace(clean_run(), states=states + 0.05 * rms * rng.standard_normal(states.shape))


def fitted(formulation: Formulation, run: Trajectory, relations: Sequence[str] = ()) -> SparseModel:
    problems = formulation.assemble([run], LIBRARY, rng=np.random.default_rng(0))
    return constrained_fit(problems, constraint(LIBRARY, SUPPORT, relations))


def covariance_of(model: SparseModel) -> np.ndarray:
    assert model.covariance is not None
    return model.covariance


def tied_by_hand(
    theta: np.ndarray, target: np.ndarray, std: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """x of x', x*y of x' and of -y', y of y', and the inverse of their Gram matrix."""
    blocks = []
    for k in (0, 1):
        block = np.zeros((len(theta), 3))
        block[:, 2 * k], block[:, 1] = theta[:, k] / std[k], (-1) ** k * theta[:, 2] / std[k]
        blocks.append(block)
    stacked, right = np.concatenate(blocks), np.concatenate((target / std).T)
    coef = np.linalg.lstsq(stacked, right, rcond=None)[0]
    squares = np.square(right - stacked @ coef).sum()
    return coef, np.linalg.inv(stacked.T @ stacked) * squares / (len(right) - 3)


def matrix_of(relations: Sequence[Relation], c: Constraint) -> tuple[np.ndarray, np.ndarray]:
    """A and b, for relations that spell terms as the library does."""
    A = np.zeros((len(relations), len(c.coefficients)))
    for row, relation in zip(A, relations, strict=True):
        for factor, state, term in relation.factors:
            row[c.coefficients.index((state, term))] += factor
    return A, np.array([relation.value for relation in relations])


@pytest.mark.parametrize(
    ("text", "factors", "value"),
    [
        ("2 * x: x*y + y: x*y == 0", [(2.0, "x", "x*y"), (1.0, "y", "x*y")], 0.0),
        ("-1e-3*x:x^2 - .5 == 1", [(-1e-3, "x", "x^2")], 1.5),
        (
            "n_i: <n_i*n_n*R_ion> == 2 * n_n: <n_i*n_n*R_ion> * n_i^2",
            [(1.0, "n_i", "<n_i*n_n*R_ion>"), (-2.0, "n_n", "<n_i*n_n*R_ion> * n_i^2")],
            0.0,
        ),
    ],
)
def test_relations_are_read(text: str, factors: list[tuple[float, str, str]], value: float) -> None:
    relation = parse_relation(text)
    assert list(relation.factors) == factors
    assert (relation.value, relation.text) == (value, text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x: x", "two sides joined by one '=='"),
        ("x: x == 1e999", "must be finite, got 'x: x == 1e999'"),
        ("x: x y: y == 0", r"\+, -, == or the end must stand at character 6 .*'y: y == 0'"),
    ],
)
def test_unreadable_relations_are_quoted_with_the_position(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_relation(text)


@pytest.mark.parametrize("seed", range(10))
def test_every_choice_of_free_coefficients_obeys_the_relations(seed: int) -> None:
    rng = np.random.default_rng(seed)
    support = {"x": LIBRARY.names, "y": LIBRARY.names}
    named = (rng.random((5, 12)) < 0.4) | np.eye(5, 12, dtype=np.bool_)
    chosen = rng.normal(size=(5, 12)) * named
    names = constraint(LIBRARY, support).coefficients
    relations = [
        Relation(
            tuple((float(f), *name) for f, name in zip(row, names, strict=True) if f),
            float(rng.normal()),
            f"relation {k}",
        )
        for k, row in enumerate(chosen)
    ]
    c = constraint(LIBRARY, support, relations)
    A, b = matrix_of(relations, c)
    assert c.C.shape == (12, 7)
    np.testing.assert_allclose(A @ c.C, 0.0, atol=1e-12)
    np.testing.assert_allclose(A @ c.d, b, atol=1e-12)
    assert np.array_equal(c.C[c.free], np.eye(7))
    z = rng.normal(size=7)
    assert np.array_equal(c.coef(z)[c.free], z)


def test_without_relations_every_coefficient_is_free() -> None:
    c = constraint(LIBRARY, {"y": ["x*y", "1"], "x": []})
    assert c.states == ("y", "x")
    assert c.coefficients == (("y", "1"), ("y", "x*y"))
    assert np.array_equal(c.C, np.eye(2))
    assert c.d.tolist() == [0.0, 0.0]


def test_the_largest_factor_is_eliminated_and_of_equals_the_last_named() -> None:
    c = constraint(LIBRARY, SUPPORT, ["x: x == 2 * y: y", TIED])
    assert [c.coefficients[k] for k in c.free] == [("x", "x"), ("x", "x*y")]
    np.testing.assert_array_equal(c.C, [[1, 0], [0, 1], [0.5, 0], [0, -1]])


def test_a_chain_of_ties_keeps_the_first_coefficient_free() -> None:
    chain = ["x: x*y == -1 * y: x*y", "y: y == y: x*y", "x: x == y: y"]
    c = constraint(LIBRARY, SUPPORT, chain)
    assert [c.coefficients[k] for k in c.free] == [("x", "x*y")]
    assert c.C[:, 0].tolist() == [-1.0, 1.0, -1.0, -1.0]


@pytest.mark.parametrize(
    ("relations", "message"),
    [
        ([TIED, "2 * x: x*y + 2 * y: x*y == 1"], r"== 1' contradicts the earlier ones, \['x: x\*y"),
        (["x: x*y == 1 + x: y*x"], "contradicts arithmetic alone"),
        (["x: y == 0"], r"relation 'x: y == 0': 'y' is not in the support of 'x', \['x', 'x\*y'\]"),
    ],
)
def test_relations_are_refused_by_name(relations: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        constraint(LIBRARY, SUPPORT, relations)


def test_a_relation_that_follows_from_others_changes_nothing() -> None:
    given = ["0.1 * x: x + 0.2 * y: y == 0.3", TIED]
    following = ["x: x + 2 * y: y == 3", "x: x*y == x: y*x", "y: x*y == -1 * x: x*y"]
    once, more = (constraint(LIBRARY, SUPPORT, each) for each in (given, [*given, *following]))
    assert (once.C.tolist(), once.d.tolist()) == (more.C.tolist(), more.d.tolist())


def test_the_matrix_of_the_thesis_is_its_formula() -> None:
    """Eqs. 13-16: one least squares on the stacked rows, theta * C, and beta_j = C_j b."""
    theta, target = random_rows()
    C = np.array([[1.0, 0.0, 1.0], [0.0, 1.0, -1.0]])
    support = {"x": ("x", "x*y"), "y": ("y", "x*y")}
    (problem,) = rows_of(theta, target)
    c = constraint(problem.library, support, ["-1 * x: x*y == 1 * y: x*y"])
    std = [
        np.sqrt(np.linalg.lstsq(theta[:, row != 0.0], y, rcond=None)[1][0] / (len(theta) - 2))
        for row, y in zip(C, target.T, strict=True)
    ]
    stacked = np.concatenate([theta * row / s for row, s in zip(C, std, strict=True)])
    b = np.linalg.lstsq(stacked, np.concatenate((target / std).T), rcond=None)[0]
    model = constrained_fit([problem], c)
    np.testing.assert_allclose(model.coef, (C * b).T, rtol=1e-12)


def test_the_matrix_may_scale_what_it_shares() -> None:
    fractions = {"x": 0.77, "y": -0.82, "z": 0.1}
    support = {"x": ["x*y"], "y": ["x*y"], "z": ["x*y", "1"]}
    relations = [f"{fractions[s]} * x: x*y == 0.77 * {s}: x*y" for s in ("y", "z")]
    c = constraint(LIBRARY, support, relations)
    coef = dict(zip(c.coefficients, c.coef(np.array([5.0, 7.0])), strict=True))
    shared = np.array([coef[s, "x*y"] / fraction for s, fraction in fractions.items()])
    np.testing.assert_allclose(shared, shared[0], rtol=1e-14)


def test_a_tied_term_is_as_eliminated_by_hand() -> None:
    theta, target = random_rows()
    (problem,) = rows_of(theta, target)
    model = constrained_fit([problem], constraint(problem.library, SUPPORT, [TIED]))
    alone = [np.linalg.lstsq(theta[:, [k, 2]], target[:, k], rcond=None)[1][0] for k in (0, 1)]
    coef, variances = tied_by_hand(theta, target, np.sqrt(np.array(alone) / (len(theta) - 2)))
    assert model.terms("x") == pytest.approx({"x": coef[0], "x*y": coef[1]}, rel=1e-12)
    assert model.terms("y") == pytest.approx({"y": coef[2], "x*y": -coef[1]}, rel=1e-12)
    spread = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, -1, 0]])
    np.testing.assert_allclose(covariance_of(model), spread @ variances @ spread.T, rtol=1e-9)


def test_without_relations_each_equation_keeps_its_own_fit_and_variance() -> None:
    theta, target = random_rows()
    (problem,) = rows_of(theta, target)
    model = constrained_fit([problem], constraint(problem.library, {"y": ["x*y"], "x": ["x"]}))
    assert model.states == ("y", "x")
    for k, (state, column) in enumerate([("y", 2), ("x", 0)]):
        x, y = theta[:, column], target[:, 0 if state == "x" else 1]
        coef = x @ y / (x @ x)
        assert model.coef[column, k] == pytest.approx(coef, rel=1e-12)
        variance = np.square(y - coef * x).sum() / (len(x) - 1) / (x @ x)
        assert covariance_of(model)[k, k] == pytest.approx(variance, rel=1e-9)


def test_fixed_values_are_kept_and_have_no_variance() -> None:
    theta, target = random_rows()
    (problem,) = rows_of(theta, target)
    relations = ["y: y == -2.5", "x: x == 0"]
    model = constrained_fit([problem], constraint(problem.library, SUPPORT, relations))
    assert model.terms("y")["y"] == -2.5
    xy, rest = theta[:, 2], target[:, 1] + 2.5 * theta[:, 1]
    assert model.terms("y")["x*y"] == pytest.approx(xy @ rest / (xy @ xy), rel=1e-12)
    assert set(model.terms("x")) == {"x*y"}
    assert covariance_of(model)[1].tolist() == [0.0, 0.0, 0.0]
    assert model.intervals("y")["y"] == (-2.5, -2.5)


def test_a_model_of_fixed_values_alone_needs_no_fit() -> None:
    problems = rows_of(*random_rows())
    c = constraint(problems[0].library, {"x": ["x"], "y": []}, ["x: x == 3"])
    model = constrained_fit(problems, c, units={"x": "m"}, provenance={"seed": "3"})
    assert model.text() == "x' = 3 x\ny' = 0"
    assert (model.units["x"], model.provenance["seed"]) == ("m", "3")
    assert not covariance_of(model).any()


@FORMULATIONS
def test_noise_free_data_give_the_exact_coefficients(formulation: Formulation) -> None:
    model = fitted(formulation, clean_run(), [TIED])
    # Differences are of second order in dt = 0.1; windows leave the states' own tolerance, 1e-10.
    tolerance = 0.1**2 if formulation is DIFFERENTIAL else 1e-9
    np.testing.assert_allclose(model.coef, lotka_volterra().model.coef, atol=tolerance)
    assert model.terms("x")["x*y"] == -model.terms("y")["x*y"]


@FORMULATIONS
def test_units_change_nothing_but_units(formulation: Formulation) -> None:
    """Densities in 1e18 and time in us; one equation's rows grow by 1e24, the other's do not."""
    run = noisy_run()
    big = replace(run, t=run.t * 1e-6, states=run.states * [1e18, 1.0])
    plain = fitted(formulation, run, [TIED, "x: x == 0.7"])
    scaled = fitted(formulation, big, ["x: x*y == -1e18 * y: x*y", "x: x == 0.7e6"])
    unit = 1e6 * np.array([1.0, 1.0, 1.0, 1e-18])
    flat = [*plain.terms("x").values(), *plain.terms("y").values()]
    again = [*scaled.terms("x").values(), *scaled.terms("y").values()]
    np.testing.assert_allclose(again, flat * unit, rtol=1e-6)
    expected = covariance_of(plain) * np.outer(unit, unit)
    np.testing.assert_allclose(covariance_of(scaled), expected, rtol=1e-4)


def test_relations_in_any_order_give_one_solution() -> None:
    theta, target = random_rows()
    (problem,) = rows_of(theta, target)
    relations = [TIED, "x: x == 3 * y: x*y + 1", "y: y - 2 * x: x == 0.5"]
    models = [
        constrained_fit([problem], constraint(problem.library, SUPPORT, order))
        for order in (relations, relations[::-1], [relations[1], relations[2], relations[0]])
    ]
    for model in models[1:]:
        np.testing.assert_allclose(model.coef, models[0].coef, rtol=1e-12)
        np.testing.assert_allclose(covariance_of(model), covariance_of(models[0]), rtol=1e-9)


def test_an_equation_of_large_units_does_not_swamp_the_other() -> None:
    """y' in units that make its rows 1e20 times larger: the tied term is a compromise still."""
    theta, target = random_rows()
    plain = rows_of(theta, target)
    large = rows_of(theta, target * [1.0, 1e20])
    coupled = constraint(plain[0].library, SUPPORT, [TIED])
    tied_large = constraint(plain[0].library, SUPPORT, ["1e20 * x: x*y == -1 * y: x*y"])
    expected = constrained_fit(plain, coupled)
    model = constrained_fit(large, tied_large)
    np.testing.assert_allclose(model.coef, expected.coef * [1.0, 1e20], rtol=1e-9)
    # The noise in y' is 4 times that in x': the weights are 16 to 1 at any units.
    alone = [np.linalg.lstsq(theta[:, [k, 2]], target[:, k], rcond=None)[0][1] for k in (0, 1)]
    fraction = (model.terms("x")["x*y"] + alone[1]) / (alone[0] + alone[1])
    assert fraction == pytest.approx(16 / 17, abs=0.03)


def test_exact_equations_weigh_a_million_times_their_targets_and_no_more() -> None:
    """Both fit exactly, with -3 and 3.2 for what is tied: rounding must not choose between them."""
    theta, _ = random_rows()
    target = theta @ [[1.0, 0.0], [0.0, -2.0], [-3.0, 3.2]]
    problems = rows_of(theta, target)
    model = constrained_fit(problems, constraint(problems[0].library, SUPPORT, [TIED]))
    coef, _ = tied_by_hand(theta, target, 1e-6 * np.sqrt(np.square(target).mean(axis=0)))
    assert model.terms("x") == pytest.approx({"x": coef[0], "x*y": coef[1]}, rel=1e-12)
    assert -3.2 < coef[1] < -3.0


def test_rows_that_cannot_tell_coefficients_apart_are_refused_unless_a_relation_does() -> None:
    theta, target = random_rows()
    theta[:, 1] = 2.0 * theta[:, 0]
    problems = rows_of(theta, target)
    support = {"x": ["x", "y", "x*y"]}
    with pytest.raises(ValueError, match=r"\[\('x', 'x'\), \('x', 'y'\)\] are not"):
        constrained_fit(problems, constraint(LIBRARY, support))
    model = constrained_fit(problems, constraint(LIBRARY, support, ["x: x == x: y"]))
    assert model.terms("x")["x"] == pytest.approx(1.0 / 3.0, abs=0.05)


def test_covariance_follows_the_library_of_the_rows() -> None:
    """The constraint may come from a library in another order; the model's is that of the rows."""
    problems = rows_of(*random_rows())
    turned = named_terms(["y", "x"], ["y*x", "y", "x"])
    model = constrained_fit(problems, constraint(LIBRARY, SUPPORT, [TIED]))
    other = constrained_fit(problems, constraint(turned, SUPPORT, [TIED]))
    np.testing.assert_allclose(other.coef, model.coef, rtol=1e-12)
    np.testing.assert_allclose(covariance_of(other), covariance_of(model), rtol=1e-9)


@FORMULATIONS
def test_a_true_relation_makes_coefficients_more_accurate(formulation: Formulation) -> None:
    """b = c = 1: two equations tell of one number."""
    errors: dict[str, list[np.ndarray]] = {"free": [], "coupled": []}
    for seed in range(8):
        problems = formulation.assemble([noisy_run(seed)], LIBRARY, rng=np.random.default_rng(0))
        for name, relations in (("free", []), ("coupled", [TIED])):
            model = constrained_fit(problems, constraint(LIBRARY, SUPPORT, relations))
            errors[name].append(model.coef[4] - [-1.0, 1.0])
    free, coupled = (np.sqrt(np.square(e).mean()) for e in errors.values())
    assert LIBRARY.names[4] == "x*y"
    assert coupled < 0.85 * free  # 0.71 if the errors of the two were independent and alike
