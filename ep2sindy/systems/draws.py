"""Random draws of known systems, as in the benchmark of the thesis.

Source: the thesis, appendix, II-E and III-C.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.systems.systems import (
    System,
    damped_oscillator,
    lorenz,
    lotka_volterra,
    van_der_pol,
)


@dataclass(frozen=True)
class Draw:
    """A system with a parameter or a starting point drawn at random."""

    system: System
    initial: np.ndarray


def _oscillator(rng: np.random.Generator) -> Draw:
    return Draw(damped_oscillator(), rng.uniform(-2.0, 2.0, 2))


def _lotka_volterra(rng: np.random.Generator) -> Draw:
    return Draw(lotka_volterra(), rng.uniform(0.1, 1.5, 2))


def _van_der_pol(rng: np.random.Generator) -> Draw:
    return Draw(van_der_pol(mu=rng.uniform(0.1, 10.0)), np.ones(2))


def _lorenz(rng: np.random.Generator) -> Draw:
    return Draw(lorenz(), rng.uniform([-15.0, -15.0, 10.0], [15.0, 15.0, 40.0]))


# The thesis draws the Van der Pol oscillator's mu and starts it at (1, 1). It does not state the
# starts of the other systems, so these ranges are our choice.
DRAWS: Mapping[str, Callable[[np.random.Generator], Draw]] = {
    "oscillator": _oscillator,
    "lotka_volterra": _lotka_volterra,
    "van_der_pol": _van_der_pol,
    "lorenz": _lorenz,
}


def realization(
    name: str, noise: float, number: int, *, n_trajectories: int = 1, seed: int = 0
) -> tuple[System, list[Trajectory]]:
    """One draw of a system with noisy trajectories; the draw is the same for every noise level.

    noise: standard deviation of the white noise, in RMS of each state. n_trajectories: the first
    trajectory starts at the draw's own start; the others start at those of further draws, or in
    [-2, 2]^2 for the Van der Pol oscillator.
    """
    check_systems([name])
    rng = np.random.default_rng([seed, list(DRAWS).index(name), number])
    draw = DRAWS[name](rng)
    starts = [draw.initial]
    for _ in range(n_trajectories - 1):
        other = rng.uniform(-2.0, 2.0, 2) if name == "van_der_pol" else DRAWS[name](rng).initial
        starts.append(other)
    return draw.system, [
        draw.system.trajectory(initial=start, noise=noise, rng=stream)
        for start, stream in zip(starts, rng.spawn(n_trajectories), strict=True)
    ]


def check_systems(systems: Sequence[str]) -> None:
    unknown = [name for name in systems if name not in DRAWS]
    if unknown:
        raise ValueError(f"unknown systems {unknown}; there are {list(DRAWS)}")
