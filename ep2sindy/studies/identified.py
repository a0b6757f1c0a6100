"""What one variant identifies of known systems, integrated beside them: figures of `benchmark`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.recipe import Recipe
from ep2sindy.figures.attractors import Identified
from ep2sindy.machine.progress import SILENT, Progress, counted
from ep2sindy.studies.variants import Variant
from ep2sindy.systems.draws import realization


@dataclass(frozen=True, eq=False)
class FirstRealizations:
    """The first realization of every system and noise, and what a variant made of it."""

    variant: str
    found: Sequence[Identified]


def first_realizations(
    variants: Mapping[str, Variant],
    systems: Sequence[str],
    noises: Sequence[float],
    *,
    n_trajectories: int,
    seed: int,
    progress: Progress = SILENT,
) -> FirstRealizations | None:
    """By the last variant that makes models, searched as the benchmark does; None without one.

    Others offer supports alone.
    """
    recipes = [(name, each) for name, each in variants.items() if isinstance(each, Recipe)]
    if not recipes:
        return None
    name, recipe = recipes[-1]
    found = []
    pairs = list(product(systems, sorted(noises)))
    for label, noise in counted(progress, pairs, "model", "first realizations"):
        (system, runs), (_, (truth, *_)) = (
            realization(label, level, 0, n_trajectories=n_trajectories, seed=seed)
            for level in (noise, 0.0)
        )
        rng = np.random.default_rng([seed, 0, *name.encode()])
        model = discover(runs, system.model.library, recipe, seed=rng, progress=progress).model
        right = np.array_equal(model.coef != 0.0, system.model.coef != 0.0)
        found.append(Identified(label, noise, runs[0], truth, model.rollout(truth), right))
    return FirstRealizations(name, found)
