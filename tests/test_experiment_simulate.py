"""`+exp=simulate`: one run, one that breaks, and what studies say of simulations."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import xarray as xr
from omegaconf import DictConfig

from ep2sindy.app.runner import run_config
from ep2sindy.app.schema import Configured, plain, study_of
from ep2sindy.figures import breathing
from ep2sindy.runtime.files import WriteError
from ep2sindy.studies import points as studied
from ep2sindy.studies.source import DivergedError, amiss, check_recorded, doubts
from tests import programs
from tests.programs import summary_of

GOOD = {
    "status": "oscillating", "cycle": "strong", "f_kHz": 14.0, "I_d_mean": 4.0, "I_d_std": 5.0,
    "parameters": "{}", "mass_balance": 1.0, "energy_balance": 0.9996, "rates": "covered",
}  # fmt: skip


def composed(*overrides: str) -> DictConfig:
    return programs.composed("+exp=simulate", *overrides)


def toy(folder: Path) -> list[str]:
    """Overrides that run the experiment on short, coarse simulations, in this process."""
    return [
        "thruster=two_cycles",  # a set that says all of itself: the default one is tuned
        "data.operating_point.neutral_speed=280.0",
        "data.stretch=1.0",
        f"output={folder}/outputs",
        f"data.cache={folder}/cache",
        "data.duration_s=6.0e-4",
        "data.warm_up_s=0.0",
        "data.n_cells=24",
        "data.progress=false",
        "parallel=serial",
    ]


@pytest.fixture(scope="module")
def one(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_config(composed(*toy(tmp_path_factory.mktemp("one"))))


@pytest.fixture(scope="module")
def field(one: Path) -> xr.Dataset:
    with xr.open_dataset(one / "field.nc", engine="h5netcdf", decode_times=False) as stored:
        return stored.load()


def test_a_run_keeps_its_field_and_says_what_it_did(one: Path, field: xr.Dataset) -> None:
    summary = summary_of(one)
    run = summary["performance"]["run"]
    assert run["status"] == field.attrs["status"] == "oscillating"
    assert (
        run["I_d_mean"]
        == summary["headline"]["run/I_d_mean"]
        == pytest.approx(float(field["I_d"].mean()))
    )
    assert run["thrust_N"] == pytest.approx(float(field["thrust"].mean()))
    assert run["initial"] == "guessed profiles"
    power = {name: row["power_W"] for name, row in summary["power"].items()}
    parts = sum(value for name, value in power.items() if name != "P_in")
    assert parts == pytest.approx(power["P_in"])
    assert power["stored"] == pytest.approx(0.0, abs=0.02 * power["P_in"])  # nothing is lost


def test_every_figure_and_table_of_a_run_is_there(one: Path) -> None:
    for name in ("current", "profiles", "maps"):
        assert (one / "figures" / f"{name}.png").stat().st_size > 8e3
    profiles = pd.read_csv(one / "tables" / "profiles.csv")
    assert len(profiles) == 24
    assert (profiles["n_i_min"] <= profiles["n_i_low"]).all()
    assert (profiles["n_i_high"] <= profiles["n_i_max"]).all()


def test_figures_show_the_last_periods(field: xr.Dataset) -> None:
    window = breathing.last_periods(field["time"].values, field.attrs["f_kHz"], 3.0)
    seconds = float(np.ptp(field["time"].values[window]))
    assert seconds == pytest.approx(3e-3 / field.attrs["f_kHz"], abs=4e-6)


def test_fields_over_r_are_averaged_by_area(field: xr.Dataset) -> None:
    r = xr.DataArray([0.04, 0.05], dims="r", coords={"r": [0.04, 0.05]})
    names = ["n_i", "n_n", "u_iz", "T_e_eV", "E_z", "ionization"]
    both = xr.concat([field[names], 2.0 * field[names]], dim=r["r"])
    for name in names:
        both[name].attrs = field[name].attrs
    both = both.assign({name: field[name] for name in ("I_d", "I_beam")})
    both.attrs = field.attrs
    expected = (0.04 + 2.0 * 0.05) / 0.09 * field["n_i"].values
    np.testing.assert_allclose(breathing.along_z(both["n_i"]), expected, rtol=1e-5)
    assert breathing.profile_table(both)["n_i_mean"].to_numpy() == pytest.approx(
        expected.mean(axis=0), rel=1e-5
    )


def test_a_run_that_cannot_be_cached_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "cache").write_text("a file, and no folder")
    with pytest.raises(WriteError, match="cache could not be written"):
        run_config(composed(*toy(tmp_path)))


def test_a_place_that_the_config_leaves_to_its_default_can_be_changed() -> None:
    data = Configured(plain(composed().data), "data")
    changed = data.changed({"thruster.transport.c_plume": 0.02, "cfl": 0.5})
    transport = changed.settings["thruster"]["transport"]
    assert transport["_target_"] == "ep2sindy.thruster.AnomalousTransport"
    assert transport["c_plume"] == 0.02
    assert transport["c_channel"] > 0.0
    assert "transport" not in data.settings["thruster"]


def test_a_run_that_breaks_at_once_is_reported(tmp_path: Path) -> None:
    folder = run_config(composed(*toy(tmp_path), "data.operating_point.voltage=5000.0"))
    summary = summary_of(folder)
    run = summary["performance"]["run"]
    assert (run["status"], run["n_samples"], run["thrust_N"]) == ("diverged", 0, None)
    assert summary["warnings"] == ["the simulation diverged: the end of its record is no physics"]


def test_an_operating_point_that_broke_has_a_row_of_its_own(tmp_path: Path) -> None:
    point = "points=[{V_D_V: 5000.0, mdot_mg_s: 5.0}]"
    config = programs.composed("+exp=parametric", *toy(tmp_path), point)
    study = study_of(studied.Study, config)
    (source,) = study._given.sources
    opened = source.open([])
    assert (opened.status, opened.run) == ("diverged", None)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({}, None),
        ({"status": "steady"}, "the simulation is steady: there is no oscillation"),
        ({"rates": "the rates of krypton cover T_e up to 100 eV"}, "the rates of krypton"),
        ({"mass_balance": 1.002}, "mass balance does not close: (out + stored)/in is 1.0020"),
    ],
)
def test_what_is_amiss_with_a_simulation_is_reported(change: dict, message: str | None) -> None:
    found = amiss(GOOD | change)
    assert len(found) == (message is not None)
    if message is not None:
        assert message in found[0]
        assert doubts(GOOD | change) == ([] if "status" in change else found)


def test_a_record_that_broke_late_can_be_studied() -> None:
    long = xr.Dataset(coords={"time": np.arange(300.0)}, attrs=GOOD | {"status": "diverged"})
    check_recorded(long)
    check_recorded(xr.Dataset(coords={"time": np.arange(3.0)}, attrs=GOOD))
    with pytest.raises(DivergedError, match="it diverged after 100"):
        check_recorded(long.isel(time=slice(100)))
