"""How often the joint estimator finds known equations, in noise, and its reports of a lack of fit.

    python -m benchmarks.estimation counts [--n 100] [--systems ...] [--noises ...] [--kind white]
    python -m benchmarks.estimation lack of fit [--n 25]     # with each true term left out
    python -m benchmarks.estimation short [--n 10]      # short and sparse records of Lorenz
    python -m benchmarks.estimation degrees [--n 10]    # a library too small; delays at 20 % noise
    python -m benchmarks.estimation samples             # CPU against the number of samples
    python -m benchmarks.estimation waves [--sizes 5 8 12 20 40] [--n 3]  # Lorenz-96 of many states
    python -m benchmarks.estimation chain [--sizes 20] [--n 3]            # coupled van der Pol's
    python -m benchmarks.estimation thruster            # the breathing mode, next to free runs
    python -m benchmarks.estimation collection [--n 3] [--noises ...]  # dysts: classes of failure
    python -m benchmarks.estimation courses --n 3 --noises 0.05        # inputs between samples
    python -m benchmarks.estimation penalties [--n 1] [--noises ...]      # dysts: penalty of a term

`counts` prints per system and noise: selected exactly right, wrong ones that are reported as a lack
of fit, right ones that are, median CPU-s and the longest; of the right ones the median relative
error of a coefficient and the fraction of 95 % intervals that hold the truth.

`short` prints for each kind of record: selected right, wrong and reported as a lack of fit, wrong
and stated that the samples do not tell, wrong without a word, and the largest RMS miss of the
model's own steps, in noise, of those that are no lack_of_fit: a path that misses them is no
trajectory of the model.

`collection` prints, for every draw of all systems of dysts, how many are exactly right, CPU-s, the
intervals, and each wrong one in the first class of these that holds: flagged (called a
lack_of_fit); search (the truth is likelier by more than 4, penalties included); near (the truth of
every wrong equation is among the rivals at better than 1:20); less likely (the truth is, by as much
as printed: terms that are missed change -2 log likelihood by less than their penalty). `penalties`
counts missed and false terms against the weight of the choice among terms in a term's penalty.
"""

from __future__ import annotations

import argparse
import resource
import time
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

import ep2sindy as ep
from benchmarks.collection import collected_draw, collected_names
from benchmarks.known_systems import KINDS, OTHERS, noisy
from benchmarks.many_states import lorenz_96
from benchmarks.sustained import DOWNSTREAM, POINTS, parts, record
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation import supports
from ep2sindy.estimation.estimate import Estimate
from ep2sindy.estimation.problem import scale_problem
from ep2sindy.estimation.solver import from_smooth
from ep2sindy.model.inputs import COURSES, curve_through
from ep2sindy.studies.sustained import start_of
from ep2sindy.systems.draws import DRAWS
from ep2sindy.systems.systems import System, lorenz
from tests.models import model_of


def assessed(system: System, found: Estimate, cpu_s: float) -> dict[str, float]:
    """Whether the support is right, and of a right one errors and coverage."""
    true, coef = system.model.coef, found.model.coef
    right = bool(((coef != 0.0) == (true != 0.0)).all())
    row = {"right": float(right), "lack_of_fit": float(bool(found.lack_of_fit)), "cpu_s": cpu_s}
    if right:
        used = true.T != 0.0
        off = (coef - true).T[used]
        row["error"] = float(np.median(np.abs(off / true.T[used])))
        if found.model.covariance is not None:  # a lack of fit has no intervals
            std = np.sqrt(np.diag(found.model.covariance))
            row["inside"] = float((np.abs(off) <= 1.96 * std).mean())
    return row


def counts(systems: Sequence[str], noises: Sequence[float], kind: str, n: int) -> None:
    print(
        f"{'system':16} noise  right  lack of fit(wrong right)  CPU-s median max  error %  inside %"
    )
    for name, noise in product(systems, noises):
        rows = []
        for number in range(n):
            system, run = noisy(name, noise, number, kind)
            start = time.process_time()
            found = ep.estimate([run], system.model.library)
            rows.append(assessed(system, found, time.process_time() - start))
        print(f"{name:16} {noise:5g}  {_line(rows)}", flush=True)


