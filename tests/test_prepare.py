from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from ep2sindy.data.prepare import (
    crop,
    decimate,
    derive,
    gradient,
    keep_where,
    low_pass,
    radial_from_middle,
)
from ep2sindy.thruster import propellants
from ep2sindy.thruster.ionization import ionization_rate, read_rate_table
from ep2sindy.thruster.propellant_files import propellant

DT = 1e-6
N = 2000


def field(**variables: tuple[tuple[str, ...], np.ndarray, str]) -> xr.Dataset:
    """Field on 2000 samples, z = 0, 1, 2 m, r = 1, 2 m; name=(dims, values, unit)."""
    axes = {"time": DT * np.arange(N), "z": [0.0, 1.0, 2.0], "r": [1.0, 2.0]}
    used = {"time"}.union(*(dims for dims, _, _ in variables.values()))
    return xr.Dataset(
        {name: (dims, values, {"units": unit}) for name, (dims, values, unit) in variables.items()},
        coords={a: (a, np.asarray(x), {"units": "SI"}) for a, x in axes.items() if a in used},
    )


def ramp() -> xr.Dataset:
    return field(I_d=(("time",), np.arange(float(N)), "A"))


def test_crop_keeps_both_ends() -> None:
    t = ramp()["time"].values
    part = crop(ramp(), start_s=t[100], stop_s=t[200])
    assert part["I_d"].values.tolist() == list(range(100, 201))
    assert part["I_d"].attrs == {"units": "A"}
    assert crop(ramp()).equals(ramp())


def test_decimate_keeps_every_nth_sample() -> None:
    part = decimate(ramp(), factor=500)
    assert part["I_d"].values.tolist() == [0, 500, 1000, 1500]
    assert part["time"].values == pytest.approx([0, 5e-4, 1e-3, 1.5e-3])


def tone(f_Hz: float) -> np.ndarray:
    return np.sin(2 * np.pi * f_Hz * DT * np.arange(N))


def test_low_pass_keeps_phase_and_halves_the_cutoff() -> None:
    waves = np.stack([tone(2e3), tone(2e4), tone(2e5)], axis=1)
    slow, cutoff, fast = low_pass(
        field(I_d=(("z", "time"), waves.T.astype(np.float32), "A")), cutoff_Hz=2e4
    )["I_d"].values.T
    inner = slice(200, -200)  # four periods of the cutoff: the ends have died away to 1e-5
    assert slow[inner] == pytest.approx(tone(2e3)[inner], abs=1e-4)
    assert cutoff[inner] == pytest.approx(0.5 * tone(2e4)[inner], abs=1e-4)
    assert np.abs(fast[inner]).max() < 1e-4


def test_low_pass_keeps_masked_cells_units_and_static_variables() -> None:
    waves = np.stack([tone(2e3), np.full(N, np.nan), tone(1e3)], axis=1)
    before = field(n_i=(("time", "z"), waves, "m^-3"), B=(("z",), np.arange(3.0), "T"))
    after = low_pass(before, cutoff_Hz=1e5)
    assert np.isnan(after["n_i"].values).all(axis=0).tolist() == [False, True, False]
    assert after["n_i"].attrs == {"units": "m^-3"}
    assert after["B"].identical(before["B"])


RAMP = ramp()
GAP = RAMP.assign(I_d=RAMP["I_d"].where(np.arange(N) != 70))


