import re
from pathlib import Path

import h5py
import numpy as np
import pytest
import xarray as xr
from hydra.utils import instantiate
from nptdms import ChannelObject, TdmsWriter
from scipy.io import savemat

from ep2sindy.data.mapping import Variable
from ep2sindy.data.open import inspect_file, open_field, read_field, write_field
from ep2sindy.data.quantities import conversion, same_unit
from ep2sindy.data.readers.source import look_at
from tests.programs import composed

RNG = np.random.default_rng(3)
NT, NZ, NR = 6, 4, 3
TIME = np.array([0.0, 1.0, 2.0, 4.0, 5.0, 7.0]) * 1e-6
Z = np.linspace(0.0, 0.03, NZ)
R = np.linspace(0.02, 0.04, NR)
N_I = RNG.uniform(1.0, 2.0, (NT, NZ, NR))
T_E = RNG.uniform(5.0, 20.0, (NT, NZ))
I_D = RNG.uniform(3.0, 5.0, NT)
ARRAYS = {"t": TIME, "z": Z, "r": R, "ni": N_I, "Te": T_E, "Id": I_D}
MAPPING = {
    "n_i": Variable("ni", "m^-3"),
    "T_e_eV": Variable("Te", "eV"),
    "I_d": Variable("Id", "A"),
    "u_iz": Variable(None, "m/s"),
}
AXES = {"time": Variable("t", "s"), "z": Variable("z", "m"), "r": Variable("r", "m")}
SETTINGS = {"variables": MAPPING, **AXES}


def dataset() -> xr.Dataset:
    """The arrays with the dimension names of some other code."""
    dims = {"t": "t", "z": "z", "r": "r", "ni": ("t", "z", "r"), "Te": ("t", "z"), "Id": "t"}
    return xr.Dataset({name: (dims[name], values) for name, values in ARRAYS.items()})


def write_netcdf4(path: Path) -> None:
    dataset().to_netcdf(path, engine="h5netcdf")


def write_netcdf3(path: Path) -> None:
    dataset().to_netcdf(path, engine="scipy", format="NETCDF3_64BIT")


def write_zarr(path: Path) -> None:
    dataset().to_zarr(path, consolidated=False, zarr_format=2 if path.stem == "v2" else 3)


def write_hdf5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        for name, values in ARRAYS.items():
            file[name] = values


def write_matlab5(path: Path) -> None:
    savemat(path, {**ARRAYS, "note": "text"}, do_compression=True)