def _line(rows: Sequence[dict[str, float]]) -> str:
    right = [row for row in rows if row["right"]]
    wrong = [row for row in rows if not row["right"]]
    cpu = [row["cpu_s"] for row in rows]
    flagged = f"{sum(r['lack_of_fit'] for r in wrong):.0f}/{len(wrong)} "
    flagged += f"{sum(r['lack_of_fit'] for r in right):.0f}/{len(right)}"
    error = 100.0 * np.median([row["error"] for row in right]) if right else np.nan
    known = [row["inside"] for row in right if "inside" in row]
    inside = 100.0 * np.mean(known) if known else np.nan
    return (
        f"{len(right):3d}/{len(rows)}  {flagged:>18}  {np.median(cpu):11.2f} {max(cpu):5.2f}"
        f"  {error:7.2f}  {inside:7.1f}"
    )


ROUTES = {
    "joint": ep.TrajectorySearch(),
    "weighted rows": ep.Regression(ep.WeightedWeak()),
    "differential rows": ep.Regression(ep.Differential(), ep.BestSubset()),
}


def lacks_of_fit(systems: Sequence[str], n: int) -> None:
    """With a true term left out, and with the whole library where that is found."""
    print(
        f"called a lack_of_fit:  a term left out, by {', '.join(ROUTES)}; right equations, by all"
    )
    totals = np.zeros((2, len(ROUTES), 2), dtype=int)
    holding = np.zeros((2, 2), dtype=int)  # (equation that is whole, that lacks the term)
    for name in systems:
        counts = np.zeros((2, len(ROUTES), 2), dtype=int)  # library, route, (called, of)
        for number in range(n):
            system, run = noisy(name, 0.05, number)
            library, true = system.model.library, system.model.coef != 0.0
            left_out = np.random.default_rng(number).choice(np.flatnonzero(true.any(axis=1)))
            for k, kept in enumerate(
                (np.arange(len(library)) != left_out, np.full(len(library), True))
            ):
                for r, method in enumerate(ROUTES.values()):
                    found = ep.discover(run, library.take(kept), method)
                    if k == 0 and found.estimate is not None and found.lack_of_fit:
                        for state, lacks in zip(run.state_names, true[left_out], strict=True):
                            holding[int(lacks)] += state in found.estimate.explained_states, 1
                    if k == 0 or ((found.model.coef != 0.0) == true).all():
                        counts[k, r] += bool(found.lack_of_fit), 1
        totals += counts
        print(f"{name:16} {_fractions(counts)}", flush=True)
    print(f"{'all':16} {_fractions(totals)}")
    (whole, n_whole), (lacking, n_lacking) = holding.tolist()
    print(
        f"equations by joint of models that do not fit, reported to hold: {whole} of {n_whole} "
        "whole ones, "
        f"{lacking} of {n_lacking} that lack the term"
    )


def chemical(
    number: int, kind: str = "white", *, noise: float = 0.02, duration_s: float = 60.0, n: int = 600
) -> Trajectory:
    """A draw of the Brusselator (A = 1, B = 3) on its cycle of 7.16 s."""
    system = OTHERS["brusselator"].system("brusselator")
    settling = replace(system, duration_s=30.0, rate_Hz=100.0).trajectory()
    on_cycle = replace(system, initial=settling.states[-1], duration_s=duration_s)
    clean = replace(on_cycle, rate_Hz=n / duration_s).trajectory()
    draw = np.random.default_rng([number, *kind.encode()]).standard_normal(clean.states.shape)
    size = np.sqrt(np.square(clean.states).mean(axis=0))
    states = clean.states + noise * draw * (clean.states if kind == "proportional" else size)
    return Trajectory(clean.t, states, clean.state_names)


