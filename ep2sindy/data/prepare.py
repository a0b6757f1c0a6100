"""Preparation steps: plain functions, field -> field.

A config lists the steps to apply. No step changes its argument, and variables keep their units.
Of those that act along time, cells that are NaN at all times stay NaN; variables without time stay
as they are.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import xarray as xr
from scipy import signal
from scipy.interpolate import CubicSpline, make_interp_spline

from ep2sindy.data.blocks import read_whole
from ep2sindy.data.fields import (
    SPACE,
    check_field,
    check_new,
    check_samples,
    clock_of,
    grid_points,
    grid_values,
    mask_cells,
    mask_outside,
)
from ep2sindy.data.zones import FACES, Factors, average_of
from ep2sindy.library.names import split_factors
from ep2sindy.library.units import unit_product
from ep2sindy.runtime.screen import cut

# Steps that act on variables and cells.


OPERATORS: Mapping[type, Callable] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.BitAnd: np.logical_and,
    ast.BitOr: np.logical_or,
}

LONGEST = 1000  # largest number of characters in an expression

FUNCTIONS: Mapping[str, Callable] = {"abs": np.abs, "exp": np.exp, "log": np.log, "sqrt": np.sqrt}


def derive(field: xr.Dataset, *, name: str, expression: str, units: str) -> xr.Dataset:
    """Add a variable computed from others, such as "sqrt(u_iz^2 + u_ir^2)".

    Parameters
    ----------
    field : Dataset
        Field over time.
    name : str
        Name of the new variable.
    expression : str
        Formula with the operators + - * / ^ and the functions abs, exp, log, sqrt. Its names are
        the field's variables and coordinates (time, z, r), all in SI or the unit of their suffix.
    units : str
        Unit of the result.

    Returns
    -------
    Dataset
        The field with the new variable, computed in float64.

    Raises
    ------
    ValueError
        If a name in the expression is unknown, the new name is already taken, or the syntax is
        another.
    """
    check_new(field, name)
    array = evaluate(field, expression)
    if not array.dims:
        raise ValueError(f"a derived variable must use at least one variable, got {expression!r}")
    derived = field.assign({name: array.drop_attrs(deep=False).assign_attrs(units=units)})
    check_field(derived)
    return derived


def gradient(field: xr.Dataset, *, of: str, name: str, axis: str = "z") -> xr.Dataset:
    """Add the derivative along z or r of a variable, or of a product of variables.

    If the record has the product at the faces between its cells (attribute `face_average_of`, with
    the lengths `dz` of the cells, as in the averages of the axial simulator), the difference of a
    cell's two faces is taken: the divergence that moved the simulator's density. The last cell,
    whose far face is not recorded, is then NaN. Otherwise differences over the neighbouring cells
    are taken, of second order on uneven grids, from the record's time average of the product
    (attribute `average_of`) if it has one. They are one-sided at the ends, and NaN next to a masked
    cell.

    Parameters
    ----------
    field : Dataset
        Field over time and the axis.
    of : str
        The variable, such as "n_n", or a product, such as "n_i*u_iz" for the flux of ions.
    name : str
        Name of the new variable.
    axis : str, default 'z'
        "z" or "r".

    Returns
    -------
    Dataset
        The field with the derivative, computed in float64.

    Raises
    ------
    ValueError
        If the field or the variables lack the axis, there is a single cell, a variable is unknown,
        or the name is taken.

    Notes
    -----
    The result is only the slope: the divergence of a radial flux q in a cylinder is (1/r) d(r
    q)/dr, and that of an axial one through a cross-section A that widens is (1/A) d(A q)/dz.
    """
    check_new(field, name)
    _check_axis(field, axis, f"a gradient along {axis!r}")
    factors = average_of(field, split_factors(of), faces=axis == "z" and "dz" in field)
    array = evaluate(field, "*".join(f"{variable}^{power}" for variable, power in factors))
    _check_axis(array, axis, f"the gradient of {of!r} along {axis!r}")
    if _holds_faces(field, factors, of):
        slope = (array.shift({axis: -1}) - array) / _touching(field)
    else:
        slope = array.differentiate(axis, edge_order=2 if field.sizes[axis] > 2 else 1)
    units = unit_product([*((field[v].attrs["units"], power) for v, power in factors), ("m", -1)])
    return field.assign({name: slope.drop_attrs(deep=False).assign_attrs(units=units)})


def _check_axis(data: xr.Dataset | xr.DataArray, axis: str, what: str) -> None:
    if axis not in SPACE or data.sizes.get(axis, 1) < 2:
        raise ValueError(
            f"{what} needs two or more cells along z or r, got sizes {dict(data.sizes)}; name an "
            "axis of several cells, or take the step before the cells are averaged"
        )


def _holds_faces(field: xr.Dataset, factors: Factors, of: str) -> bool:
    """Whether a product is one variable that holds averages at the faces between cells."""
    at_faces = [name for name, _ in factors if FACES in field[name].attrs]
    if at_faces and factors != [(at_faces[0], 1)]:
        raise ValueError(
            f"the gradient of {of!r} mixes values in cells with {at_faces[0]!r}, which is at the "
            "faces between them: give that variable alone, or averages in cells"
        )
    if at_faces and "dz" not in field:
        raise ValueError(
            f"the gradient of {of!r}, whose values are at faces, needs the lengths of the cells: "
            "keep the variable dz in the field"
        )
    return bool(at_faces)


def _touching(field: xr.Dataset) -> xr.DataArray:
    """Lengths of cells that touch each other: the face of the next one is then a cell's own."""
    dz, z = field["dz"].astype(np.float64), grid_points(field, "z")
    if not np.allclose(np.diff(z), 0.5 * (dz.values[1:] + dz.values[:-1]), rtol=1e-3, atol=0.0):
        raise ValueError(
            "values at faces need cells that touch each other: the distances of z are not those of "
            "the lengths dz; take the gradient before cells are left out"
        )
    return dz


