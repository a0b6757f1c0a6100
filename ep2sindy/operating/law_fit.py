"""A law fitted to windows of the records of all points at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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
from ep2sindy.regression.constrained import read_coefficients

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
    starts: list[np.ndarray | None] = [None] * len(runs)
    best, law, tried = _LawRows([], np.inf), fits.pool(functions), fits.pool(functions)
    ahead, fraction = law, 1.0
    for _ in range(MOST_STEPS):
        found = _linearise_all(fits, tried, at, runs, (n_windows, periods), starts)
        gain = best.loss - found.loss
        if gain > 0.0:
            best, law, fraction, starts = found, tried, 1.0, [*found.starts]
            if gain < SETTLED * found.loss:
                break
            ahead = replace(fits, rows=best.rows).pool(functions)
        else:
            fraction *= CUT
            if fraction < SMALLEST:
                break
        tried = law + fraction * (ahead - law)
    return replace(fits, rows=best.rows)


@dataclass(frozen=True, eq=False)
class _LawRows:
    """Rows of all points about a law, and the mean over the points of what windows leave.

    starts: of the windows of every point.
    """

    rows: Sequence[tuple[Float[np.ndarray, "free free"], Float[np.ndarray, " free"]]]
    loss: float
    starts: Sequence[np.ndarray] = ()


def _linearise_all(
    fits: PointFits,
    law: Float[np.ndarray, "free functions"],
    at: Float[np.ndarray, "points functions"],
    runs: Sequence[Trajectory],
    windows: tuple[int, float],
    near: Sequence[np.ndarray | None],
) -> _LawRows:
    """windows: their number and periods. near: their starts by a law that is near, if known."""
    rows, losses, starts = [], [], []
    held = fits.relations.at(fits.points)
    for k, (model, constraint, run) in enumerate(zip(fits.models, held, runs, strict=True)):
        z = law @ at[k]
        moved, _ = with_coef(model, constraint, constraint.coef(z))
        slope, left, loss, own = _linearise(moved, constraint, run, windows, near[k])
        rows.append((slope, slope @ z - left))
        losses.append(loss)
        starts.append(own)
    return _LawRows(rows, float(np.mean(losses)), starts)


def _linearise(
    model: SparseModel,
    held: Constraint,
    run: Trajectory,
    windows: tuple[int, float],
    near: Float[np.ndarray, "windows n_states"] | None,
) -> tuple[Float[np.ndarray, "free free"], Float[np.ndarray, " free"], float, np.ndarray]:
    """What windows leave, and its slopes by the free coefficients, starts eliminated.

    Both are triangles of a QR decomposition, over the root of the number of residuals; then the
    mean square of what is left, and the starts.
    """
    along, (n_windows, periods) = Restarts(model, run, ACCURATE), windows
    n_ahead = dominant_window([run], model.states, periods=periods) - 1
    first = along.starts(n_ahead, n_windows, measured=False)
    starts = along.fitted(first, n_ahead) if near is None else along.nearer(first, n_ahead, near)

    def off(of: Restarts, moved: Float[np.ndarray, "windows n_states"]) -> np.ndarray:
        found = of.off(of.paths(moved, first, n_ahead), first).reshape(len(first), -1)
        return np.where(np.isfinite(found), found, np.nan)

    left = off(along, starts)
    by_start = [(off(along, starts + MOVED * row) - left) / MOVED for row in np.diag(along.std)]
    z, by_coef = read_coefficients(model, held)[held.free], []
    for k, value in enumerate(z):
        step = MOVED * (abs(value) or 1.0)
        other, _ = with_coef(model, held, held.coef(z + step * (np.arange(len(z)) == k)))
        by_coef.append((off(along.of(other), starts) - left) / step)
    slopes = np.nan_to_num(np.array(by_coef).transpose(1, 2, 0), nan=0.0)
    moves = np.nan_to_num(np.array(by_start).transpose(1, 2, 0), nan=0.0)
    known = np.isfinite(left).all(axis=1) & np.isfinite(by_coef).all(axis=(0, 2))
    if not known.any():
        return np.zeros((len(z), len(z))), np.zeros(len(z)), LOST, starts
    rows = np.concatenate([slopes, left[..., None]], axis=-1)[known]
    basis, _ = np.linalg.qr(moves[known])
    rows = (rows - basis @ (basis.transpose(0, 2, 1) @ rows)).reshape(-1, len(z) + 1)
    loss = float(np.square(rows[:, -1]).mean())
    _, triangle = np.linalg.qr(rows / np.sqrt(len(rows)))
    share = float(known.mean())
    loss = share * loss + (1.0 - share) * LOST
    return triangle[: len(z), :-1], triangle[: len(z), -1], loss, starts
