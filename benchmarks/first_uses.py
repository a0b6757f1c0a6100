"""First uses: a default library of degree 2, and the command that the result then names.

python -m benchmarks.first_uses brusselator   # 18 draws: no sensor called late, law found after
python -m benchmarks.first_uses oregonator    # 34 cycles of a stiff reaction: never x' = 0
python -m benchmarks.first_uses populations   # counts of animals: a law, or what is lacking
"""

from __future__ import annotations

import argparse
import re
import time
from itertools import product

import numpy as np
from scipy.integrate import solve_ivp

import ep2sindy as ep

RATES = ((1.0, 3.0), (1.2, 3.5), (0.5, 1.6))  # a and b of the Brusselator
STEPS_S, SEEDS = (0.1, 0.35, 0.5), (0, 1)
LAW = [{"1", "x", "x^2*y"}, {"x", "x^2*y"}]
N_CYCLES, PER_CYCLE = 34, 16


def brusselator(a: float, b: float, step_s: float, seed: int) -> ep.Trajectory:
    """60 s on the cycle of x' = a - (b + 1) x + x^2 y, y' = b x - x^2 y, with 2 % noise."""

    def rates(t: float, x: np.ndarray) -> list[float]:
        return [a - (b + 1.0) * x[0] + x[0] ** 2 * x[1], b * x[0] - x[0] ** 2 * x[1]]

    t = np.arange(0.0, 60.0, step_s)
    path = solve_ivp(rates, (0.0, 120.0), [1.0, 1.0], "LSODA", t + 60.0, rtol=1e-9, atol=1e-12).y.T
    rms = np.sqrt(np.square(path).mean(axis=0))
    noise = 0.02 * rms * np.random.default_rng(seed).standard_normal(path.shape)
    return ep.Trajectory(t, path + noise, ["x", "y"])


def oregonator(seed: int) -> ep.Trajectory:
    """34 cycles of Tyson's two variables, 16 samples each, with 1 % noise.

    0.04 x' = x (1 - x) - z (x - q)/(x + q), z' = x - z, q = 8e-4.
    Source: Tyson 1985, in Oscillations and Traveling Waves in Chemical Systems.
    """

    def rates(t: float, x: np.ndarray) -> list[float]:
        gain = x[0] * (1.0 - x[0]) - x[1] * (x[0] - 8e-4) / (x[0] + 8e-4)
        return [gain / 0.04, x[0] - x[1]]

    fine = np.linspace(40.0, 240.0, 200_001)
    options = {"method": "LSODA", "rtol": 1e-9, "atol": 1e-12}
    z = solve_ivp(rates, (0.0, 240.0), [0.1, 0.1], t_eval=fine, **options).y[1] - 0.1
    ups = fine[1:][(z[:-1] < 0.0) & (z[1:] >= 0.0)]
    t = np.diff(ups).mean() / PER_CYCLE * np.arange(N_CYCLES * PER_CYCLE)
    path = solve_ivp(rates, (0.0, 40.0 + t[-1]), [0.1, 0.1], t_eval=40.0 + t, **options).y.T
    rms = np.sqrt(np.square(path).mean(axis=0))
    noise = 0.01 * rms * np.random.default_rng(seed).standard_normal(path.shape)
    return ep.Trajectory(t, path + noise, ["x", "z"])


def brusselators() -> None:
    right = late = silent = 0
    for seed, (a, b), step_s in product(SEEDS, RATES, STEPS_S):
        run, began = brusselator(a, b, step_s, seed), time.process_time()
        first = ep.discover(run)
        named = re.search(r"degree=(\d)", first.misfit)
        late += int(" late (" in first.misfit)
        silent += int(not first.misfit)
        if named:
            then = ep.discover(run, ep.polynomial(["x", "y"], degree=int(named[1])))
            right += not then.misfit and [set(then.model.terms(s)) for s in "xy"] == LAW
        print(f"a {a} b {b} {step_s} s: {time.process_time() - began:.1f} CPU-s", flush=True)
    n = len(SEEDS) * len(RATES) * len(STEPS_S)
    print(f"of {n}: {late} called late, {silent} without a word, {right} right by the next command")


def oregonators() -> None:
    for seed in SEEDS:
        run = oregonator(seed)
        for names in (["x", "z"], ["x"], ["z"]):
            show(f"{names}, draw {seed}", ep.Trajectory(run.t, run.columns(names), names))


def populations() -> None:
    for name, run in (("hare and lynx", ep.data.hare_lynx()), ("Gause", ep.data.gause())):
        show(name, run)
        for state in run.state_names:
            show(state, ep.Trajectory(run.t, run.columns([state]), [state]))


def show(name: str, run: ep.Trajectory) -> None:
    found = ep.discover(run)
    law = "; ".join(found.model.text().splitlines())
    print(f"{name}: {law}\n    {found.misfit[:150] or 'no misfit'}", flush=True)


def main() -> None:
    tables = {"brusselator": brusselators, "oregonator": oregonators, "populations": populations}
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=tables)
    tables[parser.parse_args().what]()


if __name__ == "__main__":
    main()
