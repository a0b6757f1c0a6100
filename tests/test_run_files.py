"""Runs with their operating points: by the names of files, or by what the files say themselves."""

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.data.runs import trajectories_of
from ep2sindy.data.trajectory import ConstantStateError, check_agreement

T = np.linspace(0.0, 1.0, 40)
POINT = {"V_D_V": 0.1 + 0.2, "mdot_mg_s": 5}
Z = np.array([0.0, 0.01, 0.02, 0.03])
FIELD = xr.Dataset(
    {
        name: (("time", "z"), np.outer(wave, 1.0 + Z), {"units": "m^-3"})
        for name, wave in (("n_i", 2.0 + np.sin(7 * T)), ("n_n", 2.0 + np.cos(7 * T)))
    },
    coords={"time": ("time", T, {"units": "s"}), "z": ("z", Z, {"units": "m"})},
)


def run_at(point: dict, **changes: object) -> ep.Trajectory:
    states = np.column_stack([np.sin(7 * T), np.cos(7 * T)])
    return replace(ep.Trajectory(T, states, ["x", "y"]), parameters=point, **changes)


def write_table(name: str, **columns: object) -> None:
    path = Path(name)
    path.parent.mkdir(exist_ok=True)
    run_at({}).to_dataframe().rename_axis("time").assign(**columns).to_csv(path)


def test_a_trajectory_keeps_its_point_as_finite_numbers() -> None:
    run = run_at(POINT | {"k": np.int64(3)}, units={"V_D_V": "V", "x": "A"})
    assert dict(run.parameters) == {"V_D_V": 0.1 + 0.2, "mdot_mg_s": 5.0, "k": 3.0}
    assert {type(value) for value in run.parameters.values()} == {float}
    assert dict(run.units) == {"x": "A", "y": "1", "V_D_V": "V", "mdot_mg_s": "1", "k": "1"}
    with pytest.raises(TypeError):
        run.parameters["k"] = 4.0  # ty: ignore
    missing = np.zeros((40, 2), dtype=bool)
    missing[3, 0] = True
    lacking = replace(run, missing=missing)
    for part in (run.window(3, 9), lacking.complete(), *run.segments()):
        assert (part.parameters, part.units) == (run.parameters, run.units)
    assert "Trajectory at V_D_V=0.3, mdot_mg_s=5, k=3: 40 samples" in repr(run)


