from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library import units
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.library.names import split_factors
from ep2sindy.library.terms import read_term, variables_of
from ep2sindy.library.units import unit_product
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.methods.nelder_mead import NelderMead
from ep2sindy.refinement.refine import refine


def waves() -> Library:
    """1, v^2, x*sin(2 x)*v, sin(2 x)^2 over x and v."""
    return named_terms(["x", "v"], ["1", "v^2", "x*sin(2*x)*v", "sin(2*x)^2"])


def test_polynomial_is_ordered_by_degree_then_variable() -> None:
    assert polynomial(["x", "y"], degree=2).names == ("1", "x", "y", "x^2", "x*y", "y^2")


@pytest.mark.parametrize(
    ("n_variables", "degree", "n_terms"), [(2, 2, 6), (3, 3, 20), (5, 2, 21), (4, 0, 1)]
)
def test_polynomial_counts_every_product(n_variables: int, degree: int, n_terms: int) -> None:
    variables = [f"v{k}" for k in range(n_variables)]
    assert len(polynomial(variables, degree=degree)) == n_terms


def test_products_are_added_once_and_in_library_order() -> None:
    library = polynomial(["n_i", "n_n", "R_ion"], degree=2, products=["R_ion*n_n*n_i", "n_n*n_i"])
    assert library.names[-1] == "n_i*n_n*R_ion"
    assert len(library) == 11


def test_terms_evaluate_to_products_of_powers() -> None:
    values = np.array([[2.0, 3.0, 5.0], [-1.0, 0.5, 4.0]])
    library = named_terms(["x", "y", "z"], ["1", "x^2*z", "y", "x*y*z"])
    expected = [[1.0, 20.0, 3.0, 30.0], [1.0, 4.0, 0.5, -2.0]]
    assert np.array_equal(library.evaluate(values), expected)


def test_numpy_and_torch_agree_to_the_last_bit() -> None:
    values = np.random.default_rng(0).normal(size=(4, 7, 3)) * [1e18, 1e-14, 1.0]
    library = polynomial(["x", "y", "z"], degree=3)
    assert np.array_equal(
        library.evaluate(torch.from_numpy(values)).numpy(), library.evaluate(values)
    )


def test_evaluation_is_differentiable_in_torch() -> None:
    library = named_terms(["x", "y"], ["1", "x^2*y"])
    point = torch.tensor([3.0, 5.0], dtype=torch.float64, requires_grad=True)
    library.evaluate(point)[1].backward()
    assert point.grad is not None
    assert point.grad.tolist() == [30.0, 9.0]


def test_averages_of_products_are_variables() -> None:
    library = named_terms(["n_i", "<n_i*n_n>"], ["n_i*<n_i*n_n>^2"])
    assert library.names == ("n_i*<n_i*n_n>^2",)
    assert split_factors(library.names[0]) == [("n_i", 1), ("<n_i*n_n>", 2)]


def test_index_accepts_factors_in_any_order() -> None:
    assert polynomial(["x", "y"], degree=2).index("y*x") == 4


def test_units_multiply() -> None:
    library = named_terms(["n", "R", "u"], ["1", "n^2*R", "n*u", "R*n"])
    units = library.units({"n": "m^-3", "R": "m^3/s", "u": "m/s"})
    assert units == ("1", "m^-3 s^-1", "m^-2 s^-1", "s^-1")
    assert unit_product([("furlong_per_fortnight!", 2)]) == "furlong_per_fortnight!^2"


