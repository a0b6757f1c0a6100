"""A whole bootstrapped adaptive-lasso search against the plain way, in CPU time.

Lorenz, 3000 samples, 10 terms, 3 equations, 32 bootstraps. The plain way is scikit-learn's
lasso_path with 100 alphas on the resampled rows of every bootstrap, then one lstsq on all
training rows per support: for the support of every alpha, as the thesis's algorithm goes, or
for each distinct support once, which already takes some care. All start from the same
assembled rows and end with the best candidate of every size on the held-out rows.

Then the calls that a user makes: `ep.discover` by the thesis's recipe, by one threshold sweep, and
by default, each with its test whether the model leaves more than noise; and of 100,000 samples.
PySINDy's fit beside it is given one threshold, and tests nothing.

    python -m benchmarks.search
    python -m benchmarks.search long   # one regression on 10,000,000 samples: time and memory
"""

import resource
import sys
import warnings
from dataclasses import replace
from functools import partial

import numpy as np
import pysindy
import sklearn
from sklearn.linear_model import lasso_path
from threadpoolctl import threadpool_limits

import ep2sindy as ep
from benchmarks.timing import cpu_s
from ep2sindy.model.many import rk4_step
from ep2sindy.regression.bootstraps import Bootstraps, pooled_supports
from ep2sindy.regression.differential import Differential
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
    supports = pooled_supports(problem, AdaptiveLasso(), BOOTSTRAPS, rng=rng)
    return [pareto_front(problem, found) for found in supports]


def plain(
    problem: RegressionRows, rng: np.random.Generator, *, distinct: bool
) -> list[dict[int, tuple]]:
    rows = problem.train_rows
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
    train, test = problem.train_rows, problem.test_rows
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


def long_record(n_samples: int = 10_000_000) -> None:
    """CPU time and peak memory of one regression with ten terms, and of the record alone."""
    walks = np.cumsum(np.random.default_rng(0).normal(scale=0.01, size=(n_samples, 3)), axis=0)
    np.sin(walks + np.arange(3), out=walks)
    run = ep.Trajectory(0.01 * np.arange(n_samples), walks, ["x", "y", "z"])
    del walks
    before_GiB = peak_GiB()
    method = replace(METHODS["thesis"], search=ep.BestSubset(), bootstraps=Bootstraps(n=0))
    call = partial(
        ep.discover, run, ep.polynomial(run.state_names, degree=2), method=method, seed=0
    )
    with threadpool_limits(limits=1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        total_s = cpu_s(call, n_runs=1)
    print(f"{n_samples} samples: {total_s:.0f} CPU-s, {peak_GiB():.2f} GiB at most", end=" ")
    print(f"(before the call {before_GiB:.2f})")


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
        states[k] = rk4_step(
            lambda x, _: system.model.derivative(x, np.empty(0)), states[k - 1], (t, t, t), step_s
        )
    noise = np.random.default_rng(0).normal(size=states.shape) * states.std(axis=0)
    return ep.Trajectory(t, states + 0.05 * noise, start.state_names)


if __name__ == "__main__":
    long_record() if sys.argv[1:] == ["long"] else main()
