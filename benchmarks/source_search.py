"""Search for a transport profile with the measured ion speeds, current and thrust of an SPT-100.

    python -m benchmarks.source_search --n 200 --out DIR          # continues from DIR/sets.csv
    python -m benchmarks.source_search --n 200 --out DIR --hold conduction=2.3 --hold drift=0
    python -m benchmarks.source_search front DIR

Differential evolution (Storn & Price 1997) over the numbers of `BOUNDS`. It begins about the set
`thruster=lif`; every set tried is a row of the file, and the best rows are the next population. A
set is assessed run by run, the telling ones first, and given up once it costs more than the one
that it would replace; what was not run is left empty. `front` prints the sets that no other one
beats.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

import ep2sindy as ep
from benchmarks.source import (
    LIF_POINT,
    LIF_SPEED,
    NEAR_KM_S,
    PERFORMANCE,
    measured_sets,
    speed_misses_km_s,
)

# Least and largest value. The barrier stands `center` mm from the exit at 300 V and moves by
# `drift` mm per 100 V; c rises towards anode and plume over `inward` and `outward` mm, from
# `barrier` to `anode` and `plume`, all three as 1/c.
BOUNDS: Mapping[str, tuple[float, float]] = {
    "center": (-8.0, 8.0), "inward": (2.0, 20.0), "outward": (2.0, 25.0), "drift": (-3.0, 3.0),
    "barrier": (60.0, 2000.0), "anode": (8.0, 300.0), "plume": (8.0, 150.0),
    "electron_scale": (0.3, 1.4), "ion_scale": (0.3, 1.2), "plume_power": (0.0, 1.2),
    "u_n": (150.0, 400.0), "resistance": (0.0, 2.0), "conduction": (2.0, 9.0),
}  # fmt: skip
LOGARITHMIC = ("barrier", "anode", "plume")
# Places within 2 km/s, rms miss of the speeds; largest misses of current and thrust over what is
# allowed; largest deviation of the current over its mean; largest differences in frequency between
# starts, between N = 100 and 200 at the first two points of FINE, and at all of them.
MEASURES = (
    "cost", "places", "miss_km_s", "current", "thrust", "f_kHz", "varies", "starts", "grid",
    "grid_all", "runs",
)  # fmt: skip
COLUMNS = [*BOUNDS, *MEASURES]
POPULATION, SPREAD = 12, 0.04  # SPREAD: of the first population, as a fraction of the bounds
N_RUNS, FIRST_LIMIT = 11, 100.0  # of a set; cost of a member of the first population
DURATION = {"warm_up_s": 1.5e-3, "duration_s": 2e-3}
FREQUENCY_KHZ = (15.0, 20.0)
QUIET, LOUD = 0.3, 0.7  # deviation of the current over its mean
SAME = 0.01  # of the frequency, between grids and between starts
COARSE = (LIF_POINT, (201.0, 5.05), (300.0, 4.17), (250.0, 5.11), (201.0, 4.10), (400.0, 5.0))
FINE = (LIF_POINT, (201.0, 5.05), (300.0, 4.17), (400.0, 5.0))
KNOWN = PERFORMANCE | {LIF_POINT: PERFORMANCE[300.0, 5.13]}  # 0.6 % off in flow
Numbers = Measures = dict[str, float]
Point = tuple[float, float]  # V, mg/s


def thruster_of(numbers: Mapping[str, float], voltage: float) -> ep.thruster.Thruster:
    base = measured_sets()["lif"][0]
    center = numbers["center"] + numbers["drift"] * (voltage - 300.0) / 100.0
    places = (center - numbers["inward"], center, center + numbers["outward"])
    return replace(
        base,
        transport=ep.thruster.MultiLogTransport(
            [1e-3 * place for place in places],
            [1.0 / numbers[name] for name in ("anode", "barrier", "plume")],
        ),
        wall=replace(
            base.wall,
            **{name: numbers[name] for name in ("electron_scale", "ion_scale", "plume_power")},
        ),
        conduction_factor=numbers["conduction"],
        series_resistance=numbers["resistance"],
    )


def numbers_of(thruster: ep.thruster.Thruster, u_n: float) -> Numbers:
    left, center, right = 1e3 * np.array(thruster.transport.distance)
    anode, barrier, plume = 1.0 / np.array(thruster.transport.c)
    wall = thruster.wall
    return {
        "center": center, "inward": center - left, "outward": right - center, "drift": 0.0,
        "barrier": barrier, "anode": anode, "plume": plume,
        "electron_scale": wall.electron_scale, "ion_scale": wall.ion_scale,
        "plume_power": wall.plume_power, "u_n": u_n, "resistance": thruster.series_resistance,
        "conduction": thruster.conduction_factor,
    }  # fmt: skip


def run(numbers: Numbers, point: Point, **how: object) -> xr.Dataset:
    operating_point = ep.thruster.OperatingPoint(*point, neutral_speed=numbers["u_n"])
    thruster = thruster_of(numbers, operating_point.voltage)
    return ep.thruster.simulate(thruster, operating_point, progress=False, **DURATION, **how)


def square(miss: float) -> float:
    """Of a miss in units of what is allowed; one that is not known, as of a steady run, is four."""
    return 16.0 if math.isnan(miss) else min(miss**2, 36.0)


def variation(run: xr.Dataset) -> float:
    return run.attrs["I_d_std"] / run.attrs["I_d_mean"]


def frequency_gap(one: xr.Dataset, other: xr.Dataset) -> float:
    """Relative; NaN if either is steady."""
    return abs(other.attrs["f_kHz"] / one.attrs["f_kHz"] - 1.0)


def cycle_cost(run: xr.Dataset) -> float:
    """Nothing for one breathing cycle whose current varies moderately."""
    f_kHz, varies, (low, high) = run.attrs["f_kHz"], variation(run), FREQUENCY_KHZ
    if run.attrs["status"] in ("diverged", "out"):
        return math.inf
    if run.attrs["status"] != "oscillating":
        return 16.0 + 16.0 * max(1.0 - varies / QUIET, 0.0)
    size = max(QUIET - varies, varies - LOUD, 0.0) / 0.2
    return square(max(low - f_kHz, f_kHz - high, 0.0)) + square(size)


def keep_largest(found: Measures, **misses: float) -> None:
    for name, miss in misses.items():
        found[name] = float(np.maximum(found.get(name, 0.0), abs(miss)))  # NaN stays


def performance_cost(run: xr.Dataset, point: Point, found: Measures) -> float:
    """Of current and thrust, in units of what is allowed."""
    known_A, thrusts = KNOWN[point]
    current = (run.attrs["I_d_mean"] / known_A - 1.0) / (0.15 if point[0] < 250.0 else 0.08)
    thrust = (1e3 * run.attrs["thrust_N"] / np.mean(thrusts) - 1.0) / 0.12
    keep_largest(found, current=current, thrust=thrust)
    return square(current) + square(thrust)


def speed_cost(run: xr.Dataset, found: Measures) -> float:
    off = speed_misses_km_s(run)
    found["places"] = float((off <= NEAR_KM_S).sum())
    found["miss_km_s"] = float(np.sqrt(np.mean(off**2)))
    found["f_kHz"] = run.attrs["f_kHz"]
    return sum(map(square, off / NEAR_KM_S))


def grid_cost(coarse: xr.Dataset, fine: xr.Dataset, point: Point, found: Measures) -> float:
    gap = frequency_gap(coarse, fine)
    keep_largest(found, grid_all=gap, **({"grid": gap} if point in FINE[:2] else {}))
    return square(gap / SAME) + square((variation(fine) / variation(coarse) - 1.0) / 0.1)


def costs(numbers: Numbers, found: Measures) -> Iterator[float]:
    """What each run adds to the cost; fills in the measures on the way."""
    coarse = {}
    for point in COARSE:
        coarse[point] = run(numbers, point)
        keep_largest(found, varies=variation(coarse[point]))
        cost = cycle_cost(coarse[point])
        cost += speed_cost(coarse[point], found) if point == LIF_POINT else 0.0
        cost += performance_cost(coarse[point], point, found) if point in KNOWN else 0.0
        yield cost
    soft = run(numbers, LIF_POINT, initial=ep.thruster.SoftStart())
    found["starts"] = frequency_gap(coarse[LIF_POINT], soft)
    yield square(found["starts"] / SAME)
    for point in FINE:
        yield grid_cost(coarse[point], run(numbers, point, n_cells=200), point, found)


def assess(numbers: Numbers, limit: float) -> Measures:
    """Measures of a set, given up where its cost passes the limit."""
    found: Measures = {"cost": 0.0, "runs": 0.0}
    for cost in costs(numbers, found):
        found["cost"] += cost
        found["runs"] += 1.0
        if found["cost"] > limit:
            break
    return found


def read_sets(folder: Path) -> pd.DataFrame:
    path = folder / "sets.csv"
    return pd.read_csv(path) if path.exists() else pd.DataFrame(columns=COLUMNS, dtype=float)


def append(folder: Path, row: Mapping[str, float]) -> None:
    path = folder / "sets.csv"
    pd.DataFrame([row], columns=COLUMNS).to_csv(
        path, mode="a", header=not path.exists(), index=False, float_format="%.6g"
    )


def to_unit(numbers: Mapping[str, float]) -> np.ndarray:
    """Each number as its fraction of the way between its bounds, in the logarithm for 1/c."""
    return np.array([
        np.log(numbers[k] / low) / np.log(high / low) if k in LOGARITHMIC
        else (numbers[k] - low) / (high - low) for k, (low, high) in BOUNDS.items()
    ])  # fmt: skip


def from_unit(fractions: np.ndarray) -> Numbers:
    return {
        k: float(low * (high / low) ** x if k in LOGARITHMIC else low + (high - low) * x)
        for x, (k, (low, high)) in zip(np.clip(fractions, 0.0, 1.0), BOUNDS.items(), strict=True)
    }


def trial(population: np.ndarray, k: int, rng: np.random.Generator) -> np.ndarray:
    """Member k, moved towards one of the best quarter and along the difference of two others."""
    best = population[rng.integers(len(population) // 4)]
    a, b = population[rng.choice(len(population), 2, replace=False)]
    moved = population[k] + rng.uniform(0.4, 0.9) * (best - population[k] + a - b)
    crossed = rng.random(moved.size) < rng.uniform(0.4, 1.0)
    crossed[rng.integers(moved.size)] = True
    return np.where(crossed, moved, population[k])


def search(folder: Path, n: int, held: Mapping[str, float], limit_s: float) -> None:
    """Try n sets, or as many as fit into limit_s, next to those of the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    first, began = to_unit(numbers_of(measured_sets()["lif"][0], LIF_SPEED)), time.monotonic()
    for _ in range(n):
        sets = read_sets(folder)
        rng = np.random.default_rng(len(sets))
        best = complete(sets).nsmallest(POPULATION, "cost")
        if len(best) < POPULATION:
            fractions = first + (SPREAD * rng.normal(size=first.size) if len(sets) else 0.0)
            limit = FIRST_LIMIT
        else:
            k = int(rng.integers(POPULATION))
            fractions = trial(np.array([to_unit(row) for _, row in best.iterrows()]), k, rng)
            limit = best["cost"].iloc[k]
        numbers = from_unit(fractions) | dict(held)
        append(folder, numbers | assess(numbers, limit))
        if time.monotonic() - began > limit_s:
            break
    print_front(folder)


