"""Measured records, by the settings that a user meets: `python -m benchmarks.measured`.

    EP2SINDY_DATA=folder python -m benchmarks.measured laser flutter headings
    python -m benchmarks.measured pendulum hares gause process_noise hidden offset

Every record is cut or split at several places: one split may be a lucky draw. The models are those
of `+exp=trace` as it comes; what differs is in `RECORDS`. Printed are medians and ranges of the
errors of forecasts: root mean squares over starts, in standard deviations of the held-out samples,
next to an autoregression by AIC and others. `headings` asks whether what the headings of all
records say holds at more starts, and next to another autoregression. Records that are not shipped
lie in the folder of EP2SINDY_DATA. Prints tables of docs/trace.md and docs/estimation.md.
"""

from __future__ import annotations

import os
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from hydra import compose, initialize_config_dir

import ep2sindy as ep
from ep2sindy.app.runner import study_class
from ep2sindy.app.schema import study_of
from ep2sindy.discovery import one_signal
from ep2sindy.forecasting.evaluation import Evaluation
from ep2sindy.signals.spectrum import crossing_frequency

FOLDER, CONF = Path(os.environ.get("EP2SINDY_DATA", ".")), Path(__file__).parents[1] / "conf"
N_DRAWS, N_MOVED, N_CYCLES, PROCESS_NOISE = 10, 20, 2, 0.05
DRY_FRICTION = "tried=[{how: auto, degree: 1, functions: ['sign(200*v)']}]"
POINTS = ((300.0, 5.0), (300.0, 4.0), (300.0, 6.0), (400.0, 5.0))  # V and mg/s
SAID = ("no equations found", "no better", "within chance", "better", "")  # first in a heading
AHEAD = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0)  # periods, or samples without one
DENSE, GAIN, LAGS = 200, 0.9, (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48)  # of the check of headings


