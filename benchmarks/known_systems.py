"""Systems with known equations next to the thesis's four, and noise of several kinds on all.

Equations and parameters are the textbooks'; each is sampled over some twenty of its turns.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.systems.draws import DRAWS, realization
from ep2sindy.systems.systems import System

# Gaps: percent of the record, and how many gaps they are divided into.
GAPS = {f"gap{fraction}x{n}": (fraction, n) for fraction in (5, 10, 20, 30) for n in (1, 3)}
KINDS = (
    *("white", "lasting", "heavy", "proportional", "thinned300", "thinned100", "missing"),
    *GAPS,
)
MEMORY, FREEDOM, MISSING = 0.7, 3.0, 0.3  # of AR(1), of Student's t, of samples


@dataclass(frozen=True)
class Known:
    """Equations, the degree of the library that they are sought in, and how they are sampled."""

    equations: Mapping[str, Mapping[str, float]]
    degree: int
    initial: tuple[float, ...]
    duration_s: float
    rate_Hz: float

    def system(self, name: str) -> System:
        library = polynomial(list(self.equations), degree=self.degree)
        coef = coef_matrix(library, list(self.equations.values()))
        model = SparseModel(library, list(self.equations), coef)
        return System(name, model, np.array(self.initial), self.duration_s, self.rate_Hz)


def lorenz_96(n: int, forcing: float = 8.0) -> dict[str, dict[str, float]]:
    """x_i' = (x_{i+1} - x_{i-2}) x_{i-1} - x_i + F, on a ring."""

    def product(i: int, j: int) -> str:
        first, second = sorted((i % n, j % n))
        return f"x{first}*x{second}"

    return {
        f"x{i}": {
            product(i + 1, i - 1): 1.0,
            product(i - 2, i - 1): -1.0,
            f"x{i}": -1.0,
            "1": forcing,
        }
        for i in range(n)
    }


# Rossler 1976; Duffing without forcing; FitzHugh 1961; Lorenz 1984; Prigogine & Lefever 1968;
# Halvorsen; Chua with a cubic resistor; Lorenz 1996; Rossler 1979 with two growing directions.
OTHERS: Mapping[str, Known] = {
    "rossler": Known(
        {
            "x": {"y": -1.0, "z": -1.0},
            "y": {"x": 1.0, "y": 0.2},
            "z": {"1": 0.2, "x*z": 1.0, "z": -5.7},
        },
        2, (1.0, 1.0, 0.0), 100.0, 20.0,
    ),
    "duffing": Known(
        {"x": {"v": 1.0}, "v": {"x": 1.0, "x^3": -1.0, "v": -0.1}}, 3, (2.5, 0.0), 50.0, 20.0
    ),
    "fitzhugh_nagumo": Known(
        {
            "v": {"v": 1.0, "v^3": -1.0 / 3.0, "w": -1.0, "1": 0.5},
            "w": {"v": 0.08, "1": 0.056, "w": -0.064},
        },
        3, (-1.0, 1.0), 150.0, 10.0,
    ),
    "lorenz84": Known(
        {
            "x": {"y^2": -1.0, "z^2": -1.0, "x": -0.25, "1": 2.0},
            "y": {"x*y": 1.0, "x*z": -4.0, "y": -1.0, "1": 1.0},
            "z": {"x*y": 4.0, "x*z": 1.0, "z": -1.0},
        },
        2, (1.0, 1.0, 1.0), 40.0, 50.0,
    ),
    "brusselator": Known(
        {"x": {"1": 1.0, "x^2*y": 1.0, "x": -4.0}, "y": {"x": 3.0, "x^2*y": -1.0}},
        3, (1.0, 1.0), 50.0, 40.0,
    ),
    "halvorsen": Known(
        {
            "x": {"x": -1.4, "y": -4.0, "z": -4.0, "y^2": -1.0},
            "y": {"y": -1.4, "z": -4.0, "x": -4.0, "z^2": -1.0},
            "z": {"z": -1.4, "x": -4.0, "y": -4.0, "x^2": -1.0},
        },
        2, (-5.0, 0.0, 0.0), 20.0, 100.0,
    ),
    "chua_cubic": Known(
        {
            "x": {"y": 10.0, "x": 9.0 / 7.0, "x^3": -10.0 / 7.0},
            "y": {"x": 1.0, "y": -1.0, "z": 1.0},
            "z": {"y": -100.0 / 7.0},
        },
        3, (0.1, 0.1, 0.1), 30.0, 60.0,
    ),
    "lorenz96": Known(lorenz_96(5), 2, (8.0, 8.0, 8.01, 8.0, 8.0), 15.0, 100.0),
    "hyperrossler": Known(
        {
            "x": {"y": -1.0, "z": -1.0},
            "y": {"x": 1.0, "y": 0.25, "w": 1.0},
            "z": {"1": 3.0, "x*z": 1.0},
            "w": {"z": -0.5, "w": 0.05},
        },
        2, (-10.0, -6.0, 0.0, 10.0), 60.0, 50.0,
    ),
}  # fmt: skip


def noisy(name: str, noise: float, number: int, kind: str = "white") -> tuple[System, Trajectory]:
    """A realization of a system, with noise of a size (in RMS of each state) and a kind.

    The thesis's four vary as in `+exp=benchmark`; the others start within 30 % of their point.
    Raises ValueError for an unknown kind.
    """
    if kind not in KINDS:
        raise ValueError(f"unknown kind of noise {kind!r}; there are {list(KINDS)}")
    rng = np.random.default_rng([number, *name.encode()])
    if name in DRAWS:
        system, (clean,) = realization(name, 0.0, number)
    else:
        system = OTHERS[name].system(name)
        clean = _from_nearby(system, rng)
    rms = np.sqrt(np.square(clean.states).mean(axis=0))
    kept = _kept(kind, clean.n_samples, rng)
    t, states = clean.t[kept], clean.states[kept]
    return system, Trajectory(
        t,
        states + noise * rms * _unit_noise(kind, states / rms, rng),
        clean.state_names,
        label=name,
    )


def _from_nearby(system: System, rng: np.random.Generator) -> Trajectory:
    """From within 30 % of the system's own start; one that escapes is drawn again."""
    spread = 0.3 * (np.abs(system.initial) + 0.1)
    while True:
        start = system.initial + spread * rng.uniform(-1.0, 1.0, len(spread))
        with suppress(ValueError):
            return system.trajectory(initial=start)


def _kept(kind: str, n: int, rng: np.random.Generator) -> np.ndarray:
    if kind.startswith("thinned"):
        count = int(kind.removeprefix("thinned"))
        return np.unique(np.round(np.linspace(0, n - 1, count)).astype(int))
    if kind == "missing":
        return np.flatnonzero(rng.random(n) > MISSING)
    if kind in GAPS:
        fraction, n_gaps = GAPS[kind]
        length = round(fraction * n / (100 * n_gaps))
        starts = (np.arange(1, n_gaps + 1) * n // (n_gaps + 1)) - length // 2
        return np.setdiff1d(np.arange(n), starts[:, None] + np.arange(length))
    return np.arange(n)


def _unit_noise(kind: str, states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    if kind == "heavy":
        return rng.standard_t(FREEDOM, states.shape) / np.sqrt(FREEDOM / (FREEDOM - 2.0))
    noise = rng.standard_normal(states.shape)
    if kind == "proportional":
        return noise * states
    if kind == "lasting":
        for k in range(1, len(noise)):
            noise[k] = MEMORY * noise[k - 1] + np.sqrt(1.0 - MEMORY**2) * noise[k]
    return noise
