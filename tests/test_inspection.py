"""Files without a mapping: what they are taken for, what is asked, and what is made of it."""

import json
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from scipy.io import savemat

import ep2sindy as ep
from ep2sindy.data.fields import clock_of
from ep2sindy.data.inspection import compare_files
from ep2sindy.data.quantities import axis_of, axis_unit, conversion, quantity_of
from ep2sindy.data.readers.registry import open_source
from ep2sindy.data.recognition import recognise
from ep2sindy.data.runs import trajectories_of

NT, NZ, NR = 40, 7, 5
T = np.arange(NT) * 1.5e-6
Z, R = np.linspace(0.001, 0.031, NZ), np.linspace(0.035, 0.05, NR)
RNG = np.random.default_rng(5)
WAVE = RNG.uniform(1.0, 2.0, (NT, NZ, NR))
N_I, N_N, U_Z, T_E = 1e18 * WAVE, 5e18 * WAVE[::-1], 1e4 * WAVE, 20 * WAVE


@pytest.mark.parametrize(
    ("name", "unit", "ours"),
    [
        ("n_i", "m^-3", "n_i"), ("ni", "cm^-3", "n_i"), ("plasma/N_ion", "m^-3", "n_i"),
         ("ions.Xe.0.n", "m^-3", "n_i"), 
         ("ni_cm3", "", "n_i"), 
        ("ui.0", "m/s", "u_iz"),  ("neutrals.Ar.n", "m^-3", "n_n"),
        ("Te", "K", "T_e_eV"), ("Tev", "eV", "T_e_eV"), ("T_e_eV", "", "T_e_eV"),
          
        ("plasma dens.", "1e17 m^-3", "n_i"),
    ],
)  # fmt: skip
def test_a_short_name_needs_a_unit_that_fits(name: str, unit: str, ours: str) -> None:
    found = quantity_of(name, unit, plasma=False)
    assert found is not None
    assert found[0] == ours
    assert quantity_of(name, "kg", plasma=True) is None


@pytest.mark.parametrize(
    ("name", "ours"),
    [
        ("ionDensity", "n_i"), ("density_ion", "n_i"), 
        ("Vel_ion_z", "u_iz"),  ("ionization_rate", "R_ion"),
         ("Discharge voltage", "V_d"),
    ],
)  # fmt: skip
def test_a_full_name_stands_for_itself(name: str, ours: str) -> None:
    found = quantity_of(name, "", plasma=False)
    assert found is not None
    assert found[0] == ours
    assert quantity_of(name, "m^3", plasma=False) is None


@pytest.mark.parametrize("name", ["te", "rate", "id", "na", "n_i", "vi", "I_d", "current"])
def test_a_short_name_without_a_unit_is_the_users_unless_all_is_plasma(name: str) -> None:
    assert quantity_of(name, "", plasma=False) is None
    assert quantity_of(name, "", plasma=True) is not None


@pytest.mark.parametrize(
    ("name", "axis", "unit"),
    [
        ("time", "time", ""), ("t_us", "time", "us"), 
        ("Year", "time", "year"),
         ("mesh/axial_pos", "z", ""), ("radius", "r", ""), ("z_mm", "z", "mm"),
        ("T", None, ""), ("T (h)", None, ""), 
    ],
)  # fmt: skip
def test_axes_go_by_their_names(name: str, axis: str | None, unit: str) -> None:
    assert axis_of(name) == axis
    if axis is not None:
        assert axis_unit(axis, name, "") == unit


def odd_hdf5(path: Path, *, units: bool) -> None:
    """Odd names, axes reversed, no time; densities in cm^-3, temperatures in K."""
    with h5py.File(path, "w") as file:
        for name, values, unit in (
            ("out/ionDens", 1e-6 * N_I, "cm-3"),
            ("out/NeutralDensity", 1e-6 * N_N, "cm-3"),
            ("out/Te", T_E / 8.617333262145e-5, "K"),
            ("out/Vel_ion_z", U_Z, "m/s"),
        ):
            file[name] = values.T
            file[name].attrs["units"] = unit if units else ""
        file["mesh/axial_pos"], file["mesh/radial_pos"] = 100 * Z, 100 * R
        for name in ("mesh/axial_pos", "mesh/radial_pos"):
            file[name].attrs["units"] = "cm"


def test_an_odd_file_that_names_its_units_opens_with_its_step_alone(tmp_path: Path) -> None:
    odd_hdf5(tmp_path / "a.h5", units=True)
    with pytest.raises(ValueError, match="a field needs time: give the step between samples"):
        ep.open_field(tmp_path / "a.h5")
    field = ep.open_field(tmp_path / "a.h5", dt_s=1.5e-6)
    expected = {"n_i": N_I, "n_n": N_N, "T_e_eV": T_E, "u_iz": U_Z, "time": T, "z": Z, "r": R}
    for name, values in expected.items():
        np.testing.assert_allclose(field[name].values, values, rtol=1e-9, err_msg=name)
    assert field["n_i"].dims == ("time", "z", "r")