def radial_from_middle(field: xr.Dataset, *, middle_m: float | None = None) -> xr.Dataset:
    """Flip the sign of u_ir below mid radius, so that positive points away from it on both sides.

    Equations that are equal on both sides then get coefficients of the same sign, and maps of the
    coefficients become symmetric.

    Parameters
    ----------
    field : Dataset
        Field with u_ir over r.
    middle_m : float, optional
        Mid radius in m. None takes the middle of the grid.

    Returns
    -------
    Dataset
        The field with the new signs.

    Raises
    ------
    ValueError
        If the field has no u_ir over r.
    """
    if "u_ir" not in field or "r" not in field["u_ir"].dims:
        raise ValueError(
            f"a velocity away from mid radius needs u_ir on r: this field has "
            f"{list(field.data_vars)} on {list(field.dims)}; leave this step out"
        )
    r = grid_points(field, "r")
    middle = 0.5 * (r[0] + r[-1]) if middle_m is None else middle_m
    below = r < middle - 1e-6 * (r[-1] - r[0])  # a row in the middle keeps its sign
    sign = xr.DataArray(np.where(below, -1, 1).astype(field["u_ir"].dtype), dims="r")
    signed = (field["u_ir"] * sign).transpose(*field["u_ir"].dims)
    name = "radial ion velocity, away from mid radius"
    return field.assign(u_ir=signed.assign_attrs(field["u_ir"].attrs | {"long_name": name}))


def keep_where(field: xr.Dataset, *, condition: str) -> xr.Dataset:
    """Mask the cells where a condition does not hold, such as the inside of a wall.

    Parameters
    ----------
    field : Dataset
        Field over time and z, r or both.
    condition : str
        Expression as in `derive`, with bracketed comparisons joined by & and |, such as
        "(z > 0.025) | ((r > 0.035) & (r < 0.05))".

    Returns
    -------
    Dataset
        The field with NaN where the condition does not hold. Variables that lack a dimension of the
        condition stay as they are.
    """
    inside = evaluate(field, condition)
    if inside.dtype != bool or not set(inside.dims) & set(SPACE) or "time" in inside.dims:
        raise ValueError(
            f"a condition must compare places, not samples, got {condition!r}; write for example "
            "'(z > 0.01) & (r < 0.05)'"
        )
    return mask_outside(field, inside)


def evaluate(field: xr.Dataset, expression: str) -> xr.DataArray:
    """Evaluate an arithmetic expression of a field's variables and coordinates, in float64."""
    shown = cut(repr(expression))
    if len(expression) > LONGEST:
        raise ValueError(
            f"an expression may have up to {LONGEST} characters: {shown} has {len(expression)}"
        )
    try:
        tree = ast.parse(expression.replace("^", "**"), mode="eval")
    except (SyntaxError, ValueError, RecursionError) as error:
        raise ValueError(f"{shown} is no expression: {error or 'too deep'}") from None
    try:
        return _value(tree.body, field)
    except (RecursionError, OverflowError) as error:
        raise ValueError(f"the expression {shown} cannot be worked out: {error}") from None


