"""A whole bootstrapped adaptive-lasso search against the plain way, in CPU time.

Lorenz, 3000 samples, 10 terms, 3 equations, 32 bootstraps. The plain way is scikit-learn's
lasso_path with 100 alphas on the resampled rows of every bootstrap, then one lstsq on all
training rows per support: for the support of every alpha, as the thesis's algorithm goes, or
for each distinct support once, which already takes some care. All start from the same
assembled rows and end with the best candidate of every size on the held-out rows.

Then the calls that a user makes: `ep.discover` by the thesis's recipe, by one threshold sweep, and
by default, each with its test whether the model leaves more than noise; and of 100,000 samples.
PySINDy's fit next to it is given one threshold, and tests nothing.

    python -m benchmarks.search
    python -m benchmarks.search long   # calls on 10,000,000 samples, and on 200 runs
"""

import resource
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from functools import partial

import numba
import numpy as np
import pysindy
import sklearn
from sklearn.linear_model import lasso_path
from threadpoolctl import threadpool_limits

import ep2sindy as ep
from benchmarks.timing import cpu_s
from ep2sindy.model.runge_kutta import step
from ep2sindy.regression.bootstraps import Bootstraps, pool_supports
from ep2sindy.regression.formulations import Differential
from ep2sindy.regression.front import ParetoFront, pareto_front
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import AdaptiveLasso
from ep2sindy.systems.systems import System, lorenz

BOOTSTRAPS = Bootstraps(n=32, n_culled=1)
# scikit-learn 1.7 renamed the argument.
N_ALPHAS = {
    "alphas" if tuple(map(int, sklearn.__version__.split(".")[:2])) >= (1, 7) else "n_alphas": 100
}


def ours(problem: RegressionRows, rng: np.random.Generator) -> list[ParetoFront]:
    supports = pool_supports(problem, AdaptiveLasso(), BOOTSTRAPS, rng=rng)
    return [pareto_front(problem, found) for found in supports]


def plain(
    problem: RegressionRows, rng: np.random.Generator, *, distinct: bool
) -> list[dict[int, tuple]]:
    rows = problem.train_columns.T
    n_terms = len(problem.library)
    theta, targets = rows[:, :n_terms], rows[:, n_terms:]
    supports: list[list[tuple[int, ...]]] = [[] for _ in problem.equations]
    for _ in range(BOOTSTRAPS.n):
        size = round(rng.uniform(BOOTSTRAPS.smallest, BOOTSTRAPS.largest) * len(rows))
        drawn = rng.integers(len(rows), size=size)
        kept = np.sort(rng.permutation(n_terms)[BOOTSTRAPS.n_culled :])
        sample = theta[np.ix_(drawn, kept)]
        for equation, found in enumerate(supports):
            target = targets[drawn, equation]
            scale = np.abs(np.linalg.lstsq(sample, target, rcond=None)[0])
            _, path, _ = lasso_path(sample * scale, target, **N_ALPHAS)
            found += [tuple(kept[column != 0.0]) for column in path.T]
    return [
        plain_front(problem, equation, sorted(set(found)) if distinct else found)
        for equation, found in enumerate(supports)
    ]


def plain_front(
    problem: RegressionRows, equation: int, supports: list[tuple[int, ...]]
) -> dict[int, tuple]:
    """Best support of every size by its error on the held-out rows."""
    train, test = problem.train_columns.T, problem.test_columns.T
    target = len(problem.library) + equation
    best: dict[int, tuple] = {}
    for columns in map(list, supports):
        coef = np.linalg.lstsq(train[:, columns], train[:, target], rcond=None)[0]
        error = np.square(test[:, target] - test[:, columns] @ coef).sum()
        if error < best.get(len(columns), (np.inf,))[0]:
            best[len(columns)] = (error, columns, coef)
    return best


def main() -> None:
    system = lorenz()
    data = system.trajectory(noise=0.05, rng=np.random.default_rng(0))
    library = system.model.library

    def fresh() -> RegressionRows:
        # A new value each time, so that no cached Gram matrix flatters us.
        (problem,) = Differential().assemble([data], library, rng=np.random.default_rng(1))
        return problem

    with threadpool_limits(limits=1):
        assembly_s = cpu_s(fresh, n_runs=9)
        ours_s = cpu_s(lambda: ours(fresh(), np.random.default_rng(2)), n_runs=9) - assembly_s
        plain_s = {
            distinct: cpu_s(
                lambda d=distinct: plain(fresh(), np.random.default_rng(2), distinct=d), n_runs=3
            )
            - assembly_s
            for distinct in (False, True)
        }
    print(f"Lorenz {data.n_samples} x {len(library)}, 3 equations, {BOOTSTRAPS.n} bootstraps")
    print(f"assembly of the rows                        {1e3 * assembly_s:8.1f} ms")
    print(f"search and fronts, ours                     {1e3 * ours_s:8.1f} ms")
    for distinct, name in ((False, "every alpha refitted"), (True, "each support once")):
        ratio = plain_s[distinct] / ours_s
        print(
            f"the plain way, {name:<22}       {1e3 * plain_s[distinct]:8.1f} ms, {ratio:.0f} times"
        )
    calls()


