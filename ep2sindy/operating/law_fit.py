"""A law fitted to windows of the records of all points at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint
from ep2sindy.model.model import SparseModel
from ep2sindy.model.restarts import MOVED, Restarts
from ep2sindy.operating.point_fits import PointFits
from ep2sindy.refinement.refine import with_coef
from ep2sindy.refinement.windows import dominant_window

ACCURATE = 1e-5  # error of a step between samples, as a fraction of the largest one

# Gauss-Newton steps of a law; one that gains less than this fraction of the loss is the last; a
# step that gains nothing is cut to this fraction, and given up below the last.
MOST_STEPS, SETTLED, CUT, SMALLEST = 8, 1e-3, 0.3, 0.02

LOST = 1.0  # loss of a window in which a model blows up: a constant's


def follow_windows(
    fits: PointFits,
    functions: Library,
    runs: Sequence[Trajectory],
    *,
    n_windows: int,
    periods: float,
) -> PointFits:
    """The fits with the rows by which their law follows windows of all records at once.

    Fits of single points differ in directions that their records hardly determine, so a law through
    them may follow none. Over the law W this

        minimises sum over points p and windows w of |x_w(t; W f(p)) - data_w|^2

    in standard deviations of each state at the point, by Gauss-Newton: the starts of windows are
    fitted for every W, and their derivatives eliminated. The rows (R_p, y_p) that are returned are
    linearised at the best W, so that laws without one of the points follow from them, too.
    fits: of each point alone, with which it begins. runs: one record of each point. n_windows,
    periods: number of windows of every record, and their length.
    """
    at = functions.evaluate(fits.columns(functions))
    points = list(zip(fits.models, fits.relations.at(fits.points), runs, at, strict=True))
    starts: Sequence[np.ndarray | None] = [None] * len(points)
    law = ahead = tried = fits.pool(functions)
    rows, least, fraction = fits.rows, np.inf, 1.0
    for _ in range(MOST_STEPS):
        found = [
            _linearise(model, held, run, tried @ own, near, n_windows=n_windows, periods=periods)
            for (model, held, run, own), near in zip(points, starts, strict=True)
        ]
        loss = float(np.mean([at_point.loss for at_point in found]))
        gain = least - loss
        if gain > 0.0:
            rows, starts = [at_point.rows for at_point in found], [each.starts for each in found]
            law, least, fraction = tried, loss, 1.0
            if gain < SETTLED * least:
                break
            ahead = replace(fits, rows=rows).pool(functions)
        else:
            fraction *= CUT
            if fraction < SMALLEST:
                break
        tried = law + fraction * (ahead - law)
    return replace(fits, rows=rows)


class _WindowRows(NamedTuple):
    """Rows (R, y) of a point about a law, the mean square of what windows leave, their starts."""

    rows: tuple[Float[np.ndarray, "free free"], Float[np.ndarray, " free"]]
    loss: float
    starts: Float[np.ndarray, "windows n_states"]


def _linearise(
    model: SparseModel,
    held: Constraint,
    run: Trajectory,
    z: Float[np.ndarray, " free"],
    near: Float[np.ndarray, "windows n_states"] | None,
    *,
    n_windows: int,
    periods: float,
) -> _WindowRows:
    """What windows leave at the free coefficients z, and its slopes by them, starts eliminated.

    Both are triangles of a QR decomposition, over the root of the number of residuals.
    near: starts of the windows by coefficients that are near, if known.
    """
    model, _ = with_coef(model, held, held.coef(z))
    along = Restarts(model, run, ACCURATE)
    n_ahead = dominant_window([run], model.states, periods=periods) - 1
    first = along.starts(n_ahead, n_windows, measured=False)
    starts = along.fitted(first, n_ahead) if near is None else along.nearer(first, n_ahead, near)

    def off(of: Restarts, moved: Float[np.ndarray, "windows n_states"]) -> np.ndarray:
        found = of.off(of.paths(moved, first, n_ahead), first).reshape(len(first), -1)
        return np.where(np.isfinite(found), found, np.nan)

    left = off(along, starts)
    by_start = [(off(along, starts + MOVED * row) - left) / MOVED for row in np.diag(along.std)]
    by_coef = []
    for k, value in enumerate(z):
        step = MOVED * (abs(value) or 1.0)
        other, _ = with_coef(model, held, held.coef(z + step * (np.arange(len(z)) == k)))
        by_coef.append((off(along.of(other), starts) - left) / step)
    slopes = np.nan_to_num(np.array(by_coef).transpose(1, 2, 0), nan=0.0)
    moves = np.nan_to_num(np.array(by_start).transpose(1, 2, 0), nan=0.0)
    known = np.isfinite(left).all(axis=1) & np.isfinite(by_coef).all(axis=(0, 2))
    if not known.any():
        return _WindowRows((np.zeros((len(z), len(z))), np.zeros(len(z))), LOST, starts)
    rows = np.concatenate([slopes, left[..., None]], axis=-1)[known]
    basis, _ = np.linalg.qr(moves[known])
    rows = (rows - basis @ (basis.transpose(0, 2, 1) @ rows)).reshape(-1, len(z) + 1)
    loss = float(np.square(rows[:, -1]).mean())
    _, triangle = np.linalg.qr(rows / np.sqrt(len(rows)))
    share = float(known.mean())
    R, left = triangle[: len(z), :-1], triangle[: len(z), -1]
    return _WindowRows((R, R @ z - left), share * loss + (1.0 - share) * LOST, starts)
