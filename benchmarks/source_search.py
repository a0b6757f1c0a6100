"""Search for a transport profile with the measured ion speeds, current and thrust of an SPT-100.

    python -m benchmarks.source_search --n 200 --out DIR          # goes on from DIR/sets.csv
    python -m benchmarks.source_search --n 200 --out DIR --hold conduction=2.3 --hold drift=0
    python -m benchmarks.source_search front DIR

Differential evolution (Storn & Price 1997) over the numbers of `BOUNDS`. It begins about the set
`thruster=lif`; every set tried is a row of the file, and the best rows are the next population. A
set is judged run by run, the telling ones first, and given up once it costs more than the one that
it would replace; what was not run is left empty. `front` prints the sets that no other one beats.
"""

from __future__ import annotations

import argparse
import csv
import math
import time
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr

import ep2sindy as ep
from benchmarks.source import (
    LIF,
    LIF_POINT,
    LIF_SPEED,
    NEAR_KM_S,
    PERFORMANCE,
    mean_speed_km_s,
    measured_sets,
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
MEASURES = (
    "cost", "places", "miss_km_s", "current", "thrust", "f_kHz", "std_300", "std_201", "grid_300",
    "grid_201", "starts", "runs",
)  # fmt: skip
POPULATION, SPREAD = 24, 0.08  # SPREAD: of the first population, as a share of the bounds
N_RUNS, FIRST_LIMIT = 9, 150.0  # of a set; cost of a member of the first population
DURATION = {"warm_up_s": 1.5e-3, "duration_s": 2e-3}
FREQUENCY_KHZ = (15.0, 20.0)
QUIET, LOUD = 0.3, 0.7  # standard deviation of the current over its mean
SAME = 0.01  # of the frequency, between grids and between starts
PAIRS = ((201.0, 5.05), (250.0, 5.11), (300.0, 4.17), (201.0, 4.10))
Numbers = dict[str, float]
Measures = dict[str, float]


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


def run(numbers: Numbers, voltage: float, flow_mg_s: float, **how: object) -> xr.Dataset:
    point = ep.thruster.OperatingPoint(voltage, flow_mg_s, neutral_speed=numbers["u_n"])
    return ep.thruster.simulate(
        thruster_of(numbers, voltage), point, progress=False, **DURATION, **how
    )


def square(miss: float) -> float:
    """Square of a miss in units of what is allowed; NaN, as of a steady run, counts as four."""
    return 16.0 if math.isnan(miss) else min(miss**2, 100.0)


def share(run: xr.Dataset) -> float:
    return run.attrs["I_d_std"] / run.attrs["I_d_mean"]


def apart(one: xr.Dataset, other: xr.Dataset) -> float:
    """Relative difference of two runs in frequency, which NaN has none of."""
    return abs(other.attrs["f_kHz"] / one.attrs["f_kHz"] - 1.0)


def cycle_cost(run: xr.Dataset) -> float:
    """Nothing for one breathing cycle of a moderate size."""
    a, (low, high) = run.attrs, FREQUENCY_KHZ
    if a["status"] != "oscillating":
        return 16.0 + 16.0 * max(1.0 - share(run) / QUIET, 0.0)
    size = max(QUIET - share(run), share(run) - LOUD, 0.0) / 0.2
    return square(max(low - a["f_kHz"], a["f_kHz"] - high, 0.0)) + square(size)


def performance_cost(run: xr.Dataset, point: tuple[float, float], found: Measures) -> float:
    """Of current and thrust; keeps the largest miss of each in units of what is allowed."""
    known_A, thrusts = PERFORMANCE[point]
    current = run.attrs["I_d_mean"] / known_A - 1.0
    current /= 0.15 if point[0] < 250.0 else 0.08
    thrust = (1e3 * run.attrs["thrust_N"] / np.mean(thrusts) - 1.0) / 0.12
    for name, miss in (("current", current), ("thrust", thrust)):
        found[name] = max(found.get(name, 0.0), abs(miss))
    return square(current) + square(thrust)


def costs(numbers: Numbers, found: Measures) -> Iterator[float]:
    """What each run adds to the cost; fills in the measures on the way."""
    main = run(numbers, *LIF_POINT)
    if main.attrs["status"] in ("diverged", "out"):
        yield math.inf
    low, high = np.sort(np.array(list(LIF.values())), axis=1).T
    speed = mean_speed_km_s(main)
    off = np.maximum(np.maximum(low - speed, speed - high), 0.0)
    found |= {
        "places": float((off <= NEAR_KM_S).sum()),
        "miss_km_s": float(np.hypot.reduce(off) / 3),
    }
    found |= {"f_kHz": main.attrs["f_kHz"], "std_300": share(main)}
    yield (
        sum(map(square, off / NEAR_KM_S))
        + cycle_cost(main)
        + performance_cost(main, (300.0, 5.13), found)
    )
    runs = {}
    for point in PAIRS:
        runs[point] = run(numbers, *point)
        if point == PAIRS[0]:
            found["std_201"] = share(runs[point])
        if runs[point].attrs["status"] in ("diverged", "out"):
            yield math.inf
        yield cycle_cost(runs[point]) + performance_cost(runs[point], point, found)
    yield cycle_cost(run(numbers, 400.0, 5.0))
    soft = run(numbers, *LIF_POINT, initial=ep.thruster.SoftStart())
    found["starts"] = apart(main, soft)
    yield square(found["starts"] / SAME)
    for name, point, coarse in (("300", LIF_POINT, main), ("201", PAIRS[0], runs[PAIRS[0]])):
        fine = run(numbers, *point, n_cells=200)
        found[f"grid_{name}"] = apart(coarse, fine)
        size = (share(fine) / share(coarse) - 1.0) / 0.1
        yield square(found[f"grid_{name}"] / SAME) + square(size)


def judge(numbers: Numbers, limit: float) -> Measures:
    """Measures of a set, given up where its cost passes the limit."""
    found: Measures = {"cost": 0.0, "runs": 0.0}
    for cost in costs(numbers, found):
        found["cost"] += cost
        found["runs"] += 1.0
        if found["cost"] > limit:
            break
    return found


def read_sets(folder: Path) -> list[dict[str, float]]:
    path = folder / "sets.csv"
    if not path.exists():
        return []
    with path.open() as file:
        return [
            {k: float(v) if v else math.nan for k, v in row.items()} for row in csv.DictReader(file)
        ]


def append(folder: Path, row: Mapping[str, float]) -> None:
    path = folder / "sets.csv"
    fresh = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, [*BOUNDS, *MEASURES], restval="")
        if fresh:
            writer.writeheader()
        writer.writerow({name: f"{value:.6g}" for name, value in row.items()})


