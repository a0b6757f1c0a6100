"""Points whose record is quiet: which they are, and laws that rest there as the record does."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.model.fixed_point import NEAR, RESTING
from ep2sindy.operating.law import LawConstraint
from ep2sindy.operating.map import NEUTRAL
from ep2sindy.operating.records import Point, values_at
from ep2sindy.regression.pooled import Basis, Rows, pool_rows, pool_within
from ep2sindy.runtime.values import Samples, check_positive, read_only
from ep2sindy.signals.attractor import find_cycle, noise_std
from ep2sindy.signals.spectrum import (
    ByState,
    Oscillation,
    States,
    dominant_frequency,
    oscillation,
)

# A record is small if every state varies, without white noise, by less than this fraction of what
# it varies by at the point where it does so most.
SMALL = 0.1

N_NEWTON = 20  # steps towards the rest point of a law
CANCELLED = 1e-9  # a slope this small by its addends is rounding: the structure fixes the growth


@dataclass(frozen=True, eq=False)
class QuietPoint:
    """An operating point at which a record rests, as steady, decaying and silent ones do.

    rest: mean of the states over the second half of the record. scale: standard deviation of each
    state where it varies most, and period_s: the dominant period there; what is near the rest and
    what is slow is measured by them.
    """

    parameters: Point
    rest: ByState
    scale: ByState
    period_s: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "rest", read_only(self.rest))
        object.__setattr__(self, "scale", read_only(self.scale))
        check_positive("period_s", self.period_s)
        if self.rest.shape != self.scale.shape or not np.isfinite(self.rest).all():
            raise ValueError(
                "a quiet point needs a finite rest and a scale of every state, got "
                f"{self.rest.tolist()} and {self.scale.tolist()}"
            )


def quiet_points(points: Iterable[Sequence[Trajectory]], states: Sequence[str]) -> list[QuietPoint]:
    """The points at which some record rests, from the runs of every point.

    A record is quiet if `oscillation` finds it decaying, or steady and small (SMALL), or if it is
    noise around a mean: small, or varying less than its white noise does, and without a waveform
    that it repeats. A damped mode that noise drives belongs here, as its amplitude wanders, which
    that of a cycle does not, however small; it is told from a cycle by records that are longer than
    its memory. A point at which one run rests and another oscillates is quiet, too: with hysteresis
    a law has both. Returns no point if no record has a dominant frequency.
    """
    runs = [[(run, run.columns(states)) for run in own] for own in points]
    every = [each for own in runs for each in own]
    spreads = np.array([_spread(run.t, values)[0] for run, values in every])
    scale = zero_to_one(spreads.max(axis=0))
    loudest, values = every[int((spreads / scale).sum(axis=1).argmax())]
    leader = int((values.std(axis=0) / scale).argmax())
    frequency_Hz = dominant_frequency(loudest.t, values[:, leader])
    found = []
    for own in runs:
        rests = [x[len(x) // 2 :].mean(axis=0) for run, x in own if _is_quiet(run.t, x, scale)]
        if rests and frequency_Hz:
            rest = np.mean(rests, axis=0)
            found.append(QuietPoint(own[0][0].parameters, rest, scale, 1.0 / frequency_Hz))
    return found


def _spread(t: Samples, states: States) -> tuple[ByState, ByState]:
    """Standard deviation of each state without its white noise, and of this noise."""
    noise = np.array([noise_std(t, x) for x in states.T])
    return np.sqrt(np.maximum(states.var(axis=0) - noise**2, 0.0)), noise


def _is_quiet(t: Samples, states: States, scale: ByState) -> bool:
    status, half = oscillation(t, states), len(t) // 2
    spread, noise = _spread(t[half:], states[half:])
    small = spread < SMALL * scale
    if status is Oscillation.DECAYING or (status is Oscillation.STEADY and small.all()):
        return True
    cycle = find_cycle(t, states)
    return bool((small | (spread < noise)).all() and (cycle is None or not cycle.repeats))


def pool_quiet(
    rows: Rows,
    basis: Basis,
    size: Float[np.ndarray, " free"],
    *,
    functions: Library,
    relations: LawConstraint,
    library: Library,
    quiet: Sequence[QuietPoint],
) -> Float[np.ndarray, "free functions"]:
    """Fit a law to the rows of all points that rests at the quiet ones, see `pool_within`.

    At each of these the law must have a rest point near the record's: the rates at the record's
    are at most NEAR of those of an oscillation that has the point's scale and period. And it must
    be stable: perturbations decay e-fold within 1 / NEUTRAL periods, where the Jacobian is that of
    the law's own rest point, found by Newton's method, or at the record's if the law has none
    within a scale of it. A law that does so already is that of `pool_rows`, to the last digit.
    functions: of the law, those of the basis. quiet: with states in the order of the relations'.
    Raises ValueError for terms of inputs: what rests depends on theirs.
    """
    if not (quiet and len(size)):
        return pool_rows(rows, basis, size)
    if inputs := [v for v in library.variables if v not in relations.common.states]:
        raise ValueError(
            f"a law that rests at quiet points must have terms of its states alone, got {inputs} "
            "as well; fit it without quiet points"
        )
    models = [RestingModel.of(point, functions, relations, library) for point in quiet]

    def limits(law: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        pairs = [(model, *model.limits(law @ model.functions)) for model in models]
        values = np.concatenate([own for _, own, _ in pairs])
        slopes = [np.kron(by_free, model.functions) for model, _, by_free in pairs]
        return values, np.concatenate(slopes)

    return pool_within(rows, basis, size, limits)


@dataclass(frozen=True, eq=False)
class RestingModel:
    """What the law's model does at a quiet point, by its free coefficients there.

    States are counted from the record's rest in scales, and time in periods.
    library: over the states. terms, equations: (coefs,), term and state of each coefficient.
    C, d: of coef = C z + d. functions: of the law, at the point.
    """

    point: QuietPoint
    library: Library
    terms: Int[np.ndarray, " coefs"]
    equations: Int[np.ndarray, " coefs"]
    C: Float[np.ndarray, "coefs free"]
    d: Float[np.ndarray, " coefs"]
    functions: Float[np.ndarray, " functions"]

    @staticmethod
    def of(
        point: QuietPoint, functions: Library, relations: LawConstraint, library: Library
    ) -> RestingModel:
        common, at = relations.common, [point.parameters]
        (held,) = relations.at(values_at(at, relations.functions.variables))
        index = [library.index(term) for _, term in common.coefficients]
        used, terms = np.unique(index, return_inverse=True)
        return RestingModel(
            point=point,
            library=library.take(used).over(common.states),
            terms=terms,
            equations=np.array([common.states.index(state) for state, _ in common.coefficients]),
            C=common.C,
            d=held.d,
            functions=functions.evaluate(values_at(at, functions.variables))[0],
        )

    def limits(
        self, free: Float[np.ndarray, " free"]
    ) -> tuple[Float[np.ndarray, " limits"], Float[np.ndarray, "limits free"]]:
        """Limits on the rates at the record's rest, and on growth at the law's; with slopes."""
        coef, n = self.C @ free + self.d, len(self.point.rest)
        slopes = self._equation * self._terms(np.zeros(n))[0, 0] / (2.0 * np.pi)
        growth, growth_slopes = self._growth(coef)
        values = np.concatenate([slopes @ coef - NEAR, -slopes @ coef - NEAR, growth + NEUTRAL])
        return values, np.concatenate([slopes, -slopes, growth_slopes]) @ self.C

    @cached_property
    def _equation(self) -> Float[np.ndarray, "n_states coefs"]:
        """One where a coefficient is of a state's equation, else zero."""
        return np.eye(len(self.point.rest))[:, self.equations]

    @cached_property
    def _derivatives(self) -> tuple[Library, Float[np.ndarray, "columns columns coefs products"]]:
        """Products of the states, and their weights in the terms' derivatives up to the second."""
        n = len(self.point.rest)
        products, once = self.library.with_derivatives(n)
        products, again = products.with_derivatives(n)
        units = np.append(1.0, self.point.scale)
        weights = np.einsum("kap,pbq,a,b->abkq", once[self.terms], again, units, units)
        return products, weights * (self.point.period_s / self.point.scale[self.equations])[:, None]

    def _terms(
        self, y: Float[np.ndarray, " n_states"]
    ) -> Float[np.ndarray, "columns columns coefs"]:
        """The term of every coefficient at a state, with first and second derivatives.

        Columns: the term itself, then its derivative by each state; [1 + v, 1 + s] is by both.
        """
        products, weights = self._derivatives
        found: np.ndarray = weights @ products.evaluate(self.point.rest + y * self.point.scale)
        return found

    def _rest(self, coef: Float[np.ndarray, " coefs"]) -> Float[np.ndarray, " n_states"] | None:
        """The law's rest point; None if there is none within a scale of the record's."""
        y, weighted = np.zeros(len(self.point.rest)), self._equation * coef
        for _ in range(N_NEWTON):
            terms = self._terms(y)
            rates, jacobian = weighted @ terms[0, 0], weighted @ terms[1:, 0].T
            if not np.isfinite(jacobian).all():  # outside the domain of a function
                return None
            y = y - np.linalg.pinv(jacobian) @ rates
            if not np.abs(y).max() < 1.0:
                return None
            if np.abs(rates).max() < RESTING:
                return y
        return None

    def _growth(
        self, coef: Float[np.ndarray, " coefs"]
    ) -> tuple[Float[np.ndarray, " modes"], Float[np.ndarray, "modes coefs"]]:
        """Growth per period of every perturbation of the rest, and its slopes by coefficients."""
        rest, weighted = self._rest(coef), self._equation * coef
        terms = self._terms(np.zeros(len(weighted)) if rest is None else rest)
        jacobian = weighted @ terms[1:, 0].T
        values, right = np.linalg.eig(jacobian)
        left = np.linalg.pinv(right)
        # A coefficient changes the Jacobian by its term, and by moving the rest point.
        change = np.einsum("ik,vk->kiv", self._equation, terms[1:, 0])
        if rest is not None:
            moved = -np.linalg.pinv(jacobian) @ (self._equation * terms[0, 0])
            bent = np.einsum("ik,vsk->ivs", weighted, terms[1:, 1:])
            change = change + np.einsum("ivs,sk->kiv", bent, moved)
        slopes = np.einsum("mi,kiv,vm->mk", left, change, right).real
        sizes = np.einsum("mi,kiv,vm->mk", np.abs(left), np.abs(change), np.abs(right))
        slopes[np.abs(slopes) <= CANCELLED * sizes] = 0.0
        own = values.imag >= 0.0  # one of each conjugate pair
        return values.real[own], slopes[own]
