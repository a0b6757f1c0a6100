"""Kinds of settings: what a number in a config must be, beside its type.

`n_realizations: Count` in a study says it once, for the reader and for the check.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Annotated, Any, Protocol, runtime_checkable


@dataclass(frozen=True)
class Kind:
    """What a value must be, in words that follow `must be`, and whether one is."""

    says: str
    fits: Callable[[Any], bool]


@runtime_checkable
class Deferred(Protocol):
    """An object that the config names, built when asked for: data, say, may be a simulation.

    changed: the same with other values at some places, such as `operating_point.voltage`, then
    `more` merged in; ValueError for a place where nothing stands. str() gives all settings, in an
    order of its own: equal objects have equal text. It can be sent to another process.
    settings: as plain values, `_target_` among them.
    """

    @property
    def settings(self) -> Mapping[str, Any]: ...

    def build(self) -> Any: ...

    def changed(
        self, places: Mapping[str, Any], more: Mapping[str, Any] | None = None
    ) -> Deferred: ...


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and isfinite(value)


def _is_positive(value: Any) -> bool:
    return _is_number(value) and value > 0


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 1


Count = Annotated[int, Kind("a whole number, one or more", _is_count)]
Share = Annotated[float, Kind("a number between 0 and 1", lambda x: _is_positive(x) and x < 1)]
Positive = Annotated[float, Kind("a positive number", _is_positive)]
PositiveOrAll = Annotated[
    float | None,
    Kind("a positive number, or null for all", lambda x: x is None or _is_positive(x)),
]
_Counts = Annotated[int, Kind("whole numbers, above zero", _is_count)]
_Levels = Annotated[float, Kind("numbers, zero or more", lambda x: _is_number(x) and x >= 0)]
_Positives = Annotated[float, Kind("numbers, above zero", _is_positive)]


def _each_once(values: Any) -> bool:
    if not isinstance(values, list) or not values:
        return False
    return all(value not in values[:k] for k, value in enumerate(values))  # 0 and 0.0 are one


A_LIST = Kind("a list such as [a,b], each once", _each_once)
Names = Annotated[Sequence[str], A_LIST]
Counts = Annotated[Sequence[_Counts], A_LIST]
Levels = Annotated[Sequence[_Levels], A_LIST]
Positives = Annotated[Sequence[_Positives], A_LIST]
Coefficients = Mapping[str, Mapping[str, float]]  # state -> term -> SI coefficient
