from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ep2sindy as ep

VARIABLES = ["n_i", "n_n", "R_ion"]
UNITS = {"n_i": "m^-3", "n_n": "m^-3", "R_ion": "m^3/s"}


def breathing() -> ep.SparseModel:
    library = ep.named_terms(VARIABLES, ["1", "n_i", "n_n", "n_i*n_n", "n_i*n_n*R_ion"])
    equations = [{"n_i": -2.62e5, "n_i*n_n": 5.481e-14}, {"1": 1.83e23, "n_i*n_n*R_ion": -0.77}]
    return ep.SparseModel(library, ["n_i", "n_n"], ep.model.coef_matrix(library, equations), UNITS)


def driven(rate: float = 2.0) -> tuple[ep.SparseModel, ep.Trajectory]:
    """x' = -rate x + u with u = sin t, whose solution is known."""
    library = ep.polynomial(["x", "u"], degree=1)
    model = ep.SparseModel(library, ["x"], ep.model.coef_matrix(library, [{"x": -rate, "u": 1.0}]))
    t = np.linspace(0.0, 5.0, 201)
    exact = np.exp(-rate * t) * (1 + 1 / (rate**2 + 1))
    exact += (rate * np.sin(t) - np.cos(t)) / (rate**2 + 1)
    run = ep.Trajectory(
        t=t,
        states=exact[:, None],
        state_names=["x"],
        inputs=np.sin(t)[:, None],
        input_names=["u"],
    )
    return model, run


def test_model_prints_as_equations() -> None:
    expected = "n_i' = -2.6e+05 n_i + 5.5e-14 n_i n_n\nn_n' = 1.8e+23 - 0.77 n_i n_n R_ion"
    assert breathing().text(digits=2) == expected


def test_an_empty_equation_prints_as_zero() -> None:
    model = ep.SparseModel(ep.polynomial(["x"], degree=1), ["x"], np.zeros((2, 1)))
    assert model.text() == "x' = 0"
    assert r"\dot{x} &= 0" in model.latex()
    assert model.sympy()["x"] == 0


def test_derivative_finds_its_variables_in_any_order() -> None:
    library = ep.named_terms(["u", "y", "x"], ["u*x", "y"])
    model = ep.SparseModel(library, ["x", "y"], np.array([[1.0, 0.0], [0.0, 3.0]]))
    assert model.inputs == ("u",)
    slope = model.derivative(np.array([[2.0, 5.0]]), np.array([[7.0]]))
    assert slope.tolist() == [[14.0, 15.0]]


def test_a_file_is_written_whole_and_read_back(tmp_path: Path) -> None:
    model = breathing()
    model.save(tmp_path / "models" / "simple.json")
    assert ep.SparseModel.load(tmp_path / "models" / "simple.json") == model
    assert [p.name for p in (tmp_path / "models").iterdir()] == ["simple.json"]


def test_rollout_of_a_window_starts_from_the_data() -> None:
    model, run = driven()
    rollout = model.rollout(run, start=50, n_samples=40)
    assert np.array_equal(rollout.t, run.t[50:90])
    assert rollout.states[0] == pytest.approx(run.states[50])
    assert np.abs(rollout.states - run.states[50:90]).max() < 1e-6
    with pytest.raises(ValueError, match="initial must give a finite number for each of"):
        model.rollout(run, initial=np.ones(7))


def test_rollout_conserves_what_predator_and_prey_conserve() -> None:
    system = ep.lotka_volterra()
    run = system.trajectory()
    x, y = system.model.rollout(run).states.T
    invariant = x - np.log(x) / 3 + y - 2 / 3 * np.log(y)
    assert np.ptp(invariant) < 1e-6


def test_a_blow_up_is_reported_and_cut() -> None:
    library = ep.named_terms(["x"], ["x^2"])
    model = ep.SparseModel(library, ["x"], np.array([[1.0]]))
    t = np.linspace(0.0, 2.0, 401)
    run = ep.Trajectory(t=t, states=(1.0 + 0.1 * t)[:, None], state_names=["x"])
    rollout = model.rollout(run)  # 1/(1 - t): infinite at t = 1
    assert rollout.diverged
    assert "grew past 100 times the data's largest value at t = 0.99 s" in rollout.message
    assert rollout.t[-1] <= 1.0
    assert np.isfinite(rollout.states).all()


def test_bad_coefficients_are_refused() -> None:
    library = ep.polynomial(["x"], degree=1)
    with pytest.raises(ValueError, match="one row per term and one column per equation"):
        ep.SparseModel(library, ["x"], np.zeros((3, 1)))


def test_intervals_come_from_the_covariance_of_their_own_equation() -> None:
    plain = breathing()
    variances = np.array([1e6, 1e-32, 1e42, 1e-4])
    model = replace(plain, covariance=np.diag(variances))
    low, high = model.intervals("n_n")["n_i*n_n*R_ion"]
    assert (low, high) == pytest.approx((-0.77 - 0.0195996, -0.77 + 0.0195996), rel=1e-6)
    low, high = model.intervals("n_i", level=0.6826894921)["n_i"]
    assert (low, high) == pytest.approx((-2.63e5, -2.61e5), rel=1e-9)


def test_equal_models_compare_equal_and_hash_alike() -> None:
    model = ep.lorenz().model
    again = ep.SparseModel.from_json(model.to_json())
    assert again == model
    assert len({model, again, replace(model, provenance={"from": "elsewhere"})}) == 1
    minus_zero = replace(model, coef=np.where(model.coef == 0.0, -0.0, model.coef))
    assert minus_zero == model
    assert hash(minus_zero) == hash(model)


@pytest.mark.parametrize(
    "change",
    [
        {"coef": ep.lorenz().model.coef * (1.0 + 1e-15)},
        {"units": {"x": "m"}},
        {"covariance": np.eye(7)},
        {"states": ["z", "y", "x"]},
        {"library": ep.polynomial(["x", "y", "z"], degree=2).take(np.arange(10)[::-1])},
    ],
)
def test_models_that_differ_are_not_equal(change: dict[str, Any]) -> None:
    model = ep.lorenz().model
    assert replace(model, **change) != model
    assert model != model.text()
    with_covariance = replace(model, covariance=np.eye(7))
    assert with_covariance == replace(model, covariance=np.eye(7))
    assert with_covariance != replace(model, covariance=2.0 * np.eye(7))
