"""Elimination on trajectories: the least certain term is dropped and the rest refined, in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.relations import Constraint
from ep2sindy.model.comparison import Verdict
from ep2sindy.model.free_run import free_run
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.ode import unconstrained
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.refinement.refine import Refinement, refine, with_coef
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.runtime.values import check_count

SETTINGS = RefinementSettings()

# Least mean square of a state's residuals, in its variance, that counts: below it a score would
# pay for terms that fit the error of the time step.
LEAST_LOSS = 1e-8

# A model to start from, its constraint, and the (state, term) that it has no more.
Shorter = tuple[SparseModel, Constraint, tuple[tuple[str, str], ...]]


@dataclass(frozen=True, eq=False)
class Elimination:
    """Models from all terms to the fewest, each refined, and the one that is recommended.

    refinements: the model with all terms first. dropped: for each further one, the (state, term)
    that are gone. scores: n sum_s log(loss_s) + log(n) n_free, the Bayesian information criterion
    of the trajectories in their windows: n is the number of samples, loss_s the mean square of
    (trajectory - data) / std of state s; infinite for models that do not stay finite.
    verdicts: of free runs over the record that was given, empty without one.
    best: number of the recommended refinement: of those of the best verdict, the least score.
    """

    refinements: tuple[Refinement, ...]
    dropped: tuple[tuple[tuple[str, str], ...], ...]
    scores: Float[np.ndarray, " models"]
    verdicts: tuple[Verdict, ...]
    best: int

    @property
    def refinement(self) -> Refinement:
        """The recommended refinement."""
        return self.refinements[self.best]

    @property
    def model(self) -> SparseModel:
        """The recommended model."""
        return self.refinement.model

    def __repr__(self) -> str:
        lines = []
        for k, found in enumerate(self.refinements):
            gone = "all terms" if not k else "without " + join_names(self.dropped[k - 1])
            verdict = f", {self.verdicts[k]}" if self.verdicts else ""
            lines.append(
                f"{'->' if k == self.best else '  '} {np.count_nonzero(found.model.coef):3d} terms,"
                f" loss {found.loss:.3g}, score {self.scores[k]:.6g}, {found.status}{verdict}: "
                f"{gone}"
            )
        return "\n".join(lines)


def join_names(terms: Sequence[tuple[str, str]]) -> str:
    """Terms by equation, as relations write them."""
    return ", ".join(f"{state}: {term}" for state, term in terms)


def eliminate(
    model: SparseModel | Refinement,
    trajectories: Sequence[Trajectory],
    settings: RefinementSettings = SETTINGS,
    *,
    min_free: int = 1,
    run_over: Trajectory | None = None,
    seed: int | np.random.Generator = 0,
    progress: Progress | bool = False,
) -> Elimination:
    """Refine a model, drop the term of least |t|, refine the rest from there, and so on.

    t is a coefficient by its standard error. Under a constraint (`settings.constraint`) it is
    that of a free coefficient, and the terms that relations bind to it alone go with it; known
    coefficients stay. All models are refined on the same windows, each from the last one's
    coefficients. The path ends at `min_free` free coefficients, where a state would be left
    without terms, or where a refinement does not stay finite.
    run_over: a record, best one that is not fitted, over which each model is run freely from its
    first sample; a model that lives is then preferred to all that do not. Without it the score
    alone recommends a model, which follows windows, but may run away beyond them.
    Raises ValueError for min_free below one, and as `refine` does.

    >>> runs = [ep.lotka_volterra().trajectory(noise=0.02, rng=0)]
    >>> model = ep.discover(runs).model
    >>> ep.eliminate(model, runs, min_free=3).best
    0
    """
    check_count("min_free", min_free)
    model = model.model if isinstance(model, Refinement) else model
    constraint = unconstrained(model) if settings.constraint is None else settings.constraint
    places = int(np.random.default_rng(seed).integers(2**32))  # the same windows for all
    path: list[Refinement] = []
    dropped: list[tuple[tuple[str, str], ...]] = []
    scores: list[float] = []
    shorter: Shorter | None = (model, constraint, ())
    with as_progress(progress).stage(None, "model", "elimination") as advance:
        while shorter is not None:
            model, constraint, gone = shorter
            found = refine(model, trajectories, settings, constraint=constraint, seed=places)
            path.append(found)
            dropped.append(gone)
            scores.append(_score(found, len(constraint.free)))
            advance(1)
            shorter = _without_weakest(found.model, constraint, min_free=min_free)
    runs = () if run_over is None else (free_run(each.model, run_over) for each in path)
    verdicts = tuple(run.verdict for run in runs)
    rank = [list(Verdict).index(verdict) for verdict in verdicts] or [0] * len(path)
    best = int(np.lexsort((scores, rank))[0])
    return Elimination(tuple(path), tuple(dropped[1:]), np.array(scores), verdicts, best)


def _without_weakest(
    model: SparseModel, constraint: Constraint, *, min_free: int
) -> Shorter | None:
    """Model and constraint without the free coefficient of least |t|, and the terms that go."""
    t = t_values(model, constraint)
    if t is None or len(t) <= min_free:
        return None
    rest = np.delete(np.arange(len(t)), int(np.argmin(t)))
    C = constraint.C[:, rest]
    stays = C.any(axis=1) | (constraint.d != 0.0)
    kept = [pair for pair, stay in zip(constraint.coefficients, stays, strict=True) if stay]
    if {state for state, _ in kept} != {state for state, _ in constraint.coefficients}:
        return None
    place = np.cumsum(stays) - 1
    shorter = replace(
        constraint,
        coefficients=tuple(kept),
        C=C[stays],
        d=constraint.d[stays],
        free=place[constraint.free[rest]],
        processes=(),
    )
    values = [model.coef[model.library.index(term), model.states.index(s)] for s, term in kept]
    z = np.array(values)[shorter.free]
    gone = [p for p, stay in zip(constraint.coefficients, stays, strict=True) if not stay]
    return with_coef(model, shorter, shorter.coef(z))[0], shorter, tuple(gone)


def t_values(model: SparseModel, constraint: Constraint) -> Float[np.ndarray, " free"] | None:
    """|coefficient| / standard error of every free coefficient; None without a covariance."""
    if model.covariance is None:
        return None
    error = np.sqrt(np.maximum(np.diag(model.covariance), 0.0))
    pairs = [(state, term) for state in model.states for term in model.terms(state)]
    at = {pair: k for k, pair in enumerate(pairs)}
    coef = np.concatenate([column[column != 0.0] for column in model.coef.T])
    free = [at[constraint.coefficients[int(k)]] for k in constraint.free]
    return np.abs(coef[free]) / np.maximum(error[free], 1e-300)


def _score(found: Refinement, n_free: int) -> float:
    """Bayesian information criterion of the trajectories; infinite if they are not finite."""
    if not np.isfinite(found.loss):
        return float("inf")
    batch = found.batch
    scale = batch.scale[: found.trajectories.shape[-1]]
    loss = np.square(found.trajectories / scale - batch.data).mean(axis=(0, 1))
    n = batch.data.shape[0] * batch.data.shape[1] / batch.multiplicity
    return float(n * np.log(np.maximum(loss, LEAST_LOSS)).sum() + n_free * np.log(n))
