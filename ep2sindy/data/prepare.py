"""Preparation steps that act on variables and cells: plain functions, field -> field.

Steps that act along time are in `in_time`. A config lists the steps to apply. No step changes its
argument, and variables keep their units.
"""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping

import numpy as np
import xarray as xr

from ep2sindy.data.fields import SPACE, check_field, check_new, grid_points, mask_outside
from ep2sindy.data.zones import FACES, Factors, average_of
from ep2sindy.library.names import split_factors
from ep2sindy.library.units import unit_product
from ep2sindy.runtime.screen import cut

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
    """Add the variable `name`, computed from others: "n_i*u_iz", "sqrt(u_iz^2 + u_ir^2)".

    expression: may use the operators + - * / ^ and the functions abs, exp, log, sqrt. Its names
    are the field's variables and coordinates (time, z, r), all in SI or the unit of their suffix.
    units: unit of the result. Computed in float64.
    Raises ValueError for an unknown name in the expression, a new name that is already taken, or
    any other syntax.
    """
    check_new(field, name)
    array = evaluate(field, expression)
    if not array.dims:
        raise ValueError(f"a derived variable must use at least one variable: {expression!r} came")
    derived = field.assign({name: array.drop_attrs(deep=False).assign_attrs(units=units)})
    check_field(derived)
    return derived


def gradient(field: xr.Dataset, *, of: str, name: str, axis: str = "z") -> xr.Dataset:
    """Add the variable `name`, the derivative along z or r of a variable or a product of variables.

    of: such as "n_n", or "n_i*u_iz" for the flux of ions. If the record has that product at the
    faces between its cells (attribute `face_average_of`, with the lengths `dz` of the cells, as in
    the axial simulator's averages), the difference of a cell's two faces is taken: the divergence
    that moved the simulator's density. The last cell, whose far face is not recorded, is then NaN.
    Otherwise differences over the neighbouring cells are taken, of second order on uneven grids,
    from the record's time average of the product (attribute `average_of`) if it has one; they are
    one-sided at the ends, and NaN beside a masked cell. Computed in float64.
    It is the slope alone: the divergence of a radial flux q in a cylinder is (1/r) d(r q)/dr, and
    that of an axial one through a cross-section A that widens is (1/A) d(A q)/dz.
    Raises ValueError for an axis that the field or the variables lack, a single cell, an unknown
    variable, or a name that is taken.
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
            f"{what} needs two or more cells along z or r: sizes {dict(data.sizes)} came; name an "
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

    Equations that are alike on both sides then get coefficients of the same sign, and maps of the
    coefficients become symmetric. middle_m: mid radius in m; None: the middle of the grid.
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

    condition: expression as in `derive`, with bracketed comparisons joined by & and |:
    "(z > 0.025) | ((r > 0.035) & (r < 0.05))". Variables that lack a dimension of the condition
    stay as they are.
    """
    inside = evaluate(field, condition)
    if inside.dtype != bool or not set(inside.dims) & set(SPACE) or "time" in inside.dims:
        raise ValueError(
            f"a condition must compare places, not samples: {condition!r} came; write for example "
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
        f"an expression may use + - * / ^ < <= > >= & |, brackets and {list(FUNCTIONS)}: "
        f"{ast.unparse(node)!r} came"
    )
