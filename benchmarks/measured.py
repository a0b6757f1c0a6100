"""Measured records, by the settings that a user meets: `python -m benchmarks.measured`.

    EP2SINDY_DATA=folder python -m benchmarks.measured sentences
    EP2SINDY_DATA=folder python -m benchmarks.measured laser electrochemical hallthruster
    python -m benchmarks.measured pendulum populations current bands process_noise hidden offset

`+exp=trace` as it comes is run on every record; what differs is written with its row. Errors are
root mean squares over starts, in standard deviations of the held-out samples, next to persistence
and an autoregression by AIC; every start is fitted to the past alone. Records that are not shipped
lie in the folder of EP2SINDY_DATA. Prints the tables of docs/trace.md.

`sentences` tests what heads the result, over all records and over signals that follow a square
wave or are noise about a sine: whether the held-out part bears it out, whether a driven signal is
reported as sustained without a question, and how much the bands hold.
"""

from __future__ import annotations

import importlib
import json
import os
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import scipy.signal
import statsmodels.api

import ep2sindy as ep
from ep2sindy.discovery.one_signal import fit_offset
from ep2sindy.signals.spectrum import crossing_frequency

FOLDER = Path(os.environ.get("EP2SINDY_DATA", "."))
N_DRAWS, N_MOVED, N_SIMULATED = 10, 20, 3
DRIFT_A, GAP, N_LONG, PROCESS = 0.4, 0.05, 1_000_000, 0.05
SHOWN = ("status", "f_error", "amplitude_ratio", "waveform_error")
N_CYCLES = 2
POINTS = ((300.0, 5.0), (300.0, 4.0), (300.0, 6.0), (400.0, 5.0))  # V and mg/s
NOISE = 0.02  # of the simulator's current, as a fraction of its mean


@dataclass(frozen=True, eq=False)
class Traced:
    """What `+exp=trace` wrote: summary, errors by horizon, and the free run next to the data.

    screen: what it printed. cpu_s: what it took.
    """

    summary: dict[str, Any]
    errors: pd.DataFrame
    run: pd.DataFrame
    screen: str
    cpu_s: float

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
        before = cpu_of_children_s()
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        cpu_s = cpu_of_children_s() - before
        if done.returncode:
            return (done.stderr or done.stdout).strip().splitlines()[-1]
        result = Path(done.stdout.split()[-1]).parent  # of the page
        tables, errors = result / "tables", result / "tables" / "forecast_trace.csv"
        return Traced(
            json.loads((result / "summary.json").read_text()),
            pd.read_csv(errors) if errors.exists() else pd.DataFrame(),
            pd.read_csv(tables / "rollout_trace.csv"),
            done.stdout + done.stderr,
            cpu_s,
        )


def cpu_of_children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


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
        print(f"  {forecast['text']}: {is_true(forecast)}")
        print(f"  {told_of_bands(forecast['coverage_90'])}", flush=True)


def told_of_bands(held: float | None) -> str:
    """How much of the samples bands of 90 % hold; None or NaN if none are shown."""
    if held is None or not np.isfinite(held):
        return "no bands"
    return f"bands of 90 % hold {100 * held:.0f} %"


def is_true(forecast: dict[str, Any]) -> str:
    """Whether the held-out part bears a sentence out: errors below one, and below the rival's."""
    errors = forecast["nrmse"]
    rivals = [name for name in ("autoregression", "persistence") if name in errors]
    own, rival = (np.array(errors[name]) for name in ("model", rivals[0]))
    until = forecast["better_until_periods"]
    stated = np.array(forecast["horizons_periods"]) <= until * (1.0 + 1e-9)
    holds = bool(((own < rival) & (own < 1.0))[stated].all())
    return "true" if holds and bool(until) == forecast["is_better"] else "not true"


@dataclass(frozen=True, eq=False)
class Record:
    """A record of one signal. unit: of its times. driven: whether something else moves it.

    is_sustained: whether it repeats one cycle, so that a model of it may sustain it.
    """

    name: str
    t: np.ndarray
    x: np.ndarray
    unit: str = "s"
    driven: bool = False
    is_sustained: bool = True


