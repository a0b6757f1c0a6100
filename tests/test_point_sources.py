"""Operating points of a study from files: by their names, by what they state, by axes of one."""

from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.app.arguments import mend
from ep2sindy.app.schema import study_of
from ep2sindy.studies.points import Study
from ep2sindy.studies.resume import pieces_key
from tests.programs import composed

T, KV = np.linspace(0.0, 1.0, 50), np.array([0.2, 0.25, 0.3])
WAVES = 2.0 + np.sin(9.0 * T + 1e1 * KV[:, None])
ONE_STATE = ["++models={own: {terms: {x: ['1']}}}", "trajectory.states=[x]"]


def write_files() -> None:
    """One file with all points, of arrays with and without named axes, and one for each point."""
    axes = {"V": ("V", KV, {"units": "kV"}), "time": ("time", T, {"units": "s"})}
    field = xr.Dataset({"x": (("V", "time"), WAVES, {"units": "A"})}, axes)
    field.to_netcdf("map.nc", engine="h5netcdf")
    with h5py.File("map.h5", "w") as file:
        file["x"], file["time_s"], file["V"] = WAVES, T, 1e3 * KV
    for k, wave in enumerate(field["x"].values):
        one = xr.Dataset({"x": ("time", wave), "m": 5.0}, {"time": axes["time"]})
        one.assign_attrs(V=1e3 * KV[k]).to_netcdf(f"V{k}.nc", engine="h5netcdf")


def sources(*typed: str) -> list:
    settings = ["+exp=predict", "data=recognised", *ONE_STATE, *typed]
    return list(study_of(Study, composed(*map(mend, settings)))._given.sources)


ASKED = "+parameters={V: null}"


@pytest.mark.parametrize(
    "typed",
    [
        ["points.files=V*.nc", ASKED],
        ["points.files=[V2.nc,V0.nc,V1.nc]", ASKED],
        ["data.path=map.nc", "points.axes=[V]"],
        ["data.path=map.h5", "points.axes=[V]"],
    ],
)
def test_points_are_read_from_files(typed: list[str], here: Path) -> None:
    write_files()
    runs = [source.open([]).run for source in sources(*typed)]
    assert [dict(run.parameters) for run in runs] == [{"V": 1e3 * V} for V in KV]
    np.testing.assert_array_equal([run.states[:, 0] for run in runs], WAVES)


def test_names_of_files_come_before_what_they_state(here: Path) -> None:
    write_files()
    found = sources("points.files=V{V}.nc", "+parameters={V: null, m: null}", "law=['1']")
    assert [dict(each.parameters) for each in found] == [{"V": k, "m": 5.0} for k in range(3)]


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        (
            ["points.files=V*.nc", "+parameters={U: null}"],
            r"^V0.nc: .*'U' is none of its \['m', 'V",
        ),
        (["points.files=V*.nc"], r"need parameters: a name in braces .*'\+parameters=\{V: null\}'"),
        (["data.path=map.nc", "points.axes=[x]"], r"axis of map.nc must be one of \['V', 'time'\]"),
        (["points.files=W*.nc", ASKED], "no file fits the pattern 'W"),
    ],
)
def test_points_that_files_lack_are_refused(typed: list[str], message: str, here: Path) -> None:
    write_files()
    with pytest.raises(ValueError, match=message):
        sources(*typed)


def test_a_value_that_an_axis_has_not_is_refused(here: Path) -> None:
    write_files()
    with pytest.raises(ValueError, match=r"V must be one of \[0.2, 0.25, 0.3\], got 0.21"):
        ep.open_field("map.nc", at={"V": 0.21})


def test_pieces_depend_on_the_files_of_a_pattern(here: Path) -> None:
    write_files()
    settings = {"points": "V*.nc"}
    before = pieces_key(settings)
    Path("V3.nc").write_bytes(Path("V2.nc").read_bytes())
    assert pieces_key(settings) != before


def test_a_steady_record_is_a_point_without_a_run(here: Path) -> None:
    write_files()
    still = xr.load_dataset("V1.nc", engine="h5netcdf")
    still.assign(x=0.0 * still["x"] + 3.0).to_netcdf("V1.nc", engine="h5netcdf")
    opened = [source.open([]) for source in sources("points.files=V*.nc", ASKED)]
    assert [point.status == "steady" for point in opened] == [False, True, False]
    assert opened[1].run is None
