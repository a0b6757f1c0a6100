"""Storage of models as JSON text, from which every number is restored exactly."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.library.functions import UnknownFunctionError
from ep2sindy.library.library import named_terms
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.vector_field import Equations
from ep2sindy.runtime.files import read_bytes, read_json
from ep2sindy.runtime.screen import words_of

FORMAT = "ep2sindy.SparseModel/1"

Model = TypeVar("Model")

ROUNDING = 1e-6  # tolerance for rounding errors in a correlation


def model_text(model: Equations, provenance: Mapping[str, str]) -> str:
    """JSON text of the whole model; floats in their shortest exact form."""
    content = {
        "format": FORMAT,
        "states": list(model.states),
        "variables": list(model.library.variables),
        "library": list(model.library.names),
        "equations": {state: model.terms(state) for state in model.states},
        "units": dict(model.units),
        "provenance": dict(provenance),
        "covariance": None if model.covariance is None else model.covariance.tolist(),
    }
    if model.clock != SECONDS:
        content["clock"] = {"unit": model.clock.unit, "seconds": model.clock.seconds}
    if model.courses:
        content["courses"] = dict(model.courses)
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def read_model(text: str, make: Callable[..., Model]) -> Model:
    """Read the text of `model_text` and build the model by `make`.

    `make` is called as make(library, equations, units=, provenance=, covariance=, clock=,
    courses=). Terms are read by name: no code from the file runs, and user functions must be
    registered beforehand.
    Raises ValueError for any other text, also if `make` rejects the content.
    """
    with read_as("a model file must hold", FORMAT, text) as content:
        states, equations = names_in(content["states"]), content["equations"]
        if sorted(equations) != sorted(states):
            raise ValueError(f"equations of {sorted(equations)}, but the states {states}")
        covariance = content.get("covariance")  # files of version 0.1 have none
        return make(
            named_terms(names_in(content["variables"]), names_in(content["library"])),
            {state: _numbers(equations[state], state) for state in states},
            units=texts_in(content["units"], "units"),
            provenance=texts_in(content["provenance"], "provenance"),
            covariance=None if covariance is None else covariance_in(covariance),
            clock=_clock_in(content["clock"]) if "clock" in content else SECONDS,
            courses=texts_in(content.get("courses", {}), "courses"),
        )


@contextmanager
def read_as(what: str, form: str, text: str) -> Iterator[Any]:
    """The content of a JSON text of a format, while it is read.

    Whatever goes wrong within becomes a ValueError that says what was wanted.
    """
    wanted = f"{what} {form} JSON"
    try:
        content = read_json(text)
        if content["format"] != form:
            raise ValueError(f"format {content['format']!r}")
        yield content
    except UnknownFunctionError:
        raise  # the text is sound: a function must be registered before it is read
    except KeyError as error:
        raise ValueError(f"{wanted}: {error} is missing") from error
    except (
        TypeError, ValueError, AttributeError, AssertionError, RecursionError, OverflowError
    ) as error:  # fmt: skip
        raise ValueError(f"{wanted}: {words_of(error)}") from error


def read_stored(path: Path, read: Callable[[str], Model]) -> Model:
    """Read a JSON file with `read`; error messages name the file.

    Raises UnknownFunctionError or another ValueError.
    """
    try:
        return read(read_bytes(path).decode("utf-8"))
    except UnknownFunctionError as error:
        raise UnknownFunctionError(f"{path}: {error}") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def names_in(value: Any) -> list[str]:
    """Check that `value` is a list of distinct strings, and return it."""
    if not isinstance(value, list) or not all(isinstance(each, str) for each in value):
        raise ValueError(f"a list of names was to come, and not {value!r:.80}")
    if len(set(value)) < len(value):
        raise ValueError(f"names that come more than once, in {value}")
    return value


def _numbers(terms: Any, state: str) -> dict[str, float]:
    """Coefficients by term; ValueError unless they are finite numbers."""
    for name, value in terms.items():
        if type(value) not in (int, float) or not np.isfinite(float(value)):
            raise ValueError(
                f"the coefficient of {name} in {state}' is no finite number: {value!r}"
            )
    return {name: float(value) for name, value in terms.items()}


def _clock_in(value: Any) -> Clock:
    unit, seconds = value["unit"], value["seconds"]
    if not isinstance(unit, str) or type(seconds) not in (int, float) or not 0.0 < seconds < np.inf:
        raise ValueError(f"a clock that is no unit of time with its length in s: {value!r:.80}")
    return Clock(unit, float(seconds))


def texts_in(value: Any, what: str) -> dict[str, str]:
    if not isinstance(value, dict) or not all(isinstance(each, str) for each in value.values()):
        raise ValueError(f"{what} that are no texts by name: {value!r:.80}")
    return value


def covariance_in(rows: Any) -> Float[np.ndarray, "_ _"]:
    """Covariance from the rows of a stored matrix, which may be empty.

    Raises ValueError unless the matrix is finite, symmetric and positive semidefinite.
    """
    if not all(type(value) in (int, float) for row in rows for value in row):
        raise ValueError("a covariance that is not of numbers")
    found = np.array(rows, dtype=np.float64).reshape(len(rows), len(rows))
    if not np.isfinite(found).all() or (np.diag(found) < 0.0).any():
        raise ValueError("a covariance that is not finite, or has a variance below zero")
    std = np.sqrt(zero_to_one(np.diag(found)))
    correlation = found / np.outer(std, std)
    if not np.allclose(correlation, correlation.T, atol=ROUNDING):
        raise ValueError("a covariance that is not symmetric")
    if np.linalg.eigvalsh(correlation).min(initial=0.0) < -ROUNDING * len(found):
        raise ValueError("a covariance that gives a combination of coefficients no variance")
    return found
