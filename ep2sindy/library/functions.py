"""Functions of one variable as factors of terms: built-in functions, and a user's own.

A function acts on the number of its variable in SI: with n_i in m^-3, log(n_i) means
log(n_i / 1 m^-3).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from math import isfinite
from typing import Any

import numpy as np
from array_api_compat import array_namespace, is_numpy_array
from jaxtyping import Float

from ep2sindy.library.names import RECIPROCAL, Part, number_text
from ep2sindy.library.units import unit_product
from ep2sindy.runtime.values import Mask, Samples

Values = Callable[[Any], Any]
Interval = tuple[float, float]

REAL_LINE: tuple[Interval, ...] = ((-np.inf, np.inf),)
LARGEST_EXPONENT = 709.0  # largest argument of exp in float64


class UnknownFunctionError(ValueError):
    """A term names a function that is neither built in nor registered."""


@dataclass(frozen=True)
class Kind:
    """A named function and its derivative, both evaluated element by element.

    value, slope: the function f and its derivative f'. domain: open intervals in which both are
    finite; a trajectory must stay in one of them. degree: p for a homogeneous function,
    f(s x) = s^p f(x) for positive s; None for others. own: True for a user's function, which takes
    NumPy arrays only.
    """

    name: str
    value: Values = field(compare=False)
    slope: Values = field(compare=False)
    domain: tuple[Interval, ...] = REAL_LINE
    degree: float | None = None
    own: bool = False

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle by name; a user's function is registered again in the receiving process."""
        return _receive, (self.name, (self.value, self.slope, self.domain) if self.own else None)


@dataclass(frozen=True)
class Function:
    """A factor of terms: f(shift + scale * variable), or f' of that argument if `is_slope`."""

    kind: Kind
    variable: str
    scale: float = 1.0
    shift: float = 0.0
    is_slope: bool = False

    @property
    def name(self) -> str:
        """Name such as `sin(2*x)` or `1/(0.5+x)`, as terms are read; slopes end in '.

        Users never name a slope.
        """
        text = Part(self.kind.name, self.variable, self.scale, self.shift).text
        return f"{text}'" if self.is_slope else text

    def value(self, x: Any) -> Any:
        is_bare = self.scale == 1.0 and self.shift == 0.0
        argument = x if is_bare else self.scale * x + self.shift
        if self.kind.own and not is_numpy_array(argument):
            return self._bridged(argument)
        return (self.kind.slope if self.is_slope else self.kind.value)(argument)

    def at(self, x: float) -> float:
        """Value at one number of the variable; NaN or infinite outside the domain."""
        with np.errstate(all="ignore"):
            return float(self.value(np.array([x]))[0])

    @property
    def is_variable(self) -> bool:
        """True for the variable itself."""
        return not self.kind.name

    def derivative(self) -> tuple[float, Function | None]:
        """Factor and function whose product is the derivative; None for the function one."""
        assert not self.is_slope, "second derivatives are never needed"
        return self.scale, None if self.is_variable else replace(self, is_slope=True)

    def scaled(self, scale: float) -> tuple[float, Function]:
        if self.kind.degree is None or not scale > 0.0:
            return 1.0, replace(self, scale=self.scale * scale)
        power = self.kind.degree - self.is_slope
        return scale**power, replace(self, shift=self.shift / scale)

    def unit(self, unit: str) -> str:
        """Unit of the function for a variable in `unit`; "1" if the function has no degree."""
        return unit_product([(unit, self.kind.degree or 0)])

    def interval(self, x: float) -> Interval | None:
        """Interval of the domain, in terms of the argument, that holds a value of the variable."""
        argument = self.scale * x + self.shift
        return next(((low, high) for low, high in self.kind.domain if low < argument < high), None)

    def keep_inside(self, x: Samples, margin: float) -> Samples:
        """Move values of the variable into the interval of the domain that holds their median.

        They end no nearer to its ends than a margin.
        """
        home = self.interval(float(np.median(x))) or self.kind.domain[-1]
        low, high = sorted((end - self.shift) / self.scale for end in home)
        return np.clip(x, low + margin, high - margin)

    def misplaced(self, x: Samples, beside: Samples) -> Mask:
        """Mask of the values x of the variable at which the function cannot be used.

        These values do not lie in the same interval of the domain as `next to`, or give an f or f'
        that is not finite.
        """
        here, there = (self.scale * values + self.shift for values in (x, beside))
        wrong = np.ones(x.shape, dtype=np.bool_)
        for low, high in self.kind.domain:
            wrong &= ~((low < here) & (here < high) & (low < there) & (there < high))
        slope = replace(self, is_slope=True)
        with np.errstate(all="ignore"):
            return wrong | ~np.isfinite(self.value(x)) | ~np.isfinite(slope.value(x))

    @property
    def need(self) -> str:
        """Condition on the variable, in words: `x > 0`."""
        argument = Part("", self.variable, self.scale, self.shift).argument
        if len(self.kind.domain) > 1:  # at poles
            ends = ", ".join(number_text(high) for _, high in self.kind.domain[:-1])
            return f"{argument} to stay on one side of {ends}"
        ((low, high),) = self.kind.domain
        above = f"{argument} > {number_text(low)}" if np.isfinite(low) else ""
        below = f"{argument} < {number_text(high)}" if np.isfinite(high) else ""
        return " and ".join(filter(None, [above, below])) or "finite values"

    def _bridged(self, argument: Any) -> Any:
        """Apply a user's NumPy function to a torch tensor; its slope provides the gradient."""
        at = argument.detach()
        numbers = at.cpu().numpy()
        found = self.kind.slope if self.is_slope else self.kind.value
        value = argument.new_tensor(found(numbers))
        if not argument.requires_grad:
            return value
        assert not self.is_slope, "second derivatives are never needed"
        return value + argument.new_tensor(self.kind.slope(numbers)) * (argument - at)