def write_matlab73(path: Path) -> None:
    """As MATLAB does: a text header of 512 bytes, axes reversed, vectors as (1, n) or (n, 1)."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, values in ARRAYS.items():
            file[name] = values[None] if values.ndim == 1 else values.T
        file["#refs#/a"] = 1.0
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\x00\x02IM")


def test_matlab_objects_are_named_and_take_nothing_with_them(tmp_path: Path) -> None:
    """Timetables, tables and strings of v7.3 are numbers that refer to others in the file."""
    path = tmp_path / "run.mat"
    write_matlab73(path)
    with h5py.File(path, "r+") as file:
        file["TT"] = np.array([[0xDD000000, 2, 1, 1, 1, 1]], dtype="u4")
        file["TT"].attrs["MATLAB_class"] = np.bytes_("timetable")
        file["TT"].attrs["MATLAB_object_decode"] = np.int32(3)
    assert re.search(r"TT +left out", str(inspect_file(path)))
    assert open_field(path, **SETTINGS)["n_i"].dims == ("time", "z", "r")


def write_npz(path: Path) -> None:
    np.savez(path, **ARRAYS)


WRITERS = {
    "field.nc": write_netcdf4,
    "classic.nc": write_netcdf3,
    "field.zarr": write_zarr,
    "v2.zarr": write_zarr,
    "field.h5": write_hdf5,
    "v7.mat": write_matlab5,
    "v73.mat": write_matlab73,
    "field.npz": write_npz,
}


@pytest.mark.parametrize("name", WRITERS)
def test_every_kind_of_file_gives_the_same_field(tmp_path: Path, name: str) -> None:
    WRITERS[name](tmp_path / name)
    field = open_field(tmp_path / name, **SETTINGS)
    assert field["n_i"].dims == ("time", "z", "r")
    assert field["T_e_eV"].dims == ("time", "z")
    for ours, values in {"n_i": N_I, "T_e_eV": T_E, "I_d": I_D, "time": TIME, "z": Z}.items():
        assert np.array_equal(field[ours].values, values), ours
    units = {str(ours): array.attrs["units"] for ours, array in field.variables.items()}
    expected = {"n_i": "m^-3", "T_e_eV": "eV", "I_d": "A", "time": "s", "z": "m", "r": "m"}
    assert units == expected


def test_structs_and_groups_are_paths(tmp_path: Path) -> None:
    savemat(tmp_path / "s.mat", {"data": {"t": TIME, "ion": {"ni": N_I[:, 0, 0]}}})
    with h5py.File(tmp_path / "g.h5", "w") as file:
        file["data/t"], file["data/ion/ni"] = TIME, N_I[:, 0, 0]
    for name, dot in (("s.mat", "."), ("g.h5", "/")):
        field = open_field(
            tmp_path / name,
            variables={"n_i": Variable(f"data{dot}ion{dot}ni", "m^-3")},
            time=Variable(f"data{dot}t", "s"),
        )
        assert np.array_equal(field["n_i"].values, N_I[:, 0, 0])


@pytest.mark.parametrize("given", [True, False], ids=["given", "determined by lengths"])
@pytest.mark.parametrize("dims", [("r", "z", "time"), ("z", "time", "r"), ("time", "r", "z")])
def test_dimension_orders_are_undone(tmp_path: Path, dims: tuple[str, ...], given: bool) -> None:
    order = [("time", "z", "r").index(d) for d in dims]
    np.savez(tmp_path / "a.npz", **{**ARRAYS, "ni": N_I.transpose(order)})
    variable = Variable("ni", "m^-3", dims if given else None)
    field = open_field(tmp_path / "a.npz", variables={"n_i": variable}, **AXES)
    assert field["n_i"].dims == ("time", "z", "r")
    assert np.array_equal(field["n_i"].values, N_I)


def test_equal_lengths_ask_for_dims_instead_of_guessing(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=TIME, z=Z, r=Z + 1, Te=T_E, ni=np.ones((NT, NZ, NZ)))
    settings = {"variables": {"T_e_eV": Variable("Te", "eV")}, **AXES}
    with pytest.raises(ValueError, match=r"shape \(6, 4\) .*'z': 4, 'r': 4.*give data.variables"):
        open_field(tmp_path / "a.npz", **settings)
    settings["variables"] = {"T_e_eV": Variable("Te", "eV", ["time", "r"])}
    assert open_field(tmp_path / "a.npz", **settings)["T_e_eV"].dims == ("time", "r")


def test_axes_of_length_one_may_be_missing_in_the_file(tmp_path: Path) -> None:
    arrays = {"t": TIME[:, None], "z": [[0.01]], "r": R[None], "ni": N_I[:, :1, :]}
    savemat(tmp_path / "a.mat", arrays)  # the reader gets a scalar z and ni of shape (6, 3)
    variables = {"n_i": Variable("ni", "m^-3", ["time", "z", "r"])}
    field = open_field(tmp_path / "a.mat", variables=variables, **AXES)
    assert field["z"].values.tolist() == [0.01]
    assert np.array_equal(field["n_i"].values, N_I[:, :1, :])


def test_units_become_si_and_suffixes_keep_theirs(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz")
    units = {"n_i": ("ni", "1e12 cm^-3"), "T_K": ("Te", "degC"), "mdot_mg_s": ("Id", "kg/s")}
    variables = {ours: Variable(*theirs) for ours, theirs in units.items()}
    axes = {"time": Variable("t", "ms"), "z": Variable("z", "cm"), "r": Variable("r", "mm")}
    field = open_field(tmp_path / "a.npz", variables=variables, **axes)
    for ours, values, unit in (
        ("n_i", 1e18 * N_I, "m^-3"),
        ("T_K", T_E + 273.15, "K"),
        ("mdot_mg_s", 1e6 * I_D, "mg s^-1"),
        ("time", 1e-3 * TIME, "s"),
        ("z", 1e-2 * Z, "m"),
    ):
        assert field[ours].values == pytest.approx(values, rel=1e-15), ours
        assert field[ours].attrs["units"] == unit


@pytest.mark.parametrize(
    ("ours", "unit", "factor", "target"),
    [
        ("R_ion", "cm3/s", 1e-6, "m^3 s^-1"),
        ("B", "1e-4 T", 1e-4, "T"),
        ("x", "percent", 0.01, "1"),
        ("x", "1000 mm", 1.0, "m"),
    ],
)
def test_conversion_factors(ours: str, unit: str, factor: float, target: str) -> None:
    assert conversion(ours, unit) == (factor, 0.0, target)


@pytest.mark.parametrize(
    ("ours", "unit", "message"),
    [
        ("p", "furlongg^-3", "the unit of p must be one that converts to SI, got 'furlongg"),
        ("n_i", "s", "the unit of n_i must be one that converts to m\\^-3, got 's'"),
        ("B", "gauss", "'gauss' is not; write a gauss as '1e-4 T'"),
    ],
)
def test_units_without_a_factor_to_si_are_refused(ours: str, unit: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        conversion(ours, unit)


def test_a_unit_that_contradicts_the_file_is_refused(tmp_path: Path) -> None:
    written = dataset()
    written["ni"].attrs["units"] = "cm-3"
    written["Te"].attrs["units"] = "electron volts (mean)"
    written.to_netcdf(tmp_path / "a.nc", engine="h5netcdf")
    with pytest.raises(ValueError, match=r"unit of n_i must agree .* 'm\^-3', the file 'cm-3'"):
        open_field(tmp_path / "a.nc", **SETTINGS)
    agreed = {**MAPPING, "n_i": Variable("ni", "1/cm^3")}
    field = open_field(tmp_path / "a.nc", variables=agreed, **AXES)
    assert field["n_i"].values == pytest.approx(1e6 * N_I, rel=1e-15)
    assert same_unit("m^-3", "no unit at all")


def test_a_step_stands_in_for_time(tmp_path: Path) -> None:
    write_npz(tmp_path / "a.npz")
    for first in (MAPPING["n_i"], Variable("ni", "m^-3", ["time", "z", "r"])):
        field = open_field(
            tmp_path / "a.npz", **{**SETTINGS, "variables": {"n_i": first}}, dt_s=1.5e-6
        )
        assert np.array_equal(field["time"].values, 1.5e-6 * np.arange(NT))


def test_a_mask_leaves_only_the_plasma(tmp_path: Path) -> None:
    inside = np.ones((NZ, NR), dtype=int)
    inside[0, 1:] = 0
    np.savez(tmp_path / "a.npz", **ARRAYS, plasma=inside)
    field = open_field(tmp_path / "a.npz", **SETTINGS, mask=Variable("plasma", "1"))
    assert np.array_equal(np.isnan(field["n_i"].values), np.tile(inside == 0, (NT, 1, 1)))
    assert np.array_equal(field["T_e_eV"].values, T_E)


def test_float32_stays_float32_and_integers_become_real(tmp_path: Path) -> None:
    whole = {**ARRAYS, "ni": N_I.astype(np.float32), "Te": np.arange(NT * NZ).reshape(NT, NZ)}
    np.savez(tmp_path / "a.npz", **whole)
    variables = {**MAPPING, "n_i": Variable("ni", "cm^-3")}
    field = open_field(tmp_path / "a.npz", variables=variables, **AXES)
    assert field["n_i"].dtype == np.float32
    assert field["T_e_eV"].dtype == np.float64


def npz(path: Path, **changes: np.ndarray) -> Path:
    np.savez(path / "a.npz", **{**ARRAYS, **changes})
    return path / "a.npz"


@pytest.mark.parametrize(
    ("arrays", "settings", "message"),
    [
        (
            {},
            {"variables": {"n_i": Variable("nii", "m^-3")}},
            r"no variable 'nii' .* \(did .*'ni'.*\?\); it holds t \(6\), z \(4\), r \(3\), ",
        ),
        (
            {"ni": N_I[:5]},
            {},
            r"n_i must fit the grid: the file has shape \(5, 4, 3\) and the grid .*'time': 6",
        ),
        ({"t": np.r_[TIME[:5], 3e-6]}, {}, r"t must increase: t\[5\] = 3e-06 s follows 5e-06 s"),
        ({"ni": N_I.astype(object)}, {}, "cannot be read: Object arrays cannot be loaded"),
    ],
)
def test_a_mapping_that_does_not_fit_is_refused(
    tmp_path: Path, arrays: dict, settings: dict, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        open_field(npz(tmp_path, **arrays), **{**SETTINGS, **settings})


def write_userblock(path: Path) -> None:
    """HDF5 after a block of the user's own."""
    with h5py.File(path, "w", userblock_size=2048) as file:
        file["ni"] = N_I