METHODS = {
    "thesis": ep.Regression(Differential(), AdaptiveLasso(), ep.Knee(), BOOTSTRAPS),
    "STLSQ": ep.Regression(Differential(), ep.STLSQ(), ep.Knee(), Bootstraps(n=0)),
    "default": ep.TrajectorySearch(),
}


def calls() -> None:
    """CPU time of whole calls, their noise tests included."""
    system = lorenz()
    run = system.trajectory(noise=0.05, rng=np.random.default_rng(0))
    long = continued(system, 100_000)
    with threadpool_limits(limits=1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, method in METHODS.items():
            call = partial(ep.discover, run, method=method, seed=0)
            print(f"discover, {name:<34}{1e3 * cpu_s(call, n_runs=9):8.1f} ms")
        theirs_s = cpu_s(partial(pysindy_fit, run), n_runs=9)
        print(f"PySINDy, STLSQ at one threshold             {1e3 * theirs_s:8.1f} ms")
        call = partial(ep.discover, long, method=METHODS["thesis"], seed=0)
        print(f"discover, {f'thesis, {long.n_samples} samples':<34}{cpu_s(call, n_runs=3):8.2f} s")


def pysindy_fit(run: ep.Trajectory) -> None:
    library = pysindy.PolynomialLibrary(degree=2)
    model = pysindy.SINDy(optimizer=pysindy.STLSQ(threshold=0.1), feature_library=library)
    model.fit(run.states, t=run.dt_s)


LONG = {
    "best subsets": replace(METHODS["thesis"], search=ep.BestSubset(), bootstraps=Bootstraps(n=0)),
    "thesis": METHODS["thesis"],
    "STLSQ": METHODS["STLSQ"],
    "weighted weak rows": ep.Regression(),
    "limit_s=60": ep.TrajectorySearch(limit_s=60.0),
}


def long_record(name: str, n_samples: int = 10_000_000) -> None:
    """Time and peak memory of one call on a record of Lorenz with ten terms."""
    start = lorenz().trajectory()
    states = lorenz_states(n_samples, start.states[0], start.dt_s)
    rng = np.random.default_rng(0)
    for column in states.T:
        column += 0.05 * column.std() * rng.normal(size=n_samples)
    states.flags.writeable = False  # so that the record takes it, and no copy
    run = ep.Trajectory(start.dt_s * np.arange(n_samples), states, start.state_names)
    del states
    call = partial(ep.discover, method=LONG[name], seed=0)
    with threadpool_limits(limits=1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        call(run.window(0, 3000))  # compiles or loads what it needs
        before_GiB, began, began_cpu = peak_GiB(), time.monotonic(), time.process_time()
        found = call(run)
    total_s = time.process_time() - began_cpu
    print(f"{n_samples} samples, {name}: {total_s:.0f} CPU-s,", end=" ")
    print(f"{time.monotonic() - began:.0f} s, {peak_GiB():.2f} GiB at most", end=" ")
    print(f"(before the call {before_GiB:.2f})")
    print(found, flush=True)


@numba.njit
def lorenz_states(n: int, start: np.ndarray, step_s: float) -> np.ndarray:
    """States of Lorenz's system at n samples, by classical Runge-Kutta steps."""
    states, slope = np.empty((n, 3)), np.zeros(3)
    states[0] = start
    for k in range(1, n):
        x, total = states[k - 1], np.zeros(3)
        for lead, weight in ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
            u, v, w = x + lead * step_s * slope
            slope = np.array([10.0 * (v - u), u * (28.0 - w) - v, u * v - 8.0 / 3.0 * w])
            total += weight / 6.0 * step_s * slope
        states[k] = x + total
    return states


def many_runs(n_runs: int = 200, n_samples: int = 60) -> None:
    """CPU time of the default search on many short runs, and on one record of as many samples."""
    system = lorenz()
    record = continued(system, n_runs * n_samples)
    short = [record.window(k, k + n_samples) for k in range(0, record.n_samples, n_samples)]
    for runs in ([record], short):
        with threadpool_limits(limits=1):
            total_s = cpu_s(partial(ep.discover, runs), n_runs=1)
        print(f"{len(runs)} runs of {runs[0].n_samples} samples: {total_s:.1f} CPU-s")


def peak_GiB() -> float:
    """Largest memory of this process so far; kilobytes on Linux, bytes on macOS."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def continued(system: System, n_samples: int) -> ep.Trajectory:
    """A record of many samples at the step of the system's own, with 5 % noise."""
    start = system.trajectory()
    step_s = float(start.t[1] - start.t[0])
    t, states = step_s * np.arange(n_samples), np.empty((n_samples, 3))
    states[0] = start.states[0]
    for k in range(1, n_samples):
        states[k] = step(
            lambda x, _: system.model.derivative(x, np.empty(0)), states[k - 1], (t, t, t), step_s
        )
    noise = np.random.default_rng(0).normal(size=states.shape) * states.std(axis=0)
    return ep.Trajectory(t, states + 0.05 * noise, start.state_names)


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["long"]:  # each call in a process of its own, which has its own peak of memory
            for name in LONG:
                subprocess.run(
                    [sys.executable, "-m", "benchmarks.search", "long", name], check=True
                )
            many_runs()
        case ["long", name]:
            long_record(name)
        case _:
            main()
