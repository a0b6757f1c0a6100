"""Driven systems: `python -m benchmarks.driven discharge records`.

`records`: one signal of four driven systems with its input beside it, held (tank), linear (probe)
or smooth (pendulum, Duffing). Counted are laws that have the right terms, forecasts better than an
autoregression that knows the input too, and questions where nobody named the column.

`discharge`: the supply's voltage is modulated by 5 % at half and at twice the breathing frequency.
The search is given both records, averaged over the channel, with the voltage as an input and
without. Each quarter of the records is held out in turn, and the model of the others follows it
from its first sample.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import numpy as np

import ep2sindy as ep
from ep2sindy.forecasting.evaluation import evaluate
from ep2sindy.signals.driving import ask_whether_driven
from ep2sindy.signals.trace import prepare_signal

POINT = ep.thruster.OPERATING_POINTS[3]  # 300 V, 5 mg/s
BREATHING_HZ = 19.15e3
SHARE = 0.05
N_PARTS = 4
STATES = ("n_i", "n_n")


def driven(frequency_Hz: float, *, duration_s: float = 6e-3) -> ep.Trajectory:
    """Channel averages of a discharge whose voltage is modulated, the voltage as an input."""
    supply = ep.thruster.ModulatedVoltage(SHARE, frequency_Hz)
    thruster, point = ep.thruster.Thruster(), replace(POINT, supply=supply)
    field = ep.thruster.simulate(thruster, point, duration_s=duration_s, cache=True, progress=False)
    inside = field.sel(z=slice(0.0, thruster.channel_length))
    weight = inside["dz"] / inside["dz"].sum()
    states = [(inside[name] * weight).sum("z").values.astype(float) for name in STATES]
    voltage = field["V_supply"].values[:, None]
    return ep.Trajectory(field["time"].values, np.column_stack(states), STATES, voltage, ["V"])


def without(run: ep.Trajectory, quarter: int) -> tuple[list[ep.Trajectory], ep.Trajectory]:
    """The parts of a record before and after one of its quarters, and that quarter."""
    edges = [run.n_samples * k // N_PARTS for k in range(N_PARTS + 1)]
    begin, end = edges[quarter : quarter + 2]
    parts = [(0, begin), (end, run.n_samples)]
    return [run.window(a, b) for a, b in parts if a < b], run.window(begin, end)


def discharge() -> None:
    runs = {text: driven(factor * BREATHING_HZ) for text, factor in (("half", 0.5), ("twice", 2.0))}
    for variables in ((*STATES, "V"), STATES):
        for quarter in range(N_PARTS):
            parts = {text: without(run, quarter) for text, run in runs.items()}
            fitted = [part for kept, _ in parts.values() for part in kept]
            library = ep.polynomial(list(variables), degree=2)
            model = ep.discover(fitted, library, seed=0).model
            print(f"{', '.join(variables)}, quarter {quarter + 1} held out:")
            for text, (_, held) in parts.items():
                found = evaluate(model, held)
                print(
                    f"  {text} the breathing frequency: {found.text}, nrmse {found.nrmse:.3f}, "
                    f"frequency {100.0 * found.f_error:+.2f} %, amplitude of n_i "
                    f"{found.amplitude_ratio['n_i']:.3f}",
                    flush=True,
                )


N_RECORDS, N_PERIODS, PER_PERIOD, FITTED, N_STARTS = 20, 40, 50, 0.75, 10
TURN = 2.0 * np.pi


@dataclass(frozen=True)
class Case:
    """A driven system whose first state alone is seen, x' = v if there is a second.

    terms: of its last equation. functions, degree: of the library. wave: the input at times in
    periods; levels that are held come from the generator.
    """

    terms: dict[str, float]
    period_s: float
    start: tuple[float, ...]
    wave: Callable[[np.ndarray, np.random.Generator], np.ndarray]
    course: str
    degree: int = 1
    functions: Sequence[str] = ()

    def record(self, noise: float, seed: int) -> ep.Trajectory:
        rng = np.random.default_rng(seed)
        states = ["x", "v"][: len(self.start)]
        library = ep.polynomial([*states, "u"], degree=3, functions=list(self.functions))
        terms = [*[{"v": 1.0}] * (len(states) - 1), self.terms]
        law = ep.SparseModel(library, states, ep.model.coef_matrix(library, terms))
        turns = np.arange(N_PERIODS * PER_PERIOD + 1) / PER_PERIOD
        t, u = self.period_s * turns, self.wave(turns, rng)
        law = replace(law, courses={"u": self.course})
        start = np.array(self.start) * rng.uniform(0.5, 1.5, len(states))
        x = law.simulate(t, start, {"u": u}).states[:, :1]
        x = x + noise * x.std() * rng.standard_normal(x.shape)
        return ep.Trajectory(t, x, ["x"], u[:, None], ["u"])


def cosine(turns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return np.cos(TURN * turns)


def triangle(turns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return 1.0 - 4.0 * np.abs(turns % 1.0 - 0.5)


def levels(turns: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    return rng.uniform(0.5, 2.0, 2 * N_PERIODS + 1)[np.floor(2.0 * turns + 1e-9).astype(int)]


CASES = {
    "pendulum": Case(
        {"sin(x)": -1.0, "v": -0.3, "u": 0.6}, 8.137, (0.5, 0.2), cosine, "smooth",
        functions=["sin(x)"],
    ),
    "Duffing": Case(
        {"x": 1.0, "x^3": -1.0, "v": -0.3, "u": 0.5}, 5.317, (0.5, 0.2), cosine, "smooth", degree=3
    ),
    "tank": Case(
        {"u": 1.0, "sqrt(x)": -1.0}, 10.0, (1.0,), levels, "held", functions=["sqrt(x)"]
    ),
    "probe": Case(
        {"1": 5e3, "x": -1e4, "u": 1e4, "u^2": 6e3}, 2e-3, (0.2,), triangle, "linear", degree=2
    ),
}  # fmt: skip


def records() -> None:
    for (name, case), noise in product(CASES.items(), (0.02, 0.1)):
        right = better = asked = 0
        for seed in range(N_RECORDS):
            run = case.record(noise, seed)
            bare = prepare_signal(replace(run, inputs=np.empty((0, 0)), input_names=()))
            asked += ask_whether_driven(bare, {"u": (run.t, run.inputs[:, 0])}) is not None
            made = ep.embed(run, "hidden", n_states=len(case.start))
            states, n = made.run, round(FITTED * made.run.n_samples)
            library = made.library(case.degree, case.functions)
            model = ep.discover(states.window(0, n), library, hidden=made.hidden).model
            right += set(model.terms(model.states[-1])) == set(case.terms)
            skill = ep.model.forecast_skill(model, states, n_fitted=n, starts=N_STARTS)
            better += skill.at(case.period_s)["model"] < skill.at(case.period_s)["autoregression"]
        print(
            f"{name}, {100 * noise:.0f} % noise: {right} of {N_RECORDS} laws right, {better} "
            f"better than an autoregression a period ahead, {asked} asked about",
            flush=True,
        )


def main() -> None:
    for name in sys.argv[1:] or ["discharge"]:
        {"discharge": discharge, "records": records}[name]()


if __name__ == "__main__":
    main()
