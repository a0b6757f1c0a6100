from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from ep2sindy.data import blocks
from ep2sindy.data.fields import check_field, mask_outside
from ep2sindy.data.open import read_field, write_field
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.data.zones import Zone, zone_average

T = np.linspace(0.0, 1e-4, 11)


def field_of(z=None, r=None, t=T, **variables: tuple[tuple[str, ...], np.ndarray]) -> xr.Dataset:
    """Field of the given variables, name=(dims, values)."""
    axes = {"time": t, "z": z, "r": r}
    return xr.Dataset(
        {name: (dims, values, {"units": "m^-3"}) for name, (dims, values) in variables.items()},
        coords={axis: np.asarray(x, float) for axis, x in axes.items() if x is not None},
    )


def column(run: Trajectory, name: str) -> np.ndarray:
    return run.values[:, run.names.index(name)]


def wave(*shape: int) -> np.ndarray:
    """1, 2, 3 ... in time, for any grid: what a state must do at the least is vary."""
    return np.broadcast_to(np.arange(1.0, 12.0).reshape(-1, *[1] * len(shape)), (11, *shape)).copy()


GOOD = field_of([0, 1], n_i=(("time", "z"), wave(2)))


def test_a_linear_profile_averages_to_its_midpoint() -> None:
    z = np.linspace(0.0, 0.05, 101)
    field = field_of(z, n_i=(("time", "z"), wave(101) * (3 + z)))
    run = zone_average(field, Zone(z=(0.01, 0.03)), states=["n_i"], label="300 V")
    assert column(run, "n_i") == pytest.approx(np.arange(1.0, 12.0) * 3.02, rel=1e-13)
    assert (run.label, run.units["n_i"]) == ("300 V", "m^-3")
    assert np.array_equal(run.t, T)


def test_unequal_cells_weigh_by_their_length() -> None:
    # Edges -0.5, 0.5, 2, 5, 9: the two cells of the zone are 1.5 and 3 long.
    field = field_of([0, 1, 3, 7], n_i=(("time", "z"), wave(4) * [9.0, 1.0, 4.0, 9.0]))
    run = zone_average(field, Zone(z=(1.0, 3.0)), states=["n_i"])
    assert column(run, "n_i")[0] == pytest.approx((1.5 * 1 + 3 * 4) / 4.5, rel=1e-15)


def test_no_zone_is_the_whole_field() -> None:
    field = masked_field()
    whole = zone_average(field, Zone(), states=["n_i"])
    assert np.array_equal(zone_average(field, None, states=["n_i"]).values, whole.values)


def test_annuli_weigh_by_their_area() -> None:
    # The mean of 1/r over a disk of radius 3 is 2/3; midpoint cells integrate r * 1/r exactly.
    r = np.array([0.5, 1.5, 2.5])
    field = field_of(r=r, n_i=(("time", "r"), wave(3) / r))
    run = zone_average(field, Zone(), states=["n_i"])
    assert column(run, "n_i")[0] == pytest.approx(2 / 3, rel=1e-15)
    planar = zone_average(field, Zone(), states=["n_i"], axisymmetric=False)
    assert column(planar, "n_i")[0] == pytest.approx((1 / r).mean(), rel=1e-15)


def test_a_cell_on_the_axis_is_a_disk_of_half_a_step() -> None:
    field = field_of(r=[0.0, 1.0], n_i=(("time", "r"), wave(2) * [1.0, 0.0]))
    run = zone_average(field, Zone(), states=["n_i"])
    assert column(run, "n_i")[0] == pytest.approx(0.5**2 / 1.5**2, rel=1e-15)


def test_the_average_of_a_product_is_not_the_product_of_averages() -> None:
    field = field_of(
        [0.0, 1.0],
        n_i=(("time", "z"), wave(2) * [1.0, 3.0]),
        n_n=(("time", "z"), np.full((11, 2), [2.0, 6.0])),
    ).assign(R_ion=("z", [1.0, 2.0], {"units": "m^3/s"}))
    products = ["n_i*n_n", "n_i^2*n_n", "n_i * n_n * R_ion"]
    run = zone_average(field, Zone(), states=["n_i"], inputs=["n_n"], products=products)
    assert run.names == ("n_i", "n_n", "<n_i*n_n>", "<n_i^2*n_n>", "<n_i*n_n*R_ion>")
    assert run.values[0] == pytest.approx([2.0, 4.0, 10.0, 28.0, 19.0], rel=1e-15)
    assert run.units["<n_i*n_n>"] == "m^-6"
    assert run.units["<n_i*n_n*R_ion>"] == "m^-3 s^-1"