def write_text(path: Path) -> None:
    path.write_text("t, Id\n0, 1\n")


def write_tdms(path: Path) -> None:
    with TdmsWriter(path) as writer:
        writer.write_segment([ChannelObject("a", n, x) for n, x in (("t", TIME), ("Id", I_D))])


KINDS = {
    **WRITERS,
    "daq.tdms": write_tdms,
    "classic.cdf": write_netcdf3,
    "field.nc4": write_netcdf4,
    "field.dat": write_hdf5,
    "block.h5": write_userblock,
    "probe.csv": write_text,
    "thruster.json": write_text,
}


@pytest.mark.parametrize("name", KINDS)
def test_hdf5_is_recognised_as_its_own_library_does(tmp_path: Path, name: str) -> None:
    KINDS[name](tmp_path / name)
    is_hdf5 = not name.endswith("zarr") and h5py.is_hdf5(tmp_path / name)
    assert (look_at(tmp_path / name)[0] == "hdf5") is is_hdf5


KNOWN = (
    r"MATLAB \(v5, v7.3\), npy, TDMS, NetCDF, HDF5 or npz, or end in .csv, .* or "
    ".zarr: "
)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("none.h5", None, "no such file: {folder}/none.h5"),
        ("a.json", '{"output": {"frames": [{"t": 0.0', "a.json (cannot be read|has no variable)"),
    ],
)
def test_what_is_no_file_of_a_known_kind_is_refused(
    tmp_path: Path, name: str, text: str | None, message: str
) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(ValueError, match=message.replace("{folder}", str(tmp_path))):
        open_field(tmp_path / name, **SETTINGS)


