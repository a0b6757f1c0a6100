"""Samples as tables and Datasets, and back: what comes from pandas and xarray is a run at once."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.data.runs import trajectories_of

RUN = ep.Trajectory(
    t=np.linspace(0.0, 2e-3, 40),
    states=np.stack([np.sin(np.arange(40)), np.cos(np.arange(40))], axis=1),
    state_names=["n_i", "n_n"],
    inputs=np.arange(40.0)[:, None],
    input_names=["V"],
    units={"n_i": "m^-3", "n_n": "m^-3", "V": "V"},
)


def test_a_table_holds_the_samples_over_time_in_seconds() -> None:
    table = RUN.to_dataframe()
    assert list(table.columns) == ["n_i", "n_n", "V"]
    assert table.index.name == "time_s"
    np.testing.assert_array_equal(table.index, RUN.t)
    np.testing.assert_array_equal(table.to_numpy(), RUN.values)
    (again,) = trajectories_of(table.drop(columns="V"))
    np.testing.assert_array_equal(again.states, RUN.states)


def test_a_dataset_keeps_units_and_comes_back_as_a_run() -> None:
    data = RUN.to_xarray()
    assert {str(n): v.attrs["units"] for n, v in data.variables.items()} == {
        "n_i": "m^-3",
        "n_n": "m^-3",
        "V": "V",
        "time": "s",
    }
    (again,) = trajectories_of(data[["n_i", "n_n"]])
    np.testing.assert_array_equal(again.states, RUN.states)
    np.testing.assert_array_equal(again.t, RUN.t)
    assert dict(again.units) == {"n_i": "m^-3", "n_n": "m^-3"}


def test_a_dataset_keeps_the_unit_in_which_times_are_shown() -> None:
    run = ep.Trajectory(
        86400.0 * np.arange(40.0), RUN.states, ["x", "y"], clock=ep.library.Clock.of("day")
    )
    (again,) = trajectories_of(run.to_xarray())
    assert again.clock == run.clock
    ahead = ep.lotka_volterra().model.simulate(np.linspace(0.0, 20.0, 500), [1.0, 1.0])
    (again,) = trajectories_of(replace(ahead, clock=run.clock).to_xarray())
    assert again.clock == run.clock


def test_what_was_not_measured_is_nan() -> None:
    states = RUN.states.copy()
    missing = np.zeros(states.shape, dtype=bool)
    missing[3:6, 1] = True
    run = ep.Trajectory(RUN.t, states, ["x", "y"], missing=missing)
    assert np.isnan(run.to_dataframe()["y"]).to_numpy().nonzero()[0].tolist() == [3, 4, 5]
    assert int(np.isnan(run.to_xarray()["y"]).sum()) == 3
    assert not np.isnan(run.to_dataframe()["x"]).any()


@pytest.mark.parametrize("name", [None, "when", "time"])
def test_an_index_of_dates_is_time(name: str | None) -> None:
    dates = pd.date_range("2026-01-01", periods=40, freq="6h", name=name)
    table = pd.DataFrame(RUN.states, index=dates, columns=["x", "y"])
    (run,) = trajectories_of(table)
    assert run.state_names == ("x", "y")
    assert run.t[:3].tolist() == [0.0, 21600.0, 43200.0]
    assert run.clock == ep.library.Clock.of("h")


@pytest.mark.parametrize(
    ("name", "unit", "seconds"),
    [("Year", "year", 31557600.0), ("Time (h)", "h", 3600.0), ("time_us", "s", 1e-6)],
)
@pytest.mark.parametrize("is_index", [False, True])
def test_a_time_column_may_be_called_by_its_unit(
    name: str, unit: str, seconds: float, is_index: bool
) -> None:
    table = pd.DataFrame({name: np.arange(40.0), "x": RUN.states[:, 0]})
    (run,) = trajectories_of(table.set_index(name) if is_index else table)
    assert run.state_names == ("x",)
    assert run.clock == ep.library.Clock.of(unit)
    np.testing.assert_allclose(run.t, seconds * np.arange(40.0), rtol=1e-12)


def test_a_column_of_years_next_to_times_is_a_state() -> None:
    table = pd.DataFrame({"t": np.arange(40.0), "year": RUN.states[:, 0]})
    (run,) = trajectories_of(table)
    assert run.state_names == ("year",)


def test_a_field_keeps_the_unit_of_time_of_its_file(tmp_path: Path) -> None:
    table = pd.DataFrame({"day": np.arange(40.0), "x": RUN.states[:, 0]})
    table.to_csv(tmp_path / "a.csv", index=False)
    (run,) = trajectories_of(ep.open_field(tmp_path / "a.csv"))
    assert run.clock == ep.library.Clock.of("day")


def test_a_field_over_a_grid_is_no_run_and_the_error_says_what_makes_one() -> None:
    field = xr.Dataset({"n_i": (("time", "z"), np.ones((5, 3)))}, coords={"time": np.arange(5.0)})
    with pytest.raises(ValueError, match=r"dimension time alone .*'time', 'z'.* ep.zone_average"):
        trajectories_of(field)


def test_a_rollout_is_a_table() -> None:
    model = ep.lotka_volterra().model
    run = model.simulate(np.linspace(0.0, 20.0, 500), [1.0, 1.0])
    table, data = run.to_dataframe(), run.to_xarray()
    np.testing.assert_array_equal(table[["x", "y"]].to_numpy(), run.states)
    np.testing.assert_array_equal(data["x"], run.states[:, 0])


def test_a_library_has_degree_two_unless_another_is_asked_for() -> None:
    assert ep.polynomial(["x", "y"]).names == ep.polynomial(["x", "y"], degree=2).names