def test_without_units_short_names_stay_and_what_is_plasma_is_offered(tmp_path: Path) -> None:
    odd_hdf5(tmp_path / "a.h5", units=False)
    found = ep.inspect_file(tmp_path / "a.h5")
    units = {name: variable.unit for name, variable in found.variables.items()}
    assert units == {"n_i": "m^-3", "n_n": "m^-3", "u_iz": "m/s", "Te": "1"}
    assert found.lacking(["T_e_eV"])
    assert "T_e_eV" in ep.inspect_file(tmp_path / "a.h5", plasma=True).variables


@pytest.mark.parametrize(
    ("columns", "ours"),
    [
        (("ne_m3", "neutral_density"), ["n_i", "n_n"]),  # a plasma is quasi-neutral
        (("ne_m3", "neutral_density", "ni_m3"), ["n_n", "n_i", "ne_m3"]),
        (("ne", "neutral_density"), ["n_n", "ne"]),
        (("ne_m3", "x"), ["ne_m3", "x"]),  # no discharge, for all that is known
    ],
)
def test_electrons_next_to_neutrals_count_the_ions(
    columns: tuple[str, ...], ours: list[str], tmp_path: Path
) -> None:
    values = {name: WAVE[:, k, 0] for k, name in enumerate(columns)}
    found = ep.inspect_file(write_csv(tmp_path / "a.csv", time_s=T, **values))
    assert list(found.variables) == ours


HEART = {"rate": 70.0 + WAVE[:, 0, 0], "te": 60.0 + WAVE[:, 1, 0]}


def write_csv(path: Path, **columns: np.ndarray) -> Path:
    pd.DataFrame(columns).to_csv(path, index=False)
    return path


def test_the_users_own_names_stay(tmp_path: Path) -> None:
    """A heart's rate is no ionization rate, whatever its size."""
    field = ep.open_field(write_csv(tmp_path / "a.csv", time_s=T, **HEART))
    assert {n: field[n].attrs["units"] for n in field.data_vars} == {"rate": "1", "te": "1"}


def test_a_time_without_a_unit_is_asked_for_and_counters_are_no_signals(tmp_path: Path) -> None:
    path = write_csv(
        tmp_path / "a.csv", time=T, id=np.arange(NT) % 7, x=HEART["rate"], na=WAVE[:, 0, 0]
    )
    found = ep.inspect_file(path)
    assert list(found.variables) == ["id", "x", "na"]
    assert found.signals == ["x", "na"]
    with pytest.raises(
        ValueError, match=r"names no unit: give it, such as 'data.units=\{time:s\}'"
    ):
        ep.open_field(path)
    field = ep.open_field(path, units={"time": "ms"})
    np.testing.assert_allclose(field["time"].values, 1e-3 * T)
    clock = clock_of(ep.open_field(path, units={"time": "step"}))
    assert clock.duration_text(3.0) == "3 steps"
    assert clock.frequency_text(0.25) == "0.25 per step"


def test_columns_of_one_array_are_signals_of_their_own(tmp_path: Path) -> None:
    savemat(tmp_path / "a.mat", {"probe": WAVE[:, :2, 0], "t_s": T, "fs": 1.0})
    field = ep.open_field(tmp_path / "a.mat")
    np.testing.assert_array_equal(field["probe_1"].values, WAVE[:, 1, 0])
    one = ep.open_field(
        tmp_path / "a.mat",
        variables={"I_d": ep.data.Variable("probe[:, 1]", "mA")},
        time=ep.data.Variable("t_s", "s"),
    )
    np.testing.assert_allclose(one["I_d"].values, 1e-3 * WAVE[:, 1, 0])


@pytest.mark.parametrize(("name", "value"), [("fs", 1 / 1.5e-6), ("dt", 1.5e-6)])
def test_a_scalar_may_say_the_step(tmp_path: Path, name: str, value: float) -> None:
    savemat(tmp_path / "a.mat", {"signal": WAVE[:, 0, 0], name: value})
    field = ep.open_field(tmp_path / "a.mat")
    np.testing.assert_allclose(field["time"].values, T, rtol=1e-12)