def test_sums_and_products_of_float32_run_in_float64() -> None:
    # In float32 the ones vanish next to 2^24, and 1e20 * 1e20 overflows.
    values = np.ones((11, 1001), np.float32)
    values[:, 0] = 2**24 * np.arange(1, 12)
    field = field_of(np.arange(1001), n_i=(("time", "z"), values)).astype(np.float32)
    run = zone_average(field, Zone(), states=["n_i"])
    # 1001 additions, each rounded at 2.2e-16.
    assert column(run, "n_i")[0] == pytest.approx((2**24 + 1000) / 1001, rel=1001 * 2.2e-16)
    dense = (wave(2) * 1e20).astype(np.float32)
    field = field_of([0, 1], n_i=(("time", "z"), dense), n_n=(("time", "z"), dense))
    run = zone_average(field, Zone(), states=["n_i"], products=["n_i*n_n"])
    assert column(run, "<n_i*n_n>")[0] == pytest.approx(1e40, rel=1e-6)


def test_variables_of_fewer_dimensions_are_averaged_over_theirs() -> None:
    field = field_of(
        [0.0, 1.0],
        [1.0, 2.0, 3.0],
        n_i=(("time", "z", "r"), wave(2, 3)),
        T_e_eV=(("z", "time"), (wave(2) * [1.0, 3.0]).T),
        I_d=(("time",), wave()),
        B=(("z",), np.array([1.0, 2.0])),
    )
    run = zone_average(field, Zone(), states=["n_i"], inputs=["T_e_eV", "I_d", "B"])
    assert run.values[3] == pytest.approx([4.0, 8.0, 4.0, 1.5], rel=1e-15)


def test_a_probe_trace_is_its_own_average() -> None:
    run = zone_average(field_of(I_d=(("time",), wave())), Zone(), states=["I_d"])
    assert np.array_equal(column(run, "I_d"), np.arange(1.0, 12.0))


def masked_field() -> xr.Dataset:
    """n_i is masked at (z 0, r 1) and (z 0, r 2), n_n at (z 1, r 2) only."""
    n_i, n_n = wave(2, 2) * [[1.0, 5.0], [3.0, 4.0]], wave(2, 2)
    n_i[:, 0, 1] = np.nan
    n_n[:, 1, 1] = np.nan
    T_e = wave(2) * [1.0, 3.0]
    dims = ("time", "z", "r")
    return field_of([0, 1], [1, 2], n_i=(dims, n_i), n_n=(dims, n_n), T_e_eV=(("time", "z"), T_e))


def test_masked_cells_are_left_out() -> None:
    field = masked_field()
    run = zone_average(field, Zone(), states=["n_i"], inputs=["T_e_eV"], axisymmetric=False)
    assert run.values[0] == pytest.approx([8 / 3, 7 / 3], rel=1e-15)


def test_one_set_of_cells_serves_all_variables() -> None:
    names = {"states": ["n_i"], "inputs": ["n_n"], "products": ["n_i*n_n"]}
    run = zone_average(masked_field(), Zone(), **names, axisymmetric=False)
    assert run.values[0] == pytest.approx([2.0, 1.0, 2.0], rel=1e-15)


def test_mask_outside_leaves_variables_without_its_dimensions() -> None:
    field = field_of(
        [0, 1], [1, 2], n_i=(("time", "z", "r"), wave(2, 2)), T_e_eV=(("time", "z"), wave(2))
    )
    masked = mask_outside(field, field["r"] + field["z"] < 2.5)
    assert np.isnan(masked["n_i"].values).sum() == 11
    assert masked["T_e_eV"].equals(field["T_e_eV"])
    with pytest.raises(ValueError, match="no variable of the field has all dimensions"):
        mask_outside(field[["T_e_eV"]], field["r"] < 2)


def test_slabs_do_not_change_the_average(monkeypatch: pytest.MonkeyPatch) -> None:
    names = {"states": ["n_i"], "inputs": ["T_e_eV"], "products": ["n_i*T_e_eV"]}
    whole = zone_average(masked_field(), Zone(), **names)
    monkeypatch.setattr(blocks, "BLOCK_VALUES", 12)  # three samples of four cells
    assert np.array_equal(zone_average(masked_field(), Zone(), **names).values, whole.values)


def test_a_gap_in_a_later_slab_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(blocks, "BLOCK_VALUES", 12)
    field = masked_field()
    field["n_i"].values[9, 1, 1] = np.nan
    with pytest.raises(ValueError, match=r"n_i = nan at time = 9e-05 s, z = 1 m, r = 2 m"):
        zone_average(field, Zone(), states=["n_i"])


def test_only_the_zone_is_read() -> None:
    dask_array = pytest.importorskip("dask.array")
    read = []

    def block(index: np.ndarray) -> np.ndarray:
        read.append(int(index[0, 0]))
        return wave(1) + index

    index = dask_array.from_array(np.tile(np.arange(4.0), (11, 1)), chunks=(11, 1))
    lazy = index.map_blocks(block, dtype=float, meta=np.empty((0, 0)))
    field = field_of([0, 1, 2, 3], n_i=(("time", "z"), lazy))
    zone_average(field, Zone(z=(1.0, 2.0)), states=["n_i"])
    assert set(read) == {1, 2}