def to_unit(numbers: Mapping[str, float]) -> np.ndarray:
    """Each number as its share of the way between its bounds, in the logarithm for 1/c."""
    return np.array([
        np.log(numbers[k] / low) / np.log(high / low) if k in LOGARITHMIC
        else (numbers[k] - low) / (high - low) for k, (low, high) in BOUNDS.items()
    ])  # fmt: skip


def from_unit(shares: np.ndarray) -> Numbers:
    return {
        k: float(low * (high / low) ** x if k in LOGARITHMIC else low + (high - low) * x)
        for x, (k, (low, high)) in zip(np.clip(shares, 0.0, 1.0), BOUNDS.items(), strict=True)
    }


def trial(population: np.ndarray, k: int, rng: np.random.Generator) -> np.ndarray:
    """Member k, moved towards one of the best and along the difference of two others."""
    best = population[rng.integers(max(len(population) // 4, 1))]
    a, b = population[rng.choice(len(population), 2, replace=False)]
    weight = rng.uniform(0.4, 0.9)
    moved = population[k] + weight * (best - population[k]) + weight * (a - b)
    crossed = rng.random(moved.size) < rng.uniform(0.4, 1.0)
    crossed[rng.integers(moved.size)] = True
    return np.where(crossed, moved, population[k])


def search(
    folder: Path, n: int, start: Mapping[str, float], held: Mapping[str, float], limit_s: float
) -> None:
    """Try n sets, or as many as fit into limit_s, beside those of the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    rows, began = read_sets(folder), time.monotonic()
    rng = np.random.default_rng(len(rows))
    first = to_unit(numbers_of(measured_sets()["lif"][0], LIF_SPEED) | dict(start))
    for _ in range(n):
        if time.monotonic() - began > limit_s:
            break
        best = sorted(complete(rows), key=lambda row: row["cost"])[:POPULATION]
        if len(best) < POPULATION:
            shares = first + (SPREAD * rng.normal(size=first.size) if rows else 0.0)
            limit = FIRST_LIMIT
        else:
            k = int(rng.integers(POPULATION))
            shares, limit = trial(np.array([to_unit(row) for row in best]), k, rng), best[k]["cost"]
        numbers = from_unit(shares) | dict(held)
        rows.append(dict.fromkeys(MEASURES, math.nan) | numbers | judge(numbers, limit))
        append(folder, rows[-1])
    print_front(folder)


def complete(rows: Iterable[Mapping[str, float]]) -> list[Mapping[str, float]]:
    return [row for row in rows if row["runs"] == N_RUNS]


def print_front(folder: Path) -> None:
    """Sets that none beats in speeds, in agreement of the grids and in variation of the current."""
    rows = read_sets(folder)
    done = [row for row in complete(rows) if math.isfinite(grid(row)) and row["starts"] <= SAME]
    print(f"{len(rows)} sets tried, {len(complete(rows))} in all runs, {len(done)} have one cycle")
    goals = np.array([[row["miss_km_s"], grid(row), loudness(row)] for row in done])
    front = [
        row
        for row, goal in zip(done, goals, strict=True)
        if not ((goals <= goal).all(axis=1) & (goals < goal).any(axis=1)).any()
    ]
    print("".join(f"{name:>11s}" for name in (*MEASURES, *BOUNDS)))
    for row in sorted(front, key=lambda row: row["cost"]):
        print("".join(f"{row[name]:11.4g}" for name in (*MEASURES, *BOUNDS)))


def grid(row: Mapping[str, float]) -> float:
    return max(row["grid_300"], row["grid_201"])


def loudness(row: Mapping[str, float]) -> float:
    return max(row["std_300"], row["std_201"])


def number_by_name(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    if name not in BOUNDS:
        raise argparse.ArgumentTypeError(
            f"a number must be one of {', '.join(BOUNDS)}: {name} came"
        )
    return name, float(value)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("front", nargs="*", help="front DIR: print what was found, search nothing")
    parser.add_argument("--n", type=int, default=100, help="sets to try")
    parser.add_argument("--out", type=Path, help="folder of sets.csv, which is continued")
    parser.add_argument("--minutes", type=float, default=math.inf, help="at most so long")
    each = {"type": number_by_name, "action": "append", "default": [], "metavar": "NAME=VALUE"}
    parser.add_argument("--start", **each, help="begin there, not at thruster=lif")
    parser.add_argument("--hold", **each, help="keep a number")
    given = parser.parse_args()
    match given.front, given.out:
        case ["front", folder], None:
            print_front(Path(folder))
        case [], Path() as folder:
            search(folder, given.n, dict(given.start), dict(given.hold), 60.0 * given.minutes)
        case _:
            parser.error("give `front DIR`, or `--out DIR`")


if __name__ == "__main__":
    main()
