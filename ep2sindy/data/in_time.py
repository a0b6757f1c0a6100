"""Preparation steps that act along time: plain functions, field -> field.

A config lists them as steps. No step changes its argument, and variables keep their units. Cells
that are NaN at all times stay NaN; variables without time stay as they are.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from scipy import signal
from scipy.interpolate import CubicSpline, make_interp_spline

from ep2sindy.data.fields import check_new, check_samples, grid_points, grid_values, mask_cells
from ep2sindy.library.units import unit_product


def crop(
    field: xr.Dataset, *, start_s: float | None = None, stop_s: float | None = None
) -> xr.Dataset:
    """Keep the samples from `start_s` to `stop_s`, both included; None: the end of the record."""
    t = grid_points(field, "time")
    start = t[0] if start_s is None else start_s
    stop = t[-1] if stop_s is None else stop_s
    keep = np.flatnonzero((t >= start) & (t <= stop))
    if len(keep) < 2:
        raise ValueError(
            f"a crop must leave two samples or more: {start:g} to {stop:g} s leaves {len(keep)} "
            f"of {len(t)}, which run from {t[0]:g} to {t[-1]:g} s"
        )
    return field.isel(time=slice(int(keep[0]), int(keep[-1]) + 1))


def decimate(field: xr.Dataset, *, factor: int) -> xr.Dataset:
    """Keep every `factor`-th sample, from the first on.

    This is plain subsampling: oscillations faster than half the new sampling rate are aliased to
    lower frequencies. Apply `low_pass` with a cutoff below half the new rate first.
    """
    n_samples = field.sizes["time"]
    if factor < 1 or n_samples <= factor:
        raise ValueError(
            f"factor must be 1 or more and leave two samples or more: {factor} came with "
            f"{n_samples} samples"
        )
    return field.isel(time=slice(None, None, factor))


def low_pass(field: xr.Dataset, *, cutoff_Hz: float, order: int = 4) -> xr.Dataset:
    """Remove oscillations faster than `cutoff_Hz` without shifting phases.

    A Butterworth filter of the given order runs forwards and backwards: amplitudes halve at
    the cutoff and fall by 12 * order dB per octave above it. Variables without time and masked
    cells stay as they are. Loads the field.
    Raises ValueError for unequal time steps (beyond 1e-3 of a step), a cutoff not between 0
    and half the sampling rate, or a record shorter than the filter's edges.
    """
    dt_s = _uniform_step(field)
    n_edge = 3 * (order + 1)
    if not 0 < cutoff_Hz < 0.5 / dt_s:
        raise ValueError(
            f"cutoff_Hz must lie between 0 and half the sampling rate, {0.5 / dt_s:g} Hz: "
            f"{cutoff_Hz:g} came"
        )
    if field.sizes["time"] <= n_edge:
        raise ValueError(
            f"a low-pass of order {order} needs more than {n_edge} samples: "
            f"{field.sizes['time']} came; lower the order or leave it out"
        )
    sos = signal.butter(order, cutoff_Hz, fs=1 / dt_s, output="sos")
    smooth = {}
    for name in _of_time(field):
        array = _samples(field, name)
        values = signal.sosfiltfilt(sos, array.values, axis=0, padlen=n_edge)
        smooth[name] = array.copy(data=values)
    return field.assign(smooth)


def _uniform_step(field: xr.Dataset) -> float:
    """Time step in s; raises ValueError if the steps are unequal."""
    steps = np.diff(grid_points(field, "time"))
    dt_s = float(steps.mean())
    if np.ptp(steps) > 1e-3 * dt_s:
        k = int(np.argmax(np.abs(steps - dt_s)))
        raise ValueError(
            f"a low-pass needs equal time steps: t[{k + 1}] - t[{k}] = {steps[k]:g} s, the mean "
            f"is {dt_s:g} s; bring the field to equal steps first (ep2sindy.prepare.resample)"
        )
    return dt_s


def resample(field: xr.Dataset, *, dt_s: float) -> xr.Dataset:
    """Resample the field to equal time steps of `dt_s`.

    If `dt_s` is at most the median step, cubic splines through the samples are evaluated from the
    first sample on. If it is longer, each new sample is the mean over one step, placed at its
    middle, of the piecewise linear interpolant; this reduces aliasing. Loads the field.
    Raises ValueError for a step that leaves fewer than two samples, or for missing samples.
    """
    t = grid_points(field, "time")
    if not 0 < dt_s <= 0.5 * (t[-1] - t[0]):
        raise ValueError(
            f"dt_s must be positive and leave two samples or more: {dt_s:g} s came for a record of "
            f"{t[-1] - t[0]:g} s"
        )
    finer = dt_s <= np.median(np.diff(t)) * (1 + 1e-6)
    n_steps = int((t[-1] - t[0]) / dt_s * (1 + 1e-12))
    new = t[0] + dt_s * (np.arange(n_steps + 1) if finer else 0.5 + np.arange(n_steps))
    found = {}
    for name in _of_time(field):
        array = _samples(field, name)
        masked = np.isnan(array.values).any(axis=0)
        filled = np.where(masked, 0.0, array.values)
        if finer:
            values = CubicSpline(t, filled, axis=0)(new)
        else:
            area = make_interp_spline(t, filled, k=1, axis=0).antiderivative()
            values = (area(new + 0.5 * dt_s) - area(new - 0.5 * dt_s)) / dt_s
        found[name] = (array.dims, np.where(masked, np.nan, values), array.attrs)
    times = xr.DataArray(new, dims="time", attrs=field["time"].attrs)
    kept = field.drop_vars([*found, "time"]).assign_coords(time=times)
    return kept.assign(found)[list(field.data_vars)].assign_attrs(field.attrs)


def interpolate(field: xr.Dataset, *, max_gap_s: float | None = None) -> xr.Dataset:
    """Fill missing samples (NaN) by linear interpolation in time.

    max_gap_s: longest gap to fill, measured between the samples on either side; None fills all.
    Loads the field.
    Raises ValueError for a longer gap, and for a gap at an end of the record.
    """
    t = grid_points(field, "time")
    filled = {}
    for name in _of_time(field):
        array = _time_first(field[name])
        values = array.values.copy()
        absent = np.isnan(values)
        some = absent.any(axis=0) & ~absent.all(axis=0)
        for cell in np.argwhere(some):
            place = (slice(None), *cell)
            present = np.flatnonzero(~absent[place])
            _check_gaps(str(name), t, present, max_gap_s)
            values[place] = np.interp(t, t[present], values[place][present])
        if some.any():
            filled[name] = array.copy(data=values)
    return field.assign(filled)


def _check_gaps(name: str, t: np.ndarray, present: np.ndarray, max_gap_s: float | None) -> None:
    if present[0] > 0 or present[-1] < len(t) - 1:
        raise ValueError(
            f"only gaps inside the record can be filled: {name} holds numbers from "
            f"{t[present[0]]:.6g} to {t[present[-1]]:.6g} s, the record runs from {t[0]:.6g} to "
            f"{t[-1]:.6g} s; crop it first (ep2sindy.prepare.crop)"
        )
    gaps = np.diff(t[present])
    if max_gap_s is not None and gaps.max() > max_gap_s:
        k = int(gaps.argmax())
        raise ValueError(
            f"gaps must not exceed max_gap_s = {max_gap_s:g} s: {name} is missing from "
            f"{t[present[k]]:.6g} to {t[present[k + 1]]:.6g} s; crop the record there"
        )


def delay(
    field: xr.Dataset, *, variable: str, delay_s: float, name: str | None = None
) -> xr.Dataset:
    """Add the delayed variable x(t - delay_s), interpolated linearly between samples.

    name: by default `<variable>_delayed`. The first samples, for which the delayed value is not
    known, are left out.
    Raises ValueError for a delay that is not positive or as long as the record.
    """
    array = _samples(field, variable)
    t = grid_points(field, "time")
    name = name or f"{variable}_delayed"
    check_new(field, name)
    kept = t >= t[0] + delay_s * (1 - 1e-12)
    if delay_s <= 0 or kept.sum() < 2:
        raise ValueError(
            f"delay_s must be positive and leave two samples or more: {delay_s:g} s came for a "
            f"record of {t[-1] - t[0]:g} s"
        )
    straight = make_interp_spline(t, array.values, k=1, axis=0, check_finite=False)
    past = straight(np.maximum(t[kept] - delay_s, t[0]))
    later = field.isel(time=np.flatnonzero(kept))
    return later.assign({name: (array.dims, past, array.attrs)})


def derivative(field: xr.Dataset, *, variable: str, name: str | None = None) -> xr.Dataset:
    """Add a variable's rate of change, by central differences of second order.

    name: by default `d<variable>_dt`. Steps may be unequal. Differentiation amplifies noise, so
    apply `low_pass` first.
    """
    array = _samples(field, variable)
    t = grid_points(field, "time")
    name = name or f"d{variable}_dt"
    check_new(field, name)
    if len(t) < 3:
        raise ValueError(f"a derivative needs three samples or more: {len(t)} came")
    rate = np.gradient(array.values, t, axis=0, edge_order=2)
    units = unit_product([(array.attrs["units"], 1), ("s", -1)])
    return field.assign({name: array.copy(data=rate).assign_attrs(units=units)})


def detrend(
    field: xr.Dataset, *, variables: Sequence[str] | None = None, degree: int = 1
) -> xr.Dataset:
    """Subtract a drift: a polynomial in time, fitted by least squares; the mean stays.

    variables: names to detrend; None: all variables that depend on time.
    """
    names = _of_time(field) if variables is None else list(variables)
    t = grid_points(field, "time")
    if not 1 <= degree < len(t):
        raise ValueError(f"degree must be 1 or more, below the number of samples: {degree} came")
    basis = np.linalg.qr(np.vander((t - t.mean()) / np.ptp(t), degree + 1, increasing=True))[0]
    found = {}
    for name in names:
        array = _samples(field, name)
        cells = array.values.reshape(len(t), -1)
        flat = cells - basis @ (basis.T @ cells) + cells.mean(axis=0)
        found[name] = array.copy(data=flat.reshape(array.shape))
    return field.assign(found)


def _of_time(field: xr.Dataset) -> list[str]:
    return [str(name) for name, array in field.data_vars.items() if "time" in array.dims]


def _samples(field: xr.Dataset, name: str) -> xr.DataArray:
    """A variable in float64, time first.

    Raises ValueError for one that is unknown or does not depend on time, and for a cell that is
    missing only at some times.
    """
    if name not in _of_time(field):
        raise ValueError(f"unknown variable of time {name!r}; this field has {_of_time(field)}")
    array = field[name]
    check_samples(array, grid_values(array), mask_cells(array))
    return _time_first(array)


def _time_first(array: xr.DataArray) -> xr.DataArray:
    return array.transpose("time", ...).astype(np.float64)