def test_a_lazy_file_gives_the_same_average(tmp_path: Path) -> None:
    write_field(masked_field(), tmp_path / "field.nc")
    lazy = zone_average(read_field(tmp_path / "field.nc"), Zone(z=(0.0, 1.0)), states=["n_i"])
    assert np.array_equal(lazy.values, zone_average(masked_field(), Zone(), states=["n_i"]).values)


def test_a_point_is_the_nearest_cell() -> None:
    field = masked_field()
    place = Zone(z=0.9, r=1.2)
    run = zone_average(field, place, states=["n_i"], inputs=["n_n", "T_e_eV"])
    assert run.values[0].tolist() == [3.0, 1.0, 3.0]


def test_points_zones_and_names_without_data_are_refused() -> None:
    field = masked_field()
    with pytest.raises(ValueError, match=r"\['n_i'\] share no unmasked cell"):
        zone_average(field, Zone(z=0.0, r=2.0), states=["n_i"])
    with pytest.raises(ValueError, match="stay on the grid, got z from 0 to 25 m"):
        zone_average(field, Zone(z=(0.0, 25.0)), states=["n_i"])
    with pytest.raises(ValueError, match=r"unknown variables \['ni', 'x'\]"):
        zone_average(field, Zone(), states=["ni"], products=["n_i*x"])


@pytest.mark.parametrize("bounds", [[0.2], [0.3, 0.2], [0.1, float("nan")]])
def test_a_zone_needs_two_increasing_bounds(bounds: list[float]) -> None:
    with pytest.raises(ValueError, match="zone.s z must be a number or two increasing"):
        Zone(z=bounds)


def test_a_zone_may_bound_only_axes_of_the_field() -> None:
    with pytest.raises(ValueError, match=r"got r, the field has \['time', 'z'\]"):
        zone_average(GOOD, Zone(r=(0.0, 1.0)), states=["n_i"])


def test_a_float32_grid_keeps_the_ends_of_a_zone() -> None:
    z = np.linspace(0.0, 0.05, 51).astype(np.float32)
    field = field_of(z, n_i=(("time", "z"), wave(51) * np.arange(51)))
    run = zone_average(field, Zone(z=(0.015, 0.025)), states=["n_i"])
    assert column(run, "n_i")[0] == pytest.approx(20.0, rel=1e-6)


def test_negative_radii_are_refused_unless_planar() -> None:
    field = field_of(r=[-1, 0, 1], n_i=(("time", "r"), wave(3)))
    with pytest.raises(ValueError, match="r must not be negative in an axisymmetric field"):
        zone_average(field, Zone(), states=["n_i"])
    assert zone_average(field, Zone(), states=["n_i"], axisymmetric=False).n_samples == 11


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_value_that_is_missing_at_some_times_is_refused(value: float) -> None:
    field = masked_field()
    field["n_i"].values[4, 1, 0] = value
    with pytest.raises(ValueError, match=rf"n_i = {value} at time = 4e-05 s, z = 1 m, r = 1 m"):
        zone_average(field, Zone(), states=["n_i"])


def test_a_first_sample_without_values_is_no_mask() -> None:
    field = masked_field()
    field["n_i"].values[0, 1, 0] = np.nan
    with pytest.raises(ValueError, match=r"n_i = 6 after NaN at time = 1e-05 s, z = 1 m, r = 1 m"):
        zone_average(field, Zone(), states=["n_i"])
    field["n_i"].values[0] = np.nan
    with pytest.raises(ValueError, match="or crop a first sample that is empty"):
        zone_average(field, Zone(), states=["n_i"])


def test_a_grid_of_one_point_needs_only_to_be_inside() -> None:
    run = zone_average(GOOD.isel(z=[1]), Zone(z=(0.0, 3.0)), states=["n_i"])
    assert column(run, "n_i")[2] == 3.0


@pytest.mark.parametrize(
    ("field", "message"),
    [
        (GOOD.rename(z="x"), r"may have z and r, got \['time', 'x'\]"),
        (GOOD.drop_vars("z"), "the dimension 'z' needs a coordinate"),
        (GOOD.assign_coords(time=np.r_[T[:5], T[4:10]]), r"t\[5\] = 4e-05 s follows 4e-05 s"),
        (GOOD.isel(z=[1, 0]), r"z must increase: z\[1\] = 0 m follows 1 m"),
        (GOOD.astype(complex), "n_i must hold real numbers: its type is complex128"),
    ],
)
def test_what_is_no_field_is_refused(field: xr.Dataset, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        check_field(field)
