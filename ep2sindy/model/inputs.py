"""Inputs that a user passes to a model: one array, or arrays and functions of time by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import factorial
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

Drive = Callable[[float], np.ndarray]


def inputs_at_samples(
    names: Sequence[str], inputs: ArrayLike | Mapping[str, Any] | None, shape: tuple[int, ...]
) -> Float[np.ndarray, "... n_inputs"]:
    """Inputs at samples, (*shape, n_inputs), from an array of that shape or arrays by name.

    Raises ValueError for inputs that are missing, unknown, of another shape or not finite.
    """
    if isinstance(inputs, Mapping):
        _check_names(names, inputs)
        columns = [_column(name, inputs[name], shape) for name in names]
        return np.stack(columns, axis=-1) if columns else np.empty((*shape, 0))
    if inputs is None:
        _check_names(names, {})
        return np.empty((*shape, 0))
    values = np.asarray(inputs, dtype=np.float64)
    if values.shape != (*shape, len(names)):
        raise ValueError(
            f"inputs must have shape {(*shape, len(names))}, one column for each of "
            f"{list(names)}: {values.shape} came"
        )
    _check_finite("inputs", values)
    return values


def driven(
    names: Sequence[str],
    inputs: ArrayLike | Mapping[str, Any] | None,
    t: Float[np.ndarray, " samples"],
) -> tuple[Drive | None, Float[np.ndarray, "samples n_inputs"]]:
    """Inputs as one function of time, or None without inputs, and their samples at t.

    Functions given by name are called at every time that the solver needs, with t in s.
    Samples are interpolated by cubic splines.
    """
    given = dict(inputs) if isinstance(inputs, Mapping) else {}
    functions = {name: value for name, value in given.items() if callable(value)}
    at_samples = {n: np.array([f(now) for now in t.tolist()]) for n, f in functions.items()}
    samples = inputs_at_samples(names, {**given, **at_samples} if given else inputs, (len(t),))
    if not names:
        return None, samples
    smooth = spline(t, samples)
    if not functions:
        return smooth, samples

    def drive(now: float) -> np.ndarray:
        values = smooth(now)
        for name, function in functions.items():
            values[list(names).index(name)] = function(now)
        return values

    return drive, samples


def spline(
    t: Float[np.ndarray, " samples"], inputs: Float[np.ndarray, "samples n_inputs"]
) -> Drive:
    """Cubic spline through the samples of the inputs."""
    from scipy.interpolate import make_interp_spline  # imported only for models with inputs

    return make_interp_spline(t, inputs, k=min(3, len(inputs) - 1))


def spline_pieces(
    drive: Drive | None, n_inputs: int
) -> tuple[Float[np.ndarray, " breaks"], Float[np.ndarray, "order spans n_inputs"]] | None:
    """Breaks of a spline of inputs, and its polynomial coefficients, the highest power first.

    The polynomials are in the time since the last break. Both arrays are empty for a model
    without inputs. Returns None for inputs that are user functions.
    """
    if drive is None:
        return np.zeros(0), np.zeros((0, 0, n_inputs))
    from scipy.interpolate import BSpline

    if not isinstance(drive, BSpline):
        return None
    breaks = np.unique(drive.t[drive.k : len(drive.t) - drive.k])
    powers = range(drive.k, -1, -1)
    pieces = [drive.derivative(m)(breaks[:-1]) / factorial(m) for m in powers]
    return breaks, np.ascontiguousarray(pieces)


def _check_names(names: Sequence[str], given: Mapping[str, Any]) -> None:
    unknown = [name for name in given if name not in names]
    if unknown:
        raise ValueError(f"unknown inputs {unknown}; this model has {list(names)}")
    missing = [name for name in names if name not in given]
    if missing:
        raise ValueError(
            f"this model is driven by {list(names)}: {missing} are missing; pass them as "
            "inputs={name: samples}, or as an array with a column for each"
        )


def _column(name: str, values: Any, shape: tuple[int, ...]) -> np.ndarray:
    if callable(values):
        raise ValueError(f"input {name!r} must be samples here: a function came; evaluate it first")
    column = np.asarray(values, dtype=np.float64)
    if column.shape not in (shape, ()):
        raise ValueError(
            f"input {name!r} must have shape {shape}, as the samples, or be one number: "
            f"{column.shape} came"
        )
    _check_finite(f"input {name!r}", column)
    return np.broadcast_to(column, shape)


def _check_finite(what: str, values: np.ndarray) -> None:
    if not np.isfinite(values).all():
        raise ValueError(f"{what} must be finite: {values[~np.isfinite(values)][0]} came")