def trace(run: ep.Trajectory, *more: str) -> Evaluation:
    """How the model of `+exp=trace` does on the rest of a record of one signal."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=["+exp=trace", *more])
    study = study_of(study_class("trace"), config)
    signal = ep.signals.prepare_signal(run, decimate=study.decimate, detrend=study.detrend)
    past = one_signal.fitted_part(signal, study.held_out)
    attempts = one_signal.try_in_turn(past, study.tried, study.method)
    return one_signal.run_on_rest(signal, one_signal.best_of(attempts))[1]


def parts(
    runs: Iterable[ep.Trajectory], held_out: Iterable[float] = (0.25,), *more: str
) -> Iterator[Evaluation]:
    return (trace(run, f"held_out={each}", *more) for run, each in product(runs, held_out))


def read(name: str, column: str, inputs: Sequence[str] = ()) -> ep.Trajectory:
    """A signal of a file, next to its inputs, over the first column."""
    table = pd.read_csv(FOLDER / f"{name}.csv").astype(float)
    columns = table.iloc[:, 0].to_numpy(), table[[column]].to_numpy(), ("x",)
    return ep.Trajectory(*columns, table[[*inputs]].to_numpy(), tuple(inputs))


def named_terms(run: ep.Trajectory, fitted: Sequence[int]) -> Iterator[Evaluation]:
    """Of predator and prey, of which so many samples are fitted; their terms are named."""
    first, second = run.state_names
    both = f"{first}*{second}"
    library = ep.polynomial(run.names).only({first: (first, both), second: (second, both)})
    for n in fitted:
        found = ep.discover(run.window(0, n), library)
        skill = partial(ep.model.forecast_skill, found.model, run, n_fitted=n)
        yield replace(ep.evaluate(found, run.window(n - 1, run.n_samples)), forecasts=skill)


LASER = [*((k, k + 700) for k in range(0, 500, 100)), (0, 1000), (0, 1100)]
FIFTHS = [(2000 * k, 2000 * (k + 1)) for k in range(5)]
CIRCUIT = [*((k, k + 1000) for k in range(0, 1250, 250)), (0, 2000)]
FLUTTER = sorted(path.stem for path in FOLDER.glob("flutter/*.csv"))
QUARTER, SWING = (0.2, 0.225, 0.25, 0.275, 0.3), (0.24, 0.28, 0.32, 0.36, 0.4)  # held out
# Models of the parts of a record, which is cut or split at several places.
RECORDS: dict[str, Callable[[], Iterator[Evaluation]]] = {
    "laser": lambda: parts(read("laser", "I").window(*each) for each in LASER),
    "electrochemical": lambda: parts(read("electrochemical", "I").window(*k) for k in FIFTHS),
    "silverbox": lambda: parts(read("silverbox", "y", ["u"]).window(*k) for k in CIRCUIT),
    "flutter": lambda: parts(read(f"flutter/{name}", "h") for name in FLUTTER),
    "grows": lambda: parts([read("hallthruster_landmark_3", "I_d")], QUARTER),
    "decays": lambda: parts([read("hallthruster_landmark_2", "I_d")], QUARTER),
    "pendulum": lambda: parts([ep.data.pendulum_swing()], SWING),
    "friction": lambda: parts([ep.data.pendulum_swing()], SWING, DRY_FRICTION),
    "hares": lambda: named_terms(ep.data.hare_lynx(), range(12, 17)),
    "gause": lambda: named_terms(ep.data.gause(), range(10, 15)),
}


@cache
def models(name: str) -> Sequence[Evaluation]:
    return tuple(RECORDS[name]())


def show(name: str) -> None:
    """Errors over the parts of a record, and what the headings say."""
    print(f"\n{name}")
    skills = [free.forecast for free in models(name) if free.forecast is not None]
    for free, skill in zip(models(name), skills, strict=True):
        n_terms = sum(len(free.model.terms(state)) for state in free.model.states)
        print(f"  {n_terms} terms; bands of 90 % hold {skill.coverage_90:.0%}: {free.heading}")
    for ahead in AHEAD:
        in_s = [(each, ahead * each.unit_s) for each in skills]
        near = [each.at(h_s) for each, h_s in in_s if h_s < 1.02 * each.horizons_s[-1]]
        if not near:
            break
        words = (f"{who} {each.median():.2g} ({each.min():.2g} to {each.max():.2g})"
                 for who, each in pd.DataFrame(near).items())  # fmt: skip
        print(f"  {ahead:g} periods ahead, {len(near)} of {len(skills)}: {', '.join(words)}")
    said = [next(words for words in SAID if words in free.heading) for free in models(name)]
    for counts in (Counter(said), Counter(str(free.status) for free in models(name))):
        print("  " + ", ".join(f"{words or 'else'} {n}" for words, n in counts.items()), flush=True)


def headings() -> None:
    """Whether headings of all records hold at two hundred starts."""
    rows = [(contradiction(free), name, free.heading) for name in RECORDS for free in models(name)]
    for row in filter(lambda each: each[0], rows):
        print(": ".join(row))
    counts = Counter(wrong for wrong, *_ in rows)
    print(
        f"{len(rows)} headings, {counts['false praise']} false praises, {counts['denial']} denials"
    )


def contradiction(free: Evaluation) -> str:
    """What more starts and another autoregression say against a heading; empty if nothing.

    False praise: the mean square error over the claimed horizons is not below the rivals'. Denial:
    at over half of the horizons the error is a tenth or more below theirs and that of the mean.
    """
    skill: Any = free.forecast
    forecasts: Any = free.forecasts
    dense, run, n = forecasts(starts=DENSE), forecasts.args[1], forecasts.keywords["n_fitted"]
    own, rival = dense.nrmse["model"], dense.nrmse[dense.rival]
    if not dense.resampled:
        rival = np.minimum(rival, linear_errors(run, n, dense.horizons_s))
    if skill.text in free.heading and (span := skill.better or skill.nearer):
        part = slice(span[0], span[1] + 1)
        return "false praise" if np.mean(own[part] ** 2 - rival[part] ** 2) >= 0.0 else ""
    gains = own < GAIN * np.minimum(rival, 1.0)
    return "denial" if "no " in free.heading and 2 * gains.sum() > len(gains) else ""


def linear_errors(run: ep.Trajectory, n_fitted: int, horizons_s: np.ndarray) -> np.ndarray:
    """Errors of a linear autoregression by least squares, its order by AIC, by horizon."""
    z, m = np.hstack([run.states, run.inputs]), run.states.shape[1]
    ends = np.rint(horizons_s / run.dt_s).astype(int)
    std, rest = z[:n_fitted].std(axis=0), z[n_fitted:, :m].std(axis=0)
    z = (z - z[:n_fitted].mean(axis=0)) / std
    lags = [p for p in LAGS if p == 1 or 8 * p * z.shape[1] < n_fitted]

    def row(w: np.ndarray, p: int) -> np.ndarray:  # inputs are known ahead
        return np.hstack([np.ones((len(w), 1)), w[:, :p].reshape(len(w), -1), w[:, p, m:]])

    fits, truth = [], z[lags[-1] : n_fitted, :m]
    for p in lags:
        rows = row(np.array([z[k - p : k + 1] for k in range(lags[-1], n_fitted)]), p)
        coef, *_ = np.linalg.lstsq(rows, truth)
        left = np.square(truth - rows @ coef).mean(axis=0)
        fits.append((len(rows) * np.log(left + 1e-20).sum() + 2 * coef.size, p, coef))
    _, p, coef = min(fits, key=lambda fit: fit[0])
    starts = np.unique(np.linspace(max(n_fitted, p), len(z) - ends[-1], DENSE).astype(int))
    ahead = np.array([z[k - p : k + ends[-1]] for k in starts])
    truth = ahead[:, p:, :m].copy()
    for j in range(ends[-1]):
        ahead[:, p + j, :m] = np.clip(row(ahead[:, j:], p) @ coef, -1e3, 1e3)
    off = np.square((ahead[:, p:, :m] - truth) * std[:m] / rest).mean(axis=(0, 2))
    bins = np.searchsorted(ends, np.arange(1, ends[-1] + 1))
    return np.asarray(np.sqrt(np.bincount(bins, off) / np.bincount(bins)))


def intervals_hold(model: ep.SparseModel, law: Mapping[str, Any]) -> list[bool] | None:
    """Which intervals hold the law's coefficients; None if the terms are not the law's."""
    if any(set(model.terms(state)) != set(law[state]) for state in law):
        return None
    pairs = [(law[s][term], ends) for s in law for term, ends in model.intervals(s).items()]
    return [low <= value <= high for value, (low, high) in pairs if low < high]  # not known ones


def process_noise() -> None:
    """Laws whose states have process noise: supports that are right, intervals that hold."""
    for system in (ep.systems.van_der_pol(), ep.lorenz()):
        truth, right, inside = system.model, 0, list[bool]()
        library = ep.polynomial(truth.states, degree=int(truth.library.degrees.max()))
        for seed in range(N_MOVED):
            found = ep.discover(moved(system, PROCESS_NOISE, seed), library)
            held = intervals_hold(found.model, {s: truth.terms(s) for s in truth.states})
            if held is not None and not found.lack_of_fit:
                right, inside = right + 1, inside + held
        print(f"{system.name}, process noise of {PROCESS_NOISE:.0%} of RMS in a period: {right} of "
              f"{N_MOVED} right, {sum(inside)} of {len(inside)} intervals hold")  # fmt: skip


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


# Laws as one measured state shows them, by x' = v or x' = x*g: what is not known of them.
LORENZ_OF_X = {
    "v": {"v": -11.0, "x*h": 1.0},
    "h": {"1": 720.0, "h": -8.0 / 3.0, "x^2": -10.0, "x*v": -1.0},
}
PREY = {"g": {"1": 2.0 / 9.0, "x": -2.0 / 3.0, "g": -1.0 / 3.0, "x*g": 1.0}}
PREDATORS = {"g": {"1": 2.0 / 9.0, "y": -1.0 / 3.0, "g": 2.0 / 3.0, "y*g": -1.0}}
SHOWN_LAWS: dict[str, tuple[ep.systems.System, str, dict[str, dict[str, float]]]] = {
    "x of Lorenz": (ep.lorenz(), "x", LORENZ_OF_X),
    "prey of Lotka-Volterra": (ep.lotka_volterra(), "x", PREY),
    "predators of Lotka-Volterra": (ep.lotka_volterra(), "y", PREDATORS),
}


def hidden() -> None:
    """One measured state, the others hidden: laws found, and forecasts over the next cycles."""
    for words, (system, name, law) in SHOWN_LAWS.items():
        right, nearer, inside, held, cpu_s = 0, 0, list[bool](), [], []
        n = round(system.duration_s * system.rate_Hz)
        longer = replace(system, duration_s=1.6 * system.duration_s)
        for seed in range(N_DRAWS):
            full = longer.trajectory(noise=0.05, rng=seed)
            run = ep.Trajectory(full.t, full.columns([name]), [name])
            begin_s = time.process_time()
            found = ep.discover(run.window(0, n), hidden=list(law))
            cpu_s.append(time.process_time() - begin_s)
            if (intervals := intervals_hold(found.model, law)) is not None:
                right, inside = right + 1, inside + intervals
            ahead_s = N_CYCLES / crossing_frequency(run.t, run.states[:, 0])
            skill = ep.model.forecast_skill(found.model, run, n_fitted=n, horizon_s=ahead_s)
            nearer += bool(np.mean(skill.nrmse["model"]) < np.mean(skill.nrmse["autoregression"]))
            held.append(skill.coverage_90)
        print(f"{words}, 5 % noise: law right in {right} of {N_DRAWS}, {sum(inside)} of "
              f"{len(inside)} intervals hold; nearer than the autoregression over {N_CYCLES} "
              f"cycles in {nearer}, bands of 90 % hold {np.mean(held):.1%} ({min(held):.0%} to "
              f"{max(held):.0%}); a search takes {np.median(cpu_s):.2g} CPU-s")  # fmt: skip
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
                value, low, high = one_signal.fit_offset(signal, 2, ep.TrajectorySearch())
            except ValueError:
                continue
            errors.append(abs(value / x.mean() - 1.0))
            held += low < x.mean() < high
        print(
            f"mean of {name}, {noise:.0%} noise: found in {len(errors)} of {N_DRAWS}, off by "
            f"{np.median(errors):.2%} ({max(errors):.2%} at most), {held} intervals hold"
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
    print(f"{voltage:g} V, {flow:g} mg/s: {free.status}, frequency off by {free.f_error:.2%}, "
          f"correlation of the hidden state with n_n {alike:.3f}; "
          f"{'a lack of fit' if found.lack_of_fit else 'fits'}: {found.model.text()}")  # fmt: skip


TABLES: dict[str, Callable[[], None]] = {name: partial(show, name) for name in RECORDS}
TABLES |= {each.__name__: each for each in (headings, process_noise, hidden, offset)}


if __name__ == "__main__":
    for name in sys.argv[1:] or TABLES:
        TABLES[name]()
