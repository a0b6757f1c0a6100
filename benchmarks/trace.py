"""Self-sustained models from the discharge current alone: clean, and as a scope has it.

    python -m benchmarks.trace
    python -m benchmarks.trace --seeds 1 --points 300/5

The simulator's current at four operating points, the method of +exp=trace; three quarters are
fitted, the rest is run freely from one sample and compared with the current itself, without noise.
Noise: white, 2 % of the mean current, then 8 bits over the range. A row per point, record and
seed, of the noise and of the windows that are drawn: frequency error, amplitude and waveform of
the current, terms of the searched equation (the known one has one more), and the fraction of starts
that reach the cycle.
"""

import argparse

import numpy as np
import pandas as pd

import ep2sindy as ep
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import Regression
from ep2sindy.forecasting.evaluation import evaluate
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.searches import BestSubset
from ep2sindy.selection.free_run import FreeRunScore
from ep2sindy.signals.signal import prepare_signal

POINTS = ("300/4", "300/5", "300/6", "400/5")
NAME, NOISE, BITS = "I_d", 0.02, 8


def current(point: str) -> Trajectory:
    """The simulator's, as +exp=trace takes it."""
    voltage, mass_flow = map(float, point.split("/"))
    field = ep.thruster.simulate(
        ep.thruster.Thruster(),
        ep.thruster.OperatingPoint(voltage, mass_flow),
        cache=True,
    )
    return Trajectory(field["time"].values, field[NAME].values[:, None], (NAME,), units={NAME: "A"})


def as_measured(run: Trajectory, seed: int) -> Trajectory:
    """White noise of 2 % of the mean, then steps of an 8-bit scope over the range and a tenth."""
    x = run.states[:, 0]
    noisy = x + NOISE * x.mean() * np.random.default_rng(seed).standard_normal(len(x))
    step = 1.1 * (noisy.max() - min(noisy.min(), 0.0)) / 2**BITS
    return Trajectory(run.t, (step * np.round(noisy / step))[:, None], (NAME,), units=run.units)


def row(clean: Trajectory, measured: Trajectory, seed: int) -> dict[str, object]:
    signal = prepare_signal(measured)
    n = round(0.75 * measured.n_samples)
    chosen = ep.embed(signal.window(0, n))
    states = chosen.along(signal.run)  # starts of other runs, and figures
    bounds = ep.model.FreeRunBounds(frequency=0.005, amplitude=0.05)
    rule = FreeRunScore(bounds=bounds, n_windows=40, assessed=(NAME,), n_starts=8, seed=seed)
    search = BestSubset(max_terms=5, n_best=8)
    method = Regression(search=search, selection=rule, bootstraps=Bootstraps(n=0), depth=8)
    model = discover(chosen.run, chosen.library(degree=3), method).model
    record = np.column_stack([clean.states[:, 0], states.states[:, 1]])
    held = Trajectory(states.t, record, states.state_names).window(n, states.n_samples)
    run = evaluate(model, held, initial=states.states[n], assessed=(NAME,))
    return {
        "status": run.text,
        "f error, %": 100.0 * run.f_error,
        "amplitude": run.amplitude_ratio[NAME],
        "waveform": run.waveform_error[NAME],
        "terms": len(model.terms("g")),
        "reaching": ep.model.basin_stability(model, run.cycle) if run.cycle else float("nan"),
        "g'": ", ".join(model.terms("g")),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description="self-sustained models from one signal")
    parser.add_argument("--points", nargs="+", default=POINTS, help="V/mg/s, such as 300/5")
    parser.add_argument("--seeds", type=int, default=3, help="draws of noise and of windows")
    arguments = parser.parse_args()
    rows = []
    for point in arguments.points:
        clean = current(point)
        for seed in range(arguments.seeds):
            for record, run in {"clean": clean, "scope": as_measured(clean, seed)}.items():
                labels = {"point": point, "record": record, "seed": seed}
                rows.append(labels | row(clean, run, seed))
    print(pd.DataFrame(rows).to_string(index=False, float_format=lambda x: f"{x:.3g}"))


if __name__ == "__main__":
    main()
