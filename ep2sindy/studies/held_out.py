"""Known terms fitted in several ways to the first part of a record, judged on the rest."""

from __future__ import annotations

from dataclasses import dataclass, replace
from time import process_time

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares

from ep2sindy.constraints.fit import constrained_fit
from ep2sindy.constraints.relations import Constraint
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.model.free_run import FreeRun, free_run
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.windows import dominant_window
from ep2sindy.regression.rows import Formulation

DIVERGED = 10.0  # residual, in std, of samples that a run does not reach


@dataclass(frozen=True, eq=False)
class Judged:
    """A fit and what it does on the held-out part.

    from_sample: started at the first sample; from_fit: at a start fitted to the first samples,
    for one sample may lie off every orbit of the model. cpu_s: of the fit, without that of the
    model it starts from. status, loss: of a refinement; None and NaN for least squares.
    """

    model: SparseModel
    from_sample: FreeRun
    from_fit: FreeRun
    cpu_s: float
    status: str | None
    loss: float


def first_and_last(run: Trajectory, held_out: float) -> tuple[Trajectory, Trajectory]:
    """The first part of a record, and the last `held_out` of its samples.

    Raises ValueError for a share that leaves either of them under 20 samples.
    """
    n_train = round(run.n_samples * (1.0 - held_out))
    if min(n_train, run.n_samples - n_train) < 20:
        raise ValueError(
            f"held_out={held_out} must leave 20 samples on either side: the data have "
            f"{run.n_samples}"
        )
    return run.window(0, n_train), run.window(n_train, run.n_samples)


def fit_and_judge(
    train: Trajectory,
    held: Trajectory,
    library: Library,
    constraint: Constraint,
    formulation: Formulation,
    *,
    rng: np.random.Generator,
) -> Judged:
    """Least squares under the constraint, in one form of the regression.

    Without covariance: smoothed rows and overlapping windows are not independent, and intervals
    that took them for it would be too narrow.
    """
    begun = process_time()
    model = constrained_fit(
        formulation.assemble([train], library, rng=rng),
        constraint,
        units=train.units,
        provenance={"formulation": repr(formulation), "trajectories": train.label},
    )
    return judge(replace(model, covariance=None), held, cpu_s=process_time() - begun)


def judge(
    model: SparseModel,
    held: Trajectory,
    *,
    cpu_s: float = float("nan"),
    status: str | None = None,
    loss: float = float("nan"),
) -> Judged:
    """Integrate a fitted model over the held-out part, from its first sample and from a fit."""
    return Judged(
        model=model,
        from_sample=free_run(model, held),
        from_fit=free_run(model, held, initial=_fitted_start(model, held)),
        cpu_s=cpu_s,
        status=status,
        loss=loss,
    )


def _fitted_start(model: SparseModel, run: Trajectory) -> Float[np.ndarray, " n_states"]:
    """The initial state whose trajectory is closest to the first one and a half periods.

    Distances in standard deviations of the data; the search begins at the first sample.
    """
    n_samples = min(dominant_window([run], model.states), run.n_samples)
    data = run.window(0, n_samples).columns(model.states)
    std = run.columns(model.states).std(axis=0)

    def residual(start: np.ndarray) -> np.ndarray:
        rollout = model.rollout(run, n_samples=n_samples, initial=start * std, rtol=1e-6)
        strayed = np.full(data.shape, DIVERGED)
        strayed[: len(rollout.t)] = (rollout.states - data[: len(rollout.t)]) / std
        return strayed.ravel()

    return least_squares(residual, data[0] / std, diff_step=1e-4).x * std