def sentences() -> None:
    """What heads the result of every record, and whether it is true."""
    false, n, held, slow = 0, 0, [], []
    for record in (*measured_records(), *made_records()):
        found = trace(record.t, record.x, f"data.time.unit={record.unit}")
        print(f"\n{record.name}")
        if isinstance(found, str):
            print(f"  refused: {found}", flush=True)
            continue
        stated, faults = assess(record, found)
        n, false = n + 1, false + bool(faults)
        forecast = found.summary.get("forecasts", {}).get("trace")
        if forecast and forecast["coverage_90"] is not None:
            held.append(100 * forecast["coverage_90"])
        bands = told_of_bands(forecast["coverage_90"] if forecast else None)
        slow.append(found.cpu_s)
        print(f"  {stated}\n  {'; '.join(faults) or 'true'}; {bands}; {found.cpu_s:.1f} CPU-s")
        print(end="", flush=True)
    outside = sum(not 80 <= each <= 97 for each in held)
    print(
        f"\n{n} records: {false} false, {outside} of {len(held)} bands hold other than 80 to 97 % "
        f"({min(held):.0f} to {max(held):.0f}), {max(slow):.0f} CPU-s at most"
    )


def assess(record: Record, found: Traced) -> tuple[str, list[str]]:
    """What is stated first of a record, with what follows a question, and what is false in it."""
    run = found.summary["evaluations"]["trace"]
    screen = " ".join(found.screen.split())
    forecast = found.summary.get("forecasts", {}).get("trace")
    asked, is_sustained = "driven?" in screen, run["status"] == "sustained"
    stated = run["status"] if forecast is None else forecast["headline"]
    faults = [] if forecast is None else false_in(forecast, found.errors)
    if is_sustained and not record.is_sustained:
        faults.append("no such record sustains one cycle")
    if is_sustained and record.driven and not asked:
        faults.append("driven, and not asked about")
    if "RuntimeWarning" in screen or re.search(r"e\+\d+ (times|standard)", screen):
        faults.append("a warning, or a size that nobody can read")
    return f"{stated}; {run['status']}{', asked whether it is driven' * asked}", faults


def false_in(forecast: dict[str, Any], errors: pd.DataFrame) -> list[str]:
    """What the held-out part does not bear out of a sentence about forecasts, at any horizon."""
    faults = [] if is_true(forecast) == "true" else ["better in sentence or span alone"]
    ahead = errors["horizon_s"].to_numpy() / forecast["unit_s"]
    rival = errors["autoregression" if "autoregression" in errors else "persistence"]
    better = ahead <= forecast["better_until_periods"] * (1.0 + 1e-9)
    if not ((errors["model"] < rival) & (errors["model"] < 1.0))[better].all():
        faults.append("not better over its span")
    close = ahead <= forecast["close_until_periods"] * (1.0 + 1e-9)
    if not (errors["model"] < 0.5)[close].all():
        faults.append("not close over its span")
    return faults


def measured_records() -> Iterator[Record]:
    """Records in the folder of EP2SINDY_DATA, and those that other packages bring."""
    for name, column, is_sustained in (
        ("laser", "I", True), ("electrochemical", "I", False), ("pendulum", "theta", False),
        ("hallthruster_landmark_3", "I_d", True), ("hallthruster_landmark_2", "I_d", False),
        ("hare_lynx", "hare", True), ("hare_lynx", "lynx", True),
        ("gause", "Paramecium aurelia", True), ("gause", "Saccharomyces exiguus", True),
    ):  # fmt: skip
        unit = "year" if name == "hare_lynx" else "day" if name == "gause" else "s"
        t, x = read(name, column)
        yield Record(f"{name}, {column}", t, x, unit, is_sustained=is_sustained)
    spots = statsmodels.api.datasets.sunspots.load_pandas().data
    t, x = spots.to_numpy(float).T
    yield Record("sunspots", t, x, "year", is_sustained=False)
    months = statsmodels.api.datasets.elnino.load_pandas().data
    x = months.iloc[:, 1:].to_numpy(float).ravel()
    years = months.iloc[0, 0] + np.arange(len(x)) / 12.0
    yield Record("El Nino, sea temperature", years, x, "year", driven=True)
    try:
        pywt = importlib.import_module("pywt")
    except ImportError:
        print("\nECG: not assessed; install PyWavelets for it")
        return
    ecg = pywt.data.ecg().astype(float)
    yield Record("ECG, 360 Hz", np.arange(len(ecg)) / 360.0, ecg, is_sustained=False)


