"""Preparation of fields before they are averaged: plain functions, field -> field.

A config lists them as steps. None changes its argument, and units stay with the variables.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping

import numpy as np
import xarray as xr
from scipy import signal

from ep2sindy.data.fields import (
    DIMS,
    SPACE,
    check_field,
    check_samples,
    grid_points,
    grid_values,
    mask_outside,
    masked_cells,
)
from ep2sindy.library.names import check_variable

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

FUNCTIONS: Mapping[str, Callable] = {"abs": np.abs, "exp": np.exp, "log": np.log, "sqrt": np.sqrt}


def crop(
    field: xr.Dataset, *, start_s: float | None = None, stop_s: float | None = None
) -> xr.Dataset:
    """Keep the samples from `start_s` to `stop_s`, ends included; None is the field's own end."""
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

    Plain subsampling: what oscillates faster than half the new rate is folded onto lower
    frequencies, so apply `low_pass` below that rate first.
    """
    n_samples = field.sizes["time"]
    if factor < 1 or n_samples <= factor:
        raise ValueError(
            f"factor must be 1 or more and leave two samples or more: {factor} came with "
            f"{n_samples} samples"
        )
    return field.isel(time=slice(None, None, factor))


def low_pass(field: xr.Dataset, *, cutoff_Hz: float, order: int = 4) -> xr.Dataset:
    """Remove what oscillates faster than `cutoff_Hz`, without shifting phases.

    A Butterworth filter of the given order run forwards and backwards: amplitudes halve at
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
    filtered = {}
    for name, array in field.data_vars.items():
        if "time" not in array.dims:
            continue
        values = grid_values(array)
        check_samples(array, values, masked_cells(array))
        smooth = signal.sosfiltfilt(sos, values, axis=0, padlen=n_edge)
        ordered = array.transpose(*[axis for axis in DIMS if axis in array.dims])
        filtered[name] = ordered.copy(data=smooth.reshape(ordered.shape))
    return field.assign(filtered)


def _uniform_step(field: xr.Dataset) -> float:
    """Time step in s."""
    steps = np.diff(grid_points(field, "time"))
    dt_s = float(steps.mean())
    if np.ptp(steps) > 1e-3 * dt_s:
        k = int(np.argmax(np.abs(steps - dt_s)))
        raise ValueError(
            f"a low-pass needs equal time steps: t[{k + 1}] - t[{k}] = {steps[k]:g} s, the mean "
            f"is {dt_s:g} s; interpolate the field onto equal steps first"
        )
    return dt_s


def derive(field: xr.Dataset, *, name: str, expression: str, units: str) -> xr.Dataset:
    """Add the variable `name`, computed from others: "n_i*u_iz", "sqrt(u_iz^2 + u_ir^2)".

    Operators + - * / ^, functions abs, exp, log, sqrt; names are the field's variables and
    coordinates (time, z, r), all in SI or the unit of their suffix, and `units` says what comes
    out. Computed in float64.
    Raises ValueError for an unknown name, one that is taken, or any other syntax.
    """
    check_variable(name)
    if name in field:
        raise ValueError(f"a derived variable needs a new name: the field already has {name!r}")
    array = evaluate(field, expression)
    if not array.dims:
        raise ValueError(f"a derived variable must use at least one variable: {expression!r} came")
    derived = field.assign({name: array.drop_attrs(deep=False).assign_attrs(units=units)})
    check_field(derived)
    return derived


def radial_from_middle(field: xr.Dataset, *, middle_m: float | None = None) -> xr.Dataset:
    """Turn the sign of u_ir below mid radius: positive is then away from it on both sides.

    Equations that are alike on both sides get coefficients of one sign, and maps of them become
    symmetric. middle_m: mid radius; None is the middle of the grid.
    Raises ValueError for a field without u_ir on r.
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
    """Mask the cells where `condition` does not hold, such as the inside of a wall.

    condition: as in `derive`, with comparisons joined by & and |, in brackets:
    "(z > 0.025) | ((r > 0.035) & (r < 0.05))". Variables without its dimensions stay as they are.
    """
    inside = evaluate(field, condition)
    if inside.dtype != bool or not set(inside.dims) & set(SPACE) or "time" in inside.dims:
        raise ValueError(
            f"a condition must compare places, not samples: {condition!r} came; write for example "
            "'(z > 0.01) & (r < 0.05)'"
        )
    return mask_outside(field, inside)


def evaluate(field: xr.Dataset, expression: str) -> xr.DataArray:
    """Value of an arithmetic expression of a field's variables and coordinates, in float64."""
    try:
        return _value(ast.parse(expression.replace("^", "**"), mode="eval").body, field)
    except SyntaxError as error:
        raise ValueError(f"{expression!r} is no expression: {error.msg}") from None


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
        f"an expression may use + - * / ^ < <= > >= & |, brackets and {list(FUNCTIONS)}: "
        f"{ast.unparse(node)!r} came"
    )
