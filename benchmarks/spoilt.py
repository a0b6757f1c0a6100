"""Records spoilt as sensors and machines spoil them: is a wrong model silent, a right one accused?

    python -m benchmarks.spoilt [--systems lorenz ...] [--kinds ...] [--n 5] [--noise 0.02]

Per kind and system: right; wrong without a word; wrong with a warning or "ambiguous" alone; right
and reported as a lack of fit. With `--words`, what was stated of the second, third and fourth.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from collections.abc import Callable, Mapping
from itertools import product

import numpy as np
from scipy.integrate import solve_ivp

import ep2sindy as ep
from benchmarks.known_systems import OTHERS, noisy
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.systems.draws import DRAWS
from ep2sindy.systems.systems import System

SYSTEMS = ("lorenz", "van_der_pol", "lotka_volterra", "rossler")
Spoil = Callable[[System, Trajectory, float, np.random.Generator], np.ndarray]


def _white(run: Trajectory, noise: float, rng: np.random.Generator) -> np.ndarray:
    """Noise of a fraction of every state's RMS."""
    rms = np.sqrt(np.square(run.states).mean(axis=0))
    return noise * rms * rng.standard_normal(run.states.shape)


def _drift(system: System, run: Trajectory, noise: float, rng: np.random.Generator) -> np.ndarray:
    """The first sensor's zero moves by half its signal's spread over the record."""
    ramp = np.linspace(0.0, 0.5, run.n_samples) * run.states[:, 0].std()
    states = run.states + _white(run, noise, rng)
    states[:, 0] += ramp
    return states


def _forced(system: System, run: Trajectory, noise: float, rng: np.random.Generator) -> np.ndarray:
    """What nobody recorded moves the first rate up and down by a fifth, some four times in all."""
    model, none = system.model, np.empty(0)
    omega = 2.0 * np.pi * 4.37 / run.t[-1]

    def rates(t: float, x: np.ndarray) -> np.ndarray:
        found = model.derivative(x, none)
        found[0] *= 1.0 + 0.2 * np.sin(omega * t)
        return found

    found = solve_ivp(
        rates, (run.t[0], run.t[-1]), run.states[0], "DOP853", run.t, rtol=1e-9, atol=1e-9
    )
    return found.y.T + _white(run, noise, rng)


def _late(n: int) -> Spoil:
    """The last channel comes n samples late."""

    def spoil(system: System, run: Trajectory, noise: float, rng: np.random.Generator):
        states = run.states + _white(run, noise, rng)
        states[n:, -1] = states[:-n, -1].copy()
        return states[n:]

    return spoil


def _clipped(fraction: float) -> Spoil:
    """The first channel saturates at a fraction of its largest deviation from the middle."""

    def spoil(system: System, run: Trajectory, noise: float, rng: np.random.Generator):
        states = run.states + _white(run, noise, rng)
        x = states[:, 0]
        middle, half = (x.max() + x.min()) / 2.0, fraction * (x.max() - x.min()) / 2.0
        states[:, 0] = np.clip(x, middle - half, middle + half)
        return states

    return spoil


def _rounded(bits: int) -> Spoil:
    """Every channel is rounded to so many bits of its range."""

    def spoil(system: System, run: Trajectory, noise: float, rng: np.random.Generator):
        states = run.states + _white(run, noise, rng)
        step = np.ptp(states, axis=0) / (2**bits - 1)
        low = states.min(axis=0)
        return low + np.round((states - low) / step) * step

    return spoil


def _outliers(system: System, run: Trajectory, noise: float, rng: np.random.Generator):
    """One sample in fifty is off by some RMS."""
    hit = rng.random(run.states.shape) < 0.02
    rms = np.sqrt(np.square(run.states).mean(axis=0))
    return run.states + _white(run, noise, rng) + hit * 2.0 * rms * rng.standard_normal(hit.shape)


def _multiplied(system: System, run: Trajectory, noise: float, rng: np.random.Generator):
    """Noise of a fraction of the state itself."""
    return run.states * (1.0 + 2.0 * noise * rng.standard_normal(run.states.shape))


def _lasting(system: System, run: Trajectory, noise: float, rng: np.random.Generator):
    """AR(1) noise of memory 0.95."""
    e = _white(run, 1.0, rng)
    for k in range(1, len(e)):
        e[k] = 0.95 * e[k - 1] + np.sqrt(1.0 - 0.95**2) * e[k]
    return run.states + 2.0 * noise * e


def _clean(system: System, run: Trajectory, noise: float, rng: np.random.Generator):
    return run.states + _white(run, noise, rng)


KINDS: Mapping[str, Spoil] = {
    "none": _clean,
    "drift": _drift,
    "forcing": _forced,
    "lag 1": _late(1),
    "lag 2": _late(2),
    "clip 90": _clipped(0.9),
    "clip 80": _clipped(0.8),
    "4 bits": _rounded(4),
    "6 bits": _rounded(6),
    "outliers": _outliers,
    "multiplicative": _multiplied,
    "AR 0.95": _lasting,
}


def spoilt(name: str, kind: str, number: int, noise: float) -> tuple[System, Trajectory]:
    """A draw of a system, spoilt."""
    system, clean = noisy(name, 0.0, number)
    rng = np.random.default_rng([number, *kind.encode(), *name.encode()])
    states = KINDS[kind](system, clean, noise, rng)
    t = clean.t[len(clean.t) - len(states) :]
    return system, Trajectory(t, states, clean.state_names, label=f"{name}, {kind}")


def main() -> None:
    every = [*DRAWS, *OTHERS]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--systems", nargs="+", default=list(SYSTEMS), choices=every)
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--n", type=int, default=5)
    parser.add_argument("--noise", type=float, default=0.02)
    parser.add_argument("--align", action="store_true", help="bring delayed channels together")
    parser.add_argument("--words", action="store_true", help="what was stated of doubtful ones")
    asked = parser.parse_args()
    method = ep.TrajectorySearch(align=asked.align)
    total: Counter[str] = Counter()
    for kind, name in product(asked.kinds, asked.systems):
        counts: Counter[str] = Counter()
        start = time.process_time()
        for number in range(asked.n):
            system, run = spoilt(name, kind, number, asked.noise)
            found = ep.discover(run, system.model.library, method)
            what = _what(system, found)
            counts[what] += 1
            if asked.words and what not in ("right", "wrong, a lack of fit"):
                print(f"  {number} {what}: {found.note[:160]} {list(found.data_warnings)}")
        total += counts
        cpu_s = (time.process_time() - start) / asked.n
        print(f"{kind:15} {name:16} {_line(counts)}  CPU-s {cpu_s:.2f}", flush=True)
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
