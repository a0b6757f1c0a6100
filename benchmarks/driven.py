"""Driven systems: `python -m benchmarks.driven records questions`.

`records`: laws of a driven pendulum, a Duffing oscillator, a tank and a probe from one signal with
10 % noise next to its input, which is held at random levels. Counted are laws of the right terms.

`questions`: whether it is asked of signals if they are driven: a probe's current at a round and
another frequency, a pendulum and a Duffing oscillator under random perturbations, and
self-sustained signals, where a question is false, their other states next to them.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

import ep2sindy as ep
from ep2sindy.signals.driving import ask_whether_driven
from ep2sindy.signals.signal import prepare_signal

N_DRAWS, N_PERIODS, PER_PERIOD, FITTED = 20, 40, 30, 0.75
TURN = 2.0 * np.pi


def triangle(turns: np.ndarray) -> np.ndarray:
    return 1.0 - 4.0 * np.abs(turns % 1.0 - 0.5)


def levels(turns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Random levels of alternating sign, each held for half a period."""
    half = np.floor(2.0 * turns + 1e-9).astype(int)
    return np.where(half % 2, -1.0, 1.0) * rng.uniform(0.4, 1.2, half[-1] + 1)[half]


@dataclass(frozen=True)
class Case:
    """A driven system whose first state alone is seen, x' = v if there is a second.

    terms: of its last equation. functions, degree: of the library. middle, size: of the input.
    """

    terms: Mapping[str, float]
    period_s: float
    start: tuple[float, ...]
    degree: int = 1
    functions: Sequence[str] = ()
    middle: float = 0.0
    size: float = 1.0

    def record(self, noise: float, seed: int) -> ep.Trajectory:
        rng = np.random.default_rng(seed)
        states = ["x", "v"][: len(self.start)]
        library = ep.polynomial([*states, "u"], degree=3, functions=list(self.functions))
        terms = [*[{"v": 1.0}] * (len(states) - 1), self.terms]
        law = ep.SparseModel(library, states, ep.model.coef_matrix(library, terms))
        turns = np.arange(N_PERIODS * PER_PERIOD + 1) / PER_PERIOD
        t, u = self.period_s * turns, self.middle + self.size * levels(turns, rng)
        start = np.array(self.start) * rng.uniform(0.5, 1.5, len(states))
        x = replace(law, courses={"u": "held"}).simulate(t, start, {"u": u}).states[:, :1]
        return ep.Trajectory(t, noisy(x, noise, rng), ["x"], u[:, None], ["u"])