@pytest.mark.parametrize(
    ("point", "message"),
    [
        ({"V": np.inf}, "a parameter must be a finite number, got V=inf"),
        ({"x": 3.0}, "a name that no variable has, got 'x'"),
    ],
)
def test_what_is_no_point_is_refused(point: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        run_at(point)


def test_units_of_a_parameter_agree() -> None:
    runs = [run_at({"V": V}, units={"V": unit}) for V, unit in ((200, "V"), (300, "V"), (4, "kV"))]
    check_agreement(runs[:2], [])
    check_agreement([run_at({}), runs[0]], [])
    with pytest.raises(ValueError, match="'V' is in V in trajectory 0 and in kV in trajectory 2"):
        check_agreement(runs, [])


def test_a_dataset_keeps_the_point_and_takes_no_other_scalar_for_one(tmp_path: Path) -> None:
    run = run_at(POINT, units={"mdot_mg_s": "mg s^-1"})
    data = run.to_xarray().assign_coords(z=0.01)  # left by .sel(z=...)
    data.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    for each in (data, xr.load_dataset(tmp_path / "a.nc", engine="h5netcdf")):
        (again,) = trajectories_of(each)
        assert (again.parameters, again.units) == (run.parameters, run.units)
    (read,) = ep.read_runs(str(tmp_path / "*.nc"), parameters=[*POINT])
    assert (read.parameters, read.units) == (run.parameters, run.units)
    np.testing.assert_array_equal(read.states, run.states)
    (plain,) = trajectories_of(data.drop_vars([*POINT]))
    assert not plain.parameters


def test_names_of_files_tell_the_points(here: Path) -> None:
    for name in ("V300_m4p5", "V300_m-5", "V1000_m4p5", "V300_mold"):
        write_table(f"runs/{name}.csv", u=2.0, V=3.0, frame=np.arange(40))
    with pytest.warns(UserWarning, match="left out, .* no number there: runs/V300_mold.csv"):
        runs = ep.read_runs(
            "runs/V{V_D_V}_m{mdot_mg_s}.csv",
            parameters=["V"],
            inputs=["u"],
            units={"V_D_V": "kV", "u": "mm"},
        )
    assert [run.label for run in runs] == [
        f"runs/{name}.csv" for name in ("V300_m-5", "V300_m4p5", "V1000_m4p5")
    ]
    assert dict(runs[1].parameters) == {"V_D_V": 3e5, "mdot_mg_s": 4.5, "V": 3.0}
    assert dict(runs[1].units) == {
        "x": "1", "y": "1", "u": "m", "V_D_V": "V", "mdot_mg_s": "mg s^-1", "V": "1",
    }  # fmt: skip
    for run in runs:
        assert (run.state_names, run.input_names) == (("x", "y"), ("u",))
        np.testing.assert_array_equal(run.t, T)
        np.testing.assert_array_equal(run.states, run_at({}).states)
        np.testing.assert_array_equal(run.inputs, np.full((40, 1), 0.002))


def test_files_say_their_points_in_columns_scalars_and_attributes(here: Path) -> None:
    write_table("a.csv", **{"Vd [kV]": 0.3, "m": 5.0, "k": [np.nan, *[2] * 39]})
    with h5py.File("b.h5", "w") as file:
        file["t"], file["x"], file["y"] = T, np.sin(7 * T), np.cos(7 * T)
        file["Vd"] = [300.0]
        file["Vd"].attrs["units"] = "V"
        file.attrs["m"], file.attrs["k"] = np.float32(5.0), np.int64(2)
    data = run_at({}).to_xarray().assign_coords(Vd=((), 0.3, {"units": "kV"}))
    data.assign_attrs(m=5, k=2.0).to_netcdf("c.nc", engine="h5netcdf")
    runs = ep.read_runs(["a.csv", "b.h5", Path("c.nc")], parameters=["Vd", "m", "k"])
    for run in runs:
        assert dict(run.parameters) == {"Vd": 300.0, "m": 5.0, "k": 2.0}
        assert dict(run.units) == {"x": "1", "y": "1", "Vd": "V", "m": "1", "k": "1"}
        np.testing.assert_array_equal(run.states, run_at({}).states)
    check_agreement(runs, [])


def test_what_is_constant_in_every_file_is_no_state(here: Path) -> None:
    write_table("a1.csv", **{"mdot [mg/s]": 4.6, "still": 1.0})
    write_table("a2.csv", **{"mdot [mg/s]": 5.0, "still": np.sin(T)})
    with pytest.raises(ConstantStateError, match="a1.csv: a state must vary: 'still'.*leave the f"):
        ep.read_runs("a{a}.csv")
    write_table("a2.csv", **{"mdot [mg/s]": 5.0, "still": 2.0})
    runs = ep.read_runs("a{a}.csv", parameters=["mdot"])
    assert [run.state_names for run in runs] == [("x", "y")] * 2
    assert [run.parameters["mdot"] for run in runs] == pytest.approx([4.6e-6, 5e-6], rel=1e-15)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"parameters": ["U"]}, r"^a.csv: a parameter must be .*: 'U' is none of its \['V'\]"),
        (
            {"parameters": ["x"]},
            "^a.csv: a parameter must be constant: 'x' runs from -0.99",
        ),
        ({"files": ["a.csv", Path("../here/a.csv")]}, "every file may come once: .*a.csv comes ag"),
        ({"files": "field.nc", "states": ["n_i"]}, "^field.nc: a field over z needs a zone"),
    ],
)
def test_files_that_tell_no_run_are_refused_by_name(
    settings: dict, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    write_table("a.csv", V=300.0)
    write_table("a1.csv")
    ep.data.write_field(FIELD, "field.nc")
    with pytest.raises(ValueError, match=message):
        ep.read_runs(settings.pop("files", "a.csv"), **settings)


def test_a_field_is_averaged_over_the_zone(here: Path) -> None:
    ep.data.write_field(FIELD, here / "m5.nc")
    zone = ep.Zone(z=(0.005, 0.025))
    (run,) = ep.read_runs("m{m}.nc", inputs=["n_n"], zone=zone)
    assert run.names == ("n_i", "n_n")
    np.testing.assert_allclose(run.states[:, 0], 1.015 * (2.0 + np.sin(7 * T)), rtol=1e-14)
    assert dict(run.parameters) == {"m": 5.0}


def test_times_without_a_unit_are_seconds_unless_it_is_given(here: Path) -> None:
    write_table("a.csv")
    np.testing.assert_array_equal(ep.read_runs("a.csv")[0].t, T)
    (run,) = ep.read_runs("a.csv", units={"time": "ms"})
    np.testing.assert_allclose(run.t, T / 1e3, rtol=1e-15)
    pd.DataFrame({"x": np.sin(7 * T)}).to_csv("b.csv", index=False)
    np.testing.assert_allclose(ep.read_runs("b.csv", dt_s=0.5)[0].t, 0.5 * np.arange(40))
