"""Measured records, by the settings that a user meets: `python -m benchmarks.measured`.

    EP2SINDY_DATA=folder python -m benchmarks.measured laser electrochemical hallthruster
    python -m benchmarks.measured pendulum populations process_noise hidden offset

`+exp=trace` as it comes is run on every record; what differs is in its table. Errors are
root mean squares over starts, in standard deviations of the held-out samples, next to persistence
and an autoregression by AIC; every start is fitted to the past alone. Records that are not shipped
lie in the folder of EP2SINDY_DATA. Prints tables of docs/trace.md and docs/estimation.md.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import ep2sindy as ep
from ep2sindy.discovery.one_signal import fit_offset
from ep2sindy.signals.spectrum import crossing_frequency

FOLDER = Path(os.environ.get("EP2SINDY_DATA", "."))
N_DRAWS, N_MOVED = 10, 20
PROCESS = 0.05  # noise
N_CYCLES = 2
DRY_FRICTION = "{how: auto, degree: 1, functions: ['sign(200*v)']}"
POINTS = ((300.0, 5.0), (300.0, 4.0), (300.0, 6.0), (400.0, 5.0))  # V and mg/s


@dataclass(frozen=True, eq=False)
class Traced:
    """What `+exp=trace` wrote: summary, and errors by horizon."""

    summary: dict[str, Any]
    errors: pd.DataFrame

    def at(self, horizon_s: float) -> str:
        """Errors at a horizon, of the model and of the autoregression."""
        if self.errors.empty:
            return "-"
        row = self.errors.iloc[int(np.argmin(np.abs(self.errors["horizon_s"] - horizon_s)))]
        names = [name for name in ("model", "autoregression", "persistence") if name in row]
        return ", ".join(f"{name} {row[name]:.3f}" for name in names)


def trace(t: np.ndarray, x: np.ndarray, *more: str) -> Traced | str:
    """Run `+exp=trace` on a file of two columns; what it says if it refuses."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "record.csv"
        np.savetxt(path, np.column_stack([t, x]), delimiter=",", header="time,x", comments="")
        given = ["+exp=trace", "data=file", f"data.path={path}", "signal=x", f"output={folder}"]
        command = [sys.executable, "-m", "experiments.run", *given, *more]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            return (done.stderr or done.stdout).strip().splitlines()[-1]
        result = Path(done.stdout.split()[-1]).parent  # of the page
        errors = result / "tables" / "forecast_trace.csv"
        return Traced(
            json.loads((result / "summary.json").read_text()),
            pd.read_csv(errors) if errors.exists() else pd.DataFrame(),
        )


def show(name: str, found: Traced | str, horizons: dict[str, float]) -> None:
    """A few lines for a record."""
    print(f"\n{name}")
    if isinstance(found, str):
        print(f"  refused: {found}")
        return
    run, signal = found.summary["evaluations"]["trace"], found.summary["signal"]
    n_terms = found.summary["headline"]["n_terms"]
    print(f"  {signal['n_states']} states, {n_terms:g} terms: {run['status']}")
    for state, terms in found.summary["models"]["trace"]["equations"].items():
        print(f"    {state}' = " + " ".join(f"{c:+.3g} {term}" for term, c in terms.items()))
    for words, horizon in horizons.items():
        print(f"  {words} ahead: {found.at(horizon)}")
    if forecast := found.summary.get("forecasts", {}).get("trace"):
        print(f"  {forecast['text']}")
        print(f"  {text_of_bands(forecast['coverage_90'])}", flush=True)


def text_of_bands(held: float | None) -> str:
    """How much of the samples bands of 90 % hold; None or NaN if none are shown."""
    if held is None or not np.isfinite(held):
        return "no bands"
    return f"bands of 90 % hold {100 * held:.0f} %"


def read(name: str, column: str) -> tuple[np.ndarray, np.ndarray]:
    table = pd.read_csv(FOLDER / f"{name}.csv")
    return table.iloc[:, 0].to_numpy(float), table[column].to_numpy(float)


def laser() -> None:
    t, x = read("laser", "I")
    found = trace(t[:1000], x[:1000])
    show("laser, rolling starts over 750 to 1000", found, {f"{n} samples": n for n in (1, 7, 14)})


def electrochemical() -> None:
    t, x = read("electrochemical", "I")
    horizons = {f"{n} samples": float(n) for n in (5, 17, 35)}
    show("electrochemical oscillator", trace(t, x), horizons)


