"""Where an autonomous model rests, and what becomes of a small perturbation from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import root

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.library.units import Clock
from ep2sindy.model.model import SparseModel

N_TRIED = 16  # samples of a record from which rest points are looked for
NEUTRAL = 1e-6  # growth per turn of a perturbation that neither grows nor decays

# Distance of two rest points, in standard deviations: Newton's method ends short of multiple roots.
APART = 1e-2

# What a cycle alone does not tell; a record has been near a rest point if some sample is as near,
# in standard deviations of every state.
UNDETERMINED, NEAR = "not determined by this record", 0.3

RESTING = 1e-8  # rates at a fixed point, relative to those half a standard deviation away


@dataclass(frozen=True, eq=False)
class RestPoint:
    """A fixed point of an autonomous model, in SI.

    growth_per_s: largest real part of the eigenvalues of the Jacobian there, in 1/s; positive if
    perturbations grow. frequency_Hz: with which that perturbation turns; zero if it does not.
    is_seen: whether some sample of a record is near.
    """

    state: Float[np.ndarray, " n_states"]
    growth_per_s: float
    frequency_Hz: float
    is_seen: bool = False

    def stays(self, length_s: float) -> bool:
        """Whether nothing moves next to it within so long, in one direction at least."""
        return not self.frequency_Hz and abs(self.growth_per_s) * length_s < NEUTRAL

    def text(self, model: SparseModel, clock: Clock) -> str:
        """Where it is; and what becomes of a perturbation, if the record has been near.

        A record that stays away from it, as a cycle does, does not determine that: models that
        have the same cycle differ in it by factors.
        """
        place = ", ".join(
            f"{state} = {value:.3g} {model.units[state]}".removesuffix(" 1")
            for state, value in zip(model.states, self.state.tolist(), strict=True)
        )
        if not self.is_seen:
            return f"{place}; growth near it is {UNDETERMINED}"
        kind, change = ("unstable", "grows") if self.growth_per_s > 0.0 else ("stable", "decays")
        rate = f" at {clock.seconds * abs(self.growth_per_s):.3g} {clock.rate_unit('1')}"
        if abs(self.growth_per_s) <= NEUTRAL * self.frequency_Hz or self.growth_per_s == 0.0:
            kind, change, rate = "neutral", "neither grows nor decays", ""
        turning = f" and oscillates at {clock.frequency_text(self.frequency_Hz)}"
        turns = turning if self.frequency_Hz else ""
        return f"{place}, {kind}: a perturbation {change}{rate}{turns}"


def rest_point(
    model: SparseModel,
    near: Float[np.ndarray, " n_states"],
    scale: Float[np.ndarray, " n_states"],
    positive: Bool[np.ndarray, " n_states"],
) -> RestPoint | None:
    """Fixed point of an autonomous model, by Newton's method from a nearby state; None if none.

    scale: of the states. positive: mask of the states that must be positive, such as densities.
    """
    scale = zero_to_one(scale)
    rates = model.derivative(near + 0.5 * np.diag(scale), np.empty((len(near), 0)))
    size = zero_to_one(np.abs(rates).max(axis=0))
    found = root(lambda y: model.derivative(y * scale, np.empty(0)) / size, near / scale)
    # What is this close to zero is zero but for rounding.
    state: np.ndarray = np.where(np.abs(found.x) < RESTING, 0.0, found.x) * scale
    if not np.abs(found.fun).max() < RESTING or (state[positive] <= 0.0).any():
        return None
    values = np.linalg.eigvals(model.field.jacobian(state))
    leading = values[int(values.real.argmax())]
    return RestPoint(state, float(leading.real), abs(float(leading.imag)) / (2.0 * np.pi))


def rest_points(
    model: SparseModel,
    states: Float[np.ndarray, "samples n_states"],
    std: Float[np.ndarray, " n_states"],
    densities: Sequence[int],
    length_s: float,
) -> tuple[RestPoint, ...]:
    """Rest points that Newton's method reaches from samples of a record and their mean.

    They lie within its range or one more on either side, for which alone the model was made. Of a
    line of rest points there is one. densities: numbers of the states that cannot be negative.
    length_s: of the record.
    """
    anywhere, width = np.zeros(len(std), dtype=np.bool_), np.ptp(states, axis=0)
    low, high = states.min(axis=0) - width, states.max(axis=0) + width
    low[list(densities)] = 0.0
    found: list[RestPoint] = []
    for near in (states.mean(axis=0), *states[:: max(1, len(states) // N_TRIED)]):
        point = rest_point(model, near, std, anywhere)
        if point is None or not ((low <= point.state) & (point.state <= high)).all():
            continue
        lines = [p for p in (point, *found) if p.stays(length_s)]
        if len(lines) == 2 and lines[0] is point:
            continue
        if all(np.abs((point.state - p.state) / std).max() > APART for p in found):
            is_seen = bool((np.abs(states - point.state) / std).max(axis=1).min() < NEAR)
            found.append(replace(point, is_seen=is_seen))
    return tuple(found)
