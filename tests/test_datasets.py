"""The records that are shipped, and what they show."""

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.discovery.one_signal import fit_functions


def test_the_records_are_as_published() -> None:
    swing = ep.data.pendulum_swing()
    assert swing.n_samples == 5500
    assert swing.dt_s == pytest.approx(1e-3)
    assert swing.units["theta"] == "rad"
    pelts = ep.data.hare_lynx()
    assert pelts.states[[0, -1], 0].tolist() == [30.0, 24.7]
    assert pelts.clock.duration_text(pelts.t[-1]) == "20 years"
    counts = ep.data.gause()
    assert counts.states.shape == (18, 2)
    assert counts.clock.unit == "day"


def test_predator_and_prey_forecast_the_pelts_better_than_persistence() -> None:
    run = ep.data.hare_lynx()
    named = ep.named_terms(["hare", "lynx"], ["hare", "lynx", "hare*lynx"])
    terms = {"hare": ("hare", "hare*lynx"), "lynx": ("lynx", "hare*lynx")}
    model = ep.discover(run.window(0, 14), named.only(terms)).model
    skill = ep.model.forecast_skill(model, run, n_fitted=14)
    a_year = skill.at(run.dt_s)
    assert a_year["model"] < 0.4 < a_year["persistence"]


def test_dry_friction_is_found_with_its_width() -> None:
    """A swing under gravity and friction, whose sign turns over a width of 0.1 rad/s."""
    library = ep.polynomial(["x", "v"], degree=1, functions=["sign(10*v)"])
    coef = ep.model.coef_matrix(library, [{"v": 1.0}, {"x": -40.0, "sign(10*v)": -0.5}])
    truth = ep.SparseModel(library, ["x", "v"], coef)
    run = truth.simulate(np.linspace(0.0, 8.0, 1601), [0.5, 0.0]).trajectory()
    seen = []

    def lack_of_fit(functions: list[str]) -> float:
        tried = ep.polynomial(["x", "v"], degree=1, functions=functions)
        theta, rate = tried.evaluate(run.states), truth.predict(run)[:, 1]
        left = rate - theta @ np.linalg.lstsq(theta, rate, rcond=None)[0]
        seen.append(tried)
        return float(left @ left)

    (found,) = fit_functions(["sign(?*v)"], run, lack_of_fit)
    factor = float(found.removeprefix("sign(").removesuffix("*v)"))
    assert factor == pytest.approx(10.0, rel=0.02)
    assert len(seen) < 40
    with pytest.raises(ValueError, match=r"no number in the place of \?"):
        fit_functions(["sign(?*v)"], run, lambda tried: np.inf)


def test_a_smooth_sign_is_integrated_written_and_stored() -> None:
    library = ep.polynomial(["v"], degree=1, functions=["sign(10*v)"])
    model = ep.SparseModel(library, ["v"], ep.model.coef_matrix(library, [{"sign(10*v)": -1.0}]))
    run = model.simulate(np.linspace(0.0, 2.0, 201), [1.0])
    assert run.states[50, 0] == pytest.approx(0.5, abs=1e-3)  # a constant force, until it rests
    assert run.states[-1, 0] == pytest.approx(0.0, abs=1e-3)
    assert r"\tanh(10 \, v)" in model.latex()
    at_one = float(model.sympy()["v"].subs({"v": 1.0}))
    assert at_one == pytest.approx(-np.tanh(10.0))
    assert ep.SparseModel.from_json(model.to_json()).terms("v") == model.terms("v")
