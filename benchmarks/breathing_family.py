"""A family of known systems at six operating points.

A breathing mode in its simplest form, n_i' = -l n_i + k n_i n_n, n_n' = g - k n_i n_n (the
thesis's Eq. 25, made dimensionless), whose coefficients follow the discharge voltage and the mass
flow by a known law. Records hold about one pulse, so that one point often does not suffice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.systems.systems import System

# The thesis's six operating points (Table IV): V and mg/s.
PARAMETERS: Mapping[str, Mapping[str, float]] = {
    f"{V_D}V_{mdot_mgs}mgs": {"V_D": float(V_D), "mdot_mgs": float(mdot_mgs)}
    for V_D, mdot_mgs in ((200, 5), (300, 2), (300, 4), (300, 5), (300, 6), (400, 5))
}

LAW = polynomial(["V_D", "mdot_mgs"], degree=1)

# State -> term -> coefficients of 1, V_D and mdot_mgs in the law.
TRUTH: Mapping[str, Mapping[str, Sequence[float]]] = {
    "n_i": {"n_i": (-0.4, -0.002, 0.0), "n_i*n_n": (1.0, 0.002, -0.05)},
    "n_n": {"1": (0.0, 0.0, 0.015), "n_i*n_n": (-1.0, -0.002, 0.05)},
}

LIBRARY = polynomial(list(TRUTH), degree=3)

DURATION_S, RATE_HZ = 15.0, 10.0  # small oscillations last 18 to 30 s

# Where records start, drawn evenly between: away from the steady state, which would show little.
INITIAL = ((0.1, 0.4), (0.5, 1.6))


def system_at(parameters: Mapping[str, float]) -> System:
    """The member of the family at one operating point."""
    law = LAW.evaluate(np.array([parameters[name] for name in LAW.variables]))
    equations = {
        state: {term: float(law @ coef) for term, coef in terms.items()}
        for state, terms in TRUTH.items()
    }
    coef = coef_matrix(LIBRARY, list(equations.values()))
    model = SparseModel(LIBRARY, list(equations), coef, provenance={"truth": "breathing family"})
    return System("breathing family", model, np.mean(INITIAL, axis=0), DURATION_S, RATE_HZ)


def realization(noise: float, number: int, *, seed: int = 0) -> dict[str, list[Trajectory]]:
    """One noisy record for each point, from a random start; noise levels share starts and pattern.

    noise: standard deviation of the white noise, in RMS of each state.
    """
    rng = np.random.default_rng([seed, number])
    starts = rng.uniform(*INITIAL, size=(len(PARAMETERS), len(TRUTH)))
    found = {}
    streams = rng.spawn(len(PARAMETERS))
    for (point, parameters), start, stream in zip(PARAMETERS.items(), starts, streams, strict=True):
        run = system_at(parameters).trajectory(initial=start, noise=noise, rng=stream)
        found[point] = [replace(run, parameters=parameters)]
    return found
