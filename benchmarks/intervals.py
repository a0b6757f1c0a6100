"""How often 95 % intervals of the weighted weak form hold the true coefficient, at 5 % noise.

python -m benchmarks.intervals --n 200
"""

import argparse
from functools import partial

import numpy as np

from ep2sindy.discovery.choice import reweight
from ep2sindy.regression.formulations import RandomSplit, Weak
from ep2sindy.regression.front import fit_support
from ep2sindy.runtime.parallel import Loky
from ep2sindy.systems.draws import DRAWS, realization

NOISE = 0.05


def held(name: str, number: int) -> list[bool]:
    """For every true coefficient of one realization: is it inside its interval?"""
    system, runs = realization(name, NOISE, number, seed=1)
    formulation = Weak(split=RandomSplit(0.0))
    inside: list[bool] = []
    rng = np.random.default_rng(0)
    for problem in formulation.assemble(runs, system.model.library, rng=rng):
        (state,) = problem.equations
        truth = system.model.terms(state)
        candidate = reweight(problem, fit_support(problem, state, list(truth)))
        assert candidate.covariance is not None
        error = candidate.coef - [truth[term] for term in candidate.terms]
        inside += (np.abs(error) < 1.96 * np.sqrt(np.diag(candidate.covariance))).tolist()
    return inside


def main() -> None:
    parser = argparse.ArgumentParser(description="coverage of 95 % intervals at 5 % noise")
    parser.add_argument("--n", type=int, default=200, help="realizations per system")
    n = parser.parse_args().n
    print(f"true coefficients inside their 95 % interval, {n} realizations at 5 % noise")
    for name in DRAWS:
        found = dict(Loky().run(partial(held, name), range(n))).values()
        print(f"{name:<16}{np.mean(list(found)):7.1%}")


if __name__ == "__main__":
    main()
