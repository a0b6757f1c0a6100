"""Right-hand sides as sums of products: rates, Jacobian, perturbations, units and entries."""

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.model.vector_field import VectorField, entries_of
from tests.models import model_of

PENDULUM = {"x": {"v": 1.0}, "v": {"sin(x)": -4.0, "v": -0.1, "u*x^2": 0.3}}


def pendulum() -> ep.SparseModel:
    return model_of(PENDULUM, inputs=["u"])


def points(n_variables: int, n: int = 20) -> np.ndarray:
    return np.random.default_rng(0).uniform(0.5, 2.0, (n, n_variables))


def test_rates_and_jacobian_are_those_of_the_formula() -> None:
    values = points(3)
    x, v, u = values.T
    field = pendulum().field
    expected = np.stack([v, -4.0 * np.sin(x) - 0.1 * v + 0.3 * u * x**2], axis=1)
    np.testing.assert_allclose(field.rates(values), expected, rtol=1e-14)
    jacobian = np.zeros((len(x), 2, 2))
    jacobian[:, 0, 1], jacobian[:, 1, 1] = 1.0, -0.1
    jacobian[:, 1, 0] = -4.0 * np.cos(x) + 0.6 * u * x
    np.testing.assert_allclose(field.jacobian(values), jacobian, rtol=1e-13)
    at, rates = field.at_point()
    at[:] = values[3]
    np.testing.assert_allclose(rates(), expected[3], rtol=1e-14)


def test_terms_without_a_coefficient_are_not_evaluated() -> None:
    """log(x) has no value at -1, and no coefficient."""
    library = ep.polynomial(["x"], degree=1, functions=["log"])
    model = ep.SparseModel(library, ["x"], ep.model.coef_matrix(library, [{"x": -2.0}]))
    assert model.field.library.names == ("x",)
    assert model.field.rates(np.array([-1.0])) == 2.0


def test_a_model_without_terms_rests() -> None:
    library = ep.polynomial(["x", "y"], degree=2)
    field = VectorField.of(library, ["x", "y"], np.zeros((len(library), 2)))
    assert not field.rates(points(2)).any()
    assert not field.with_perturbations().rates(points(6)).any()


@pytest.mark.parametrize("system", [ep.lorenz(), ep.systems.van_der_pol()])
def test_departures_follow_the_linearised_equations(system: ep.systems.System) -> None:
    field, d = system.model.field, len(system.model.states)
    values = points(d + d * d)
    rates = field.with_perturbations().rates(values)
    jacobian = field.jacobian(values[:, :d])
    np.testing.assert_allclose(rates[:, :d], field.rates(values[:, :d]), rtol=1e-14)
    perturbations = values[:, d:].reshape(-1, d, d)  # each a row
    expected = np.einsum("njv,nrv->nrj", jacobian, perturbations)
    np.testing.assert_allclose(rates[:, d:], expected.reshape(len(values), -1), rtol=1e-12)


def test_departures_of_functions_do_so_too() -> None:
    model = model_of({"x": {"v": 1.0}, "v": {"sin(x)": -4.0}})
    values = points(6)
    rates = model.field.with_perturbations().rates(values)
    np.testing.assert_allclose(rates[:, 3], -4.0 * np.cos(values[:, 0]) * values[:, 2], rtol=1e-13)


def test_units_of_states_and_time_change_and_inputs_stay() -> None:
    field, scale, values = pendulum().field, np.array([1e3, 1e-5]), points(3)
    scaled = field.scaled(scale, time_s=0.01)
    in_units = np.append(values[:, :2] / scale, values[:, 2:], axis=1)
    expected = field.rates(values) * 0.01 / scale
    np.testing.assert_allclose(scaled.rates(in_units), expected, rtol=1e-12)


def test_several_models_are_evaluated_as_each_is() -> None:
    library, rng = ep.polynomial(["x", "y"], degree=2), np.random.default_rng(1)
    coefs, values = rng.normal(size=(3, len(library), 2)), rng.normal(size=(3, 5, 2))
    together = VectorField(library, coefs).rates(values)
    for coef, at, found in zip(coefs, values, together, strict=True):
        np.testing.assert_allclose(found, VectorField(library, coef).rates(at), rtol=1e-14)


def test_entries_are_the_weights_that_are_not_zero() -> None:
    table, weights = np.array([[0, 1], [0, 0]]), np.array([[0.0, 2.0], [3.0, 4.0]])
    _, product, target, weight = entries_of(table, weights)
    assert product.tolist() == [0, 1, 1]
    assert target.tolist() == [1, 0, 1]
    assert weight.tolist() == [2.0, 3.0, 4.0]
