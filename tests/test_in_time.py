"""Steps of `prepare` along time: onto equal steps, into gaps, the past, the rate, the drift."""

from pathlib import Path

import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep

T = np.sort(np.random.default_rng(2).uniform(0.0, 1.0, 400))
T[[0, -1]] = 0.0, 1.0
OMEGA = 20.0


def field_of(t: np.ndarray, **columns: np.ndarray) -> xr.Dataset:
    data = {name: ("time", values, {"units": "A"}) for name, values in columns.items()}
    return xr.Dataset(data, coords={"time": ("time", t, {"units": "s"})})


def plane(t: np.ndarray) -> xr.Dataset:
    """x(t, z) = t z with a cell outside the plasma, B(z), and x alone in time."""
    x = np.outer(t, [1.0, 2.0, 3.0])
    x[:, 2] = np.nan
    data = {
        "x": (("time", "z"), x, {"units": "m"}),
        "B": ("z", [1.0, 2.0, 3.0], {"units": "T"}),
        "I_d": ("time", t**2, {"units": "A"}),
    }
    return xr.Dataset(data, coords={"time": ("time", t), "z": ("z", [0.0, 1.0, 2.0])})


def test_resampling_finer_follows_a_smooth_signal_to_fourth_order() -> None:
    errors = []
    for n in (50, 100, 200):
        t = np.linspace(0.0, 1.0, n + 1)
        fine = ep.data.resample(field_of(t, x=np.sin(OMEGA * t)), dt_s=0.37 / n)
        errors.append(np.abs(fine["x"].values - np.sin(OMEGA * fine["time"].values)).max())
        assert np.ptp(np.diff(fine["time"].values)) < 1e-12
    slopes = np.diff(np.log2(errors))
    assert np.all(slopes < -3.5)


def test_resampling_coarser_takes_means_of_what_lies_between() -> None:
    t = np.linspace(0.0, 1.0, 1001)
    coarse = ep.data.resample(
        field_of(t, line=2 + 3 * t, fast=np.sin(2 * np.pi * 250 * t)), dt_s=0.1
    )
    at = coarse["time"].values
    np.testing.assert_allclose(at, 0.05 + 0.1 * np.arange(10), rtol=1e-12)
    np.testing.assert_allclose(coarse["line"].values, 2 + 3 * at, rtol=1e-12)
    assert np.abs(coarse["fast"].values).max() < 1e-12  # whole periods: a plain pick has up to one


def test_resampling_takes_unequal_steps_and_leaves_masks_and_maps(tmp_path: Path) -> None:
    even = ep.data.resample(plane(T), dt_s=0.001)
    assert even["x"].dims == ("time", "z")
    np.testing.assert_allclose(even["x"].values[:, 1], 2 * even["time"].values, atol=1e-12)
    assert np.isnan(even["x"].values[:, 2]).all()
    assert list(even.data_vars) == ["x", "B", "I_d"]
    np.testing.assert_array_equal(even["B"].values, [1.0, 2.0, 3.0])
    ep.data.write_field(even, tmp_path / "even.nc")  # which checks that it is a field


def gappy() -> xr.Dataset:
    t = np.arange(11.0)
    x = 2 * t
    x[[3, 4, 7]] = np.nan
    return field_of(t, x=x, y=t)


def test_interpolation_fills_gaps_by_straight_lines() -> None:
    np.testing.assert_allclose(ep.data.interpolate(gappy())["x"].values, 2 * np.arange(11.0))
    outside = ep.data.interpolate(plane(T))
    assert np.isnan(outside["x"].values[:, 2]).all()


def test_gaps_too_long_or_at_an_end_are_refused() -> None:
    with pytest.raises(ValueError, match="max_gap_s = 2 s: x is missing from 2 to 5 s"):
        ep.data.interpolate(gappy(), max_gap_s=2.0)
    with pytest.raises(ValueError, match="x holds numbers from 5 to 10 s, .*; crop it first"):
        ep.data.interpolate(gappy().isel(time=slice(3, None)))


def test_derivatives_at_unequal_steps_are_exact_for_parabolas() -> None:
    field = ep.data.derivative(plane(T), variable="I_d")
    np.testing.assert_allclose(field["dI_d_dt"].values, 2 * T, atol=1e-9)
    assert field["dI_d_dt"].attrs["units"] == "A s^-1"


@pytest.mark.parametrize("degree", [1, 2])
def test_detrending_takes_a_polynomial_out_and_keeps_the_mean(degree: int) -> None:
    field = field_of(T, x=5 + (T**degree - (T**degree).mean()) * 7, y=T)
    flat = ep.data.detrend(field, variables=["x"], degree=degree)
    np.testing.assert_allclose(flat["x"].values, 5.0, atol=1e-10)
    np.testing.assert_array_equal(flat["y"].values, T)
    both = ep.data.detrend(plane(T), degree=degree)
    assert np.isnan(both["x"].values[:, 2]).all()
    np.testing.assert_allclose(both["x"].values[:, 1], 2 * T.mean(), atol=1e-10)


@pytest.mark.parametrize(
    ("step", "settings", "message"),
    [
        (ep.data.resample, {"dt_s": 2.0},
         "leave two samples or more, got 2 s for a record of 1 s"),
        (ep.data.detrend, {"degree": 0}, "degree must be 1 or more, .*, got 0"),
    ],
)  # fmt: skip
def test_steps_say_what_they_cannot_do(step: object, settings: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        step(plane(T), **settings)


def test_steps_that_need_every_sample_name_a_gap() -> None:
    for step, settings in (
        (ep.data.resample, {"dt_s": 0.5}),
        (ep.data.derivative, {"variable": "x"}),
        (ep.data.detrend, {}),
    ):
        with pytest.raises(ValueError, match=r"x = nan at time = 3 s \(3 such values\)"):
            step(gappy(), **settings)


def test_missing_samples_of_a_record_are_left_out_for_all() -> None:
    run = ep.zone_average(gappy(), None, states=["x", "y"])
    kept = np.array([0, 1, 2, 5, 6, 8, 9, 10])
    np.testing.assert_array_equal(run.t, kept)
    np.testing.assert_array_equal(run.states, np.column_stack([2 * kept, kept]))
    alone = ep.zone_average(gappy(), None, states=["y"])
    assert alone.n_samples == 11


def test_a_state_without_a_number_is_named() -> None:
    field = gappy()
    field["x"].values[:] = np.nan
    with pytest.raises(ValueError, match="x must hold numbers: all its 11 samples are NaN"):
        ep.zone_average(field, None, states=["x", "y"])
