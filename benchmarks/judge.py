"""What is said of exact laws and of wrong ones: `python -m benchmarks.judge`.

Over systems with known equations, with a noise of 0, 1, 5 and 20 % of each state's RMS and three
draws of each: of how many records it is said that the exact law follows the samples, that one
whose coefficients are all off by 5 % does, and that one without its least term does; the distance
of the exact law in units of the noise, and how often its forecasts over one step are vetoed. It
sets the bounds of `ep2sindy/forecasting/following.py`. Prints a table of docs/judging.md.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import product

import numpy as np

import ep2sindy as ep
from benchmarks.known_systems import OTHERS, noisy
from ep2sindy.systems.draws import DRAWS

SYSTEMS, NOISES, SEEDS, OFF = [*DRAWS, *OTHERS], (0.0, 0.01, 0.05, 0.2), range(3), 0.05


def without_least(model: ep.SparseModel, run: ep.Trajectory) -> ep.SparseModel:
    """The model without the term that moves its state least over the record."""
    terms = model.library.evaluate(run.columns(model.library.variables))
    moved = np.abs(model.coef) * terms.std(axis=0)[:, None] / run.states.std(axis=0)
    coef = model.coef.copy()
    coef[np.unravel_index(np.argmin(np.where(coef == 0.0, np.inf, moved)), coef.shape)] = 0.0
    return replace(model, coef=coef)


def laws(model: ep.SparseModel, run: ep.Trajectory, seed: int) -> Iterator[ep.SparseModel]:
    """The exact law, one with all coefficients off, and one that lacks a term."""
    signs = np.random.default_rng(seed).choice([-1.0, 1.0], model.coef.shape)
    yield model
    yield replace(model, coef=model.coef * (1.0 + OFF * signs))
    yield without_least(model, run)


def main() -> None:
    warnings.simplefilter("ignore")
    print("noise  exact  5 % off  a term less  distance of the exact law  vetoed, of")
    for noise in NOISES:
        follows, distances, vetoed = [], [], []
        for name, seed in product(SYSTEMS, SEEDS):
            system, run = noisy(name, noise, seed)
            found = [ep.evaluate(each, run) for each in laws(system.model, run, seed)]
            follows.append([each.status is ep.model.Status.FOLLOWS for each in found])
            distances.append(max(found[0].distance.values()))
            vetoed.append(bool(found[0].one_step and found[0].one_step.rival))
        low, middle, high = np.quantile(distances, [0.1, 0.5, 0.9])
        counts = "  ".join(f"{n:5d}" for n in np.sum(follows, axis=0))
        print(
            f"{noise:5.0%}  {counts}  {middle:.2f} ({low:.2f} to {high:.2f})  {sum(vetoed)}, "
            f"{len(vetoed)}",
            flush=True,
        )


if __name__ == "__main__":
    main()
