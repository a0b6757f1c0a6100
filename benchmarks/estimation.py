"""How often the joint estimator finds known equations, in noise, and its reports of a lack of fit.

    python -m benchmarks.estimation counts [--n 100] [--systems ...] [--noises ...] [--kind white]
    python -m benchmarks.estimation lack_of_fit [--n 25]  # with each true term left out
    python -m benchmarks.estimation short [--n 10]        # short and sparse records of Lorenz
    python -m benchmarks.estimation degrees [--n 10]      # a library that is too small
    python -m benchmarks.estimation samples               # CPU against the number of samples
    python -m benchmarks.estimation waves [--sizes 5 8 12 20 40] [--n 3]  # Lorenz-96
    python -m benchmarks.estimation chain [--sizes 20] [--n 3]            # coupled van der Pol's
    python -m benchmarks.estimation thruster              # the breathing mode, next to free runs
    python -m benchmarks.estimation penalties [--n 1] [--noises ...]      # dysts

`counts` prints per system and noise: selected exactly right, wrong ones that are reported as a lack
of fit, right ones that are, median CPU-s and the longest; of the right ones the median relative
error of a coefficient and the fraction of 95 % intervals that hold the truth.

`short` prints for each kind of record: selected right, wrong and reported as a lack of fit, wrong
and stated that the samples do not suffice, wrong without a word. `penalties` counts missed and
false terms in all systems of dysts against the weight of the choice among terms in a term's
penalty. Prints the tables of docs/estimation.md.
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

import numpy as np

import ep2sindy as ep
from benchmarks.collection import collected_draw, collected_names
from benchmarks.known_systems import KINDS, OTHERS, noisy
from benchmarks.many_states import lorenz_96
from benchmarks.sustained import DOWNSTREAM, POINTS, parts, record
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation import supports
from ep2sindy.estimation.estimate import Estimate
from ep2sindy.selection.criteria import Selection
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


def lacks_of_fit(systems: Sequence[str], n: int) -> None:
    """Reported lacks of fit with a true term left out, and of right models by the whole library."""
    totals = np.zeros((2, 2), dtype=int)  # (left out, whole), (reported, of)
    for name in systems:
        counts = np.zeros((2, 2), dtype=int)
        for number in range(n):
            system, run = noisy(name, 0.05, number)
            library, true = system.model.library, system.model.coef != 0.0
            left_out = np.random.default_rng(number).choice(np.flatnonzero(true.any(axis=1)))
            lacking = library.take(np.arange(len(library)) != left_out)
            counts[0] += bool(ep.discover(run, lacking).lack_of_fit), 1
            found = ep.discover(run, library)
            if ((found.model.coef != 0.0) == true).all():
                counts[1] += bool(found.lack_of_fit), 1
        totals += counts
        print(f"{name:16} {_fractions(counts)}", flush=True)
    print(f"{'all':16} {_fractions(totals)}")


def _fractions(counts: np.ndarray) -> str:
    (lacking, n_lacking), (whole, n_whole) = counts.tolist()
    return f"a term left out {lacking}/{n_lacking}, right equations {whole}/{n_whole}"


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


def short(n: int) -> None:
    print(f"{'record':32} right  lack of fit  open  silent")
    for words, make in SHORT.items():
        rows = Counter[str]()
        for number in range(n):
            found = ep.estimate(make(number), LORENZ.model.library)
            right = bool(((found.model.coef != 0.0) == (LORENZ.model.coef != 0.0)).all())
            wrong = "open" if found.too_few_samples else "silent"
            rows["right" if right else "lack of fit" if found.lack_of_fit else wrong] += 1
        counts = "  ".join(f"{rows[k]:5d}" for k in ("right", "lack of fit", "open", "silent"))
        print(f"{words:32} {counts}", flush=True)


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


def degrees(n: int) -> None:
    """The Brusselator in libraries of degree 2 and 3."""
    true = OTHERS["brusselator"].system("brusselator").model.coef != 0.0
    for degree, kind in product((2, 3), ("proportional", "white")):
        library, right, lacks = ep.polynomial(["x", "y"], degree=degree), 0, 0
        for number in range(n):
            found = ep.estimate([chemical(number, kind)], library)
            right += degree == 3 and bool(((found.model.coef != 0.0) == true).all())
            lacks += bool(found.lack_of_fit)
        print(f"degree {degree} {kind:12} right {right}, lack of fit {lacks} of {n}", flush=True)


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
        rules: tuple[Selection, ...] = (ep.discovery.Evidence(), ep.FreeRunScore())
        for rule in rules:
            start = time.process_time()
            method = ep.TrajectorySearch(max_terms=4, selection=rule, depth=2)
            found = ep.discover(fitted, ep.polynomial(["n_i", "n_n"], degree=2), method)
            cpu_s = time.process_time() - start
            run = ep.evaluate(found.model, held, initial=start_of(held, found.model))
            print(
                f"{label} {rule.label:9} {np.count_nonzero(found.model.coef)} terms, {run.text}; "
                f"{cpu_s:.1f} CPU-s",
                flush=True,
            )


def penalties(noises: Sequence[float], n: int) -> None:
    print("weight  noise  right  missed terms  false terms")
    for noise, weight in product(noises, (0.0, 0.25, 0.5, 1.0, 1.5)):
        supports.GAMMA = weight
        counts = np.zeros(4, dtype=int)
        for name, number in product(collected_names(), range(n)):
            system, runs = collected_draw(name, noise, number)
            found = ep.estimate(runs, system.model.library)
            true, used = system.model.coef != 0.0, found.model.coef != 0.0
            missed, false = (true & ~used).sum(), (used & ~true).sum()
            counts += missed + false == 0, 1, missed, false
        right, of, missed, false = counts.tolist()
        print(f"{weight:6g}  {noise:5g}  {right}/{of}  {missed:12d}  {false:11d}", flush=True)


def main() -> None:
    every = [*DRAWS, *OTHERS]
    what: dict[str, Callable[[argparse.Namespace], None]] = {
        "counts": lambda asked: counts(asked.systems, asked.noises, asked.kind, asked.n),
        "lack_of_fit": lambda asked: lacks_of_fit(asked.systems, asked.n),
        "short": lambda asked: short(asked.n),
        "degrees": lambda asked: degrees(asked.n),
        "samples": lambda _: samples(),
        "waves": lambda asked: waves(asked.sizes or [5, 8, 12, 20], asked.n),
        "chain": lambda asked: chain(asked.sizes or [20], asked.n),
        "thruster": lambda _: thruster(),
        "penalties": lambda asked: penalties(asked.noises, asked.n),
    }
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("what", choices=what)
    parser.add_argument("--n", type=int, default=100)
    parser.add_argument("--systems", nargs="+", default=every, choices=every)
    parser.add_argument("--noises", nargs="+", type=float, default=[0.0, 0.05, 0.2, 0.4])
    parser.add_argument("--sizes", nargs="+", type=int)
    parser.add_argument("--kind", default="white", choices=KINDS)
    asked = parser.parse_args()
    what[asked.what](asked)


if __name__ == "__main__":
    main()
