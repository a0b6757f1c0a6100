import numpy as np
import pandas as pd
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.data.runs import trajectories_of

T = np.linspace(0.0, 3.0, 31)
X = np.column_stack([np.exp(-T), np.sin(T)])


@pytest.mark.parametrize("time", ["time", "t", "time_s", "t_s"])
def test_a_table_has_its_time_in_a_column_and_states_in_the_others(time: str) -> None:
    (run,) = trajectories_of(pd.DataFrame({"a": X[:, 0], time: T, "b": X[:, 1]}))
    assert run.state_names == ("a", "b")
    np.testing.assert_array_equal(run.t, T)
    np.testing.assert_array_equal(run.states, X)


def test_arrays_are_named_x() -> None:
    assert trajectories_of((T, X))[0].state_names == ("x0", "x1")
    assert trajectories_of((T, X[:, 0]))[0].state_names == ("x",)


def test_numbered_columns_are_named_as_those_of_arrays() -> None:
    """A state called 1 could not be distinguished from the constant term."""
    table = pd.DataFrame(X).assign(t=T)
    assert trajectories_of(table)[0].state_names == ("x0", "x1")


@pytest.mark.parametrize("name", ["1", "", "x^2", "x*y", "=cmd", "a b", "1/x", "<a", "x\n", "${x}"])
def test_names_that_no_term_could_hold_are_refused_at_every_door(name: str) -> None:
    message = r"must be a word of letters, digits and _, .*; rename it, perhaps '[a-z]\w*'"
    with pytest.raises(ValueError, match=message):
        trajectories_of(pd.DataFrame({"t": T, name: X[:, 0], "y": X[:, 1]}))
    with pytest.raises(ValueError, match=message):
        ep.Trajectory(T, X, ["y", name])
    with pytest.raises(ValueError, match=message):
        ep.Library(["y", name], np.eye(2, dtype=np.int64))


def test_averages_of_products_are_names() -> None:
    assert ep.Trajectory(T, X, ["x", "<x^2*y>"]).names == ("x", "<x^2*y>")


def test_columns_that_repeat_are_refused() -> None:
    table = pd.DataFrame(np.column_stack([T, X]), columns=["t", "x", "x"])
    with pytest.raises(ValueError, match=r"got \['t', 'x', 'x'\]; rename or drop those"):
        trajectories_of(table)


@pytest.mark.parametrize(
    ("runs", "message"),
    [
        ([T, X], "a run must be a Trajectory, a pandas DataFrame .* run 0 of the list is of type"),
        (pd.DataFrame({"x": T}), r"must have one time column, .* its columns are \['x'\]"),
        ((T, X.T), r"must have shapes .*, got \(31,\) and \(2, 31\)"),
    ],
    ids=str,
)
def test_what_is_no_run_is_refused(runs: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        trajectories_of(runs)


def test_discover_needs_no_more_than_data() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=np.random.default_rng(0))
    found = ep.discover((run.t, run.states))
    assert found.model.library.names == ("1", "x0", "x1", "x0^2", "x0*x1", "x1^2")
    assert set(found.model.terms("x0")) == {"x0", "x0*x1"}
    assert found.model.covariance is not None
    for state, chosen in found.chosen.items():
        assert chosen.coef_by_term == found.model.terms(state)


def test_a_seed_and_its_generator_give_the_same() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=np.random.default_rng(0))
    recipe = ep.Regression(ep.Differential(), ep.AdaptiveLasso(), ep.Knee(), ep.Bootstraps(n=4))
    one = ep.discover(run, method=recipe, seed=3)
    other = ep.discover(run, method=recipe, seed=np.random.default_rng(3))
    assert np.array_equal(one.model.coef, other.model.coef)


def test_a_model_takes_runs_as_discover_does() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    table = pd.DataFrame({"t": run.t, "x": run.states[:, 0], "y": run.states[:, 1]})
    model = ep.discover(table).model
    assert model.score(table) == model.score(run)
    assert np.array_equal(model.predict(table), model.predict(run))
    assert np.array_equal(model.rollout(table).states, model.rollout(run).states)


