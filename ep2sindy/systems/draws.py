"""Random draws of known systems: those of the thesis's benchmark, and a collection of chaotic ones.

Source: the thesis, appendix, II-E and III-C; of the others, `systems.collection`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.systems.collection import collected, collected_names, is_installed
from ep2sindy.systems.systems import (
    System,
    damped_oscillator,
    lorenz,
    lotka_volterra,
    van_der_pol,
)

# Systems with a parameter or a start drawn at random. The thesis draws the Van der Pol oscillator's
# mu and starts it at (1, 1), as the system does. It does not state the starts of the other systems,
# so these ranges are our choice.
DRAWS: Mapping[str, Callable[[np.random.Generator], System]] = {
    "oscillator": lambda rng: replace(damped_oscillator(), initial=rng.uniform(-2.0, 2.0, 2)),
    "lotka_volterra": lambda rng: replace(lotka_volterra(), initial=rng.uniform(0.1, 1.5, 2)),
    "van_der_pol": lambda rng: van_der_pol(mu=rng.uniform(0.1, 10.0)),
    "lorenz": lambda rng: replace(
        lorenz(), initial=rng.uniform([-15.0, -15.0, 10.0], [15.0, 15.0, 40.0])
    ),
}


COLLECTION = "dysts"  # stands for all systems of the collection


def drawn(name: str, rng: np.random.Generator) -> System:
    """Draw a system by name; one of the collection starts anywhere on its attractor."""
    if name in DRAWS:
        return DRAWS[name](rng)
    system = collected(name)
    states = system.trajectory().states
    return replace(system, initial=states[rng.integers(len(states))])


def realization(
    name: str,
    noise: float,
    number: int,
    *,
    n_trajectories: int = 1,
    degree: int | None = None,
    seed: int = 0,
) -> tuple[System, list[Trajectory]]:
    """One draw of a system with noisy trajectories; the draw is the same for every noise level.

    noise: standard deviation of the white noise, in RMS of each state. n_trajectories: the first
    trajectory starts at the draw's own start; the others start at those of further draws, or in
    [-2, 2]^2 for the Van der Pol oscillator. degree: of the library; None takes the system's own.
    """
    check_systems([name])
    key = [list(DRAWS).index(name)] if name in DRAWS else list(name.encode())
    rng = np.random.default_rng([seed, *key, number])
    own = drawn(name, rng)
    starts = [own.initial]
    for _ in range(n_trajectories - 1):
        other = rng.uniform(-2.0, 2.0, 2) if name == "van_der_pol" else drawn(name, rng).initial
        starts.append(other)
    system = own if degree is None else with_degree(own, degree)
    return system, [
        own.trajectory(initial=start, noise=noise, rng=stream)
        for start, stream in zip(starts, rng.spawn(n_trajectories), strict=True)
    ]


def with_degree(system: System, degree: int) -> System:
    """The same model over the library of all products up to a degree.

    Raises ValueError if the model has a term of higher degree.
    """
    model = system.model
    least = int(model.library.degrees[(model.coef != 0.0).any(axis=1)].max())
    if degree < least:
        raise ValueError(
            f"the library must hold the terms of {system.name}, of degree {least} or more: "
            f"degree={degree} came; raise it, or leave that system out"
        )
    library = polynomial(model.states, degree=degree)
    coef = coef_matrix(library, [model.terms(state) for state in model.states])
    return replace(system, model=SparseModel(library, model.states, coef))


def system_names(asked: Sequence[str]) -> tuple[str, ...]:
    """The names asked for, with all names of the collection in place of `dysts`.

    Raises ValueError for a name that there is not, or if the collection is not installed.
    """
    every = [collected_names() if name == COLLECTION else (name,) for name in asked]
    names = tuple(dict.fromkeys(name for names in every for name in names))
    check_systems(names)
    return names


def check_systems(systems: Sequence[str]) -> None:
    others = [name for name in systems if name not in DRAWS]
    known = collected_names() if others and is_installed() else ()
    unknown = [name for name in others if name not in known]
    if unknown:
        raise ValueError(
            f"unknown systems {unknown}; there are {[*DRAWS]}, and with the package dysts the "
            f"names of its systems, such as Rossler, and {COLLECTION} for all of these"
        )