UNREADABLE = ["x^-1", "", "x+y", "x*", "2*x", "x y", "x^y"]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["x*q"], r"unknown variable 'q' in term 'x\*q'; there are \['x', 'y'\]"),
        *(([name], "a term is variables joined by") for name in UNREADABLE),
        (["x*y", "y*x"], "terms must be unique"),
        ([], "at least one term"),
    ],
)
def test_bad_terms_are_refused_by_name(names: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        named_terms(["x", "y"], names)


def test_unknown_term_names_what_exists() -> None:
    with pytest.raises(ValueError, match=r"unknown term 'x\^3'; this library has \['1', 'x'"):
        polynomial(["x"], degree=2).index("x^3")


def test_libraries_over_other_variables_do_not_join() -> None:
    with pytest.raises(ValueError, match="must share their variables"):
        _ = polynomial(["x"], degree=1) + polynomial(["y"], degree=1)


def test_repeated_variables_are_refused() -> None:
    with pytest.raises(ValueError, match="variables must be unique"):
        Library(["x", "x"], np.array([[1, 0]]))
    with pytest.raises(ValueError, match="degree must be a whole number"):
        polynomial(["x"], degree=-1)


POINTS = np.random.default_rng(3).normal(size=(5, 2))


def test_functions_of_variables_are_factors_of_terms() -> None:
    library = waves()
    assert library.names == ("1", "v^2", "x*sin(2*x)*v", "sin(2*x)^2")
    assert library.units({"x": "m", "v": "m/s"}) == ("1", "m^2 s^-2", "m^2 s^-1", "1")
    assert library.index("v * sin(2*x) * x") == 2
    x, v = POINTS.T
    expected = np.stack([x**0, v**2, x * np.sin(2 * x) * v, np.sin(2 * x) ** 2], axis=1)
    np.testing.assert_allclose(library.evaluate(POINTS), expected, rtol=1e-14)
    together = library.evaluate(torch.from_numpy(POINTS)).numpy()
    np.testing.assert_allclose(together, expected, rtol=1e-14)


def test_functions_follow_their_chain_rule() -> None:
    x, v = POINTS.T
    sine, cosine = np.sin(2 * x), np.cos(2 * x)
    by_x = np.stack([0 * x, 0 * x, v * sine + 2 * x * v * cosine, 4 * sine * cosine], axis=1)
    by_v = np.stack([0 * x, 2 * v, x * sine, 0 * x], axis=1)
    np.testing.assert_allclose(waves().jacobian(POINTS), [by_x, by_v], rtol=1e-13, atol=1e-15)


def test_terms_in_other_units_have_the_values_they_had() -> None:
    scale = np.array([3.0, 0.25])
    scaled, factors = waves().scaled(scale)
    expected = waves().evaluate(POINTS)
    np.testing.assert_allclose(scaled.evaluate(POINTS / scale) * factors, expected, rtol=1e-13)


def test_points_one_by_one_and_other_orders_of_variables_agree_with_samples() -> None:
    library = waves()
    reordered = library.over(["u", "v", "x"]).take(np.array([3, 2]))
    assert reordered.names == ("sin(2*x)^2", "v*x*sin(2*x)")
    values, terms = library.at_points(["v", "u", "x"], np.array([3, 2]))
    for x, v in POINTS:
        values[:] = v, 7.0, x
        expected = library.evaluate(np.array([x, v]))[[3, 2]]
        np.testing.assert_allclose(terms(), expected, rtol=1e-14)
        found = reordered.evaluate(np.array([7.0, v, x]))
        np.testing.assert_allclose(found, expected, rtol=1e-14)


@pytest.mark.parametrize("way", ["multiple shooting", "simplex"])
def test_a_model_with_functions_is_integrated_and_refined(way: str) -> None:
    """A pendulum: its energy v^2/2 - 4 cos x stays, and its coefficients are found again."""
    library = named_terms(["x", "v"], ["v", "sin(x)"])
    pendulum = SparseModel(library, ["x", "v"], np.array([[1.0, 0.0], [0.0, -4.0]]))
    t = np.linspace(0.0, 6.0, 301)
    start = Trajectory(t=t, states=np.stack([2.0 - 0.01 * t, -t], axis=1), state_names=["x", "v"])
    path = pendulum.rollout(start).states
    assert np.ptp(path[:, 1] ** 2 / 2 - 4.0 * np.cos(path[:, 0])) < 1e-6
    run = Trajectory(t=t, states=path, state_names=["x", "v"])
    off = replace(pendulum, coef=pendulum.coef * 1.03)
    simplex = {"method": NelderMead(), "free_start": False} if way == "simplex" else {}
    found = refine(off, [run], n_windows=4, window=60, rng=np.random.default_rng(0), **simplex)
    # Steps of 0.02 by Runge-Kutta or Hermite-Simpson are exact to 1e-7 and better.
    np.testing.assert_allclose(found.model.coef, pendulum.coef, atol=1e-5)


def test_names_tell_the_variables_they_need() -> None:
    assert variables_of("y^2*<n_i*n_n>*y") == ["y", "<n_i*n_n>"]
    assert variables_of(" 1 ") == []
    assert read_term("y*x*y", ["x", "y"]).name == "x*y^2"


@pytest.mark.parametrize(
    "unit",
    [
        *sorted(units.PLAIN),
        "m^-3",
        "m^3/s",
        "m^-3 s^-1",
        "1/s",
        "m^2/s^2",
        "A m^-2",
        "m/s/s",
        "s m^-1 V",
    ],
)
def test_what_needs_no_registry_reads_as_the_registry_does(unit: str) -> None:
    plain = units._plain_powers(unit)
    registry = units.registry()
    parsed = registry.parse_units(unit)._units
    assert plain == {registry.get_symbol(name): power for name, power in parsed.items()}


@pytest.mark.parametrize("unit", ["m/s V", "mm", "eV m^-3 sr", "m^0.5", "2 m", "furlong", "m^ 2"])
def test_other_units_are_left_to_the_registry(unit: str) -> None:
    assert units._plain_powers(unit) is None