def noisy(x: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    return x + noise * x.std(axis=0) * rng.standard_normal(x.shape)


CASES = {
    "pendulum": Case(
        {"sin(x)": -1.0, "v": -0.3, "u": 0.6}, 8.137, (0.5, 0.2), functions=["sin(x)"]
    ),
    "Duffing": Case({"x": 1.0, "x^3": -1.0, "v": -0.3, "u": 0.5}, 5.317, (0.5, 0.2), degree=3),
    "tank": Case(
        {"u": 1.0, "sqrt(x)": -1.0}, 9.713, (1.0,), functions=["sqrt(x)"], middle=1.25, size=0.6
    ),
    "probe": Case({"1": 5e3, "x": -1e4, "u": 1e4, "u^2": 6e3}, 2.1137e-3, (0.2,), degree=2),
}


def is_asked(run: ep.Trajectory, beside: Mapping[str, np.ndarray]) -> bool:
    """Whether the signal x of a run looks driven, with other columns next to it."""
    try:
        signal = prepare_signal(ep.Trajectory(run.t, run.columns(["x"]), ["x"]))
    except ValueError:  # no oscillation
        return False
    columns = {name: (run.t, values) for name, values in beside.items()}
    return ask_whether_driven(signal, columns) is not None


def records(noise: float = 0.1) -> None:
    """Print how often the law of a driven record is right."""
    for name, case in CASES.items():
        right = 0
        for seed in range(N_DRAWS):
            made = ep.embed(case.record(noise, seed), "hidden", n_states=len(case.start))
            past = made.run.window(0, round(FITTED * made.run.n_samples))
            library = made.library(case.degree, case.functions)
            model = ep.discover(past, library, hidden=made.hidden).model
            right += set(model.terms(model.states[-1])) == set(case.terms)
        print(f"{name}, {100 * noise:.0f} % noise: {right} of {N_DRAWS} right", flush=True)


Rates = Callable[[np.ndarray, float], Sequence[np.ndarray]]


@dataclass(frozen=True)
class Oscillator:
    """rates: of states (n_states, draws) at a time. period: about, of a cycle, in its own time."""

    rates: Rates
    start: tuple[float, ...]
    period: float
    is_positive: bool = False

    def runs(
        self, process_noise: float, noise: float, n_periods: int, seed: int
    ) -> list[ep.Trajectory]:
        """N_DRAWS noisy runs. process_noise: of every state in a period, in its deviations."""
        rng, n_fine, n_first = np.random.default_rng(seed), 12, 20 * PER_PERIOD
        h = self.period / PER_PERIOD / n_fine
        x = np.array(self.start)[:, None] * rng.uniform(0.9, 1.1, (len(self.start), N_DRAWS))
        found, size = [], np.zeros((len(self.start), 1))
        for k in range((n_first + n_periods * PER_PERIOD) * n_fine):
            if k % n_fine == 0:
                found.append(x)
            if k == n_first * n_fine // 2:
                size = process_noise * np.std(found[len(found) // 2 :], axis=(0, 2))[:, None]
            half = x + 0.5 * h * np.asarray(self.rates(x, k * h))
            x = x + h * np.asarray(self.rates(half, (k + 0.5) * h))
            x = x + size * np.sqrt(h / self.period) * rng.standard_normal(x.shape)
            x = np.abs(x) if self.is_positive else x
        t = np.arange(n_periods * PER_PERIOD) * h * n_fine
        samples = np.array(found[n_first:])
        names = ["x", "y", "z"][: len(self.start)]
        return [
            ep.Trajectory(t, noisy(samples[:, :, k], noise, rng), names) for k in range(N_DRAWS)
        ]


def brusselator(x: np.ndarray, t: float) -> Sequence[np.ndarray]:
    return [1.0 + x[0] ** 2 * x[1] - 4.0 * x[0], 3.0 * x[0] - x[0] ** 2 * x[1]]


def fitzhugh_nagumo(x: np.ndarray, t: float) -> Sequence[np.ndarray]:
    return [x[0] - x[0] ** 3 / 3.0 - x[1] + 0.5, 0.08 * (x[0] + 0.7 - 0.8 * x[1])]


def van_der_pol(x: np.ndarray, t: float) -> Sequence[np.ndarray]:
    return [x[1], (1.0 - x[0] ** 2) * x[1] - x[0]]


def lorenz(x: np.ndarray, t: float) -> Sequence[np.ndarray]:
    return [10.0 * (x[1] - x[0]), x[0] * (28.0 - x[2]) - x[1], x[0] * x[1] - 8.0 / 3.0 * x[2]]


def predator_prey(x: np.ndarray, t: float) -> Sequence[np.ndarray]:
    """Rosenzweig and MacArthur's, whose predators are sated: a limit cycle."""
    eaten = x[0] * x[1] / (1.0 + x[0])
    return [x[0] * (1.0 - x[0] / 4.0) - eaten, 0.8 * eaten - 0.35 * x[1]]


SELF_SUSTAINED = {
    "Brusselator": Oscillator(brusselator, (1.0, 3.0), 7.16, is_positive=True),
    "FitzHugh-Nagumo": Oscillator(fitzhugh_nagumo, (1.0, 0.0), 39.5),
    "van der Pol": Oscillator(van_der_pol, (2.0, 0.0), 6.66),
    "Lorenz": Oscillator(lorenz, (1.0, 1.0, 20.0), 0.75),
    "predator-prey": Oscillator(predator_prey, (1.0, 1.0), 20.0, is_positive=True),
}


def pushed_pendulum(x: np.ndarray, t: float) -> Sequence[np.ndarray]:
    return [x[1], 0.6 * np.cos(TURN * t / 8.137) - 0.3 * x[1] - np.sin(x[0])]


def pushed_duffing(x: np.ndarray, t: float) -> Sequence[np.ndarray]:
    return [x[1], 0.9 * np.cos(TURN * t / 4.137) - 0.4 * x[1] - x[0] - x[0] ** 3]


DRIVEN = {
    "pendulum": Oscillator(pushed_pendulum, (0.5, 0.2), 8.137),
    "Duffing": Oscillator(pushed_duffing, (0.5, 0.2), 4.137),
}
ROUND_HZ = 500.0
PROCESS_NOISES, LENGTHS = (0.0, 0.05, 0.15), (40, 150)


def at_frequency(run: ep.Trajectory, f_Hz: float) -> ep.Trajectory:
    """The run at such a speed that the frequency of its x is as given."""
    own_Hz = prepare_signal(run, "x").frequency_Hz
    return replace(run, t=run.t * own_Hz / f_Hz)


def any_frequency(rng: np.random.Generator) -> float:
    return float(10.0 ** rng.uniform(-1.0, 4.0))


def lagging(u: np.ndarray, lag: float) -> np.ndarray:
    """What relaxes to u, samples at PER_PERIOD a period. lag: in periods."""
    x, keeps = np.empty(len(u)), np.exp(-1.0 / (PER_PERIOD * lag)) if lag else 0.0
    x[0] = u[0]
    for k in range(1, len(u)):
        x[k] = keeps * x[k - 1] + (1.0 - keeps) * u[k]
    return x


def tell(words: str, runs: Sequence[ep.Trajectory]) -> None:
    """Print how often it is asked with the other columns next to x, and without."""
    tables = [
        dict(zip(run.names, np.column_stack([run.states, run.inputs]).T, strict=True))
        for run in runs
    ]
    beside = [{name: u for name, u in table.items() if name != "x"} for table in tables]
    among = sum(is_asked(run, columns) for run, columns in zip(runs, beside, strict=True))
    print(f"{words} | {among} | {sum(is_asked(run, {}) for run in runs)}", flush=True)


def generators() -> list[np.random.Generator]:
    return [np.random.default_rng(seed) for seed in range(N_DRAWS)]


def probe(rng: np.random.Generator, lag: float, f_Hz: float, noise: float) -> ep.Trajectory:
    """The current of a probe behind its supply's triangle, whose voltage has noise of 0.3 V."""
    turns = np.arange(N_PERIODS * PER_PERIOD) / PER_PERIOD
    V = 30.0 * triangle(turns + rng.uniform()) + 0.3 * rng.standard_normal(len(turns))
    current = lagging(np.tanh((V - 5.0) / 8.0) + 0.01 * V, lag)[:, None]
    return ep.Trajectory(turns / f_Hz, noisy(current, noise, rng), ["x"], V[:, None], ["u"])


def questions() -> None:
    """Print how often it is asked of driven and of self-sustained signals."""
    print(f"driven, asked of {N_DRAWS} | column next to | none")
    for lag, round_, noise in product((0.0, 0.05), (True, False), (0.02, 0.1)):
        how = f"{'lagging' if lag else 'static'}, {'500 Hz' if round_ else 'any frequency'}"
        runs = [
            probe(rng, lag, ROUND_HZ if round_ else any_frequency(rng), noise)
            for rng in generators()
        ]
        tell(f"probe, {how}, {100 * noise:.0f} % noise", runs)
    for (name, case), process_noise, n in product(DRIVEN.items(), PROCESS_NOISES, LENGTHS):
        runs = [
            ep.Trajectory(run.t / case.period / any_frequency(rng), run.columns(["x"]), ["x"])
            for run, rng in zip(
                case.runs(process_noise, 0.02, n, seed=0), generators(), strict=True
            )
        ]
        tell(
            f"{name}, any frequency, process noise of {100 * process_noise:.0f} %, {n} periods",
            runs,
        )
    print("self-sustained, asked falsely | columns next to | none")
    for (name, case), process_noise, n in product(SELF_SUSTAINED.items(), PROCESS_NOISES, LENGTHS):
        made = case.runs(process_noise, 0.02, n, seed=0)
        for round_ in (False, True):
            runs = [
                at_frequency(run, ROUND_HZ if round_ else any_frequency(rng))
                for run, rng in zip(made, generators(), strict=True)
            ]
            how = "500 Hz" if round_ else "any frequency"
            how = f"{how}, process noise of {100 * process_noise:.0f} %"
            tell(f"{name}, {how}, {n} periods", runs)


def main() -> None:
    for name in sys.argv[1:] or ["records", "questions"]:
        {"records": records, "questions": questions}[name]()


if __name__ == "__main__":
    main()
