"""Records spoilt as sensors and machines spoil them: is a wrong model silent, a right one accused?

    python -m benchmarks.spoilt [--kinds ...] [--n 5] [--align]

Per kind and system: right; wrong without a word; wrong with a warning or "ambiguous" alone; right
and reported as a lack of fit.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from scipy.integrate import solve_ivp

import ep2sindy as ep
from benchmarks.known_systems import noisy
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.systems.systems import System

SYSTEMS, NOISE = ("lorenz", "van_der_pol", "lotka_volterra", "rossler"), 0.02


@dataclass(frozen=True)
class Draw:
    """A clean record of a system, and noise of a fraction of every state's RMS."""

    system: System
    run: Trajectory
    noise: float
    rng: np.random.Generator

    def white(self, noise: float) -> np.ndarray:
        rms = np.sqrt(np.square(self.run.states).mean(axis=0))
        return noise * rms * self.rng.standard_normal(self.run.states.shape)

    def noisy(self) -> np.ndarray:
        return self.run.states + self.white(self.noise)


def _drift(draw: Draw) -> np.ndarray:
    """The first sensor's zero moves by half its signal's spread over the record."""
    states = draw.noisy()
    states[:, 0] += np.linspace(0.0, 0.5, len(states)) * draw.run.states[:, 0].std()
    return states


def _forced(draw: Draw) -> np.ndarray:
    """What nobody recorded moves the first rate up and down by a fifth, some four times in all."""
    t, start, none = draw.run.t, draw.run.states[0], np.empty(0)
    omega = 2.0 * np.pi * 4.37 / t[-1]

    def rates(now: float, x: np.ndarray) -> np.ndarray:
        found = draw.system.model.derivative(x, none)
        found[0] *= 1.0 + 0.2 * np.sin(omega * now)
        return found

    found = solve_ivp(rates, (t[0], t[-1]), start, "DOP853", t, rtol=1e-9, atol=1e-9)
    return found.y.T + draw.white(draw.noise)


def _late(draw: Draw, *, n: int) -> np.ndarray:
    """The last channel comes n samples late."""
    states = draw.noisy()
    states[n:, -1] = states[:-n, -1].copy()
    return states[n:]


def _clipped(draw: Draw, *, fraction: float) -> np.ndarray:
    """The first channel saturates at a fraction of its largest deviation from the middle."""
    states = draw.noisy()
    x = states[:, 0]
    middle, half = (x.max() + x.min()) / 2.0, fraction * (x.max() - x.min()) / 2.0
    states[:, 0] = np.clip(x, middle - half, middle + half)
    return states


def _rounded(draw: Draw, *, bits: int) -> np.ndarray:
    """Every channel is rounded to so many bits of its range."""
    states = draw.noisy()
    step, low = np.ptp(states, axis=0) / (2**bits - 1), states.min(axis=0)
    return low + np.round((states - low) / step) * step


def _outliers(draw: Draw) -> np.ndarray:
    """One sample in fifty is off by some RMS."""
    hit = draw.rng.random(draw.run.states.shape) < 0.02
    return draw.noisy() + hit * draw.white(2.0)


def _multiplied(draw: Draw) -> np.ndarray:
    """Noise of a fraction of the state itself."""
    states = draw.run.states
    return states * (1.0 + 2.0 * draw.noise * draw.rng.standard_normal(states.shape))


def _lasting(draw: Draw) -> np.ndarray:
    """AR(1) noise of memory 0.95."""
    e = draw.white(1.0)
    for k in range(1, len(e)):
        e[k] = 0.95 * e[k - 1] + np.sqrt(1.0 - 0.95**2) * e[k]
    return draw.run.states + 2.0 * draw.noise * e


KINDS: Mapping[str, Callable[[Draw], np.ndarray]] = {
    "none": Draw.noisy,
    "drift": _drift,
    "forcing": _forced,
    "lag 1": partial(_late, n=1),
    "lag 2": partial(_late, n=2),
    "clip 90": partial(_clipped, fraction=0.9),
    "clip 80": partial(_clipped, fraction=0.8),
    "4 bits": partial(_rounded, bits=4),
    "outliers": _outliers,
    "multiplicative": _multiplied,
    "AR 0.95": _lasting,
}


def spoilt(name: str, kind: str, number: int, noise: float) -> tuple[System, Trajectory]:
    """A draw of a system, spoilt."""
    system, clean = noisy(name, 0.0, number)
    rng = np.random.default_rng([number, *kind.encode(), *name.encode()])
    states = KINDS[kind](Draw(system, clean, noise, rng))
    t = clean.t[len(clean.t) - len(states) :]
    return system, Trajectory(t, states, clean.state_names, label=f"{name}, {kind}")


def main() -> None:
    parser = argparse.ArgumentParser(description="records spoilt on purpose")
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--n", type=int, default=5)
    parser.add_argument("--align", action="store_true", help="bring delayed channels together")
    asked = parser.parse_args()
    method = ep.TrajectorySearch(align=asked.align)
    total: Counter[str] = Counter()
    for kind, name in product(asked.kinds, SYSTEMS):
        counts: Counter[str] = Counter()
        for number in range(asked.n):
            system, run = spoilt(name, kind, number, NOISE)
            found = ep.discover(run, system.model.library, method)
            counts[_what(system, found)] += 1
        total += counts
        print(f"{kind:15} {name:16} {_line(counts)}", flush=True)
    print(f"{'all':32} {_line(total)}")


def _what(system: System, found: ep.Discovery) -> str:
    right = bool(((found.model.coef != 0.0) == (system.model.coef != 0.0)).all())
    if right:
        return "right, a lack of fit" if found.lack_of_fit else "right"
    if found.lack_of_fit:
        return "wrong, a lack of fit"
    doubted = found.data_warnings or found.note.startswith("ambiguous")
    return "wrong, a doubt" if doubted else "wrong, silent"


WHAT = ("right", "right, a lack of fit", "wrong, a lack of fit", "wrong, a doubt", "wrong, silent")


def _line(counts: Counter[str]) -> str:
    return "  ".join(f"{what}: {counts[what]}" for what in WHAT)


if __name__ == "__main__":
    main()
