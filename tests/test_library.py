from __future__ import annotations

import numpy as np
import pytest
import torch

from ep2sindy.library import units
from ep2sindy.library.library import named_terms, polynomial
from ep2sindy.library.names import split_factors
from ep2sindy.library.terms import read_term, variables_of
from ep2sindy.library.units import unit_product


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


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (["x*q"], r"unknown variable 'q' in term 'x\*q'; there are \['x', 'y'\]"),
        (["x+y"], "a term is variables joined by"),
        (["x*y", "y*x"], "terms must be unique"),
    ],
)
def test_bad_terms_are_refused_by_name(names: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        named_terms(["x", "y"], names)


def test_points_one_by_one_and_other_orders_of_variables_agree_with_samples() -> None:
    library = named_terms(["x", "v"], ["1", "v^2", "x*sin(2*x)*v", "sin(2*x)^2"])
    assert library.index("v * sin(2*x) * x") == 2
    reordered = library.over(["u", "v", "x"]).take(np.array([3, 2]))
    assert reordered.names == ("sin(2*x)^2", "v*x*sin(2*x)")
    values, terms = reordered.at_points()
    for x, v in np.random.default_rng(3).normal(size=(5, 2)):
        values[:] = 7.0, v, x
        expected = library.evaluate(np.array([x, v]))[[3, 2]]
        np.testing.assert_allclose(terms(), expected, rtol=1e-14)
        found = reordered.evaluate(np.array([7.0, v, x]))
        np.testing.assert_allclose(found, expected, rtol=1e-14)


def test_names_tell_the_variables_they_need() -> None:
    assert variables_of("y^2*<n_i*n_n>*y") == ["y", "<n_i*n_n>"]
    assert variables_of(" 1 ") == []
    assert read_term("y*x*y", ["x", "y"]).name == "x*y^2"


@pytest.mark.parametrize(
    "unit",
    [
        *sorted(units.PLAIN),
        "m^3/s",
        "m^-3 s^-1",
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
