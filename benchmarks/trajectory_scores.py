"""Selecting by trajectories: refined and free, and by EBIC next to them.

    python -m benchmarks.trajectory_scores [--n 12]

Realizations of four systems as the synthetic benchmark draws them; weighted weak form,
the two best subsets of every size up to four terms, depth 2.
"""

import argparse
import time
from functools import partial
from itertools import product

import numpy as np
import pandas as pd

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.regression.bootstraps import Bootstraps, pool_supports
from ep2sindy.regression.formulations import WeightedWeak
from ep2sindy.regression.front import ParetoFront, pareto_front
from ep2sindy.regression.searches import BestSubset
from ep2sindy.runtime.parallel import Loky
from ep2sindy.selection.criteria import EBIC, Selection
from ep2sindy.selection.free_run import FreeRunScore
from ep2sindy.systems.draws import realization

SYSTEMS = ("lotka_volterra", "van_der_pol", "oscillator", "lorenz")
NOISES = (0.0, 0.05, 0.2)
RULES: dict[str, Selection] = {
    "windows": FreeRunScore(bounds=None),
    "FreeRunScore": FreeRunScore(),
    "EBIC": EBIC(),
}


def assessed(number: int, *, name: str, noise: float) -> dict[str, float]:
    """Was the truth on the fronts, and which rule selected all of it? CPU seconds of each.

    A rule selects in vain where the truth is not there, and is not asked.
    """
    system, runs = realization(name, noise, number, n_trajectories=1, seed=7)
    rng = np.random.default_rng(number)
    fronts: list[ParetoFront] = [
        pareto_front(problem, found, depth=2)
        for problem in WeightedWeak().assemble(runs, system.model.library, rng=rng)
        for found in pool_supports(
            problem, BestSubset(max_terms=4, n_best=2), Bootstraps(n=0), rng=rng
        )
    ]
    truth = [set(system.model.terms(front.equation)) for front in fronts]
    there = all(
        any(set(c.terms) == terms for c in front.candidates)
        for front, terms in zip(fronts, truth, strict=True)
    )
    row = {"on the front": float(there)}
    for label, rule in RULES.items() if there else ():
        begin = time.process_time()
        scores = rule.decide(fronts, DiscoveryProblem(runs, system.model.library)).scores
        row[f"{label}, s"] = time.process_time() - begin
        chosen = [set(f.with_scores(s).best.terms) for f, s in zip(fronts, scores, strict=True)]
        row[label] = float(chosen == truth)
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description="selection by trajectories")
    parser.add_argument("--n", type=int, default=12, help="realizations per system and noise")
    n = parser.parse_args().n
    for name, noise in product(SYSTEMS, NOISES):
        assess = partial(assessed, name=name, noise=noise)
        table = pd.DataFrame([row for _, row in Loky().run(assess, range(n))])
        counts = ", ".join(f"{key} {table[key].sum():.0f}" for key in ("on the front", *RULES))
        cost = ", ".join(f"{rule} {table[f'{rule}, s'].mean():.2g} s" for rule in RULES)
        print(f"{name}, {noise:.0%}: of {n}, {counts}; CPU: {cost}", flush=True)


if __name__ == "__main__":
    main()
