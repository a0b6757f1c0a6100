"""Regimes of a synthetic channel with three known equations: adjusted Rand index by selection.

    python -m benchmarks.regimes [--seeds 3]

20 x 15 points of 1500 samples, best subsets of five terms, 32 bootstraps in blocks of a period; the
index counts points away from the transitions.
"""

import argparse

import numpy as np
from sklearn.metrics import adjusted_rand_score

from benchmarks.regions import STATES, RegionField, three_regions
from ep2sindy.discovery.method import Regression
from ep2sindy.discovery.pointwise import PointSearch, pointwise
from ep2sindy.discovery.regimes import Regimes, find_regimes
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.formulations import Differential
from ep2sindy.regression.searches import BestSubset
from ep2sindy.runtime.parallel import Loky
from ep2sindy.selection.criteria import EBIC, Knee, Selection

NOISES = (0.0, 0.02, 0.05, 0.1)
RULES: dict[str, Selection] = {"ebic": EBIC(), "knee": Knee()}


def found(truth: RegionField, rule: Selection, *, noise: float, seed: int) -> Regimes:
    rng = np.random.default_rng(seed)
    search = PointSearch(
        states=STATES,
        library=truth.library,
        method=Regression(
            formulation=Differential(),
            search=BestSubset(max_terms=5),
            selection=rule,
            bootstraps=Bootstraps(n=32, n_culled=0, block=35),
        ),
        seed=seed,
    )
    field = truth.noisy(noise, rng=rng).field
    return find_regimes(pointwise(field, search, workers=Loky()), rng=rng)


def main() -> None:
    parser = argparse.ArgumentParser(description="regimes of a field with known regions")
    parser.add_argument("--seeds", type=int, default=3)
    seeds = range(parser.parse_args().seeds)
    truth = three_regions()
    inside = truth.inside.values
    for name, rule in RULES.items():
        cells = []
        for noise in NOISES:
            runs = [found(truth, rule, noise=noise, seed=seed) for seed in seeds]
            scores = [
                adjusted_rand_score(truth.labels.values[inside], run.labels.values[inside])
                for run in runs
            ]
            n_regimes = "/".join(str(run.n_regimes) for run in runs)
            cells.append(f"{noise:.0%}: {min(scores):.2f} to {max(scores):.2f} ({n_regimes})")
        print(f"{name:<10} " + ", ".join(cells), flush=True)


if __name__ == "__main__":
    main()
