"""One law from one signal at each operating point, every point left out in turn and run freely.

    python -m benchmarks.currents [grid voltage flow tube] [--noise 0.02] [--periods 2]

Records of one signal: the discharge current of the package's thruster, 6 ms at twelve points, with
white noise in shares of its mean; and the pressure of an oscillator of six terms at eleven powers
of its heater (tube), with 1.5 % noise. States are the signal and its rate, whose first equation is
known. One search over the rows of all records finds the best supports of the second; each is
refined at every record on long windows, and the law of the others is run freely at the point left
out. Of laws whose cycles attract, instead of keeping the start's amplitude, one is chosen and
refined over all records. A line per support and degree of the law.
"""

import argparse
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import product

import numpy as np

import ep2sindy as ep
from benchmarks.predict import DEFAULT_SPEED, line
from ep2sindy.model.free_run import cycle_of
from ep2sindy.operating.branch import BranchSettings, StructureCase, choose, try_structures
from ep2sindy.operating.fit import SETTINGS, LeaveOneOut, leave_one_out
from ep2sindy.operating.records import OperatingRecord
from ep2sindy.operating.shared_support import discover_shared
from ep2sindy.selection.free_run import PULL

Signals = Sequence[tuple[Mapping[str, float], ep.Trajectory]]

POINTS: dict[str, list[dict[str, float]]] = {
    "grid": [{"V_D_V": v, "mdot_mg_s": m} for v, m in product((300, 320, 340, 360), (4, 4.5, 5))],
    "voltage": [{"V_D_V": v} for v in range(290, 401, 10)],
    "flow": [{"mdot_mg_s": m} for m in np.linspace(3.8, 5.45, 12).round(2).tolist()],
}
VOLTAGE, FLOW = 320.0, 4.5  # of what does not vary, in V and mg/s
POWERS_kW, TUBE_NOISE = np.linspace(1.0, 2.0, 11), 0.015
MIN_TERMS, MAX_TERMS, N_BEST = 4, 6, 2  # of the second equation, and supports of each size
N_WINDOWS, DEGREES = 10, (2, 3)  # at every point, and of the laws


def currents(points: Sequence[Mapping[str, float]], noise: float) -> Signals:
    rng, found = np.random.default_rng(0), []
    for point in points:
        at = point.get("V_D_V", VOLTAGE), point.get("mdot_mg_s", FLOW)
        field = ep.thruster.simulate(
            ep.thruster.Thruster(), ep.thruster.OperatingPoint(*at, neutral_speed=DEFAULT_SPEED),
            cache=True, duration_s=6e-3, progress=False,
        )  # fmt: skip
        x = field["I_d"].values
        x = x + noise * x.mean() * rng.standard_normal(len(x))
        run = ep.Trajectory(field["time"].values, x[:, None], ("I_d",), units={"I_d": "A"})
        found.append((point, run))
    return found


def tube() -> Signals:
    """A pressure p, in units of its own, with t in ms: 180 to 230 Hz, sixty periods."""
    library, rng, found = ep.polynomial(["p", "v"], degree=3), np.random.default_rng(0), []
    for power in POWERS_kW:
        w = 2.0 * np.pi * 0.18 * (0.94 + 0.06 * power)
        second = {
            "p": -(w**2), "v": w * (0.25 * power - 0.1), "p^2": w**2 * (0.084 + 0.036 * power),
            "p*v": -0.1 * w * power, "p^2*v": -w * (0.35 + 0.07 * (power - 1.0) ** 2),
            "p^3": -0.1 * w**2 * power,
        }  # fmt: skip
        coef = ep.coef_matrix(library, [{"v": 1.0}, second])
        model = ep.SparseModel(library, ["p", "v"], coef)
        x = model.simulate(np.arange(4200) / 10.8, [0.5, 0.0]).states[600:, 0]
        x = x + TUBE_NOISE * x.std() * rng.standard_normal(len(x))
        run = ep.Trajectory(np.arange(len(x)) / 10.8e3, x[:, None], ("p",))
        found.append(({"P_kW": float(power)}, run))
    return found


def n_attracting(left_out: Sequence[LeaveOneOut]) -> int:
    cycles = [cycle_of(each.run) for each in left_out]
    return sum(cycle is not None and cycle.largest_multiplier < PULL for cycle in cycles)


def tell(name: str, found: Sequence[LeaveOneOut]) -> None:
    print(f"{line(name, [e.run for e in found])}; attract {n_attracting(found)}", flush=True)


def measure(signals: Signals, *, periods: float) -> None:
    points, runs = zip(*signals, strict=True)
    states = ep.signals.embed([ep.signals.prepare_signal(run) for run in runs])
    records = [OperatingRecord.of(p, each.run) for p, each in zip(points, states, strict=True)]
    (searched,), told = states[0].searched, states[0].relations
    library = ep.polynomial(records[0].run.state_names, degree=3)
    method = ep.Regression(ep.Differential(), ep.BestSubset(MAX_TERMS, n_best=N_BEST), depth=N_BEST)
    front = discover_shared({each.label: [each.run] for each in records}, library, method).fronts
    cases = [
        StructureCase(library, {**states[0].terms, searched: support}, told)
        for support in front[searched].supports
        if len(support) >= MIN_TERMS
    ]
    settings = replace(SETTINGS, periods=periods, n_windows=N_WINDOWS)
    how = BranchSettings(library, cases, MAX_TERMS, DEGREES, settings, n_map=0, seed=0)
    trials = try_structures(records, cases, how)
    for trial in trials:
        tell(f"{', '.join(trial.case.structure[searched])} ({trial.degree})", trial.left_out)
    pulled = [each for each in trials if 2 * n_attracting(each.left_out) > len(records)]
    chosen = choose(pulled or trials)
    functions = chosen.fit.functions(chosen.degree)
    law, found = chosen.fit.refine_law(functions)
    tell(
        f"refined, degree {chosen.degree}: {found.status}",
        leave_one_out(chosen.fit, functions, start=law),
    )
    print(law.model_at(records[len(records) // 2].parameters).text())


def main() -> None:
    parser = argparse.ArgumentParser(description="one law from one signal at each operating point")
    parser.add_argument("sets", nargs="*", default=[*POINTS, "tube"])
    parser.add_argument("--noise", type=float, default=0.0)
    parser.add_argument("--periods", type=float, default=8.0, help="of a window")
    arguments = parser.parse_args()
    for name in arguments.sets:
        known = tube() if name == "tube" else currents(POINTS[name], arguments.noise)
        start = time.process_time()
        measure(known, periods=arguments.periods)
        print(f"{name}: {time.process_time() - start:.0f} CPU-s after simulation", flush=True)


if __name__ == "__main__":
    main()
