"""Scores of predictions against data."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ep2sindy.data.coerce import check_domain, keep_inside, noise_inside
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.vector_field import Equations
from ep2sindy.signals.smoothers import Smoother


def r2(
    *, truth: Float[np.ndarray, " rows"], prediction: Float[np.ndarray, "models rows"]
) -> Float[np.ndarray, " models"]:
    """Coefficient of determination, 1 - SS_res/SS_tot, with SS_tot about the mean of the truth."""
    spread = np.square(truth - truth.mean()).sum()
    return r2_of(np.square(truth - prediction).sum(axis=1), spread=float(spread))


def r2_of(squares: Float[np.ndarray, " models"], *, spread: float) -> Float[np.ndarray, " models"]:
    """As `r2`, from the sums of squares of the residuals; spread: of the truth about its mean.

    Raises ValueError for a truth that is constant.
    """
    if spread == 0.0:
        raise ValueError(
            "R2 needs a target that varies: it is constant on these rows; hold out more rows "
            "or check that the state varies"
        )
    return 1.0 - squares / spread


def derivative_r2(
    model: Equations,
    run: Trajectory,
    *,
    x_dot: Float[np.ndarray, "_ _"] | None,
    smoother: Smoother,
) -> float:
    """Mean over the states of the R2 of their derivatives; see `SparseModel.score`."""
    library = model.field.library
    check_domain([run], library, smooth=x_dot is None)
    values, data = run.columns(library.variables), run.columns(model.states)
    if x_dot is None:
        smooth, sides = [], []
        for each in run.stretches():
            samples = each.columns(library.variables)
            inside = noise_inside(library, samples)
            smooth.append(keep_inside(library, smoother.smooth(each.t, samples), inside))
            sides.append(smoother.derivative(each.t, each.columns(model.states)))
        values, truth = np.concatenate(smooth), np.concatenate(sides)
    else:
        truth = np.asarray(x_dot, dtype=np.float64)
        if truth.shape != data.shape:
            raise ValueError(
                f"x_dot must have shape {data.shape}, a row per sample and a column for each of "
                f"{list(model.states)}: {truth.shape} came"
            )
    found = model.field.rates(values)
    pairs = zip(truth.T, found.T, strict=True)
    return float(np.mean([r2(truth=y, prediction=p[None])[0] for y, p in pairs]))
