"""Models selected by free run on the package's own source: `python -m benchmarks.living`.

Over draws of windows and splits of the record, over operating points, zones of the channel and
seeds, in noise; every model called living is run again by another solver, ten times as long.
Prints the tables of docs/living.md; name some of them to print those alone.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

import ep2sindy as ep
from ep2sindy.studies.living import start_of

POINTS = {point.label: point for point in ep.thruster.OPERATING_POINTS}
BREATHING = "300V_5mgs"
ZONES_MM = ((0, 10), (5, 15), (10, 20), (15, 25), (20, 30))
DOWNSTREAM_MM = (15, 25)
SPLITS = {"last": (0.0, 0.75), "first": (0.25, 1.0), "second half": (0.0, 0.5)}  # what is fitted
N_DRAWS, N_SEEDS = 8, 3
NOISES = ((0.2, 6.0), (0.4, 50.0))  # share of each state's RMS, periods
N_NOISE_DRAWS = 5
LONGER = 10.0  # times the held-out part, for the other solver


@dataclass(frozen=True)
class Case:
    """One selection: the model on held-out time, what it cost, and what another solver says."""

    run: ep.FreeRun
    n_terms: int
    multiplier: float
    cpu_s: float
    confirmed: bool

    @property
    def structure(self) -> str:
        """Terms of every equation."""
        model = self.run.model
        return "; ".join(f"{state}': {', '.join(model.terms(state))}" for state in model.states)

    @property
    def amplitude(self) -> float:
        """Of the state that is farthest off, less one."""
        ratios = np.array(list(self.run.amplitude_ratio.values()))
        return float(np.abs(ratios - 1.0).max())

    @property
    def waveform(self) -> float:
        return max(self.run.waveform_error.values())


@cache
def record(label: str, zone_mm: tuple[int, int]) -> ep.Trajectory:
    """Zone averages of the default simulation."""
    field = ep.thruster.simulate(
        ep.thruster.Thruster(), POINTS[label], cache=Path(".cache/simulations"), progress=False
    )
    zone = ep.Zone(z=(1e-3 * zone_mm[0], 1e-3 * zone_mm[1]))
    return ep.zone_average(field, zone, states=["n_i", "n_n"], label=label)


def selected(fitted: ep.Trajectory, *, seed: int, weak: bool = False) -> ep.Discovery:
    """By free runs, from the library of degree 2, up to 4 + 4 terms."""
    method = ep.Regression(
        ep.WeightedWeak() if weak else ep.Differential(),
        ep.BestSubset(max_terms=4, n_best=2),
        ep.FreeRunScore(seed=seed),
        ep.Bootstraps(n=0),
        depth=2,
    )
    library = ep.polynomial(["n_i", "n_n"], degree=2)
    return ep.discover([fitted], library, method, seed=seed)


def case(fitted: ep.Trajectory, judged: ep.Trajectory, *, seed: int, weak: bool = False) -> Case:
    """Select on one record, run freely over another from its first sample."""
    begun = time.process_time()
    model = selected(fitted, seed=seed, weak=weak).model
    cpu_s = time.process_time() - begun
    run = ep.free_run(model, judged, initial=start_of(judged, model))
    multiplier = float("nan")
    if run.verdict is ep.Verdict.LIVES:
        period_s = 1.0 / max(run.frequency_Hz.values())
        cycle = ep.limit_cycle(model, run.rollout.states[-1], period_s=period_s)
        if cycle is not None:
            multiplier = float(np.abs(cycle.multipliers[1]))
    confirmed = run.verdict is not ep.Verdict.LIVES or lives_on(model, judged)
    return Case(run, int(np.count_nonzero(model.coef)), multiplier, cpu_s, confirmed)


def lives_on(model: ep.SparseModel, run: ep.Trajectory) -> bool:
    """Whether LSODA with tight tolerances keeps the amplitudes, ten times as long, to 20 %."""
    std, start = run.states.std(axis=0), start_of(run, model)
    length_s = LONGER * float(run.t[-1] - run.t[0])
    t = np.linspace(0.9 * length_s, length_s, 4000)

    def slope(_: float, y: np.ndarray) -> np.ndarray:
        return model.predict(y * std) / std

    path = solve_ivp(
        slope, (0.0, length_s), start / std, method="LSODA", t_eval=t, rtol=1e-9, atol=1e-10
    )
    if not path.success or path.y.shape[1] < len(t):
        return False
    return bool((np.abs(path.y.std(axis=1) - 1.0) < 0.2).all())


def parts(run: ep.Trajectory, split: str) -> tuple[ep.Trajectory, ep.Trajectory]:
    """What is fitted, and the rest."""
    first, last = (round(share * run.n_samples) for share in SPLITS[split])
    held = (last, run.n_samples) if first == 0 else (0, first)
    return run.window(first, last), run.window(*held)


def line(name: str, cases: Sequence[Case]) -> str:
    """How many live, and the median and the worst of each figure of those that have it."""
    living = [each for each in cases if each.run.verdict is ep.Verdict.LIVES]
    wrong = sum(not each.confirmed for each in cases)
    if not living:
        return f"{name:24s} 0 of {len(cases)} live: {[c.run.text for c in cases][:3]}"
    figures = (
        (100.0 * abs(c.run.f_error), 100.0 * c.amplitude, c.waveform, c.n_terms, c.multiplier)
        for c in living
    )
    f, amplitude, waveform, n_terms, multiplier = (
        f"{np.median(v):.3g} / {np.max(v):.3g}" for v in zip(*figures, strict=True)
    )
    cpu_s = np.median([c.cpu_s for c in cases])
    found = Counter(each.structure for each in living) if len(cases) <= N_DRAWS else {}
    return (
        f"{name:24s} {len(living)} of {len(cases)} live ({wrong} refuted); f {f} %; "
        f"amplitude {amplitude} %; waveform {waveform}; terms {n_terms}; multiplier {multiplier}; "
        f"{cpu_s:.1f} CPU-s"
    ) + "".join(f"\n    {n} x {terms}" for terms, n in found.items())


def print_draws() -> None:
    """The breathing job: draws of windows and splits."""
    print("300 V, 5 mg/s, by what is held out: median / worst of the draws of windows")
    run = record(BREATHING, DOWNSTREAM_MM)
    for split in SPLITS:
        fitted, held = parts(run, split)
        cases = [case(fitted, held, seed=seed) for seed in range(N_DRAWS)]
        print(line(split, cases), flush=True)


def print_points() -> None:
    """Six operating points, the downstream zone."""
    print("\nthe downstream zone, the last quarter held out: median / worst of three seeds")
    for label in POINTS:
        fitted, held = parts(record(label, DOWNSTREAM_MM), "last")
        print(line(label, [case(fitted, held, seed=s) for s in range(N_SEEDS)]), flush=True)


def print_zones() -> None:
    """Six operating points, five zones, three seeds."""
    print("\nsix points, by zone: median / worst of the points and three seeds")
    for zone_mm in ZONES_MM:
        cases = []
        for label in POINTS:
            fitted, held = parts(record(label, zone_mm), "last")
            cases += [case(fitted, held, seed=seed) for seed in range(N_SEEDS)]
        lost = [
            f"{label} {each.run.text}"
            for label, each in zip(np.repeat(list(POINTS), N_SEEDS), cases, strict=True)
            if each.run.verdict is not ep.Verdict.LIVES
        ]
        print(line(f"{zone_mm[0]} to {zone_mm[1]} mm", cases), lost or "", flush=True)


def noisy(run: ep.Trajectory, share: float, n_periods: float, *, seed: int) -> ep.Trajectory:
    """The first periods of a record with white noise, a share of each state's RMS."""
    cycle = ep.signals.find_cycle(run.t, run.states)
    assert cycle is not None
    n = round(n_periods / (cycle.frequency_Hz * run.dt_s)) + 1
    rms = np.sqrt(np.square(run.states).mean(axis=0))
    noise = np.random.default_rng(seed).normal(size=(n, run.states.shape[1])) * share * rms
    return ep.Trajectory(
        t=run.t[:n], states=run.states[:n] + noise, state_names=run.state_names,
        units=run.units, label=run.label,
    )  # fmt: skip


def print_noise() -> None:
    """White noise on both densities; judged on the clean record behind it."""
    for share, n_periods in NOISES:
        print(f"\n{100 * share:.0f} % noise, {n_periods:.0f} periods: five draws; noise of n_n")
        for label in POINTS:
            run = record(label, DOWNSTREAM_MM)
            clean = run.window(round(0.75 * run.n_samples), run.n_samples)
            cases = [
                case(noisy(run, share, n_periods, seed=seed), clean, seed=seed, weak=True)
                for seed in range(N_NOISE_DRAWS)
            ]
            spread = share * np.sqrt(np.square(run.states).mean(axis=0)) / run.states.std(axis=0)
            print(line(f"{label}, {spread[1]:.1f} std", cases), flush=True)


def main() -> None:
    """Print every table, or those that are named: draws, points, zones, noise."""
    tables: dict[str, Callable[[], None]] = {
        "draws": print_draws, "points": print_points, "zones": print_zones, "noise": print_noise,
    }  # fmt: skip
    for name in sys.argv[1:] or tables:
        begun = time.process_time()
        tables[name]()
        print(f"({time.process_time() - begun:.0f} CPU-s)")


if __name__ == "__main__":
    main()
