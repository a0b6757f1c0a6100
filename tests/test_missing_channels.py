"""Channels of their own rates, equations that hold next to others, and states that are missing."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

import ep2sindy as ep
from ep2sindy.estimation.explanation import unobserved_state
from ep2sindy.estimation.problem import scale_problem
from ep2sindy.systems.systems import System, van_der_pol
from tests.models import model_of

LORENZ = ep.lorenz()
LIBRARY = LORENZ.model.library


def every_third(run: ep.Trajectory, state: int = 2) -> ep.Trajectory:
    """The run with a state that is measured at every third instant alone."""
    states = run.states.copy()
    states[np.arange(run.n_samples) % 3 != 0, state] = np.nan
    return ep.Trajectory(run.t, states, run.state_names, missing=np.isnan(states))


def test_a_slow_channel_is_taken_as_it_was_measured() -> None:
    run = LORENZ.trajectory(noise=0.1, rng=0)
    found = ep.estimate(every_third(run), LIBRARY)
    assert not found.lack_of_fit
    assert found.data_warnings == ("z was measured at 1000 of 3000 samples",)
    for state in run.state_names:
        assert set(found.model.terms(state)) == set(LORENZ.model.terms(state))
    true_std = 0.1 * np.sqrt(np.square(LORENZ.trajectory().states).mean(axis=0))
    np.testing.assert_allclose(found.noise_std, true_std, rtol=0.08)
    assert found.model.covariance is not None
    std = np.sqrt(np.diag(found.model.covariance))
    used = LORENZ.model.coef.T != 0.0
    off = (found.model.coef - LORENZ.model.coef).T[used] / std
    assert np.sqrt(np.square(off).mean()) < 2.0


def test_what_is_missing_plays_no_part() -> None:
    """Any numbers in its place give the same result, to the last digit."""
    run = every_third(LORENZ.trajectory(noise=0.1, rng=0).window(0, 900))
    other = run.states.copy()
    other[run.missing] = -1e3
    again = ep.Trajectory(run.t, other, run.state_names, missing=run.missing)
    first, second = (ep.estimate(each, LIBRARY).model.coef for each in (run, again))
    assert np.array_equal(first, second)


def test_a_table_may_lack_single_values() -> None:
    """A search of trajectories takes the rest of the row; a regression leaves the row out."""
    run = LORENZ.trajectory(noise=0.02, rng=0)
    table = pd.DataFrame(run.states, columns=list(run.state_names)).assign(t=run.t)
    rng = np.random.default_rng(0)
    for name in run.state_names:
        table.loc[rng.random(len(table)) < 0.2, name] = np.nan
    with pytest.warns(ep.data.MissingSamples, match=r"of 3000 samples are missing \(NaN\): x "):
        found = ep.discover(table, LIBRARY)
    assert found.estimate is not None
    kept = int(table[list(run.state_names)].notna().any(axis=1).sum())
    assert len(found.estimate.paths[0]) == kept
    assert set(found.model.terms("z")) == {"x*y", "z"}
    with pytest.warns(ep.data.MissingSamples):
        rows = ep.discover(table, LIBRARY, ep.Regression())
    assert set(rows.model.terms("z")) == {"x*y", "z"}


def test_complete_samples_and_windows_keep_what_is_missing() -> None:
    run = every_third(LORENZ.trajectory().window(0, 30))
    assert run.missing is not None
    part = run.window(1, 10)
    assert part.missing is not None
    assert part.missing[:, 2].tolist() == [True, True, False] * 3
    assert run.complete().n_samples == 10
    assert run.complete().missing is None
    assert part.complete().complete().n_samples == 3
    assert "30 samples (z lacks 20)" in repr(run)
    assert "lacks" not in repr(run.complete())


@pytest.mark.parametrize(
    ("missing", "message"),
    [
        (np.tile([True, False], (5, 1)), r"every state needs samples: all of \['x'\] are missing"),
    ],
)
def test_masks_that_mean_nothing_are_refused(missing: np.ndarray, message: str) -> None:
    states = np.arange(10.0).reshape(5, 2)
    with pytest.raises(ValueError, match=message):
        ep.Trajectory(np.arange(5.0), states, ["x", "y"], missing=missing)


@pytest.mark.slow
def test_an_equation_that_is_closed_holds_next_to_one_that_is_not() -> None:
    """Lorenz without z: x' = 10 (y - x) needs no z, and y' does."""
    run = LORENZ.trajectory(noise=0.05, rng=0).window(0, 900)
    two = ep.Trajectory(run.t, run.states[:, :2], ["x", "y"])
    found = ep.estimate(two, ep.polynomial(["x", "y"], degree=2))
    assert found.explained_states == ("x",)
    assert found.lack_of_fit.startswith(
        "no law of this library explains y: a term or a state is missi"
    )
    assert found.model.terms("x") == pytest.approx({"x": -10.0, "y": 10.0}, rel=0.02)
    assert found.process_noise_std[1] > 5.0 * found.process_noise_std[0]
    assert found.model.covariance is None


def problem_of(run: ep.Trajectory, degree: int = 2):
    return scale_problem([run], ep.polynomial(run.state_names, degree=degree))


def test_a_single_state_that_swings_lacks_another() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    one = ep.Trajectory(run.t[::3], run.states[::3, :1], ["x"])
    assert unobserved_state(problem_of(one)).startswith("x passes the same values up and down")
    found = ep.estimate(one, ep.polynomial(["x"], degree=2))
    assert "A state is missing for certain: x passes the same" in found.lack_of_fit
    assert "Name a hidden state (hidden=[...])" in found.lack_of_fit


def test_a_path_that_crosses_itself_lacks_a_state() -> None:
    """Rossler in the plane of x and y turns about a centre and overlaps itself."""
    model = model_of(
        {
            "x": {"y": -1.0, "z": -1.0},
            "y": {"x": 1.0, "y": 0.2},
            "z": {"1": 0.2, "x*z": 1.0, "z": -5.7},
        }
    )
    system = System("rossler", model, np.array([1.0, -4.0, 0.1]), 80.0, 20.0)
    run = system.trajectory(noise=0.005, rng=0)
    whole = unobserved_state(problem_of(run))
    plane = unobserved_state(problem_of(ep.Trajectory(run.t, run.states[:, [0, 2]], ["x", "z"])))
    assert whole == ""
    assert plane == "the path of x and z crosses itself, which no law of x and z alone does"


@pytest.mark.parametrize("system", [ep.lotka_volterra(), van_der_pol()], ids=lambda s: s.name)
@pytest.mark.parametrize("noise", [0.0, 0.02, 0.1])
def test_two_states_with_a_law_never_show_that_one_is_missing(system: System, noise: float) -> None:
    assert unobserved_state(problem_of(system.trajectory(noise=noise, rng=1))) == ""


def test_inputs_may_move_a_state_up_and_down() -> None:
    t = np.linspace(0.0, 20.0, 400)
    drive = np.sin(t)[:, None]
    run = ep.Trajectory(t, np.cos(t)[:, None], ["x"], inputs=drive, input_names=["u"])
    assert unobserved_state(scale_problem([run], ep.polynomial(["x", "u"], degree=1))) == ""
