"""What is taken as samples and times: one meaning is converted, the rest is refused."""

import sys

import numpy as np
import pandas as pd
import pytest

from ep2sindy.data.gaps import MissingSamples
from ep2sindy.data.numbers import check_magnitude, column_norms, real_numbers, rounding_s, seconds
from ep2sindy.data.runs import trajectories_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.regression.windows import is_even
from ep2sindy.signals.spectrum import is_uniform

T = np.arange(8.0)
X = np.sin(T)


def test_dates_of_tables_and_arrays_are_seconds() -> None:
    dates = pd.date_range("2024-03-30 23:00", periods=8, freq="250ms", tz="Europe/Berlin")
    for run in (pd.DataFrame({"time": dates, "x": X}), (dates.tz_convert(None).to_numpy(), X)):
        (found,) = trajectories_of(run)
        np.testing.assert_allclose(found.t, 0.25 * np.arange(8), rtol=1e-15)


def test_a_time_that_is_no_date_is_missing() -> None:
    t = np.array(["2024-01-01", "NaT", "2024-01-03"], dtype="M8[D]")
    np.testing.assert_array_equal(seconds(t), [0, np.nan, 172800])


@pytest.mark.parametrize(
    ("values", "match"),
    [
        (X + 0j, "got complex128; give real and imaginary parts"),
        (["1", "2"], "got <U1; convert them first"),
    ],
)
def test_what_is_no_real_number_is_refused(values: object, match: str) -> None:
    with pytest.raises(ValueError, match=f"states must hold real numbers.*{match}"):
        real_numbers(values, "states")


def test_masked_values_are_missing() -> None:
    masked = np.ma.array([1.0, 9.97e36, 3.0], mask=[False, True, False])
    np.testing.assert_array_equal(real_numbers(masked, "x"), [1, np.nan, 3])
    with pytest.warns(MissingSamples, match="1 of 3 samples are missing"):
        (run,) = trajectories_of((np.arange(3.0), masked))
    np.testing.assert_array_equal(run.states[:, 0], [1.0, 3.0])


@pytest.mark.parametrize("level", [1e-300, 1e-60, 1e160])
def test_sizes_whose_products_leave_the_number_format_are_refused(level: float) -> None:
    with pytest.raises(ValueError, match=r"'x' reaches .*; count it in another unit"):
        check_magnitude(level * X[:, None], ("x",))
    check_magnitude(np.zeros((3, 1)), ("x",))


def test_times_in_single_precision_are_even() -> None:
    t = 0.5 + 1.5e-6 * np.arange(4000)
    assert not is_uniform(t.astype(np.float32).astype(np.float64))
    assert is_uniform(seconds(t.astype(np.float32)))
    np.testing.assert_allclose(seconds(t.astype(np.float32)), t, atol=6e-8)


def test_unequal_times_stay_so_in_single_precision() -> None:
    t = 1e-6 * np.cumsum(1.0 + 0.01 * np.sin(np.arange(100))).astype(np.float32)
    np.testing.assert_array_equal(seconds(t), t.astype(np.float64))


def test_epoch_seconds_are_even_but_for_their_rounding() -> None:
    t = 1.7e9 + 2e-6 * np.arange(1000)
    assert np.ptp(np.diff(t)) > 0.05 * 2e-6
    assert is_uniform(t)
    assert is_even(t)
    assert rounding_s(t) == pytest.approx(4.8e-7, rel=0.01)
    t[500:] += 2e-6
    assert not is_uniform(t)
    assert not is_even(t)


@pytest.mark.skipif("tests.checked" in sys.modules, reason="jaxtyping refuses them first")
@pytest.mark.parametrize(
    ("t", "states", "message"),
    [
        (list("01234567"), X, "t must hold real numbers, got <U1"),
        (T, 1e-300 * X, "a variable must be of a size"),
    ],
)
def test_a_trajectory_refuses_them(t: object, states: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Trajectory(t, states[:, None], ["x"])


def test_norms_of_columns_neither_overflow_nor_vanish() -> None:
    values = np.array([[3.0, -3e200, 3e-200, 0.0], [4.0, 4e200, -4e-200, 0.0]])
    np.testing.assert_allclose(column_norms(values), [5.0, 5e200, 5e-200, 1.0], rtol=1e-15)
    np.testing.assert_array_equal(column_norms(np.zeros((0, 2))), [1.0, 1.0])
    assert column_norms(np.zeros((3, 0))).shape == (0,)