CUT = [n for n in WRITERS if not n.endswith("zarr")]


@pytest.mark.parametrize("fraction", [0.02, 0.5, 0.95])
@pytest.mark.parametrize("name", CUT)
def test_a_truncated_file_is_refused(tmp_path: Path, name: str, fraction: float) -> None:
    KINDS[name](tmp_path / name)
    content = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(content[: int(fraction * len(content))])
    with pytest.raises(ValueError, match=f"{name} (cannot be read|begins with)"):
        open_field(tmp_path / name, **SETTINGS)


def test_a_field_is_written_and_read_back_whole(tmp_path: Path) -> None:
    field = open_field(npz(tmp_path), **SETTINGS).assign_attrs(label="300 V, 5 mg/s")
    write_field(field, tmp_path / "deep" / "field.nc")
    assert read_field(tmp_path / "deep" / "field.nc").identical(field)
    variables = {"n_i": Variable("n_i", "m^-3")}
    own = {axis: Variable(axis, v.unit) for axis, v in AXES.items()}
    again = open_field(tmp_path / "deep" / "field.nc", variables=variables, **own)
    assert again["n_i"].identical(field["n_i"])


def test_a_written_field_is_netcdf(tmp_path: Path) -> None:
    field = open_field(npz(tmp_path), **SETTINGS)
    with pytest.raises(ValueError, match=r"to a name that ends in .nc, got .*field.h5"):
        write_field(field, tmp_path / "field.h5")
    with pytest.raises(ValueError, match=r"a written field is NetCDF: .*a.npz is not"):
        read_field(tmp_path / "a.npz")


def test_chunks_without_dask_name_the_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("ep2sindy.data.open.find_spec", lambda name: None)
    write_netcdf4(tmp_path / "a.nc")
    with pytest.raises(ValueError, match=r"data.chunks needs dask: pip install .*files"):
        open_field(tmp_path / "a.nc", **SETTINGS, chunks={"time": 2})


def test_chunks_stream_a_file(tmp_path: Path) -> None:
    pytest.importorskip("dask")
    write_netcdf4(tmp_path / "a.nc")
    variables = {"n_i": Variable("ni", "cm^-3")}
    field = open_field(tmp_path / "a.nc", variables=variables, **AXES, chunks={"time": 2})
    assert field["n_i"].chunks == ((2, 2, 2), (NZ,), (NR,))
    assert field["n_i"].values == pytest.approx(1e6 * N_I, rel=1e-15)


def opened(*overrides: str) -> xr.Dataset:
    """What `data=file` with these overrides opens."""
    return instantiate(composed("data=file", *overrides).data, _convert_="all")


def test_the_config_group_opens_a_file_without_code(tmp_path: Path) -> None:
    path = npz(tmp_path, nn=N_I.T)
    field = opened(
        f"data.path={path}",
        "data.variables.n_i.name=null",
        "data.variables.n_n={name: nn, unit: '1e19 m^-3', dims: [r,z,time]}",
        "+data.variables.x={name: Id, unit: 1}",
        "data.time={name: t, unit: us}",
        "data.r.name=r",
    )
    assert sorted(map(str, field.data_vars)) == ["n_n", "x"]
    assert field["x"].attrs["units"] == "1"
    assert field["n_n"].values == pytest.approx(1e19 * N_I, rel=1e-15)
    assert field["time"].values == pytest.approx(1e-6 * TIME, rel=1e-15)
