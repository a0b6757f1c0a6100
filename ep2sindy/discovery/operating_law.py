"""A model whose coefficients are functions of the operating point, with intervals and bounds."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls
from scipy.special import ndtri

from ep2sindy.data.scales import zero_to_one
from ep2sindy.library.equations import equation_text
from ep2sindy.library.functions import UnknownFunctionError
from ep2sindy.library.library import Library, named_terms
from ep2sindy.model.model import SparseModel
from ep2sindy.model.storage import covariance_in, names_in, read_stored, texts_in
from ep2sindy.runtime.arrays import read_only
from ep2sindy.runtime.files import read_json, write_text

FORMAT = "ep2sindy.OperatingLaw/1"

INSIDE = 1e-6  # a point this far outside the hull, in ranges of the parameters, lies on its edge


@dataclass(frozen=True, eq=False)
class OperatingLaw:
    """One structure, coefficients by law: coef[k] at a point = coef[k] @ functions(parameters).

    functions: of the parameters; library: of the states. coefficients: (state, term) of each row
    of coef, in SI. covariance: of coef.ravel(), None where it is not known. points: the operating
    points that it was fitted to, columns in the order of the functions' variables.
    """

    functions: Library
    library: Library
    states: tuple[str, ...]
    coefficients: tuple[tuple[str, str], ...]
    coef: Float[np.ndarray, "coefs functions"]
    points: Float[np.ndarray, "points parameters"]
    covariance: Float[np.ndarray, "_ _"] | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        object.__setattr__(self, "coef", read_only(self.coef))
        object.__setattr__(self, "points", read_only(self.points))
        object.__setattr__(self, "units", MappingProxyType(dict(self.units)))
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        shape = (len(self.coefficients), len(self.functions))
        if self.coef.shape != shape or not np.isfinite(self.coef).all():
            raise ValueError(
                "a law must have a finite number for every coefficient and function: shape "
                f"{self.coef.shape} came for {shape}"
            )
        for state, term in self.coefficients:
            if state not in self.states or term not in self.library.names:
                raise ValueError(
                    f"a law's coefficients must be of {list(self.states)} and "
                    f"{list(self.library.names)}: {term} of {state} came"
                )
        if self.points.shape[1:] != (len(self.parameters),) or not len(self.points):
            raise ValueError(
                f"points must have a column for each of {list(self.parameters)}: shape "
                f"{self.points.shape} came"
            )
        if not np.isfinite(self.points).all():
            raise ValueError(f"points must be finite: {self.points.tolist()} came")
        if self.covariance is not None:
            object.__setattr__(self, "covariance", read_only(self.covariance))
            if self.covariance.shape != (self.coef.size, self.coef.size):
                raise ValueError(
                    f"the covariance must be that of {self.coef.size} numbers: shape "
                    f"{self.covariance.shape} came"
                )

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(self.functions.variables)

    def model_at(
        self, parameters: Mapping[str, float], *, extrapolate: bool = False
    ) -> SparseModel:
        """The model at an operating point, which need not be among those of the fit.

        Raises ValueError unless `parameters` has a finite value for each of the law's, or outside
        the convex hull of the points that it was fitted to, but for extrapolate=True.
        """
        values = self._values(parameters)
        if not extrapolate and not self._holds(values):
            raise ValueError(
                f"{_text(parameters)} lies outside the points that this law was fitted to, "
                f"{self._ranges()}: pass extrapolate=True to read it off the law all the same"
            )
        functions = self.functions.evaluate(values[None])[0]
        coef, covariance = np.zeros((len(self.library), len(self.states))), None
        places = [(self.library.index(term), self.states.index(s)) for s, term in self.coefficients]
        for place, value in zip(places, self.coef @ functions, strict=True):
            coef[place] = value
        if self.covariance is not None:
            spread = np.kron(np.eye(len(self.coefficients)), functions)
            order = [k for k in np.lexsort(np.transpose(places)) if coef[places[k]] != 0.0]
            covariance = (spread @ self.covariance @ spread.T)[np.ix_(order, order)]
        provenance = {**self.provenance, "point": _text(parameters)}
        return SparseModel(self.library, self.states, coef, self.units, provenance, covariance)

    def is_inside(self, parameters: Mapping[str, float]) -> bool:
        """Whether a point lies in the convex hull of those of the fit."""
        return self._holds(self._values(parameters))

    def intervals(self, *, level: float = 0.95) -> dict[tuple[str, str], dict[str, Any]]:
        """(state, term) -> function -> lower and upper bound of its number, for Gaussian errors.

        Raises ValueError for a law without covariance.
        """
        if self.covariance is None:
            raise ValueError("intervals need a covariance: this law has none; fit it tied")
        std = np.sqrt(np.maximum(np.diag(self.covariance), 0.0)).reshape(self.coef.shape)
        reach = ndtri(0.5 + 0.5 * level) * std
        return {
            pair: {
                name: (low, high)
                for name, low, high in zip(
                    self.functions.names, (row - r).tolist(), (row + r).tolist(), strict=True
                )
            }
            for pair, row, r in zip(self.coefficients, self.coef, reach, strict=True)
        }

    def text(self, *, digits: int = 3) -> str:
        """One line per coefficient: `n_i: n_n = 4.83e+03 + 12.1 V_d`."""
        lines = []
        for (state, term), row in zip(self.coefficients, self.coef.tolist(), strict=True):
            by_function = dict(zip(self.functions.names, row, strict=True))
            right = equation_text("c", by_function, digits=digits).partition("= ")[2]
            lines.append(f"{state}: {term} = {right}")
        return "\n".join(lines)

    def __repr__(self) -> str:
        head = (
            f"OperatingLaw of {len(self.coefficients)} coefficients in {list(self.parameters)}, "
            f"{self.coef.size} numbers, {len(self.points)} points"
        )
        return f"{head}\n{self.text()}"

    def to_json(self) -> str:
        """Everything in the law; floats in their shortest exact form."""
        content = {
            "format": FORMAT,
            "parameters": list(self.parameters),
            "functions": list(self.functions.names),
            "variables": list(self.library.variables),
            "library": list(self.library.names),
            "states": list(self.states),
            "coefficients": [list(pair) for pair in self.coefficients],
            "coef": self.coef.tolist(),
            "points": self.points.tolist(),
            "covariance": None if self.covariance is None else self.covariance.tolist(),
            "units": dict(self.units),
            "provenance": dict(self.provenance),
        }
        return json.dumps(content, indent=2, allow_nan=False) + "\n"

    @staticmethod
    def from_json(text: str) -> OperatingLaw:
        """Inverse of `to_json`, exact. Raises ValueError for anything else."""
        try:
            content = read_json(text)
            if content["format"] != FORMAT:
                raise ValueError(f"format {content['format']!r}")
            known = content["covariance"]
            return OperatingLaw(
                functions=named_terms(*(names_in(content[k]) for k in ("parameters", "functions"))),
                library=named_terms(*(names_in(content[k]) for k in ("variables", "library"))),
                states=tuple(names_in(content["states"])),
                coefficients=tuple((state, term) for state, term in content["coefficients"]),
                coef=np.array(content["coef"], dtype=np.float64),
                points=np.array(content["points"], dtype=np.float64),
                covariance=None if known is None else covariance_in(known),
                units=texts_in(content["units"], "units"),
                provenance=texts_in(content["provenance"], "provenance"),
            )
        except UnknownFunctionError:
            raise  # the file is sound: a function must be registered before it is read
        except (KeyError, TypeError, ValueError, RecursionError, OverflowError) as error:
            raise ValueError(f"a law file must hold {FORMAT} JSON: {error}") from error

    def save(self, path: str | Path) -> None:
        write_text(Path(path), self.to_json())

    @staticmethod
    def load(path: str | Path) -> OperatingLaw:
        return read_stored(Path(path), OperatingLaw.from_json)

    def _values(self, parameters: Mapping[str, float]) -> Float[np.ndarray, " parameters"]:
        names = list(self.parameters)
        if set(parameters) != set(names):
            raise ValueError(
                f"an operating point must have {names}, and no other: {dict(parameters)} came"
            )
        values = np.array([float(parameters[name]) for name in names])
        if not np.isfinite(values).all():
            raise ValueError(f"an operating point must be finite: {dict(parameters)} came")
        return values

    def _holds(self, values: Float[np.ndarray, " parameters"]) -> bool:
        return in_hull(self.points, values)

    def _ranges(self) -> str:
        ends = zip(self.parameters, self.points.min(axis=0), self.points.max(axis=0), strict=True)
        return ", ".join(f"{name} {low:g} to {high:g}" for name, low, high in ends)


def in_hull(
    points: Float[np.ndarray, "points parameters"], value: Float[np.ndarray, " parameters"]
) -> bool:
    """Whether a value is an average of points, with weights that are not negative."""
    scale = zero_to_one(np.ptp(points, axis=0))
    columns = np.vstack([((points - value) / scale).T, np.ones(len(points))])
    target = np.append(np.zeros(points.shape[1]), 1.0)
    return float(nnls(columns, target)[1]) <= INSIDE


def _text(parameters: Mapping[str, float] | Sequence[float]) -> str:
    if not isinstance(parameters, Mapping):
        return ", ".join(f"{value:g}" for value in parameters)
    return ", ".join(f"{name}={value:g}" for name, value in parameters.items())