def _fractions(counts: np.ndarray) -> str:
    return "  ".join(f"{called}/{of}" for called, of in counts.reshape(-1, 2))


def short(n: int) -> None:
    print(
        "record                                right lack of fit open silent   largest miss, CPU-s"
    )
    for words, make in SHORT.items():
        rows, misses, cpu_s = Counter[str](), [0.0], 0.0
        for number in range(n):
            runs, start = make(number), time.process_time()
            found = ep.estimate(runs, LORENZ.model.library)
            cpu_s += time.process_time() - start
            right = bool(((found.model.coef != 0.0) == (LORENZ.model.coef != 0.0)).all())
            stated = (
                "lack_of_fit"
                if found.lack_of_fit
                else "open"
                if found.too_few_samples
                else "silent"
            )
            rows[f"right {stated}" if right else stated] += 1
            misses += [] if found.lack_of_fit else [_largest_miss(found)]
        right = sum(count for word, count in rows.items() if word.startswith("right"))
        counts = f"{right:5d} {rows['lack_of_fit']:6d} {rows['open']:4d} {rows['silent']:6d}"
        print(f"{words:38}{counts}   {max(misses):.1e}  {cpu_s:.0f}", flush=True)


def _lorenz_piece(number: int, n_samples: int, noise: float) -> ep.Trajectory:
    rng = np.random.default_rng(number)
    start = rng.uniform([-10.0, -10.0, 15.0], [10.0, 10.0, 30.0])
    return LORENZ.trajectory(noise=noise, rng=rng, initial=start).window(0, n_samples)


def _sparse(run: ep.Trajectory) -> ep.Trajectory:
    """The run with z at every tenth instant."""
    missing = np.zeros(run.states.shape, dtype=np.bool_)
    missing[:, 2] = np.arange(run.n_samples) % 10 > 0
    return replace(run, missing=missing)


LORENZ = lorenz()
SHORT: dict[str, Callable[[int], list[ep.Trajectory]]] = {
    "60 samples, 20 %": lambda k: [_lorenz_piece(k, 60, 0.2)],
    "three of 100, 20 %": lambda k: [_lorenz_piece(3 * k + j, 100, 0.2) for j in range(3)],
    "300, z at every tenth, 20 %": lambda k: [_sparse(_lorenz_piece(k, 300, 0.2))],
    "1000, z at every tenth, 20 %": lambda k: [_sparse(_lorenz_piece(k, 1000, 0.2))],
}