def test_units_in_the_names_of_a_table_are_those_of_a_file() -> None:
    table = pd.DataFrame({"Time (ms)": 1e3 * T, "prey (mV)": X[:, 0], "n_i [cm^-3]": X[:, 1]})
    (run,) = trajectories_of(table)
    assert dict(run.units) == {"prey": "V", "n_i": "m^-3"}
    np.testing.assert_allclose(run.t, T)
    np.testing.assert_allclose(run.states, X * [1e-3, 1e6])


PREY = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
TIMES, SAMPLES = PREY.t, PREY.states


@pytest.mark.parametrize(
    ("runs", "given"),
    [
        (SAMPLES, {"t": TIMES}),
        (SAMPLES, {"t": PREY.dt_s}),
        (pd.DataFrame(SAMPLES, columns=["x0", "x1"]), {"t": TIMES}),
        (pd.DataFrame(SAMPLES, columns=["x0", "x1"]), {"t": PREY.dt_s}),
        (pd.DataFrame({"time (ms)": 1e3 * TIMES, "x0": SAMPLES[:, 0], "x1": SAMPLES[:, 1]}), {}),
        (
            xr.Dataset(
                {"x0": ("time", SAMPLES[:, 0]), "x1": ("time", SAMPLES[:, 1])},
                coords={"time": ("time", 1e3 * TIMES, {"units": "ms"})},
            ),
            {},
        ),
    ],
    ids=["array", "step", "table", "table and step", "table in ms", "Dataset in ms"],
)
def test_times_come_with_samples_or_next_to_them(runs: object, given: dict) -> None:
    (run,) = trajectories_of(runs, **given)
    np.testing.assert_allclose(run.t, TIMES, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(run.states, SAMPLES)
    assert list(run.state_names) == ["x0", "x1"]


def test_several_arrays_take_times_for_each_or_one_step() -> None:
    parts = [SAMPLES[:400], SAMPLES[500:]]
    by_times = trajectories_of(parts, t=[TIMES[:400], TIMES[500:]])
    by_step = trajectories_of(parts, t=PREY.dt_s)
    for run, part in zip([*by_times, *by_step], parts + parts, strict=True):
        np.testing.assert_array_equal(run.states, part)
    with pytest.raises(ValueError, match="t must hold times for each run, got 1 for 2"):
        trajectories_of(parts, t=[TIMES])


def test_a_dict_labels_its_runs() -> None:
    first, second = trajectories_of({"300 V": (TIMES, SAMPLES), "400 V": (TIMES, SAMPLES + 1.0)})
    assert (first.label, second.label) == ("300 V", "400 V")


def test_columns_may_be_inputs() -> None:
    table = pd.DataFrame(
        {"time": TIMES, "x": SAMPLES[:, 0], "u": np.sin(TIMES), "y": SAMPLES[:, 1]}
    )
    (run,) = trajectories_of(table, inputs=["u"])
    assert (list(run.state_names), list(run.input_names)) == (["x", "y"], ["u"])
    np.testing.assert_array_equal(run.states, SAMPLES)
    np.testing.assert_array_equal(run.inputs[:, 0], np.sin(TIMES))
    assert trajectories_of(run, inputs=["u"])[0].input_names == run.input_names
    with pytest.raises(ValueError, match=r"unknown inputs \['v'\]; the run has"):
        trajectories_of(table, inputs=["v"])


def test_arrays_lack_samples_as_tables_do() -> None:
    holes = SAMPLES.copy()
    holes[7, 0] = np.nan
    holes[9] = np.nan
    table = pd.DataFrame({"time": TIMES, "x0": holes[:, 0], "x1": holes[:, 1]})
    for partial in (False, True):
        with pytest.warns(ep.data.MissingSamples, match="NaN"):
            (ours,) = trajectories_of((TIMES, holes), partial=partial)
        with pytest.warns(ep.data.MissingSamples):
            (theirs,) = trajectories_of(table, partial=partial)
        assert ours.n_samples == len(TIMES) - (1 if partial else 2)
        np.testing.assert_array_equal(ours.states, theirs.states)
    with (
        pytest.warns(ep.data.MissingSamples),
        pytest.raises(ValueError, match=r"an input needs a value at every sample: \['x0'\] lack"),
    ):
        trajectories_of(table, inputs=["x0"], partial=True)
