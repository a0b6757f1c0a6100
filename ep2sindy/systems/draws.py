"""Random draws of the known systems of the thesis's benchmark.

Source: the thesis, appendix, II-E and III-C.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.systems.systems import System, damped_oscillator, lorenz, lotka_volterra, van_der_pol

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


def realization(
    system: str | System,
    noise: float = 0.0,
    number: int = 0,
    *,
    rate_Hz: float | None = None,
    duration_s: float | None = None,
    n_trajectories: int = 1,
    degree: int | None = None,
    seed: int = 0,
) -> tuple[System, list[Trajectory]]:
    """One draw of a system with noisy trajectories; the draw is the same for every noise level.

    system: a name in `DRAWS`, or a system, of which the noise alone is drawn. noise: standard
    deviation of the white noise, in RMS of each state. rate_Hz, duration_s: sampling; None takes
    the system's own. n_trajectories: the first trajectory starts at the draw's own start; the
    others start at those of further draws, or in [-2, 2]^2 for the Van der Pol oscillator. degree:
    of the library; None takes the system's own.
    """
    if isinstance(system, System):
        rng, starts = np.random.default_rng([seed, number]), [system.initial] * n_trajectories
        streams = [rng, *rng.spawn(n_trajectories - 1)]
    else:
        check_systems([system])
        rng, name = np.random.default_rng([seed, list(DRAWS).index(system), number]), system
        system = DRAWS[name](rng)
        starts = [system.initial]
        for _ in range(n_trajectories - 1):
            other = rng.uniform(-2.0, 2.0, 2) if name == "van_der_pol" else DRAWS[name](rng).initial
            starts.append(other)
        streams = rng.spawn(n_trajectories)
    rate_Hz, duration_s = rate_Hz or system.rate_Hz, duration_s or system.duration_s
    system = replace(system, rate_Hz=rate_Hz, duration_s=duration_s)
    return noisy_records(system, starts, streams, noise, degree=degree)


def noisy_records(
    system: System,
    starts: Sequence[Float[np.ndarray, " n_states"]],
    streams: Sequence[np.random.Generator],
    noise: float,
    *,
    degree: int | None,
) -> tuple[System, list[Trajectory]]:
    """A system with its noisy trajectories, each from a start and with a stream for its noise.

    degree: of the library; None takes the system's own.
    """
    return system if degree is None else with_degree(system, degree), [
        system.trajectory(initial=start, noise=noise, rng=stream)
        for start, stream in zip(starts, streams, strict=True)
    ]


def with_degree(system: System, degree: int) -> System:
    """The same model over the library of all products up to a degree.

    Raises ValueError if the model has a term of higher degree.
    """
    model = system.model
    least = int(model.library.degrees[(model.coef != 0.0).any(axis=1)].max())
    if degree < least:
        raise ValueError(
            f"the library must hold the terms of {system.name}, of degree {least} or more, got "
            f"degree={degree}; raise it, or leave that system out"
        )
    library = polynomial(model.states, degree=degree)
    coef = coef_matrix(library, [model.terms(state) for state in model.states])
    return replace(system, model=SparseModel(library, model.states, coef))


def check_systems(names: Sequence[str]) -> None:
    """Raise ValueError for a name that there is not."""
    unknown = [name for name in names if name not in DRAWS]
    if unknown:
        raise ValueError(f"unknown systems {unknown}; there are {[*DRAWS]}")