def complete(sets: pd.DataFrame) -> pd.DataFrame:
    return sets[sets["runs"] == N_RUNS]


def print_front(folder: Path) -> None:
    """Sets that none beats in speeds, in agreement of the grids and in variation of the current."""
    sets = read_sets(folder)
    done = complete(sets).dropna(subset=["starts", "grid"])
    done = done[done["starts"] <= SAME].sort_values("cost")
    print(f"{len(sets)} sets tried, {len(complete(sets))} in all runs, {len(done)} have one cycle")
    goals = done[["miss_km_s", "grid", "varies"]].to_numpy()
    beaten = [((goals <= goal).all(axis=1) & (goals < goal).any(axis=1)).any() for goal in goals]
    front = done[~np.array(beaten, dtype=bool)]
    print(front[[*MEASURES, *BOUNDS]].to_string(index=False, float_format="{:.4g}".format))


def number_by_name(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    if name not in BOUNDS:
        raise argparse.ArgumentTypeError(f"a number must be one of {', '.join(BOUNDS)}, got {name}")
    return name, float(value)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("front", nargs="*", metavar="front DIR", help="print, and search nothing")
    parser.add_argument("--out", type=Path, metavar="DIR", help="of sets.csv, which is continued")
    parser.add_argument("--n", type=int, default=100, help="sets to try")
    parser.add_argument("--minutes", type=float, default=math.inf, help="at most so long")
    parser.add_argument(
        "--hold", type=number_by_name, action="append", default=[], metavar="NAME=VALUE"
    )
    given = parser.parse_args()
    match given.front, given.out:
        case ["front", folder], None:
            print_front(Path(folder))
        case [], Path() as folder:
            search(folder, given.n, dict(given.hold), 60.0 * given.minutes)
        case _:
            parser.error("give `front DIR`, or `--out DIR`")


if __name__ == "__main__":
    main()
