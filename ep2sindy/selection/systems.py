"""Combinations of candidates as systems of equations that obey relations, ready to be refined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Int

from ep2sindy.constraints.relations import Constraint, Relation, binding, constraint
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.refine import refine, with_coef
from ep2sindy.refinement.windows import WindowBatch
from ep2sindy.search.front import ParetoFront
from ep2sindy.selection.combinations import support_of

# Steps of all windows of all systems that are refined together: more leave the cache.
BATCH_STEPS = 6000


@dataclass(frozen=True, eq=False)
class System:
    """One candidate per equation as a model whose coefficients obey the constraint."""

    model: SparseModel
    constraint: Constraint

    @property
    def n_terms(self) -> int:
        return int(np.count_nonzero(self.model.coef))

    def refined_on_all(
        self,
        runs: Sequence[Trajectory],
        *,
        window: int | None = None,
        n_windows: int = 30,
        n_reweights: int = 1,
        seed: int = 0,
    ) -> SparseModel:
        """Refined on windows spread over all the data, with the covariance of its coefficients.

        window: None takes one and a half periods. n_windows, n_reweights, and seed for its rng,
        as for `refine`. A system without terms, or one whose refinement does not stay finite,
        comes back as it is, without covariance.
        """
        if not len(self.constraint.free):
            return self.model
        found = refine(
            self.model,
            runs,
            n_windows=n_windows,
            window=window,
            constraint=self.constraint,
            n_reweights=n_reweights,
            rng=seed,
        )
        return found.model


def system_of(
    fronts: Sequence[ParetoFront],
    choice: Int[np.ndarray, " fronts"],
    relations: Sequence[Relation] = (),
) -> System:
    """A combination: free coefficients from the candidates, the others as the relations say."""
    problem, states = fronts[0].problem, [front.equation for front in fronts]
    chosen = [front.candidates[k] for front, k in zip(fronts, choice, strict=True)]
    coef = coef_matrix(problem.library, [candidate.coef_by_term for candidate in chosen])
    units = problem.trajectories[0].units if problem.trajectories else {}
    model = SparseModel(problem.library, states, coef, units)
    support = support_of(fronts, choice)
    held = constraint(problem.library, support, binding(relations, support) or ())
    places = [(model.library.index(term), states.index(state)) for state, term in held.coefficients]
    free = np.array([coef[places[k]] for k in held.free])
    return System(with_coef(model, held, held.coef(free))[0], held)


def budget(batch: WindowBatch) -> tuple[MultipleShooting, int]:
    """How long to refine systems that are to be judged, and how many together.

    The regression's coefficients are close: whole windows at once, and few iterations. Those
    that need more are the wrong ones.
    """
    method = MultipleShooting(first_block=batch.data.shape[1], tolerance=1e-3, max_iter=10)
    return method, max(1, BATCH_STEPS // batch.steps.size)