def _value(node: ast.expr, field: xr.Dataset) -> xr.DataArray:
    match node:
        case ast.Constant(value=int() | float() as number):
            return xr.DataArray(float(number))
        case ast.Name(id=name) if name in field.variables:
            return field[name].astype(np.float64)
        case ast.Name(id=name):
            raise ValueError(f"unknown variable {name!r}; this field has {list(field.variables)}")
        case ast.UnaryOp(op=op, operand=operand) if type(op) in OPERATORS:
            return OPERATORS[type(op)](_value(operand, field))
        case ast.BinOp(op=op, left=left, right=right) if type(op) in OPERATORS:
            return OPERATORS[type(op)](_value(left, field), _value(right, field))
        case ast.Compare(left=left, ops=[op], comparators=[right]) if type(op) in OPERATORS:
            return OPERATORS[type(op)](_value(left, field), _value(right, field))
        case ast.Call(func=ast.Name(id=name), args=[argument]) if name in FUNCTIONS:
            return FUNCTIONS[name](_value(argument, field))
    raise ValueError(
        f"an expression may use + - * / ^ < <= > >= & |, brackets and {list(FUNCTIONS)}, got "
        f"{ast.unparse(node)!r}"
    )


# Steps that act along time.


def crop(
    field: xr.Dataset, *, start_s: float | None = None, stop_s: float | None = None
) -> xr.Dataset:
    """Keep the samples from `start_s` to `stop_s`, both included.

    Parameters
    ----------
    field : Dataset
        Field over time.
    start_s : float, optional
        First time in s. None takes the beginning of the record.
    stop_s : float, optional
        Last time in s. None takes the end of the record.

    Returns
    -------
    Dataset
        The shorter field.
    """
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

    Parameters
    ----------
    field : Dataset
        Field over time.
    factor : int
        One sample is kept in so many.

    Returns
    -------
    Dataset
        The shorter field.
    """
    n_samples = field.sizes["time"]
    if factor < 1 or n_samples <= factor:
        raise ValueError(
            f"factor must be 1 or more and leave two samples or more, got {factor} with "
            f"{n_samples} samples"
        )
    return field.isel(time=slice(None, None, factor))


def low_pass(field: xr.Dataset, *, cutoff_Hz: float, order: int = 4) -> xr.Dataset:
    """Remove oscillations faster than `cutoff_Hz` without shifting phases.

    A Butterworth filter runs forwards and backwards: amplitudes halve at the cutoff and fall by 12
    order dB per octave above it. Variables without time and masked cells stay as they are. The
    field is loaded.

    Parameters
    ----------
    field : Dataset
        Field over time, at equal steps.
    cutoff_Hz : float
        Frequency at which amplitudes halve.
    order : int, default 4
        Order of the filter.

    Returns
    -------
    Dataset
        The filtered field.

    Raises
    ------
    ValueError
        If time steps are unequal (beyond 1e-3 of a step), the cutoff does not lie between 0 and
        half the sampling rate, or the record is shorter than the edges of the filter.
    """
    steps = np.diff(grid_points(field, "time"))
    dt_s, n_edge = float(steps.mean()), 3 * (order + 1)
    if np.ptp(steps) > 1e-3 * dt_s:
        raise ValueError(
            f"a low-pass needs equal time steps: they run from {steps.min():g} to {steps.max():g} "
            "s; bring the field to equal steps first (ep2sindy.data.resample)"
        )
    if not 0 < cutoff_Hz < 0.5 / dt_s:
        raise ValueError(
            f"cutoff_Hz must lie between 0 and half the sampling rate, {0.5 / dt_s:g} Hz, got "
            f"{cutoff_Hz:g}"
        )
    if field.sizes["time"] <= n_edge:
        raise ValueError(
            f"a low-pass of order {order} needs more than {n_edge} samples, got "
            f"{field.sizes['time']}; lower the order or leave it out"
        )
    sos = signal.butter(order, cutoff_Hz, fs=1 / dt_s, output="sos")
    smooth = partial(signal.sosfiltfilt, sos, axis=0, padlen=n_edge)
    return _with_samples(field, _of_time(field), smooth)


def resample(field: xr.Dataset, *, dt_s: float) -> xr.Dataset:
    """Resample the field to equal time steps.

    If `dt_s` is at most the median step, cubic splines through the samples are evaluated from the
    first sample on. If it is longer, each new sample is the mean over one step, placed at its
    middle, of the piecewise linear interpolant; this reduces aliasing. The field is loaded.

    Parameters
    ----------
    field : Dataset
        Field over time.
    dt_s : float
        New time step in s.

    Returns
    -------
    Dataset
        The field at the new times.

    Raises
    ------
    ValueError
        If the step leaves fewer than two samples, or samples are missing.
    """
    t = grid_points(field, "time")
    if not 0 < dt_s <= 0.5 * (t[-1] - t[0]):
        raise ValueError(
            f"dt_s must be positive and leave two samples or more, got {dt_s:g} s for a record of "
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

    The field is loaded.

    Parameters
    ----------
    field : Dataset
        Field over time.
    max_gap_s : float, optional
        Longest gap to fill, measured between the samples on either side, in s. None fills all.

    Returns
    -------
    Dataset
        The field without missing samples.

    Raises
    ------
    ValueError
        If a gap is longer, or lies at an end of the record.
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
            f"{t[-1]:.6g} s; crop it first (ep2sindy.data.crop)"
        )
    gaps = np.diff(t[present])
    if max_gap_s is not None and gaps.max() > max_gap_s:
        k = int(gaps.argmax())
        raise ValueError(
            f"gaps must not exceed max_gap_s = {max_gap_s:g} s: {name} is missing from "
            f"{t[present[k]]:.6g} to {t[present[k + 1]]:.6g} s; crop the record there"
        )


def derivative(field: xr.Dataset, *, variable: str, name: str | None = None) -> xr.Dataset:
    """Add a variable's rate of change, by central differences of second order.

    Steps may be unequal. Differentiation amplifies noise, so apply `low_pass` first.

    Parameters
    ----------
    field : Dataset
        Field over time.
    variable : str
        Name of the variable.
    name : str, optional
        Name of the new variable. None takes `d<variable>_dt`.

    Returns
    -------
    Dataset
        The field with the rate, in the unit of the variable per second, or per step.
    """
    array = _samples(field, variable)
    t = grid_points(field, "time")
    name = name or f"d{variable}_dt"
    check_new(field, name)
    if len(t) < 3:
        raise ValueError(f"a derivative needs three samples or more, got {len(t)}")
    rate = np.gradient(array.values, t, axis=0, edge_order=2)
    units = unit_product([(array.attrs["units"], 1), (clock_of(field).of_values, -1)])
    return field.assign({name: array.copy(data=rate).assign_attrs(units=units)})


def detrend(
    field: xr.Dataset, *, variables: Sequence[str] | None = None, degree: int = 1
) -> xr.Dataset:
    """Subtract a drift: a polynomial in time, fitted by least squares; the mean stays.

    Parameters
    ----------
    field : Dataset
        Field over time.
    variables : sequence of str, optional
        Names of the variables to detrend. None takes all that depend on time.
    degree : int, default 1
        Degree of the polynomial.

    Returns
    -------
    Dataset
        The field without the drift.

    Notes
    -----
    The polynomial p at each place minimises sum_k (x(t_k) - p(t_k))^2.
    """
    names = _of_time(field) if variables is None else list(variables)
    t = grid_points(field, "time")
    if not 1 <= degree < len(t):
        raise ValueError(f"degree must be 1 or more, below the number of samples, got {degree}")
    basis = np.linalg.qr(np.vander((t - t.mean()) / np.ptp(t), degree + 1, increasing=True))[0]

    def flatten(values: np.ndarray) -> np.ndarray:
        cells = values.reshape(len(t), -1)
        return (cells - basis @ (basis.T @ cells) + cells.mean(axis=0)).reshape(values.shape)

    return _with_samples(field, names, flatten)


def _with_samples(
    field: xr.Dataset, names: Sequence[str], change: Callable[[np.ndarray], np.ndarray]
) -> xr.Dataset:
    """The field with changed samples of some variables of time; see `_samples`."""
    arrays = ((name, _samples(field, name)) for name in names)
    return field.assign({name: array.copy(data=change(array.values)) for name, array in arrays})


def _of_time(field: xr.Dataset) -> list[str]:
    return [str(name) for name, array in field.data_vars.items() if "time" in array.dims]


def _samples(field: xr.Dataset, name: str) -> xr.DataArray:
    """A variable in float64, time first.

    Raises ValueError for one that is unknown or does not depend on time, and for a cell that is
    missing only at some times.
    """
    if name not in _of_time(field):
        raise ValueError(f"unknown variable of time {name!r}; this field has {_of_time(field)}")
    array = _time_first(field[name])
    check_samples(array, grid_values(array), mask_cells(array))
    return array


def _time_first(array: xr.DataArray) -> xr.DataArray:
    """The variable, read once into memory, in float64 with time first."""
    ordered = array.transpose("time", ...)
    return ordered.copy(data=read_whole(ordered).astype(np.float64, copy=False))