def hallthruster() -> None:
    for case in (3, 2):
        t, x = read(f"hallthruster_landmark_{case}", "I_d")
        found = trace(t, x)
        period_s = 1.0 / 9.7e3
        show(f"HallThruster.jl, case {case}", found, {"1 period": period_s, "2": 2 * period_s})


def pendulum() -> None:
    run = ep.data.pendulum_swing()
    more = (f"held_out={1.0 - 3.6 / 5.5}", f"tried=[{DRY_FRICTION}]")
    found = trace(run.t, run.states[:, 0], *more)
    show("pendulum, dry friction", found, {"0.1 s": 0.1, "0.4 s": 0.4})


def populations() -> None:
    """Hare and lynx over 14 of 21 years, Gause over 12 of 18 days, their terms named."""
    for run, n_fitted in ((ep.data.hare_lynx(), 14), (ep.data.gause(), 12)):
        first, second = run.state_names
        both = f"{first}*{second}"
        library = ep.polynomial(run.names).only({first: (first, both), second: (second, both)})
        found = ep.discover(run.window(0, n_fitted), library)
        skill = ep.model.forecast_skill(found.model, run, n_fitted=n_fitted)
        print(f"\n{run.label}\n{found.model.text()}\n  {found.note}")
        print(f"  {skill.text}; one step ahead {skill.at(run.dt_s)}")
        print(f"  {text_of_bands(skill.coverage_90)}", flush=True)


def process_noise() -> None:
    """Laws whose states have process noise: supports that are right, intervals that hold."""
    for system in (ep.systems.van_der_pol(), ep.lorenz()):
        right = held = n = 0
        for seed in range(N_MOVED):
            found = ep.discover(moved(system, PROCESS, seed), library_of(system))
            own, truth = found.model, system.model
            if found.lack_of_fit or any(
                set(own.terms(s)) != set(truth.terms(s)) for s in truth.states
            ):
                continue
            right += 1
            for state in truth.states:
                inside = [
                    low <= truth.terms(state)[term] <= high
                    for term, (low, high) in own.intervals(state).items()
                ]
                held, n = held + sum(inside), n + len(inside)
        print(
            f"{system.name}, process noise of {100 * PROCESS:.0f} % of RMS in a period: {right} of "
            f"{N_MOVED} right, {held} of {n} intervals hold",
            flush=True,
        )


def moved(system: ep.systems.System, fraction: float, seed: int) -> ep.Trajectory:
    """A record at 1 % noise with process noise of a fraction of every state's RMS in a period."""
    rng, clean, n_substeps = np.random.default_rng(seed), system.trajectory(), 10
    rms = np.sqrt(np.square(clean.states).mean(axis=0))
    turns_Hz = max(crossing_frequency(clean.t, x) for x in clean.states.T)
    h, none = clean.dt_s / n_substeps, np.empty(0)
    x, states = clean.states[0], [clean.states[0]]
    for _ in range(clean.n_samples - 1):
        for _ in range(n_substeps):
            half = x + 0.5 * h * system.model.derivative(x, none)
            x = x + h * system.model.derivative(half, none)
            x = x + fraction * rms * np.sqrt(h * turns_Hz) * rng.standard_normal(len(x))
        states.append(x)
    samples = np.array(states) + 0.01 * rms * rng.standard_normal((len(states), len(rms)))
    return ep.Trajectory(clean.t, samples, clean.state_names)


def library_of(system: ep.systems.System) -> ep.Library:
    """All products up to the degree of the law, two at least."""
    degree = max(2, int(system.model.library.degrees.max()))
    return ep.polynomial(system.model.states, degree=degree)


# Laws as one measured state shows them, by x' = v or x' = x*g: what is not known of them.
SHOWN_LAWS: dict[str, tuple[ep.systems.System, str, dict[str, dict[str, float]]]] = {
    "x of Lorenz": (
        ep.lorenz(),
        "x",
        {
            "v": {"v": -11.0, "x*h": 1.0},
            "h": {"1": 720.0, "h": -8.0 / 3.0, "x^2": -10.0, "x*v": -1.0},
        },
    ),
    "prey of Lotka-Volterra": (
        ep.lotka_volterra(),
        "x",
        {"g": {"1": 2.0 / 9.0, "x": -2.0 / 3.0, "g": -1.0 / 3.0, "x*g": 1.0}},
    ),
    "predators of Lotka-Volterra": (
        ep.lotka_volterra(),
        "y",
        {"g": {"1": 2.0 / 9.0, "y": -1.0 / 3.0, "g": 2.0 / 3.0, "y*g": -1.0}},
    ),
}


