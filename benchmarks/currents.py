"""One law from one signal at each operating point, every point left out in turn and run freely.

    python -m benchmarks.currents
    python -m benchmarks.currents grid line --noise 0.02 --periods 2

Records of one signal: the discharge current of the package's thruster, 6 ms at twelve points (grid:
voltage and mass flow; line: voltage), with white noise in shares of its mean; and the pressure of
an oscillator of six terms at eleven powers of its heater (tube), with 1.5 % noise. States are the
signal and its rate, whose first equation is known. One search over the rows of all records finds
the best supports of the second; each is refined at every record on long windows, and the law of the
others is run freely at the point left out. The chosen one is refined over all records. A line per
support: the free runs, and how many end on a cycle that attracts, not on one set by the start.
"""

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

import ep2sindy as ep
from benchmarks.predict import DEFAULT_SPEED, line
from ep2sindy.model.free_run import FreeRun, cycle_of
from ep2sindy.operating.branch import BranchSettings, StructureCase, choose, try_structures
from ep2sindy.operating.fit import SETTINGS, LeaveOneOut, leave_one_out
from ep2sindy.operating.records import OperatingRecord
from ep2sindy.operating.shared_support import discover_shared
from ep2sindy.selection.free_run import PULL

Signals = Sequence[tuple[Mapping[str, float], ep.Trajectory]]

POINTS = {
    "grid": [{"V_D_V": v, "mdot_mg_s": m} for v, m in product((300, 320, 340, 360), (4, 4.5, 5))],
    "line": [{"V_D_V": v} for v in range(290, 401, 10)],
}
FLOW = 4.5  # of the line, in mg/s
POWERS_kW, TUBE_NOISE = np.linspace(1.0, 2.0, 11), 0.015
MIN_TERMS, MAX_TERMS, N_BEST = 4, 6, 2  # of the second equation, and supports of each size
N_WINDOWS = 10  # at every point


def currents(points: Sequence[Mapping[str, float]], noise: float) -> Signals:
    rng, found = np.random.default_rng(0), []
    for point in points:
        flow = float(point.get("mdot_mg_s", FLOW))
        at = ep.thruster.OperatingPoint(float(point["V_D_V"]), flow, neutral_speed=DEFAULT_SPEED)
        field = ep.thruster.simulate(
            ep.thruster.Thruster(), at, cache=True, duration_s=6e-3, progress=False
        )
        x = field["I_d"].values
        x = x + noise * x.mean() * rng.standard_normal(len(x))
        run = ep.Trajectory(field["time"].values, x[:, None], ("I_d",), units={"I_d": "A"})
        found.append((point, run))
    return found


def tube() -> Signals:
    """A pressure p, in units of its own, with t in ms: 180 to 230 Hz, sixty periods."""
    library, rng, found = ep.polynomial(["p", "v"], degree=3), np.random.default_rng(0), []
    for power in POWERS_kW:
        w, more = 2.0 * np.pi * 0.18 * (1.0 + 0.06 * (power - 1.0)), power - 1.0
        second = {
            "p": -(w**2), "v": w * (0.15 + 0.25 * more), "p^2": 0.12 * w**2 * (1.0 + 0.3 * more),
            "p*v": -0.1 * w * power, "p^2*v": -0.35 * w * (1.0 + 0.2 * more**2),
            "p^3": -0.1 * w**2 * power,
        }  # fmt: skip
        coef = ep.coef_matrix(library, [{"v": 1.0}, second])
        model = ep.SparseModel(library, ["p", "v"], coef)
        x = model.simulate(np.arange(4200) / 10.8, [0.5, 0.0]).states[600:, 0]
        x = x + TUBE_NOISE * x.std() * rng.standard_normal(len(x))
        run = ep.Trajectory(np.arange(len(x)) / 10.8e3, x[:, None], ("p",))
        found.append(({"P_kW": float(power)}, run))
    return found


def attracting(run: FreeRun) -> bool:
    cycle = cycle_of(run)
    return cycle is not None and cycle.largest_multiplier < PULL


def tell(name: str, left_out: Sequence[LeaveOneOut]) -> None:
    runs = [each.run for each in left_out]
    print(f"{line(name, runs)}; attract {sum(map(attracting, runs))}", flush=True)


def measure(signals: Signals, *, periods: float) -> None:
    states = ep.signals.embed([ep.signals.prepare_signal(run) for _, run in signals])
    records = [
        OperatingRecord.of(parameters, each.run)
        for (parameters, _), each in zip(signals, states, strict=True)
    ]
    (searched,), told = states[0].searched, states[0].relations
    library = ep.polynomial(records[0].run.state_names, degree=3)
    search = ep.BestSubset(MAX_TERMS, n_best=N_BEST)
    method = ep.Regression(ep.Differential(), search, depth=N_BEST)
    front = discover_shared({each.label: [each.run] for each in records}, library, method).fronts
    cases = [
        StructureCase(library, {**states[0].terms, searched: support}, told)
        for support in front[searched].supports
        if len(support) >= MIN_TERMS
    ]
    settings = replace(SETTINGS, periods=periods, n_windows=N_WINDOWS)
    how = BranchSettings(library, cases, MAX_TERMS, [2], settings, n_map=0, seed=0)
    trials = try_structures(records, cases, how)
    for trial in trials:
        tell(f"  {', '.join(trial.case.structure[searched])}", trial.left_out)
    chosen = choose(trials)
    functions = chosen.fit.functions(chosen.degree)
    law, found = chosen.fit.refine_law(functions)
    tell(f"chosen and refined: {found.status}", leave_one_out(chosen.fit, functions, start=law))
    print(law.model_at(records[len(records) // 2].parameters).text())


def main() -> None:
    parser = argparse.ArgumentParser(description="one law from one signal at each operating point")
    parser.add_argument("sets", nargs="*", default=["grid", "line", "tube"])
    parser.add_argument("--noise", type=float, default=0.0, help="of the currents, in their mean")
    parser.add_argument("--periods", type=float, default=8.0, help="of a window")
    arguments = parser.parse_args()
    for name in arguments.sets:
        known = tube() if name == "tube" else currents(POINTS[name], arguments.noise)
        start = time.process_time()
        measure(known, periods=arguments.periods)
        print(f"{name}: {time.process_time() - start:.0f} CPU-s", flush=True)


if __name__ == "__main__":
    main()