@pytest.mark.parametrize(
    ("step", "field", "setting", "message"),
    [
        (crop, RAMP, {"start_s": 0.01}, r"0.01 to 0.001999 s leaves 0 of 2000, .* 0 to 0.001999"),
        *((decimate, RAMP, {"factor": n}, f"got {n} with 2000 samples") for n in (0, -2, 2000)),
        (low_pass, GAP, {"cutoff_Hz": 1e5}, "I_d = nan at time = 7e-05 s"),
    ],
)
def test_steps_say_what_they_cannot_do(
    step: Callable[..., xr.Dataset], field: xr.Dataset, setting: dict[str, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        step(field, **setting)


def grid() -> xr.Dataset:
    values = np.arange(1.0, 1 + N * 6).reshape(N, 3, 2)
    return field(
        u_iz=(("time", "z", "r"), values, "m/s"),
        u_ir=(("time", "z", "r"), 2 * values, "m/s"),
        T_e_eV=(("time", "z"), values[:, :, 0], "eV"),
    )


@pytest.mark.parametrize(
    ("expression", "expected"),
    [
        ("sqrt(u_iz^2 + u_ir**2)", lambda f: np.hypot(f.u_iz, f.u_ir)),
        ("-u_iz / 2 + 1e3", lambda f: 1e3 - f.u_iz / 2),
        ("u_iz * z * exp(-r)", lambda f: f.u_iz * f.z * np.exp(-f.r)),
        ("log(abs(u_iz - T_e_eV) + 1)", lambda f: np.log(abs(f.u_iz - f.T_e_eV) + 1)),
    ],
)
def test_derive_computes_expressions(expression: str, expected: object) -> None:
    before = grid()
    after = derive(before, name="w", expression=expression, units="m/s")
    xr.testing.assert_allclose(after["w"].drop_attrs(), expected(before), rtol=1e-15)
    assert after["w"].attrs == {"units": "m/s"}
    assert after.drop_vars("w").identical(before)
    assert "w" not in before


def test_derive_does_not_overflow_in_float32() -> None:
    dense = field(n=(("time",), np.full(N, 1e20, np.float32), "m^-3"))
    squared = derive(dense, name="n2", expression="n^2", units="m^-6")["n2"]
    assert squared.values == pytest.approx(np.full(N, 1e40), rel=1e-6)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"expression": "u_z * 2"}, r"unknown variable 'u_z'; this field has \[.*'u_iz'"),
        ({"expression": "__import__('os')"}, "an expression may use .*"),
        ({"expression": "u_iz", "name": "u_ir"}, "the field already has 'u_ir'"),
    ],
)
def test_derive_refuses_what_is_no_arithmetic(settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        derive(grid(), **{"name": "w", "units": "1", **settings})


def test_keep_where_masks_walls() -> None:
    after = keep_where(grid(), condition="(z > 0.5) | ((r >= 1) & (r < 1.5))")
    assert np.isnan(after["u_iz"].values[7]).tolist() == [[False, True], [False] * 2, [False] * 2]
    assert after["u_iz"].attrs == {"units": "m/s"}
    assert after["T_e_eV"].identical(grid()["T_e_eV"])


@pytest.mark.parametrize("condition", ["u_iz > 3", "0 < z < 1"])
def test_a_condition_must_compare_places(condition: str) -> None:
    with pytest.raises(ValueError, match="a condition must compare|an expression may use"):
        keep_where(grid(), condition=condition)


def plasma() -> xr.Dataset:
    T = np.outer(np.linspace(1.0, 2.0, N), [5.0, 10.0, np.nan])
    return field(T_e_eV=(("time", "z"), T, "eV"))


def test_the_rate_comes_from_the_fits() -> None:
    after = ionization_rate(plasma())
    expected = propellants.ionization_rate(plasma()["T_e_eV"].values[:, :2])
    assert np.array_equal(after["R_ion"].values[:, :2], expected)
    assert np.isnan(after["R_ion"].values[:, 2]).all()
    assert after["R_ion"].attrs == {"units": "m^3/s"}


TABLE = (
    "Energy (eV),rate coefficient (m3/s),energy loss\n1,1e-22,0\n5,2e-14,0\n# a gap\n25,6e-14,0\n"
)


def test_the_rate_comes_from_a_table(tmp_path: Path) -> None:
    (tmp_path / "rates.csv").write_text(TABLE)
    after = ionization_rate(plasma(), table=tmp_path / "rates.csv")
    expected = 2e-14 + 2e-15 * (plasma()["T_e_eV"].values - 5.0)
    assert after["R_ion"].values[:, :2] == pytest.approx(expected[:, :2], rel=1e-12)
    assert np.isnan(after["R_ion"].values[:, 2]).all()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,1e-22\n", "must have two rows or more: it has 1"),
        ("T,k\n1,1e-22\n", "a rate table must have two columns"),
        ("5,1\n1,2\n", "a rate table must have two columns"),
        ("a,b\nc,d\n", "must have 2 numbers in every row"),
    ],
)
def test_a_bad_table_is_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "rates.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        read_rate_table(tmp_path / "rates.csv")


def radial(r: list[float]) -> xr.Dataset:
    """u_ir = 1, 2, .. m/s over r, at two times."""
    values = np.ones((2, 1)) * np.arange(1.0, 1.0 + len(r))
    return xr.Dataset(
        {"u_ir": (("time", "r"), values, {"units": "m/s"})},
        coords={"time": [0.0, 1.0], "r": r},
    )


@pytest.mark.parametrize(
    ("r", "middle_m", "expected"),
    [
        ([0.03, 0.04, 0.05, 0.06], None, [-1.0, -2.0, 3.0, 4.0]),
        ([0.03, 0.04, 0.05], None, [-1.0, 2.0, 3.0]),  # a row in the middle stays as it is
        ([0.03, 0.04, 0.05, 0.06], 0.035, [-1.0, 2.0, 3.0, 4.0]),
    ],
)
def test_radial_velocity_counts_from_mid_radius(
    r: list[float], middle_m: float | None, expected: list[float]
) -> None:
    before = radial(r)
    found = radial_from_middle(before, middle_m=middle_m)["u_ir"]
    assert found.dims == ("time", "r")
    assert found.values.tolist() == [expected] * 2
    assert found.attrs["units"] == "m/s"
    assert before["u_ir"].values[0, 0] == 1.0


@pytest.mark.parametrize("gas", ["krypton", "argon"])
def test_other_gases_have_rates_of_their_own(gas: str) -> None:
    after = ionization_rate(plasma(), gas=gas)
    T = plasma()["T_e_eV"].values
    known = propellant(gas)
    expected = np.interp(T, known.T_e_eV, known.ionization_rate)
    np.testing.assert_array_equal(after["R_ion"].values[np.isfinite(T)], expected[np.isfinite(T)])
    assert after["R_ion"].attrs["units"] == "m^3/s"


