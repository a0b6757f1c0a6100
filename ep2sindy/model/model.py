"""A sparse model: a few terms per equation, readable, runnable and storable."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from scipy.special import ndtri

from ep2sindy.data.trajectory import Trajectory, read_only
from ep2sindy.library.equations import equation_text, equations_latex, sum_sympy
from ep2sindy.library.library import Library
from ep2sindy.machine.files import write_text
from ep2sindy.model.rollout import Rollout, rollout
from ep2sindy.model.storage import model_text, read_model

if TYPE_CHECKING:
    import sympy


@dataclass(frozen=True, eq=False)
class SparseModel:
    """Equations x' = library(states, inputs) coef, in SI units.

    coef: (terms, equations), zero outside the support. states: one name per equation.
    units: of the states and of the library's variables. provenance: where it came from.
    covariance: (coefs, coefs) of the coefficients that are not zero, equation by equation and
    within one in the order of the library, in SI; None where it is not known.
    """

    library: Library
    states: Sequence[str]
    coef: Float[np.ndarray, "terms equations"]
    units: Mapping[str, str] = field(default_factory=dict)
    provenance: Mapping[str, str] = field(default_factory=dict)
    covariance: Float[np.ndarray, "_ _"] | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "states", tuple(self.states))
        object.__setattr__(self, "coef", read_only(self.coef))
        names = dict.fromkeys((*self.states, *self.library.variables))
        units = {name: self.units.get(name, "1") for name in names}
        object.__setattr__(self, "units", MappingProxyType(units))
        object.__setattr__(self, "provenance", MappingProxyType(dict(self.provenance)))
        if self.coef.shape != (len(self.library), len(self.states)):
            raise ValueError(
                "coef must have one row per term and one column per equation: shape "
                f"{self.coef.shape} came for {len(self.library)} terms and {list(self.states)}"
            )
        if not np.isfinite(self.coef).all():
            raise ValueError(f"coefficients must be finite: {self.coef.tolist()} came")
        if self.covariance is not None:
            object.__setattr__(self, "covariance", read_only(self.covariance))
            n_coefs = int(np.count_nonzero(self.coef))
            if self.covariance.shape != (n_coefs, n_coefs):
                raise ValueError(
                    "covariance must have a row and a column per coefficient that is not zero: "
                    f"shape {self.covariance.shape} came for {n_coefs}"
                )

    @property
    def inputs(self) -> tuple[str, ...]:
        """Variables of the library that are not states."""
        return tuple(v for v in self.library.variables if v not in self.states)

    def terms(self, state: str) -> dict[str, float]:
        """Term name -> SI coefficient, of one equation, in the order of the library."""
        column = self.coef[:, self._equation(state)]
        return {n: float(c) for n, c in zip(self.library.names, column, strict=True) if c != 0.0}

    def intervals(self, state: str, *, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """Term name -> lower and upper bound of its coefficient, for Gaussian errors.

        Raises ValueError for a model without covariance.
        """
        if self.covariance is None:
            raise ValueError(
                "intervals need a covariance: this model has none; discover it with the "
                "formulation Weak"
            )
        used = self.coef.T != 0.0
        std = np.zeros(used.shape)
        std[used] = np.sqrt(np.diag(self.covariance))
        row = self._equation(state)
        reach = ndtri(0.5 + 0.5 * level) * std[row, used[row]]
        return {
            name: (value - r, value + r)
            for (name, value), r in zip(self.terms(state).items(), reach.tolist(), strict=True)
        }

    def derivative(
        self,
        states: Float[np.ndarray, "... n_states"],
        inputs: Float[np.ndarray, "... n_inputs"],
    ) -> Float[np.ndarray, "... n_states"]:
        """Right-hand side at any number of samples; inputs in the order of `inputs`."""
        values = np.concatenate([states, inputs], axis=-1)
        return self.library.evaluate(values[..., self._gather]) @ self.coef

    def rollout(
        self,
        trajectory: Trajectory,
        *,
        start: int = 0,
        n_samples: int | None = None,
        initial: Float[np.ndarray, " n_states"] | None = None,
        blow_up: float = 100.0,
        rtol: float = 1e-8,
    ) -> Rollout:
        """Integrate from one sample of a trajectory, driven by its inputs (cubic splines).

        initial: the state at that sample, in SI; None takes the data's.
        The states are scaled by their largest value in the window, so that one tolerance fits
        all. A state that exceeds `blow_up` times that value ends the run as diverged.
        Raises ValueError for a window outside the trajectory or a missing variable.
        """
        return rollout(
            self,
            trajectory,
            start=start,
            n_samples=n_samples,
            initial=initial,
            blow_up=blow_up,
            rtol=rtol,
        )

    def text(self, *, digits: int = 3) -> str:
        """One line per equation: `n_i' = -2.62e+05 n_i + 5.48e-14 n_i n_n`."""
        return "\n".join(equation_text(s, self.terms(s), digits=digits) for s in self.states)

    def sympy(self) -> dict[str, sympy.Expr]:
        """State name -> right-hand side as a sympy expression, coefficients as floats."""
        return {state: sum_sympy(self.terms(state)) for state in self.states}

    def latex(self, *, digits: int = 3) -> str:
        """An `aligned` block with one equation per line."""
        terms = {state: self.terms(state) for state in self.states}
        return equations_latex(terms, digits=digits)

    def to_json(self) -> str:
        """Everything in the model; floats in their shortest exact form."""
        return model_text(
            self.library,
            {state: self.terms(state) for state in self.states},
            units=self.units,
            provenance=self.provenance,
            covariance=self.covariance,
        )

    @staticmethod
    def from_json(text: str) -> SparseModel:
        """Inverse of `to_json`, exact. Raises ValueError for anything else."""
        return read_model(text, model_of)

    def save(self, path: str | Path) -> None:
        write_text(Path(path), self.to_json())

    @staticmethod
    def load(path: str | Path) -> SparseModel:
        return SparseModel.from_json(Path(path).read_text(encoding="utf-8"))

    def _equation(self, state: str) -> int:
        if state not in self.states:
            raise ValueError(f"unknown state {state!r}; this model has {list(self.states)}")
        return list(self.states).index(state)

    @cached_property
    def _gather(self) -> np.ndarray:
        """Where each variable of the library stands among states, then inputs."""
        known = [*self.states, *self.inputs]
        return np.array([known.index(v) for v in self.library.variables], dtype=np.int64)


def coef_matrix(
    library: Library, equations: Sequence[Mapping[str, float]]
) -> Float[np.ndarray, "terms equations"]:
    """Coefficients by term name, as a matrix over the library."""
    coef = np.zeros((len(library), len(equations)))
    for k, terms in enumerate(equations):
        for name, value in terms.items():
            coef[library.index(name), k] = value
    return coef


def model_of(
    library: Library,
    equations: Mapping[str, Mapping[str, float]],
    *,
    units: Mapping[str, str],
    provenance: Mapping[str, str],
    covariance: Float[np.ndarray, "_ _"] | None,
) -> SparseModel:
    """A model from its coefficients by state and term name."""
    coef = coef_matrix(library, list(equations.values()))
    return SparseModel(library, list(equations), coef, units, provenance, covariance)
