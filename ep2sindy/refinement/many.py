"""Many models on the same windows at once: refined, or followed with their coefficients held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.constraints.relations import Constraint
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.judge import closed
from ep2sindy.refinement.ode import ODE, held, unconstrained
from ep2sindy.refinement.problem import Method, Problem
from ep2sindy.refinement.refine import with_coef
from ep2sindy.refinement.windows import WindowBatch
from ep2sindy.runtime.progress import Advance, nothing
from ep2sindy.runtime.threads import one_thread


@dataclass(frozen=True, eq=False)
class Together:
    """Models refined on the same windows, judged by none.

    finished: which met the method's own test. loss: mean square of (trajectory - data) in the
    batch's scale; infinite for a model whose refinement did not stay finite, which comes back as
    it was.
    """

    models: Sequence[SparseModel]
    finished: Bool[np.ndarray, " models"]
    loss: Float[np.ndarray, " models"]


@one_thread()
def refine_together(
    models: Sequence[SparseModel],
    batch: WindowBatch,
    *,
    method: Method,
    constraints: Sequence[Constraint] | None = None,
    n_reweights: int = 1,
    points_per_batch: int = 8,
    advance: Advance = nothing,
) -> Together:
    """Refine models of the same states on the same windows, with free starts, and judge none.

    constraints: one per model; None leaves all coefficients free. points_per_batch: as for
    `refine_many`; models may differ in their terms as there. advance: told of finished models.
    Raises ValueError for a model without terms.
    """
    found: list[SparseModel] = []
    finished, losses = [], []
    for first in range(0, len(models), points_per_batch):
        chunk = models[first : first + points_per_batch]
        relations = (
            [unconstrained(model) for model in chunk]
            if constraints is None
            else list(constraints[first : first + points_per_batch])
        )
        odes = [_scaled(m, batch, relation) for m, relation in zip(chunk, relations, strict=True)]
        problem = _unobserved(odes, [batch] * len(chunk), n_reweights=n_reweights)
        fit = method.fit(problem)
        for p, (model, ode) in enumerate(zip(chunk, problem.odes, strict=True)):
            free = ode.free0.cpu().numpy() * fit.scaling[p, : len(ode.free0)]
            refined, _ = with_coef(model, relations[p], relations[p].coef(free))
            found.append(refined if fit.finite[p] else model)
        finished.append(fit.finished & fit.finite)
        with np.errstate(over="ignore", invalid="ignore"):
            loss = np.square(fit.nodes - problem.data).mean(axis=(1, 2, 3))
        losses.append(np.where(fit.finite, loss, np.inf))
        advance(len(chunk))
    return Together(found, np.concatenate(finished), np.concatenate(losses))


def follow_together(
    models: Sequence[SparseModel],
    batch: WindowBatch,
    *,
    method: Method,
    points_per_batch: int = 8,
    advance: Advance = nothing,
) -> Float[np.ndarray, "models windows samples n_states"]:
    """Trajectories that follow the windows best: starts fitted, coefficients held.

    In units of the batch's scale; NaN in windows where a model blows up. points_per_batch: as
    for `refine_many`; models may differ in their terms as there. advance: told of those followed.
    Raises ValueError for a model without terms.
    """
    # Every window is a point of its own: one that blows up stops no other.
    windows = [
        replace(
            batch,
            steps=batch.steps[[w]],
            data=batch.data[[w]],
            inputs=batch.inputs[[w]],
            trajectory=batch.trajectory[[w]],
            start=batch.start[[w]],
        )
        for w in range(len(batch.start))
    ]
    found = []
    for first in range(0, len(models), points_per_batch):
        chunk = models[first : first + points_per_batch]
        odes = [_scaled(model, batch, held(model)) for model in chunk]
        problem = _unobserved(
            [ode for ode in odes for _ in windows], windows * len(chunk), n_reweights=0
        )
        found.append(closed(problem, method.fit(problem)))
        advance(len(chunk))
    return np.concatenate(found).reshape(len(models), *batch.data.shape)


def _scaled(model: SparseModel, batch: WindowBatch, relations: Constraint) -> ODE:
    return ODE(model, scale=batch.scale, step_s=batch.step_s, constraint=relations)


def _unobserved(
    odes: Sequence[ODE], batches: Sequence[WindowBatch], *, n_reweights: int
) -> Problem:
    """With free starts, and nobody watching."""
    return Problem(
        odes=tuple(odes),
        batches=tuple(batches),
        free_start=True,
        n_reweights=n_reweights,
        observe=lambda iteration: None,
    )
