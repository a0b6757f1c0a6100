"""The protocol of studies: an experiment with its settings, which fills a report.

The module also holds annotated types for numbers in a config. `n_realizations: Count` in a study
states the requirement once, for the reader and for the check.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Annotated, Any, Protocol, runtime_checkable

from ep2sindy.report.report import Report


@runtime_checkable
class Experiment(Protocol):
    """A frozen dataclass whose fields are the keys of its config.

    A field of type AnyMethod or Source is made of several groups of the config: formulation,
    search, ...; data, prepare, trajectory. Everything but the data is built before `run` is
    called, so that a misspelt key costs no simulation.
    """

    def run(self, report: Report) -> None: ...


@dataclass(frozen=True)
class Check:
    """A requirement on a value: the words after `must be` in an error, and a test."""

    message: str
    test: Callable[[Any], bool]


@runtime_checkable
class Deferred(Protocol):
    """An object named in the config and built on request, since data, for one, may be a simulation.

    changed: a copy with other values at some places, such as `operating_point.voltage`, and then
    `more` merged in; raises ValueError for a place that does not exist. str() gives all settings in
    a fixed order, so that equal objects have equal text. A Deferred can be sent to another process.
    settings: plain values, including `_target_`.
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


Count = Annotated[int, Check("a whole number, one or more", lambda x: type(x) is int and x >= 1)]
ZeroOrMore = Annotated[
    int, Check("a whole number, zero or more", lambda x: type(x) is int and x >= 0)
]
Fraction = Annotated[float, Check("a number between 0 and 1", lambda x: _is_positive(x) and x < 1)]
Positive = Annotated[float, Check("a positive number", _is_positive)]
PositiveOrAll = Annotated[
    float | None,
    Check("a positive number, or null for all", lambda x: x is None or _is_positive(x)),
]
_Levels = Annotated[float, Check("numbers, zero or more", lambda x: _is_number(x) and x >= 0)]
_Positives = Annotated[float, Check("numbers, above zero", _is_positive)]


def _each_once(values: Any) -> bool:
    if not isinstance(values, list) or not values:
        return False
    return all(value not in values[:k] for k, value in enumerate(values))  # 0 and 0.0 are one


A_LIST = Check("a list such as [a,b], each once", _each_once)
Names = Annotated[Sequence[str], A_LIST]
Levels = Annotated[Sequence[_Levels], A_LIST]
Positives = Annotated[Sequence[_Positives], A_LIST]
Terms = Mapping[str, Sequence[int | str]]  # by state; the constant term 1 may be a number
Coefficients = Mapping[str, Mapping[str, float]]  # state -> term -> SI coefficient
