"""The algorithm on one screen: trajectories and a library in, fronts and a model out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ep2sindy.ambiguity import Ambiguity, ambiguities
from ep2sindy.library import Library
from ep2sindy.model import SparseModel, assemble_model
from ep2sindy.pareto import Knee, ParetoFront, pareto_front
from ep2sindy.regression import Differential, Regression
from ep2sindy.search import Bootstraps, Search, pooled_supports
from ep2sindy.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Discovery:
    """What a search leaves: its rows, a front per state, the selected model, what to beware of."""

    problem: Regression
    fronts: Mapping[str, ParetoFront]
    model: SparseModel
    ambiguities: Sequence[Ambiguity]


def discover(
    trajectories: Sequence[Trajectory],
    library: Library,
    *,
    formulation: Differential,
    search: Search,
    bootstraps: Bootstraps,
    selection: Knee,
    rng: np.random.Generator,
) -> Discovery:
    """Find sparse equations for every state of the trajectories.

    Rows are assembled by `formulation`; `search` proposes supports in every bootstrap; each
    support is fitted to all training rows; `selection` picks one per equation from the front.
    """
    problem = formulation.assemble(trajectories, library, rng=rng)
    supports = pooled_supports(problem, search, bootstraps, rng=rng)
    fronts = {found.equation: pareto_front(problem, found) for found in supports}
    model = assemble_model(
        library,
        [selection.select(front) for front in fronts.values()],
        units=trajectories[0].units,
        provenance={
            "formulation": repr(formulation),
            "search": repr(search),
            "bootstraps": repr(bootstraps),
            "selection": repr(selection),
            "trajectories": ", ".join(run.label for run in trajectories),
        },
    )
    return Discovery(problem, fronts, model, ambiguities(problem))