# What follows a square wave: its period and the lag in s, the fraction of a period at which it is
# high, the time in which it rises in periods, and noise.
SQUARES = (
    (1.37, 0.1, 0.5, 0.0, 0.01), (1.37, 0.3, 0.5, 0.0, 0.05), (1.37, 1.0, 0.5, 0.0, 0.02),
    (7.3e-3, 1e-3, 0.3, 0.0, 0.02), (7.3e-3, 3e-3, 0.2, 0.0, 0.05), (7.3e-3, 1e-3, 0.7, 0.05, 0.01),
    (0.02, 5e-3, 0.5, 0.0, 0.02), (0.1, 0.02, 0.4, 0.1, 0.03), (25.0, 8.0, 0.5, 0.2, 0.02),
    (60.0, 10.0, 0.25, 0.0, 0.05),
)  # fmt: skip
PER_PERIOD, N_SQUARES = 40, 40


def made_records() -> Iterator[Record]:
    """Signals that follow a square wave, and a sine in noise that lasts."""
    rng = np.random.default_rng(0)
    for period_s, lag_s, high, rise, noise in SQUARES:
        t = period_s / PER_PERIOD * np.arange(PER_PERIOD * N_SQUARES)
        x = relaxation(t, period_s, lag_s, high, rise)
        x = x + noise * x.std() * rng.standard_normal(len(x))
        words = f"square wave, {period_s:g} s, {100 * high:.0f} % high, {100 * noise:.0f} % noise"
        yield Record(words, t, x, driven=True)
    t, lasting = 0.05 * np.arange(2000), np.zeros(2000)
    for k in range(1, len(t)):
        lasting[k] = 0.9 * lasting[k - 1] + rng.standard_normal()
    for fraction in (0.2, 0.5):
        x = np.sin(2.0 * np.pi * t / 1.43) + fraction * lasting / lasting.std()
        yield Record(f"sine, noise of {fraction:g} that lasts", t, x, driven=True)


def relaxation(
    t: np.ndarray, period_s: float, lag_s: float, high: float, rise: float
) -> np.ndarray:
    """x of lag_s x' = u - x, in fine steps, u being a wave of zero and one with sloped sides."""
    n = 20
    fine = np.linspace(t[0], t[-1], n * (len(t) - 1) + 1)
    place = fine / period_s % 1.0
    if rise:
        u = np.interp(place, [0.0, rise, high, high + rise, 1.0], [0.0, 1.0, 1.0, 0.0, 0.0])
    else:
        u = (place < high).astype(float)
    keep = np.exp(-(fine[1] - fine[0]) / lag_s)
    return scipy.signal.lfilter([1.0 - keep], [1.0, -keep], u)[::n]


def read(name: str, column: str) -> tuple[np.ndarray, np.ndarray]:
    table = pd.read_csv(FOLDER / f"{name}.csv")
    return table.iloc[:, 0].to_numpy(float), table[column].to_numpy(float)


def laser() -> None:
    t, x = read("laser", "I")
    found = trace(t[:1000], x[:1000])
    show("laser, rolling starts over 750 to 1000", found, {f"{n} samples": n for n in (1, 7, 14)})
    found = trace(t, x, f"held_out={1.0 - 1000.0 / len(t)}")
    if isinstance(found, Traced):
        off = (found.run["x_model"] - found.run["x_data"]).to_numpy()
        spread = x[:1000].var()
        fractions = ", ".join(
            f"{n}: {np.mean(off[1 : n + 1] ** 2) / spread:.3f}" for n in (20, 40, 100)
        )
        print(f"  1000 seen, then free; mean square over the variance after {fractions}")


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
    held_out = f"held_out={1.0 - 3.6 / 5.5}"
    for words, more in {
        "as it comes": [],
        "dry friction, its width fitted": [
            "tried=[{how: auto, degree: 1, functions: ['sign(?*v)']}]"
        ],
        "dry friction, its width given": [
            "tried=[{how: auto, degree: 1, functions: ['sign(200*v)']}]"
        ],
    }.items():
        found = trace(run.t, run.states[:, 0], held_out, *more)
        show(f"pendulum, {words}", found, {"0.1 s": 0.1, "0.4 s": 0.4})
        if isinstance(found, Traced):
            off = found.run["x_model"] - found.run["x_data"]
            print(
                f"  free over {100.0 * np.isfinite(off).mean():.0f} % of the rest: nrmse "
                f"{np.std(off) / found.run['x_data'].std():.3f}"
            )


