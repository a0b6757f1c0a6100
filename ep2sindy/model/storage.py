"""A model as text: JSON that gives back every number exactly."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from typing import TypeVar

import numpy as np
from jaxtyping import Float

from ep2sindy.library.functions import UnknownFunctionError
from ep2sindy.library.library import Library, named_terms

FORMAT = "ep2sindy.SparseModel/1"

Model = TypeVar("Model")


def model_text(
    library: Library,
    equations: Mapping[str, Mapping[str, float]],
    *,
    units: Mapping[str, str],
    provenance: Mapping[str, str],
    covariance: Float[np.ndarray, "_ _"] | None,
) -> str:
    """Everything in the model; floats in their shortest exact form."""
    content = {
        "format": FORMAT,
        "states": list(equations),
        "variables": list(library.variables),
        "library": list(library.names),
        "equations": equations,
        "units": dict(units),
        "provenance": dict(provenance),
        "covariance": None if covariance is None else covariance.tolist(),
    }
    return json.dumps(content, indent=2, allow_nan=False) + "\n"


def read_model(text: str, make: Callable[..., Model]) -> Model:
    """Inverse of `model_text`: make(library, equations, units=, provenance=, covariance=).

    Terms are read by name: no code runs, and a user's own function must be registered before.
    Raises ValueError for anything else, also where it is `make` that refuses it.
    """
    try:
        content = json.loads(text)
        if content["format"] != FORMAT:
            raise ValueError(f"format {content['format']!r}")
        covariance = content.get("covariance")  # files of version 0.1 have none
        return make(
            named_terms(content["variables"], content["library"]),
            {state: content["equations"][state] for state in content["states"]},
            units=content["units"],
            provenance=content["provenance"],
            covariance=None if covariance is None else _square(covariance),
        )
    except UnknownFunctionError:
        raise  # the file is sound: a function must be registered before it is read
    except (KeyError, TypeError, json.JSONDecodeError, ValueError) as error:
        raise ValueError(f"a model file must hold {FORMAT} JSON: {error}") from error


def _square(rows: Sequence[Sequence[float]]) -> Float[np.ndarray, "_ _"]:
    """Rows of a stored matrix, which may be empty."""
    return np.array(rows, dtype=np.float64).reshape(len(rows), len(rows))