def _largest_miss(found: Estimate) -> float:
    """RMS of what the model, run from each sample of its path, misses of the next, in noise."""
    squares, n_steps, own = np.zeros(len(found.noise_std)), 0, found.model
    for path, run in zip(found.paths, found.runs, strict=True):
        for k in range(0, len(path) - 1, max(1, len(path) // 50)):
            ends = own.simulate(run.t[k : k + 2], path[k]).states
            squares += np.square((ends[-1] - path[k + 1]) / found.noise_std)
            n_steps += 1
    return float(np.sqrt(squares.max() / n_steps))


def degrees(n: int) -> None:
    """The Brusselator in libraries of degree 2 and 3; right models at 20 % noise called late."""
    true = OTHERS["brusselator"].system("brusselator").model.coef != 0.0
    for degree, align, kind in product((2, 3), (False, True), ("proportional", "white")):
        library, counted = ep.polynomial(["x", "y"], degree=degree), np.zeros(3, dtype=int)
        for number in range(n):
            found = ep.estimate([chemical(number, kind)], library, align=align)
            right = degree == 3 and bool(((found.model.coef != 0.0) == true).all())
            counted += right, bool(found.lack_of_fit), bool(found.delays_s.any())
        print(
            f"degree {degree} {align=} {kind:12} right, lack of fit, late: {counted} of {n}",
            flush=True,
        )
    total = np.zeros(2, dtype=int)
    for name in [*DRAWS, *OTHERS]:
        for number in range(2 * n):
            system, run = noisy(name, 0.2, number)
            found = ep.estimate([run], system.model.library)
            late, coef = bool(found.delays_s.any()), found.model.coef != 0.0
            total += late, bool((coef == (system.model.coef != 0.0)).all())
    print(f"20 % noise, {2 * n} draws of each system: {total[0]} called late, {total[1]} right")


def samples() -> None:
    print("samples  CPU-s  right")
    for n in (1000, 3000, 10_000, 30_000, 100_000):
        system = lorenz()
        longer = System(system.name, system.model, system.initial, n / 300.0, 300.0)
        run = longer.trajectory(noise=0.05, rng=0)
        start = time.process_time()
        found = ep.estimate([run], system.model.library)
        row = assessed(system, found, time.process_time() - start)
        print(f"{n:7d}  {row['cpu_s']:5.2f}  {bool(row['right'])}", flush=True)


def waves(sizes: Sequence[int], n: int) -> None:
    """Lorenz-96, F = 8: 3000 samples at steps of 0.01, 5 % noise, all products of degree 2."""
    for size, number in product(sizes, range(n)):
        start = 8.0 + np.random.default_rng(number).standard_normal(size)
        system = _settled(System("waves", lorenz_96(size), start, 30.0, 100.0))
        _large(system, ep.polynomial(system.model.states, degree=2), number)


def chain(sizes: Sequence[int], n: int) -> None:
    """Van der Pol oscillators, each pulled by its neighbours: 4000 samples, 5 % noise.

    The library has the products of degree 3 of each oscillator, and all states.
    """
    for size, number in product(sizes, range(n)):
        rng = np.random.default_rng(number)
        names = [f"{letter}{k}" for letter in "xv" for k in range(size)]
        equations: dict[str, dict[str, float]] = {f"x{k}": {f"v{k}": 1.0} for k in range(size)}
        for k in range(size):
            x, v = f"x{k}", f"v{k}"
            own = {v: 1.0, f"{x}^2*{v}": -1.0, x: -rng.uniform(1.0, 3.0)}
            sides = {f"x{j}": 0.3 for j in (k - 1, k + 1) if 0 <= j < size}
            equations[v] = own | sides
        start = rng.uniform(-2.0, 2.0, 2 * size)
        model = model_of({name: equations[name] for name in names})
        system = _settled(System("chain", model, start, 80.0, 50.0))
        pairs = (ep.polynomial(pair, degree=3) for pair in zip(names, names[size:], strict=False))
        terms = [name for each in pairs for name in np.array(each.names)[each.degrees > 1]]
        _large(system, ep.polynomial(names, degree=1, products=terms), number)


def _settled(system: System) -> System:
    """The system, starting where a first record ends."""
    return replace(system, initial=system.trajectory().states[-1])


def _large(system: System, library: ep.Library, number: int) -> None:
    run = system.trajectory(noise=0.05, rng=number)
    start = time.process_time()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ep.discovery.SlowSearch)
        found = ep.estimate(run, library)
    cpu_s = time.process_time() - start
    truth = system.model
    right = sum(set(found.model.terms(s)) == set(truth.terms(s)) for s in truth.states)
    n, gigabytes = len(truth.states), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    print(
        f"{system.name} of {n} states, {n * len(library)} coefficients, draw {number}: "
        f"{right} of {n} equations right, {cpu_s:.1f} CPU-s, {gigabytes:.2f} GB at most",
        flush=True,
    )


def thruster() -> None:
    """Six operating points: the estimator's own model, and what free runs choose of its fronts."""
    for label in POINTS:
        fitted, held = parts(record(label, DOWNSTREAM).run, "last")
        for rule in (ep.discovery.Evidence(), ep.FreeRunScore()):
            start = time.process_time()
            method = ep.TrajectorySearch(max_terms=4, selection=rule, depth=2)
            found = ep.discover(fitted, ep.polynomial(["n_i", "n_n"], degree=2), method)
            cpu_s = time.process_time() - start
            run = ep.evaluate(found.model, held, initial=start_of(held, found.model))
            print(
                f"{label} {rule.label:9} {np.count_nonzero(found.model.coef)} terms, {run.text}; "
                f"flow error {found.estimate.flow_error:g}, {cpu_s:.1f} CPU-s",
                flush=True,
            )


class Judged(NamedTuple):
    """One record of a collected system."""

    name: str
    missed: int
    false: int
    failure: str
    cpu_s: float
    inside: float


def judged_draw(name: str, noise: float, number: int) -> Judged:
    system, runs = collected_draw(name, noise, number)
    start = time.process_time()
    found = ep.estimate(runs, system.model.library)
    cpu_s = time.process_time() - start
    true, used = system.model.coef != 0.0, found.model.coef != 0.0
    row = assessed(system, found, cpu_s)
    failure = "" if row["right"] else _failure(system, runs, found)
    missed, false = int((true & ~used).sum()), int((used & ~true).sum())
    return Judged(name, missed, false, failure, cpu_s, row.get("inside", np.nan))


def _failure(system: System, runs: Sequence[ep.Trajectory], found: Estimate) -> str:
    """The class of a wrong model, see the module; with what the truth lacks in likelihood."""
    if found.lack_of_fit:
        return "flagged"
    behind = _behind(system, runs, found)
    if behind < -4.0:
        return f"search ({behind:.0f})"
    wrong = [
        state
        for state in system.model.states
        if set(found.model.terms(state)) != set(system.model.terms(state))
    ]
    odds = {(r.state, frozenset(r.terms)): r.odds for r in found.rivals}
    known = [odds.get((s, frozenset(system.model.terms(s))), 0.0) for s in wrong]
    return "near" if min(known) > 0.05 else f"less likely ({behind:.0f})"


def _behind(system: System, runs: Sequence[ep.Trajectory], found: Estimate) -> float:
    """-2 log likelihood of the true terms minus that of those found, with the terms' penalties."""
    problem = scale_problem(runs, system.model.library)
    scores = []
    for coef in (system.model.coef, found.model.coef):
        part = problem.restricted((coef != 0.0)[problem.column, problem.equation])
        part = replace(part, required=np.ones_like(part.required))
        scores.append(from_smooth(part, None).score)
    return scores[0] - scores[1]


def collection(noises: Sequence[float], n: int) -> None:
    for noise, number in product(noises, range(n)):
        rows = [judged_draw(name, noise, number) for name in collected_names()]
        cpu = [row.cpu_s for row in rows]
        wrong = [row for row in rows if row.failure]
        print(
            f"noise {noise:g}, draw {number}: {len(rows) - len(wrong)} of {len(rows)} right; CPU-s "
            f"median {np.median(cpu):.2f}, mean {np.mean(cpu):.2f}, most {max(cpu):.1f}; "
            f"{100.0 * np.nanmean([row.inside for row in rows]):.1f} % of intervals hold"
        )
        for row in wrong:
            print(
                f"    {row.name}: {row.missed} missed, {row.false} false; {row.failure}", flush=True
            )


def penalties(noises: Sequence[float], n: int) -> None:
    print("weight  noise  right  missed terms  false terms")
    for noise, weight in product(noises, (0.0, 0.25, 0.5, 1.0, 1.5)):
        supports.GAMMA = weight
        rows = [
            judged_draw(name, noise, number)
            for name, number in product(collected_names(), range(n))
        ]
        missed, false = sum(row.missed for row in rows), sum(row.false for row in rows)
        right = sum(not row.failure for row in rows)
        print(
            f"{weight:6g}  {noise:5g}  {right}/{len(rows)}  {missed:12d}  {false:11d}", flush=True
        )


def set_record(model: ep.SparseModel, course: str, hold: int, noise: float, number: int):
    """A record of 1000 samples, its input drawn anew every `hold` samples and on a course."""
    rng = np.random.default_rng([number, hold, list(COURSES).index(course)])
    k, knots = np.arange(1000), np.arange(0, 1000 + hold, hold)
    t = {"x": 0.05, "th": 0.03}[model.states[0]] * k
    levels = curve_through(knots.astype(float), rng.uniform(-1.0, 1.0, (len(knots), 1)), [course])
    u = np.array([levels(float(each)) for each in k])
    start = [0.3, 0.0][: len(model.states)]
    path = replace(model, courses={"u": course}).simulate(t, start, u, rtol=1e-10).states
    rms = np.sqrt(np.square(path).mean(axis=0))
    return ep.Trajectory(
        t, path + noise * rms * rng.standard_normal(path.shape), model.states, u, ["u"]
    )


def courses(noise: float, n: int) -> None:
    """A first-order lag and a pendulum, driven by inputs on every course."""
    lag = model_of({"x": {"x": -2.0, "u": 2.0}}, inputs=["u"])
    swing = {"sin(th)": -9.0, "w": -0.3, "u": 4.0}
    pendulum = model_of({"th": {"w": 1.0}, "w": swing}, inputs=["u"])
    swings = ep.polynomial(["th", "w", "u"], degree=2, functions=["sin(th)"])
    libraries = {"lag": (lag, ep.polynomial(["x", "u"], degree=3)), "pendulum": (pendulum, swings)}
    print("right laws, with all 95 % intervals right, all intervals, lacks of fit, courses; CPU-s")
    for (name, (model, library)), course, hold in product(libraries.items(), COURSES, (1, 20)):
        rows, chosen = [], []
        for number in range(n):
            run, began = set_record(model, course, hold, noise, number), time.process_time()
            found = ep.estimate([run], library)
            cpu_s, held = time.process_time() - began, []
            right = all(set(found.model.terms(s)) == set(model.terms(s)) for s in model.states)
            if right and found.model.covariance is not None:
                held = [
                    low <= model.terms(s)[term] <= high
                    for s in model.states
                    for term, (low, high) in found.model.intervals(s).items()
                ]
            rows.append((right, bool(held) and all(held), sum(held), len(held), cpu_s))
            chosen.append(
                found.model.courses["u"] + (", a lack of fit" if found.lack_of_fit else "")
            )
        laws, within, inside, of, cpu = np.array(rows, dtype=float).T
        print(
            f"{name:9} {course:7} {hold:3} {laws.sum():.0f}/{n} {within.sum():.0f}/{n} "
            f"{inside.sum():.0f}/{of.sum():.0f} {np.median(cpu):.2f} {chosen}",
            flush=True,
        )


WHAT = [
    "counts",
    "lack_of_fit",
    "short",
    "degrees",
    "samples",
    "thruster",
    "collection",
    "penalties",
    "waves",
    "chain",
    "courses",
]


def main() -> None:
    every = [*DRAWS, *OTHERS]
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=WHAT)
    parser.add_argument("--n", type=int, default=100)
    parser.add_argument("--systems", nargs="+", default=every, choices=every)
    parser.add_argument("--noises", nargs="+", type=float, default=[0.0, 0.05, 0.2, 0.4])
    parser.add_argument("--sizes", nargs="+", type=int)
    parser.add_argument("--kind", default="white", choices=KINDS)
    asked = parser.parse_args()
    if asked.what == "counts":
        counts(asked.systems, asked.noises, asked.kind, asked.n)
    elif asked.what == "lack_of_fit":
        lacks_of_fit(asked.systems, asked.n)
    elif asked.what == "degrees":
        degrees(asked.n)
    elif asked.what == "collection":
        collection(asked.noises, asked.n)
    elif asked.what == "waves":
        waves(asked.sizes or [5, 8, 12, 20], asked.n)
    elif asked.what == "chain":
        chain(asked.sizes or [20], asked.n)
    elif asked.what == "penalties":
        penalties(asked.noises, asked.n)
    elif asked.what == "short":
        short(asked.n)
    elif asked.what == "courses":
        courses(asked.noises[0] or 0.05, asked.n)
    elif asked.what == "samples":
        samples()
    else:
        thruster()


if __name__ == "__main__":
    main()