def _of(name: str) -> Values:
    return lambda x: getattr(array_namespace(x), name)(x)


_POSITIVE: tuple[Interval, ...] = ((0.0, np.inf),)
_POLE: tuple[Interval, ...] = ((-np.inf, 0.0), (0.0, np.inf))
_BUILT_IN = (
    Kind("", lambda x: x, lambda x: array_namespace(x).ones_like(x), degree=1.0),  # the identity
    Kind("sin", _of("sin"), _of("cos")),
    Kind("cos", _of("cos"), lambda x: -array_namespace(x).sin(x)),
    Kind("exp", _of("exp"), _of("exp"), ((-np.inf, LARGEST_EXPONENT),)),
    Kind("log", _of("log"), lambda x: 1.0 / x, _POSITIVE),
    Kind("sqrt", _of("sqrt"), lambda x: 0.5 / array_namespace(x).sqrt(x), _POSITIVE, degree=0.5),
    Kind("abs", _of("abs"), _of("sign"), degree=1.0),
    # Smooth, so that it can be integrated and refined: sign(v/w) turns over a width w.
    Kind("sign", _of("tanh"), lambda x: 1.0 - array_namespace(x).tanh(x) ** 2),
    Kind(RECIPROCAL, lambda x: 1.0 / x, lambda x: -1.0 / (x * x), _POLE, degree=-1.0),
)
_kinds = {kind.name: kind for kind in _BUILT_IN}  # register_function adds to it
INVERSE = "inverse"  # name that asks for the reciprocal of every variable


def function_names() -> list[str]:
    """Names of all functions that terms may use, in the order of registration."""
    return [INVERSE if name == RECIPROCAL else name for name in _kinds if name]


def function_of(part: Part) -> Function:
    """Function that a part of a term's name stands for; of a variable alone the identity.

    Raises UnknownFunctionError, listing the known functions; ValueError if the variable is
    multiplied by zero, or a number is not finite.
    """
    name = RECIPROCAL if part.function == INVERSE else part.function
    if name not in _kinds:
        raise UnknownFunctionError(
            f"unknown function {name!r} in {part.text!r}; there are {function_names()}; register "
            f"your own before it is named: ep.register_function({name!r}, value, derivative)"
        )
    if not (isfinite(part.scale) and isfinite(part.shift)):
        raise ValueError(f"the numbers of a function must be finite, got {part.text!r:.80}")
    if not part.scale:
        raise ValueError(f"a function must be of its variable: {part.text!r} multiplies it by 0")
    return Function(_kinds[name], part.variable, part.scale, part.shift)