def populations() -> None:
    """Hare and lynx over 14 of 21 years, Gause over 12 of 18 days: all terms, and named ones."""
    for run, n_fitted in ((ep.data.hare_lynx(), 14), (ep.data.gause(), 12)):
        first, second = run.state_names
        both = f"{first}*{second}"
        named = {first: (first, both), second: (second, both)}
        for words, terms in {"the whole library": {}, "terms named": named}.items():
            library = ep.polynomial(run.names).only(terms)
            found = ep.discover(run.window(0, n_fitted), library)
            print(f"\n{run.label}, {words}\n{found.model.text()}\n  {found.note}")
            if found.model.coef.any():
                skill = ep.model.forecast_skill(found.model, run, n_fitted=n_fitted)
                print(f"  {skill.text}; one step ahead {skill.at(run.dt_s)}")
                print(f"  {is_true(skill.summary())}")
                print(f"  {told_of_bands(skill.coverage_90)}", flush=True)


def current() -> None:
    """The simulator's current as a scope has it, spoilt in three ways, over draws of its noise."""
    field = ep.thruster.simulate(
        ep.thruster.Thruster(), ep.thruster.OperatingPoint(300, 5), cache=True
    )
    t, x = field["time"].values, field["I_d"].values
    spoilt: dict[str, Callable[[np.random.Generator], tuple[np.ndarray, np.ndarray]]] = {
        "as a scope has it": lambda rng: (t, scope(x, rng)),
        f"drift of {DRIFT_A} A": lambda rng: (t, scope(x + DRIFT_A * t / t[-1], rng)),
        f"gap of {100 * GAP:.0f} %": lambda rng: with_gap(t, scope(x, rng), rng),
        "a million samples": lambda rng: finer(t, x, rng),
    }
    for words, spoil in spoilt.items():
        rows = []
        for seed in range(N_SIMULATED):
            found = trace(*spoil(np.random.default_rng(seed)), "unit=A", f"seed={seed}")
            rows.append(found if isinstance(found, str) else found.summary["evaluations"]["trace"])
        n_sustained = sum(isinstance(row, dict) and row["status"] == "sustained" for row in rows)
        print(f"\ncurrent, {words}: {n_sustained} of {len(rows)} live")
        for row in rows:
            shown = row if isinstance(row, str) else [row[key] for key in SHOWN]
            print(f"    {shown}", flush=True)


def scope(x: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """White noise of 2 % of the mean, then 8 bits over the range and a tenth."""
    noisy = x + NOISE * x.mean() * rng.standard_normal(len(x))
    step = 1.1 * (noisy.max() - min(noisy.min(), 0.0)) / 256.0
    return step * np.round(noisy / step)


def with_gap(
    t: np.ndarray, x: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Without 5 % of the samples, in one piece within the fitted part."""
    n = round(GAP * len(t))
    begin = int(rng.integers(len(t) // 10, len(t) // 2))
    kept = np.r_[0:begin, begin + n : len(t)]
    return t[kept], x[kept]


def finer(t: np.ndarray, x: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    fine = np.linspace(t[0], t[-1], N_LONG)
    return fine, scope(np.interp(fine, t, x), rng)


def bands() -> None:
    """Coverage of bands of 90 % on systems whose law was found, over draws of white noise."""
    for system in (ep.lorenz(), ep.lotka_volterra(), ep.systems.van_der_pol()):
        for noise in (0.05, 0.2):
            held = []
            for seed in range(N_DRAWS):
                run = system.trajectory(noise=noise, rng=seed)
                n = round(0.75 * run.n_samples)
                model = ep.discover(run.window(0, n), library_of(system)).model
                held.append(ep.model.forecast_skill(model, run, n_fitted=n, starts=20).coverage_90)
            print(
                f"{system.name}, {100 * noise:.0f} % noise: bands of 90 % hold "
                f"{100 * np.mean(held):.1f} % ({100 * min(held):.0f} to {100 * max(held):.0f})",
                flush=True,
            )


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
            f"{len(inside)} intervals hold; nearer than the autoregression over {N_CYCLES} "
            f"cycles in {nearer}, bands of 90 % hold {100 * np.mean(held):.1f} % "
            f"({100 * min(held):.0f} to {100 * max(held):.0f}); a search takes "
            f"{np.median(cpu_s):.2g} CPU-s",
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
    sentences, laser, electrochemical, hallthruster, pendulum, populations, current, bands,
    process_noise, hidden, offset,
)}  # fmt: skip


def main(names: Sequence[str]) -> None:
    unknown = set(names) - set(TABLES)
    if unknown:
        raise SystemExit(f"tables are {', '.join(TABLES)}, got {', '.join(sorted(unknown))}")
    for name in names or TABLES:
        TABLES[name]()


if __name__ == "__main__":
    main(sys.argv[1:])
