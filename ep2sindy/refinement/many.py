"""Many models on the same windows at once: refined, or followed with their coefficients held."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.constraints.relations import Constraint
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.judge import closed
from ep2sindy.refinement.ode import ODE, held, unconstrained
from ep2sindy.refinement.problem import Method, Problem
from ep2sindy.refinement.refine import with_coef
from ep2sindy.refinement.windows import WindowBatch


def refine_together(
    models: Sequence[SparseModel],
    batch: WindowBatch,
    *,
    method: Method,
    n_reweights: int = 1,
    points_per_batch: int = 8,
) -> tuple[list[SparseModel], Bool[np.ndarray, " models"]]:
    """Refine models of the same states on the same windows, with free starts, and judge none.

    Returns them and which of them met the method's own test. A model whose refinement does not
    stay finite comes back as it was. points_per_batch: as for `refine_many`; models may differ in
    their terms as there. Raises ValueError for a model without terms.
    """
    found: list[SparseModel] = []
    finished = []
    for first in range(0, len(models), points_per_batch):
        chunk = models[first : first + points_per_batch]
        relations = [unconstrained(model) for model in chunk]
        odes = [_scaled(m, batch, relation) for m, relation in zip(chunk, relations, strict=True)]
        problem = _unobserved(odes, [batch] * len(chunk), n_reweights=n_reweights)
        fit = method.fit(problem)
        for p, (model, ode) in enumerate(zip(chunk, problem.odes, strict=True)):
            values = ode.free0.cpu().numpy() * fit.scaling[p, : len(ode.free0)]
            found.append(with_coef(model, relations[p], values)[0] if fit.finite[p] else model)
        finished.append(fit.finished & fit.finite)
    return found, np.concatenate(finished)


def follow_together(
    models: Sequence[SparseModel],
    batch: WindowBatch,
    *,
    method: Method,
    points_per_batch: int = 8,
) -> Float[np.ndarray, "models windows samples n_states"]:
    """Trajectories that follow the windows best: starts fitted, coefficients held.

    In units of the batch's scale; NaN in windows where a model blows up. points_per_batch: as
    for `refine_many`; models may differ in their terms as there.
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