def hidden() -> None:
    """One measured state, the others hidden: laws found, and forecasts over the next cycles."""
    for words, (system, name, law) in SHOWN_LAWS.items():
        right, nearer, inside, held, cpu_s = 0, 0, [], [], []
        n = round(system.duration_s * system.rate_Hz)
        longer = replace(system, duration_s=1.6 * system.duration_s)
        for seed in range(N_DRAWS):
            full = longer.trajectory(noise=0.05, rng=seed)
            run = ep.Trajectory(full.t, full.columns([name]), [name])
            begin_s = time.process_time()
            found = ep.discover(run.window(0, n), hidden=list(law))
            cpu_s.append(time.process_time() - begin_s)
            if all(set(found.model.terms(s)) == set(terms) for s, terms in law.items()):
                right += 1
                inside += [
                    low <= law[state][term] <= high
                    for state in law
                    for term, (low, high) in found.model.intervals(state).items()
                    if low < high  # the others set the scale of a hidden state
                ]
            cycle_s = 1.0 / crossing_frequency(run.t, run.states[:, 0])
            skill = ep.model.forecast_skill(
                found.model, run, n_fitted=n, horizon_s=N_CYCLES * cycle_s
            )
            nearer += bool(np.mean(skill.nrmse["model"]) < np.mean(skill.nrmse["autoregression"]))
            held.append(skill.coverage_90)
        print(
            f"{words}, 5 % noise: law right in {right} of {N_DRAWS}, {sum(inside)} of "
            f"{len(inside)} intervals hold; nearer than the autoregression over {N_CYCLES} cycles "
            f"in {nearer}, bands of 90 % hold {100 * np.mean(held):.1f} % ({100 * min(held):.0f} "
            f"to {100 * max(held):.0f}); a search takes {np.median(cpu_s):.2g} CPU-s",
            flush=True,
        )
    for voltage, flow in POINTS:
        neutrals(voltage, flow)


def offset() -> None:
    """Either species of Lotka and Volterra less its mean: `offset=fit` of +exp=trace."""
    system = replace(ep.lotka_volterra(), duration_s=100.0)
    for name, noise in product(system.model.states, (0.01, 0.05)):
        errors, held = [], 0
        for seed in range(N_DRAWS):
            run = system.trajectory(noise=noise, rng=seed)
            x = run.columns([name])
            signal = ep.signals.prepare_signal(ep.Trajectory(run.t, x - x.mean(), [name]))
            try:
                value, low, high = fit_offset(signal, 2, ep.TrajectorySearch())
            except ValueError:
                continue
            errors.append(abs(value / x.mean() - 1.0))
            held += low < x.mean() < high
        print(
            f"mean of {name}, {100 * noise:.0f} % noise: found in {len(errors)} of {N_DRAWS}, off "
            f"by {100 * np.median(errors):.2g} % ({100 * max(errors):.2g} at most), {held} "
            "intervals hold",
            flush=True,
        )


def neutrals(voltage: float, flow: float) -> None:
    """The simulator's ions measured, its neutrals hidden; the last quarter held out."""
    point = ep.thruster.OperatingPoint(voltage, flow)
    field = ep.thruster.simulate(ep.thruster.Thruster(), point, cache=True)
    both = ep.zone_average(field, ep.Zone(z="channel"), states=["n_i", "n_n"])
    run = ep.Trajectory(both.t, both.columns(["n_i"]), ["n_i"], units={"n_i": "m^-3"})
    n = round(0.75 * run.n_samples)
    found = ep.discover(run.window(0, n), hidden=["g"])
    states = ep.model.estimate_states(found.model, run)
    free = ep.evaluate(found.model, states.window(n, run.n_samples))
    alike = np.corrcoef(states.columns(["g"])[n:, 0], both.columns(["n_n"])[n:, 0])[0, 1]
    print(
        f"{voltage:g} V, {flow:g} mg/s: {free.status}, frequency off by {100 * free.f_error:.2f} "
        f"%, correlation of the hidden state with n_n {alike:.3f}; "
        f"{'a lack of fit' if found.lack_of_fit else 'fits'}: {found.model.text()}",
        flush=True,
    )


TABLES = {each.__name__: each for each in (
    laser, electrochemical, hallthruster, pendulum, populations, process_noise, hidden, offset,
)}  # fmt: skip


def main(names: Sequence[str]) -> None:
    unknown = set(names) - set(TABLES)
    if unknown:
        raise SystemExit(f"tables are {', '.join(TABLES)}, got {', '.join(sorted(unknown))}")
    for name in names or TABLES:
        TABLES[name]()


if __name__ == "__main__":
    main(sys.argv[1:])
