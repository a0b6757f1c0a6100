"""Physical quantities read from coefficients, with intervals, and the results of one point."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, place_of
from ep2sindy.library.units import unit_product
from ep2sindy.model.model import SparseModel

LEVEL = 0.95  # level of all intervals in this file
FITTED, SEARCHED, CONVERGED = "fitted", "searched", "converged"
REFINED = "_refined"  # suffix of the name of a case's refinement


@dataclass(frozen=True)
class Quantity:
    """A physical quantity read from a coefficient: factor * coef^power, in SI.

    coefficient: "state: term". power: 1, or -1 for a length or a time such as L = -1/coef.
    """

    coefficient: str
    factor: float = 1.0
    power: int = 1

    def __post_init__(self) -> None:
        if self.coefficient.count(":") != 1:
            raise ValueError(
                f"a quantity needs a coefficient such as 'n_i: n_i*u_iz': {self.coefficient!r} came"
            )
        if not np.isfinite(self.factor) or self.factor == 0.0 or self.power not in (-1, 1):
            raise ValueError(
                "a quantity is factor * coef^power, the factor not zero and the power 1 or -1: "
                f"factor={self.factor!r}, power={self.power!r} came"
            )

    @property
    def state(self) -> str:
        return self.coefficient.split(":")[0].strip()

    @property
    def term(self) -> str:
        return self.coefficient.split(":")[1].strip()

    def of(self, coef: Float[np.ndarray, " coefs"]) -> Float[np.ndarray, " coefs"]:
        """Values of the quantity for an array of values of the coefficient."""
        return self.factor * coef**self.power

    def slope(self, coef: float) -> float:
        """Derivative of the quantity by the coefficient."""
        return self.factor * self.power * coef ** (self.power - 1)

    def place(self, constraint: Constraint, library: Library) -> int:
        """Index of its coefficient in the constraint. Raises ValueError if it is not there."""
        who = f"the quantity of {self.coefficient!r}"
        return place_of(library, constraint.coefficients, self.state, self.term, who)

    def unit(self, library: Library, units: Mapping[str, str]) -> str:
        """Unit of the quantity, from the units of the states and variables."""
        of_term = library.units(units)[library.index(self.term)]
        p = self.power
        return unit_product([(units[self.state], p), ("s", -p), (of_term, -p)])


@dataclass(frozen=True)
class QuantityEstimate:
    """A quantity with the ends of its 95 % interval."""

    value: float
    low: float
    high: float


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model of one operating point.

    The model's covariance is that of the draws, or of the refinement.
    status: fitted (by least squares), searched, or the status of a refinement. r2: for each state,
    of the derivative, on training rows. loss: of a refinement, else NaN. draws: for each quantity,
    (draws,), the bootstrap draws behind the intervals of least squares.
    """

    model: SparseModel
    status: str
    r2: Mapping[str, float]
    loss: float = float("nan")
    estimates: Mapping[str, QuantityEstimate] = field(default_factory=dict)
    draws: Mapping[str, Float[np.ndarray, " draws"]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PointResult:
    """Results at one operating point; without fits unless its status is "oscillating".

    f_Hz: dominant frequency of the first state. spread: for each state, standard deviation over
    mean. fits: by the name of the case, and of the case + "_refined". searched: the model that the
    search chose.
    """

    parameters: Mapping[str, float]
    status: str
    n_samples: int = 0
    dt_s: float = float("nan")
    f_Hz: float = float("nan")
    spread: Mapping[str, float] = field(default_factory=dict)
    fits: Mapping[str, Fitted] = field(default_factory=dict)
    searched: Fitted | None = None

    def usable(self, fit: str) -> bool:
        """True if this fit exists and finished."""
        return fit in self.fits and self.fits[fit].status in (FITTED, CONVERGED)


def estimates_of_draws(
    coef: Float[np.ndarray, " coefs"],
    draws: Float[np.ndarray, "draws coefs"],
    quantities: Mapping[str, Quantity],
    constraint: Constraint,
    library: Library,
) -> tuple[dict[str, QuantityEstimate], dict[str, Float[np.ndarray, " draws"]]]:
    """Estimates with intervals from percentiles of draws, and the draws of every quantity.

    The reciprocal of a coefficient has an infinite interval if the coefficient's interval holds
    zero.
    coef, draws: in the order of the constraint's coefficients.
    """
    estimates, drawn = {}, {}
    for name, quantity in quantities.items():
        k = quantity.place(constraint, library)
        drawn[name] = quantity.of(draws[:, k])
        ends = (50 * (1 - LEVEL), 50 * (1 + LEVEL))
        low, high = np.percentile(drawn[name], ends)
        if quantity.power < 0 and np.prod(np.sign(np.percentile(draws[:, k], ends))) <= 0:
            low, high = -np.inf, np.inf
        estimates[name] = QuantityEstimate(
            float(quantity.of(coef[k : k + 1])[0]), float(low), float(high)
        )
    return estimates, drawn


def estimates_of_covariance(
    model: SparseModel,
    quantities: Mapping[str, Quantity],
    constraint: Constraint,
    library: Library,
) -> dict[str, QuantityEstimate]:
    """Estimates with intervals from the model's covariance, linearised in the coefficient."""
    estimates = {}
    for name, quantity in quantities.items():
        state, term = constraint.coefficients[quantity.place(constraint, library)]
        coef = model.terms(state)[term]
        low, _ = model.intervals(state, level=LEVEL)[term]
        reach = abs(quantity.slope(coef)) * (coef - low)
        value = float(quantity.of(np.array([coef]))[0])
        estimates[name] = QuantityEstimate(value, value - reach, value + reach)
    return estimates
