"""Inputs that a user passes to a model: one array, or arrays and functions of time by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import factorial
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ep2sindy.data.trajectory import read_only_mapping

# How an input goes from one sample to the next, and the degree of the spline that does: it holds
# the value of the last sample, or follows a straight line, or a smooth curve.
COURSES = {"held": 0, "linear": 1, "smooth": 3}


def inputs_at_samples(
    names: Sequence[str], inputs: ArrayLike | Mapping[str, Any] | None, shape: tuple[int, ...]
) -> Float[np.ndarray, "... n_inputs"]:
    """Inputs at samples, (*shape, n_inputs), from an array of that shape or arrays by name.

    Raises ValueError for inputs that are missing, unknown, of another shape or not finite.
    """
    if inputs is None:
        inputs = {}
    if isinstance(inputs, Mapping):
        _check_names(names, inputs)
        columns = [_column(name, inputs[name], shape) for name in names]
        return np.stack(columns, axis=-1) if columns else np.empty((*shape, 0))
    values = np.asarray(inputs, dtype=np.float64)
    if values.shape != (*shape, len(names)):
        raise ValueError(
            f"inputs must have shape {(*shape, len(names))}, one column for each of "
            f"{list(names)}, got {values.shape}"
        )
    _check_finite("inputs", values)
    return values


@dataclass(frozen=True, eq=False)
class Curve:
    """Inputs between samples: in each step a polynomial of the fraction of it that has passed.

    t: (samples,). pieces: (powers, steps, n_inputs), the highest power first. stops: times at
    which an input jumps or bends, where a scheme of high order must start anew. functions: of time
    in s, by column, which take the place of the polynomials.
    """

    t: Float[np.ndarray, " samples"]
    pieces: Float[np.ndarray, "powers steps n_inputs"]
    stops: Float[np.ndarray, " _"]
    functions: Mapping[int, Callable[[float], float]] = field(default_factory=dict)

    def __call__(self, now: float) -> Float[np.ndarray, " n_inputs"]:
        """The inputs at one time; at a sample they have jumped already."""
        place = min(max(int(self.t.searchsorted(now, "right")) - 1, 0), len(self.t) - 2)
        fraction = (now - self.t[place]) / (self.t[place + 1] - self.t[place])
        values = np.polyval(self.pieces[:, place], fraction)
        for column, function in self.functions.items():
            values[column] = function(now)
        return values

    def at(self, fraction: float) -> Float[np.ndarray, "steps n_inputs"]:
        """The inputs at a given fraction of every step; at its end they have not jumped yet."""
        values: np.ndarray = np.polyval(self.pieces, fraction)
        times = self.t[:-1] + fraction * np.diff(self.t)
        for column, function in self.functions.items():
            values[:, column] = [function(now) for now in times.tolist()]
        return values


def curve_through(
    t: Float[np.ndarray, " samples"],
    samples: Float[np.ndarray, "samples n_inputs"],
    courses: Sequence[str | None],
) -> Curve:
    """Inputs through their samples, each on its course; None takes the most plausible one."""
    n_steps, n_inputs = len(t) - 1, len(courses)
    pieces = np.zeros((1 + max(COURSES.values()), n_steps, n_inputs))
    rough = np.zeros(max(n_steps - 1, 0), dtype=np.bool_)
    if n_inputs:
        from scipy.interpolate import make_interp_spline  # imported only for models with inputs
    for j, column in enumerate(samples.T):
        degree = COURSES[courses[j] or plausible_courses([column])[0]]
        curve = make_interp_spline(t, column, k=min(degree, n_steps))
        for power in range(curve.k + 1):
            slope = curve.derivative(power)(t[:-1])
            pieces[-1 - power, :, j] = slope * np.diff(t) ** power / factorial(power)
        if degree < COURSES["smooth"]:
            rough |= (np.diff(pieces[..., j]) != 0.0).any(axis=0)
    return Curve(t, pieces, t[1:-1][rough])


def plausible_courses(samples: Sequence[np.ndarray]) -> tuple[str, ...]:
    """Courses that the samples of one input allow, over some records, the most plausible first.

    What rests over most steps is set, and a cubic would overshoot at its jumps. A record whose
    noise exceeds half its resolution repeats its last value less often.
    """
    resting = np.concatenate([np.diff(each, axis=0) == 0.0 for each in samples])
    if resting.all():
        return ("held",)
    return ("held", "linear") if resting.mean() > 0.5 else ("smooth", "linear", "held")


def check_courses(courses: Mapping[str, str], inputs: Sequence[str]) -> Mapping[str, str]:
    """Return a read-only copy. Raises ValueError for an unknown input, or an unknown course."""
    for name, course in courses.items():
        if name not in inputs or course not in COURSES:
            raise ValueError(
                f"courses must give one of {list(COURSES)} for some of the inputs {list(inputs)}: "
                f"got {name!r}: {course!r}"
            )
    return read_only_mapping(dict(courses))


def driven(
    names: Sequence[str],
    inputs: ArrayLike | Mapping[str, Any] | None,
    t: Float[np.ndarray, " samples"],
    courses: Mapping[str, str],
) -> tuple[Curve, Float[np.ndarray, "samples n_inputs"]]:
    """Inputs between the samples, each on its course, and their samples at t.

    Functions given by name are called at every time that the solver needs, with t in s.
    """
    given = dict(inputs) if isinstance(inputs, Mapping) else {}
    functions = {name: value for name, value in given.items() if callable(value)}
    at_samples = {n: np.array([f(now) for now in t.tolist()]) for n, f in functions.items()}
    samples = inputs_at_samples(names, {**given, **at_samples} if given else inputs, (len(t),))
    # A function is called, and its own bends are not known: nothing stops there.
    known = ["smooth" if name in functions else courses.get(name) for name in names]
    by_column = {list(names).index(name): function for name, function in functions.items()}
    return replace(curve_through(t, samples, known), functions=by_column), samples


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
        raise ValueError(f"input {name!r} must be samples here, got a function; evaluate it first")
    column = np.asarray(values, dtype=np.float64)
    if column.shape not in (shape, ()):
        raise ValueError(
            f"input {name!r} must have shape {shape}, as the samples, or be one number, got "
            f"{column.shape}"
        )
    _check_finite(f"input {name!r}", column)
    return np.broadcast_to(column, shape)


def _check_finite(what: str, values: np.ndarray) -> None:
    if not np.isfinite(values).all():
        raise ValueError(f"{what} must be finite, got {values[~np.isfinite(values)][0]}")