def variable_factor(name: str) -> Function:
    """The factor that is a variable itself."""
    return Function(_kinds[""], name)


def register_function(
    name: str, value: Values, derivative: Values, *, domain: Interval = (-np.inf, np.inf)
) -> None:
    """Register a function of your own, so that terms can use it: `tanh(x)` or `tanh(2*x)`.

    Models store only the name, so register the function before you load one. Registering a name
    again replaces the function from then on.

    Parameters
    ----------
    name : str
        A plain word that is not the name of a built-in function.
    value : callable
        Takes a NumPy array and returns an array of the same shape, element by element. PyTorch
        needs nothing more.
    derivative : callable
        The derivative of `value`, in the same form.
    domain : (float, float), default (-inf, inf)
        Open interval in which both are finite.

    Raises
    ------
    ValueError
        If the name is not a plain word or is built in, the domain is not an interval, values have
        another shape or are not finite, or the derivative is wrong.

    Examples
    --------
    >>> ep.register_function("tanh", np.tanh, lambda x: 1.0 - np.tanh(x) ** 2)
    >>> ep.polynomial(["x"], degree=1, functions=["tanh"]).names
    ('1', 'x', 'tanh(x)')
    """
    if not re.fullmatch(r"[^\W\d]\w*", name) or name == INVERSE:
        raise ValueError(f"a function's name must be a plain word, such as 'tanh', got {name!r}")
    if name in _kinds and not _kinds[name].own:
        raise ValueError(f"{name!r} is built in: give your function another name")
    low, high = map(float, domain)
    if not low < high:
        raise ValueError(f"a domain must be an interval (low, high), got {domain}")
    _check_derivative(name, value, derivative, low, high)
    _kinds[name] = Kind(name, value, derivative, ((low, high),), own=True)


def _check_derivative(
    name: str, value: Values, derivative: Values, low: float, high: float
) -> None:
    """Compare a derivative with central differences at a few points of the domain."""
    points = points_inside(low, high)
    step = 1e-5 * np.minimum(1.0, np.minimum(points - low, high - points))
    try:
        with np.errstate(all="ignore"):
            slopes, values = (np.asarray(f(points), np.float64) for f in (derivative, value))
            ahead, behind = (np.asarray(value(x)) for x in (points + step, points - step))
    except (TypeError, AttributeError) as error:
        raise ValueError(
            f"value and derivative of {name!r} must take and return NumPy arrays: {error}; write "
            "them with NumPy, np.tanh and not math.tanh"
        ) from error
    for what, found in (("value", values), ("derivative", slopes)):
        if found.shape != points.shape or not np.isfinite(found).all():
            raise ValueError(
                f"{what} of {name!r} must give a finite number for each of {points.tolist()}, got "
                f"{found.tolist()}; write it with NumPy, and give domain=(low, high) where it ends"
            )
    differences = (ahead - behind) / (2.0 * step)
    rounding = 1e-9 * np.abs(values) / step
    wrong = np.abs(differences - slopes) > 1e-3 * np.abs(differences) + rounding + 1e-8
    if wrong.any():
        k = int(np.argmax(wrong))
        raise ValueError(
            f"the derivative of {name!r} must be that of its value: at {points[k]:g} it gives "
            f"{slopes[k]:.6g}, and differences of the value {differences[k]:.6g}"
        )


def points_inside(low: float, high: float) -> Float[np.ndarray, " points"]:
    """A few points inside an interval."""
    if np.isfinite(low) and np.isfinite(high):
        return low + (high - low) * np.array([0.21, 0.47, 0.83])
    away = np.array([0.37, 1.13, 2.71])
    if np.isfinite(low):
        return low + away
    return high - away if np.isfinite(high) else away - 1.5


def _receive(name: str, own: tuple[Values, Values, tuple[Interval, ...]] | None = None) -> Kind:
    """A function by its name; a user's, from another process, is registered unless it is known."""
    return _kinds[name] if own is None else _kinds.setdefault(name, Kind(name, *own, own=True))
