"""The study protocol: what an experiment is, from its settings to what people read.

And what a number in a config must be, beside its type: `n_realizations: Count` in a study says it
once, for the reader and for the check.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite
from typing import Annotated, Any, Protocol, runtime_checkable

import pandas as pd

from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Captioned, Section
from ep2sindy.report.run import Run


@runtime_checkable
class Outcome(Protocol):
    """All that a study leaves. The runner writes it: models and tables first, then the views.

    figures: by name, drawn when they are written. sections: what the terminal and the page show.
    summary: the findings, for `summary.json`; experiment and seed are added to it. headline: the
    few numbers by which runs are compared, in TensorBoard and in the index of a sweep; their
    names do not depend on what was found.
    """

    def models(self) -> Mapping[str, SparseModel]: ...

    def tables(self) -> Mapping[str, pd.DataFrame]: ...

    def figures(self) -> Mapping[str, Captioned]: ...

    def sections(self) -> Sequence[Section]: ...

    def summary(self) -> dict[str, Any]: ...

    def headline(self) -> Mapping[str, float]: ...


@runtime_checkable
class Experiment(Protocol):
    """A frozen dataclass whose fields are the keys of the config that it takes.

    A field of type AnyMethod or Source stands for the groups that it is made of: formulation,
    search, ...; data, prepare, trajectory. Everything but the data is built before
    `compute` is called, so that a misspelt key costs no simulation.
    """

    def compute(self, run: Run) -> Outcome: ...


@dataclass(frozen=True)
class Check:
    """What a value must be, in words that follow `must be`, and whether one is."""

    message: str
    test: Callable[[Any], bool]


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


Count = Annotated[int, Check("a whole number, one or more", _is_count)]
Share = Annotated[float, Check("a number between 0 and 1", lambda x: _is_positive(x) and x < 1)]
Positive = Annotated[float, Check("a positive number", _is_positive)]
PositiveOrAll = Annotated[
    float | None,
    Check("a positive number, or null for all", lambda x: x is None or _is_positive(x)),
]
_Counts = Annotated[int, Check("whole numbers, above zero", _is_count)]
_Levels = Annotated[float, Check("numbers, zero or more", lambda x: _is_number(x) and x >= 0)]
_Positives = Annotated[float, Check("numbers, above zero", _is_positive)]


def _each_once(values: Any) -> bool:
    if not isinstance(values, list) or not values:
        return False
    return all(value not in values[:k] for k, value in enumerate(values))  # 0 and 0.0 are one


A_LIST = Check("a list such as [a,b], each once", _each_once)
Names = Annotated[Sequence[str], A_LIST]
Counts = Annotated[Sequence[_Counts], A_LIST]
Levels = Annotated[Sequence[_Levels], A_LIST]
Positives = Annotated[Sequence[_Positives], A_LIST]
Coefficients = Mapping[str, Mapping[str, float]]  # state -> term -> SI coefficient