@pytest.mark.parametrize(("factor", "unit"), [(1.0, "s"), (1e3, "ms"), (1e6, "us"), (7.0, "s")])
def test_a_rate_next_to_a_time_says_its_unit(tmp_path: Path, factor: float, unit: str) -> None:
    savemat(tmp_path / "a.mat", {"signal": WAVE[:, 0, 0], "t": factor * T, "fs": 1 / 1.5e-6})
    assert ep.inspect_file(tmp_path / "a.mat").time == ep.data.Variable("t", unit)


def test_equal_lengths_are_asked_not_guessed(tmp_path: Path) -> None:
    square = 1e18 * np.repeat(WAVE[:, :, :1], NZ, axis=2)
    np.savez(tmp_path / "a.npz", t=T, z=Z, r=R[0] + Z, ni=square, I_d=WAVE[:, 0, 0])
    found = recognise(open_source(tmp_path / "a.npz"), plasma=True)
    assert "n_i" not in found.variables
    wanted = "'ni' of shape (40, 7, 7) may be [time,z,r] or [time,r,z]"
    assert any(wanted in question for question in found.questions)


def test_two_names_for_one_quantity_are_asked(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=T, ni=N_I[:, 0, 0], ion_density=N_I[:, 1, 0])
    found = recognise(open_source(tmp_path / "a.npz"), plasma=True)
    assert "n_i may be 'ni' or 'ion_density': name one" in found.questions


def frames(*, old: bool) -> list[dict]:
    columns = zip(*(values[:, :, 0].tolist() for values in (N_I, U_Z, N_N)), strict=True)
    if old:
        return [{"ni": [n], "ui": [u], "nn": nn} for n, u, nn in columns]
    return [
        {"neutrals": {"Kr": {"n": nn}}, "ions": {"Kr": [{"n": n, "u": u, "Z": 1}]}}
        for n, u, nn in columns
    ]


def hallthruster(layout: str) -> object:
    """One run in a layout of HallThruster.jl."""
    old = layout != "0.22"
    each = frames(old=old)
    if layout == "beside":
        return {"t": T.tolist(), "grid": {"cell_centers": Z.tolist()}, "frames": each}
    each = [frame | {"t": t, "z": Z.tolist()} for frame, t in zip(each, T.tolist(), strict=True)]
    config = {"thruster": {"geometry": {"channel_length": 0.025}}}
    return each if old else {"input": {"config": config}, "output": {"frames": each}}


@pytest.mark.parametrize("layout", ["0.18", "0.22", "beside"])
def test_layouts_of_hallthruster_are_known(tmp_path: Path, layout: str) -> None:
    (tmp_path / "a.json").write_text(json.dumps(hallthruster(layout)))
    field = ep.open_field(tmp_path / "a.json")
    expected = {"n_i": N_I[:, :, 0], "n_n": N_N[:, :, 0], "u_iz": U_Z[:, :, 0], "time": T, "z": Z}
    for name, values in expected.items():
        np.testing.assert_array_equal(field[name].values, values, err_msg=name)
    assert field.attrs.get("channel_m") == (0.025 if layout == "0.22" else None)


def test_plain_columns_in_json_are_a_record(tmp_path: Path) -> None:
    content = {"t": T.tolist(), "discharge_current": WAVE[:, 0, 0].tolist(), "note": "text"}
    (tmp_path / "a.json").write_text(json.dumps(content))
    field = ep.open_field(tmp_path / "a.json")
    np.testing.assert_array_equal(field["I_d"].values, WAVE[:, 0, 0])
    assert field["I_d"].attrs["units"] == "A"


