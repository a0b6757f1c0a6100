"""Right supports by joint search and at single points, on a family of known systems.

    python -m benchmarks.joint
    python -m benchmarks.joint 20      # realizations per noise level

Prints, per noise level, the percentage of realizations in which the supports of all equations are
right, and the errors of the coefficients, free and by the law.
"""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd

from benchmarks.breathing_family import LAW, LIBRARY, PARAMETERS, TRUTH, realization, system_at
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.method import AnyMethod, Regression
from ep2sindy.operating.fit_rows import fit_law
from ep2sindy.operating.shared_support import SharedDiscovery, discover_shared
from ep2sindy.regression.formulations import RandomSplit, Weak, WeightedWeak
from ep2sindy.regression.searches import BestSubset
from ep2sindy.regression.windows import Bumps
from ep2sindy.runtime.parallel import Loky, Workers
from ep2sindy.selection.criteria import EBIC


def find(method: AnyMethod, points: Mapping[str, Sequence[Trajectory]]) -> SharedDiscovery:
    """The same search for all points jointly and for one alone."""
    return discover_shared(points, LIBRARY, method, seed=0)


def run_family(
    method: AnyMethod,
    *,
    noises: Sequence[float],
    n_realizations: int,
    workers: Workers,
    seed: int = 0,
    progress: Callable[[int], None] = lambda n_done: None,
) -> pd.DataFrame:
    """Search every realization at all points jointly, and at every point alone.

    One row per noise and number. joint, pooled and one column per point: 1 where the supports of
    all equations are right; pooled is one regression over all points, with one set of
    coefficients. error_free, error_law: RMS relative error of the coefficients at all points,
    free or by the true law, and p_value the least of the equations', where joint is right.
    """
    if n_realizations < 1 or not len(noises):
        raise ValueError(
            "a study needs a noise level and a realization at least: "
            f"noises={list(noises)}, n_realizations={n_realizations}"
        )
    tasks = [(noise, number) for noise in noises for number in range(n_realizations)]
    rows = {}
    for k, row in workers.run(partial(outcome, method, seed=seed), tasks):
        rows[k] = row
        progress(len(rows))
    return pd.DataFrame([rows[k] for k in range(len(tasks))])


def outcome(method: AnyMethod, task: tuple[float, int], *, seed: int = 0) -> dict[str, float]:
    """One realization: one row of `run_family`."""
    noise, number = task
    points = realization(noise, number, seed=seed)
    joint = find(method, points)
    pooled = find(method, {"all": [run for runs in points.values() for run in runs]})
    row = {"noise": noise, "number": number, "joint": _right(joint), "pooled": _right(pooled)}
    row |= {point: _right(find(method, {point: runs})) for point, runs in points.items()}
    return row | (_errors(joint) if row["joint"] else dict.fromkeys(ERRORS, np.nan))


def _right(found: SharedDiscovery) -> float:
    return float(all(set(found.chosen[state]) == set(terms) for state, terms in TRUTH.items()))


ERRORS = ("error_free", "error_law", "p_value")


def _errors(joint: SharedDiscovery) -> dict[str, float]:
    fit = fit_law(joint, LAW, parameters=PARAMETERS)
    errors: dict[str, list[float]] = {"error_free": [], "error_law": []}
    for point, parameters in PARAMETERS.items():
        truth = system_at(parameters).model
        for name, model in (
            ("error_free", joint.models[point]),
            ("error_law", fit.law.model_at(parameters)),
        ):
            used = truth.coef != 0.0
            errors[name] += (model.coef[used] / truth.coef[used] - 1.0).tolist()
    found = {name: float(np.sqrt(np.mean(np.square(each)))) for name, each in errors.items()}
    return found | {"p_value": min(e.p_value for e in fit.tests.values())}


def rates(outcomes: pd.DataFrame) -> pd.DataFrame:
    """Realizations with the right support, in %, by noise: joint, pooled, every point alone."""
    shown = ["joint", "pooled", *PARAMETERS]
    return 100.0 * outcomes.groupby("noise")[shown].mean()


NOISES = (0.0, 0.05, 0.1)
# The same for joint search and single points. A tenth of a record: the automatic width can leave
# fewer windows than terms in a record this short. Five candidates of each size: the rows are
# weighted under the whole library, where a wrong support can lead its size by a hair; the
# criterion weighs them again under the candidate.
METHOD = Regression(
    WeightedWeak(Weak(test_functions=Bumps(half_width_s=1.5), split=RandomSplit(0.0))),
    BestSubset(n_best=5),
    selection=EBIC(),
    depth=5,
)


def main() -> None:
    n_realizations = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    start = time.perf_counter()
    outcomes = run_family(METHOD, noises=NOISES, n_realizations=n_realizations, workers=Loky())
    errors = outcomes.groupby("noise")[["error_free", "error_law"]].median()
    calm = outcomes.groupby("noise")["p_value"].agg(lambda p: (p > 0.05 / 2).mean())
    with pd.option_context(
        "display.width", 120, "display.max_columns", 20, "display.float_format", "{:.4g}".format
    ):
        print(f"right supports, % of {n_realizations} realizations")
        print(rates(outcomes))
        print("median relative error of the coefficients where the joint support is right")
        print(errors.assign(law_not_rejected=calm))
    print(f"{time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
