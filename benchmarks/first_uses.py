"""First uses: a default library of degree 2, and the command that the result then names.

python -m benchmarks.first_uses brusselator   # 18 draws: no sensor called late, law found after
python -m benchmarks.first_uses oregonator    # 34 cycles of a stiff reaction: never x' = 0
python -m benchmarks.first_uses populations   # counts of animals: a law, or what is lacking
python -m benchmarks.first_uses ahead         # four tables of them: forecasts next to a VAR
python -m benchmarks.first_uses long          # 200,000 samples of two channels: CPU-s, and the law
"""

from __future__ import annotations

import argparse
import re
import time
from collections.abc import Callable
from dataclasses import replace
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
        named = re.search(r"degree=(\d)", first.lack_of_fit)
        late += int(" late (" in first.lack_of_fit)
        silent += int(not first.lack_of_fit)
        if named:
            then = ep.discover(run, ep.polynomial(["x", "y"], degree=int(named[1])))
            right += not then.lack_of_fit and [set(then.model.terms(s)) for s in "xy"] == LAW
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


def with_process_noise(
    rates: Callable[[np.ndarray], np.ndarray], n: int, step: float
) -> ep.Trajectory:
    """Simulated counts: n of two species, 10 % process noise a time unit, counted to 5 %."""
    rng, x, h, states = np.random.default_rng(0), np.array([0.5, 0.3]), step / 100, []
    for k in range(100 * (n + 50)):
        if k >= 5000 and k % 100 == 0:
            states.append(x * np.exp(0.05 * rng.standard_normal(2)))
        x = x * np.exp(h * rates(x) + 0.1 * np.sqrt(h) * rng.standard_normal(2))
    return ep.Trajectory(step * np.arange(float(n)), np.array(states), ["prey", "predator"])


def lotka(x: np.ndarray) -> np.ndarray:
    """Growth of prey that crowd each other by a tenth, and of their predators."""
    return np.array([1.0 - 0.1 * x[0] - x[1], x[0] - 1.0])


def rosenzweig(x: np.ndarray) -> np.ndarray:
    """Growth of prey, and of predators that are sated: Rosenzweig & MacArthur 1963."""
    eaten = 2.0 / (0.3 + x[0])
    return np.array([1.0 - x[0] - eaten * x[1], eaten * x[0] - 1.2])


def ahead() -> None:
    """What the first two thirds of a table foresee of the rest, in its standard deviations."""
    tables = {
        "hare and lynx": ep.data.hare_lynx(),
        "Gause": ep.data.gause(),
        "simulated, Lotka-Volterra": with_process_noise(lotka, 90, 0.5),
        "simulated, Rosenzweig-MacArthur": with_process_noise(rosenzweig, 90, 0.5),
    }
    for name, run in tables.items():
        n = 2 * run.n_samples // 3
        found = ep.discover(run.window(0, n))
        longest = min(5, run.n_samples - n - 1)
        horizon_s = longest * run.dt_s
        rival = var_errors(run, n, longest)
        print(f"\n{name}: {'; '.join(found.model.text().splitlines())}\n  {found.note}")
        print(f"  VAR: {np.round(rival, 2)} one to {longest} samples ahead")
        if not found.model.coef.any():
            continue
        skill = ep.model.forecast_skill(found.model, run, n_fitted=n, horizon_s=horizon_s)
        own = skill.nrmse["model"]
        stated = own[: skill.n_better] >= rival[: skill.n_better]
        print(f"  model: {np.round(own, 2)}; found: {skill.headline}")
        print(
            f"  a VAR is nearer at {(rival < own).sum()} of {longest} horizons, at "
            f"{stated.sum()} of "
            f"the {skill.n_better} for which the sentence claims to be better",
            flush=True,
        )


def var_errors(run: ep.Trajectory, n_fitted: int, longest: int) -> np.ndarray:
    """Errors of a vector autoregression of the logarithms, its order by AIC, by horizon."""
    from statsmodels.tsa.api import VAR

    logs = np.log(np.maximum(run.states, 0.5 * run.states[run.states > 0.0].min()))
    most = max(1, min(4, n_fitted // 6))
    fit = VAR(logs[:n_fitted]).fit(maxlags=most, ic="aic", trend="c")
    starts = range(n_fitted, run.n_samples - longest + 1)
    order = max(1, fit.k_ar)
    paths = [np.exp(fit.forecast(logs[k - order : k], longest)) for k in starts]
    truth = [run.states[k : k + longest] for k in starts]
    scale = run.states[n_fitted:].std(axis=0)
    return np.sqrt(np.mean(np.square((np.array(paths) - truth) / scale), axis=(0, 2)))


def long_record() -> None:
    """Lotka and Volterra at 336 samples in a unit of time, with 2 % noise."""
    system = replace(ep.lotka_volterra(), rate_Hz=336.0, duration_s=200_000 / 336.0)
    run, began = system.trajectory(noise=0.02, rng=0), time.process_time()
    found = ep.discover(run)
    cpu_s, law = time.process_time() - began, "; ".join(found.model.text().splitlines())
    print(f"{run.n_samples} samples: {cpu_s:.1f} CPU-s; {found.data_warnings[-1]}\n{law}")
    print(found.lack_of_fit or "no lack of fit")


def show(name: str, run: ep.Trajectory) -> None:
    found = ep.discover(run)
    law = "; ".join(found.model.text().splitlines())
    print(f"{name}: {law}\n    {found.lack_of_fit[:150] or 'no lack of fit'}", flush=True)


def main() -> None:
    tables = {
        "brusselator": brusselators,
        "oregonator": oregonators,
        "populations": populations,
        "ahead": ahead,
        "long": long_record,
    }
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=tables)
    tables[parser.parse_args().what]()


if __name__ == "__main__":
    main()