def test_all_that_is_wrong_with_a_mapping_is_reported_at_once(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", t=T, z=Z, ni=N_I[:, :, 0], Te=T_E[:10, :, 0])
    wrong = {"n_i": ("nii", "m^-3"), "u_iz": ("ni", "kg"), "T_e_eV": ("Te", "eV")}
    with pytest.raises(ValueError, match="3 things must be put right"):
        ep.open_field(
            tmp_path / "a.npz",
            variables={name: ep.data.Variable(*theirs) for name, theirs in wrong.items()},
            time=ep.data.Variable("t", "s"),
            z=ep.data.Variable("z", "m"),
        )


def test_temperatures_in_kelvin_become_those_in_eV() -> None:
    factor, zero, unit = conversion("T_e_eV", "K")
    assert (zero, unit) == (0.0, "eV")
    assert factor == pytest.approx(8.617333262e-5, rel=1e-9)  # k_B/e, CODATA 2018


def test_only_what_varies_along_time_is_offered_as_a_signal(tmp_path: Path) -> None:
    np.savez(
        tmp_path / "a.npz",
        t=T, z=Z, B=RNG.uniform(size=NZ), n_i=N_I[:, :, 0], I_d=WAVE[:, 0, 0],
        V_d=np.full(NT, 300.0),
    )  # fmt: skip
    found = ep.inspect_file(tmp_path / "a.npz")
    assert found.traces == ["I_d"]


def test_time_that_does_not_increase_is_named(tmp_path: Path) -> None:
    back, rounded = tmp_path / "back.csv", tmp_path / "rounded.csv"
    back.write_text("time,x\n0,1\n1,2\n2,0\n1.5,3\n2.5,1\n")
    with pytest.raises(ValueError, match="1.5 follows 2 at row 4"):
        ep.open_field(back)
    rounded.write_text("time,x\n99.9,1\n100,2\n100,0\n100,3\n101,1\n")
    with pytest.raises(ValueError, match="100 follows 100 at row 3; 2 repeat"):
        ep.open_field(rounded)
    assert list(ep.open_field(rounded, dt_s=0.1)["x"].values) == [1, 2, 0, 3, 1]


def test_times_rounded_to_few_digits_are_equal_steps(tmp_path: Path) -> None:
    t = 99.0 + 0.35 * np.arange(NT)
    path = tmp_path / "a.csv"
    rows = [f"{a:.2E},{b:.4f}" for a, b in zip(t, WAVE[:, 0, 0], strict=True)]
    path.write_text("time (ms),x\n" + "\n".join(rows))
    steps = np.diff(ep.open_field(path)["time"].values)
    np.testing.assert_allclose(steps, 0.35e-3, rtol=0.05)
    assert np.ptp(steps) < 1e-12


@pytest.mark.parametrize("mark", [9.91e37, 9.9e37, 1e30, -999.0, -9999.0, 32767.0])
def test_marks_of_overload_that_repeat_are_missing_samples(tmp_path: Path, mark: float) -> None:
    x = WAVE[:, 0, 0].copy()
    x[[3, 9]] = mark
    path = write_csv(tmp_path / "a.csv", t_s=T, x=x)
    found = ep.inspect_file(path)
    assert found.held[1].n_missing == 2
    assert np.isnan(ep.open_field(path)["x"].values[[3, 9]]).all()
    (run,) = trajectories_of(pd.read_csv(path))
    assert run.n_samples == NT - 2


def test_a_long_table_is_refused_by_name(tmp_path: Path) -> None:
    t, z = np.repeat(T, NZ), np.tile(Z, NT)
    path = write_csv(tmp_path / "a.csv", t_s=t, z=z, x=WAVE[:, :, 0].ravel())
    with pytest.raises(ValueError, match="the table is long: 'z' runs through 7 values and starts"):
        ep.open_field(path)


@pytest.mark.parametrize("first", [0, 1, 22])
def test_what_counts_samples_is_no_time(tmp_path: Path, first: int) -> None:
    for name in ("cycle", "n"):
        path = write_csv(tmp_path / "a.csv", **{name: first + np.arange(NT)}, x=WAVE[:, 0, 0])
        with pytest.raises(ValueError, match="a field needs time: give the step between samples"):
            ep.open_field(path)
        field = ep.open_field(path, dt_s=2e-6)
        assert field["time"].values[1] == 2e-6


def test_one_bad_column_does_not_take_the_rest(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("t_s,x,y\n0,1,2\n1,0,1\n2,2,oops\n3,5,1\n")
    assert list(ep.open_field(tmp_path / "a.csv").data_vars) == ["x"]


def test_what_differs_between_files_of_a_kind_is_listed(tmp_path: Path) -> None:
    x = WAVE[:, 0, 0]
    first = ep.inspect_file(write_csv(tmp_path / "a.csv", t_s=T, x=x, y=x))
    alike = ep.inspect_file(write_csv(tmp_path / "b.csv", t_s=T[:30], x=2.0 * x[:30], y=x[:30]))
    other = ep.inspect_file(write_csv(tmp_path / "c.csv", t_s=2.0 * T, x=x))
    differing, same = compare_files(first, [alike, other])
    assert differing.startswith(f"{other.source.path}: read as: text, 2 columns")
    assert "3e-06 apart" in differing
    assert differing.endswith("y: absent")
    assert "x: " not in differing
    assert same == f"{alike.source.path}: the same arrays; 30 samples"


def test_a_channel_that_a_file_states_is_not_asked_for(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.attrs["channel_m"] = 0.025
        for name, values, unit in (("time", T, "s"), ("z", Z, "m"), ("n_i", N_I[..., 0], "m^-3")):
            file[name] = values
            file[name].attrs["units"] = unit
    assert not any("channel" in note for note in ep.inspect_file(tmp_path / "a.h5").notes())
    assert ep.open_field(tmp_path / "a.h5").attrs["channel_m"] == 0.025