def test_a_gas_has_its_range_and_its_own_table(tmp_path: Path) -> None:
    hot = plasma()
    hot["T_e_eV"] *= 20
    with pytest.raises(ValueError, match="T_e_eV must stay in the rate table, 0 to 100 eV"):
        ionization_rate(hot, gas="krypton")
    with pytest.raises(ValueError, match="got gas='argon' next to"):
        ionization_rate(plasma(), gas="argon", table=tmp_path / "rates.csv")


Z_UNEVEN = np.array([0.0, 1.0, 3.0, 3.5])


def uneven(values: np.ndarray, **more: np.ndarray) -> xr.Dataset:
    """Field of two samples on uneven cells along z: n_i, twice as large at the second sample."""
    arrays = {"n_i": values} | more
    return xr.Dataset(
        {
            name: (("time", "z"), np.stack([array, 2.0 * array]), {"units": "m^-3"})
            for name, array in arrays.items()
        },
        coords={"time": [0.0, 1.0], "z": Z_UNEVEN},
    )


def test_the_gradient_of_a_parabola_is_exact_on_uneven_cells() -> None:
    found = gradient(uneven(5.0 + Z_UNEVEN + 3.0 * Z_UNEVEN**2), of="n_i", name="slope")["slope"]
    np.testing.assert_allclose(found[0], 1.0 + 6.0 * Z_UNEVEN, rtol=1e-13)
    np.testing.assert_allclose(found[1], 2.0 * found[0], rtol=1e-13)
    assert found.attrs["units"] == "m^-4"


def test_two_cells_have_the_gradient_of_a_straight_line() -> None:
    found = gradient(uneven(7.0 * Z_UNEVEN).isel(z=[1, 2]), of="n_i", name="slope")["slope"]
    np.testing.assert_allclose(found[0], 7.0, rtol=1e-13)


def test_the_gradient_of_a_product_goes_along_r_and_keeps_units() -> None:
    z, r = np.array([0.0, 1.0, 2.0]), np.array([1.0, 2.0])
    both = field(
        n_i=(("time", "z", "r"), np.ones((N, 1, 1)) * (z[:, None] * r), "m^-3"),
        u_ir=(("r",), 3.0 * r, "m/s"),
    )
    found = gradient(both, of="n_i*u_ir", axis="r", name="slope")["slope"]
    np.testing.assert_allclose(found[0], 9.0 * z[:, None] * np.ones(2))
    assert found.attrs["units"] == "m^-3 s^-1"
    assert found.dims == ("time", "z", "r")


def test_by_faces_the_divergence_telescopes() -> None:
    faces = np.array([0.0, 1.0, 3.0, 3.5, 6.0])
    flux = np.array([2.0, 7.0, -1.0, 4.0])
    cells = uneven(np.ones(4), u_iz=np.array([0.0, 9.0, 1.0, 5.0]), face_flux_i=flux)
    cells = cells.assign_coords(z=0.5 * (faces[:-1] + faces[1:]))
    cells = cells.assign(dz=("z", np.diff(faces), {"units": "m"}))
    cells["face_flux_i"].attrs |= {"face_average_of": "n_i*u_iz"}
    for of in ("n_i*u_iz", "u_iz*n_i", "face_flux_i"):
        slope = gradient(cells, of=of, name="slope")["slope"]
        total = (slope * cells["dz"]).isel(z=slice(3)).sum("z")
        np.testing.assert_allclose(total, [4.0 - 2.0, 2.0 * (4.0 - 2.0)], rtol=1e-13)
        assert np.isnan(slope[:, 3]).all()  # its far face is not recorded
    for of in ("face_flux_i*u_iz", "u_iz*face_flux_i", "face_flux_i^2"):
        with pytest.raises(ValueError, match="mixes values in cells with 'face_flux_i'"):
            gradient(cells, of=of, name="slope")
    with pytest.raises(ValueError, match="keep the variable dz"):
        gradient(cells.drop_vars("dz"), of="face_flux_i", name="slope")
    with pytest.raises(ValueError, match="cells that touch each other"):
        gradient(cells.isel(z=[0, 2, 3]), of="n_i*u_iz", name="slope")


def test_a_gradient_without_faces_takes_the_average_of_the_product() -> None:
    line = uneven(np.ones(4), u_iz=np.zeros(4), flux_i=4.0 * Z_UNEVEN)
    line["flux_i"].attrs["average_of"] = "n_i*u_iz"
    found = gradient(line, of="n_i*u_iz", name="slope")["slope"]
    np.testing.assert_allclose(found[0], 4.0, rtol=1e-13)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"of": "I_d"}, r"gradient of 'I_d' along 'z' needs .*sizes \{'time': 2\}"),
        ({"of": "n_i", "name": "n_i"}, "already has 'n_i'"),
    ],
)
def test_a_gradient_that_cannot_be_taken_says_why(settings: dict[str, str], message: str) -> None:
    line = uneven(np.ones(4)).assign(I_d=("time", [1.0, 2.0], {"units": "A"}))
    with pytest.raises(ValueError, match=message):
        gradient(line, **{"name": "slope", **settings})
