"""Regimes of a field: groups of points where the same terms act, their number and certainty.

The pointwise study gives every point its equations. A term's weight at a point is its signed
fraction of the equation. Regimes differ by which terms act, as source or sink, so a weight w counts
as w |w| / (w^2 + LEAST^2): near 0 well below the fraction LEAST, near +-1 well above it. The points
are grouped by a Gaussian mixture of these values. No component is narrower than RESOLUTION or than
the bootstraps' own spread, and Schwarz's criterion decides on the number of components. Neighbours
are alike and no regime is exact, so with enough points any difference would become significant: the
likelihood is therefore raised to the power 1 / (1 + n_points / COARSENING). If equations change
gradually from one regime to another, the points between may still come out as a regime of their
own. Sources: Callaham, Koch, Brunton, Kutz & Brunton 2021, doi:10.1038/s41467-021-21331-z (regimes
as clusters of the balance between terms); Schwarz 1978, doi:10.1214/aos/1176344136; Miller & Dunson
2019, doi:10.1080/01621459.2018.1469995 (coarsening).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float, Int
from sklearn.mixture import GaussianMixture

from ep2sindy.data.fields import SPACE
from ep2sindy.runtime.threads import one_thread
from ep2sindy.runtime.values import check_count

N_STARTS = 20  # of the mixture's iteration, which may converge to a poor optimum

COARSENING = 100.0  # number of points at which evidence stops growing

UNSURE = 0.5  # confidence below which a point counts as unsure

LEAST = 0.1  # fraction of an equation from which a term acts

EVERYWHERE = 0.9  # of a regime's points: a term that as many hold, with one sign, acts all the same

RESOLUTION = 0.2  # least width of a regime, in activities of terms


@dataclass(frozen=True, eq=False)
class Regimes:
    """Groups of points that share an equation.

    labels: over those of z and r that the field has; 0 is the largest regime, -1 a point without
    equations. confidence: same shape, mean probability of the point's regime over the bootstraps;
    NaN where labels are -1.
    table: one row per regime, equation and term. acts: True if the median of |weight| reaches
    LEAST, or if in_support reaches EVERYWHERE and coef_low and coef_high have one sign.
    in_support: fraction of the regime's points whose support holds the term. weight: the
    median. coef, coef_low and coef_high: median, 16 % and 84 % of the points that hold the term, in
    the unit of the column coef_units. n_points, confidence (mean) and unsure (fraction of the
    points whose confidence is below UNSURE) are those of the regime. at_limit: True if there are as
    many regimes as max_regimes allows; the points may support more.
    """

    labels: xr.DataArray
    confidence: xr.DataArray
    table: pd.DataFrame
    at_limit: bool

    @property
    def n_regimes(self) -> int:
        return int(self.labels.max()) + 1

    def equations(self, regime: int) -> dict[str, dict[str, float]]:
        """Acting terms of each equation in a regime, with the medians of their coefficients.

        The medians are over the points that have the term. No single point need have exactly this
        equation: see in_support and the spread in the table.
        """
        if not 0 <= regime < self.n_regimes:
            raise ValueError(f"regimes run from 0 to {self.n_regimes - 1}, got {regime}")
        rows = self.table[self.table["regime"] == regime]
        return {
            str(equation): dict(zip(acting["term"], acting["coef"], strict=True))
            for equation, terms in rows.groupby("equation", sort=False)
            for acting in [terms[terms["acts"]]]
        }


def find_regimes(
    result: xr.Dataset,
    *,
    rng: np.random.Generator | int,
    max_regimes: int = 8,
) -> Regimes:
    """Group the points of a pointwise study by the terms that act in their equations.

    result: as returned by `pointwise`. Its variables weight, weight_draws, coef and coef_units are
    used, with the dimensions equation, term, draw, and those of z and r that the field has.
    max_regimes: if as many are found, the points may support more.
    Raises ValueError if no point has equations, or if there are no bootstraps.
    """
    rng = np.random.default_rng(rng)
    if not result.sizes["draw"]:
        raise ValueError("a regime's confidence needs bootstraps: the study made none; ask for 32")
    space = [axis for axis in SPACE if axis in result["weight"].dims]
    weights = _rows(result["weight"], space)
    draws = _rows(result["weight_draws"], space)
    coef = _rows(result["coef"], space)
    valid = np.isfinite(weights).all(axis=(1, 2))
    if not valid.any():
        raise ValueError(
            f"regimes need a point with equations: none of the {len(valid)} points of the study "
            "has any; its variable `status` says why"
        )
    labels = np.full(len(valid), -1)
    confidence = np.full(len(valid), np.nan)
    labels[valid], confidence[valid] = group_points(
        weights[valid].reshape(valid.sum(), -1),
        np.moveaxis(draws[valid], 1, 0).reshape(draws.shape[1], valid.sum(), -1),
        rng=rng,
        max_regimes=max_regimes,
    )
    grid = result["weight"].isel(equation=0, term=0, drop=True).transpose(*space)
    return Regimes(
        labels=xr.DataArray(labels.reshape(grid.shape), grid.coords, space, "regime"),
        confidence=xr.DataArray(confidence.reshape(grid.shape), grid.coords, space, "confidence"),
        table=_table(result, labels, confidence, weights, coef),
        at_limit=int(labels.max()) + 1 == max_regimes,
    )


def _rows(array: xr.DataArray, space: Sequence[str]) -> np.ndarray:
    """Values with the points along the first axis, then any draws, equations and terms."""
    rest = [axis for axis in ("draw", "equation", "term") if axis in array.dims]
    values = array.transpose(*space, *rest).values
    return values.reshape(-1, *values.shape[len(space) :])


def group_points(
    weights: Float[np.ndarray, "points features"],
    draws: Float[np.ndarray, "draws points features"],
    *,
    rng: np.random.Generator | int,
    max_regimes: int = 8,
) -> tuple[Int[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Regime and confidence of every point; the order of the points does not matter.

    weights: signed fractions of all terms in all equations. draws: the same from each bootstrap,
    NaN if it could not be fitted. The confidence is the probability of the point's regime under the
    mixture, averaged over the bootstraps. It is low if they disagree or fail, and for a point
    between two regimes. Raises ValueError unless max_regimes is one or more.
    """
    rng, _ = np.random.default_rng(rng), check_count("max_regimes", max_regimes)
    known = np.isfinite(draws).all(axis=2)
    acting = _action(weights)
    drawn = _action(np.where(known[:, :, None], draws, weights))
    floor = RESOLUTION**2 + float(drawn.var(axis=0).mean())
    mixture = _mixture(acting, floor, max_regimes, seed=int(rng.integers(2**31)))
    if mixture is None:
        return np.zeros(len(weights), dtype=np.int64), known.mean(axis=0)
    found = mixture.predict(acting)
    # A component may be the likeliest at no point; the largest regime comes first.
    names, which, sizes = np.unique(found, return_inverse=True, return_counts=True)
    order = np.lexsort([*mixture.means_[names].T, -sizes])
    labels = np.argsort(order)[which]
    chosen = np.arange(len(found)), found
    agreeing = np.array([mixture.predict_proba(draw)[chosen] for draw in drawn])
    return labels, (known * agreeing).mean(axis=0)


def _action(weights: np.ndarray) -> np.ndarray:
    """Activity of a term by its weight: 0 if inactive, +-1/2 at the fraction LEAST, at most +-1."""
    return weights * np.abs(weights) / (weights**2 + LEAST**2)


def _mixture(
    features: np.ndarray, floor: float, max_regimes: int, *, seed: int
) -> GaussianMixture | None:
    """The mixture of least coarsened BIC; None if one regime suffices.

    floor: added to the variance of every component.
    """
    # Sorted, so that the random starts do not depend on the order of the points.
    points = features[np.lexsort(features.T)]
    n_most = min(max_regimes, len(np.unique(points, axis=0)))
    if n_most == 1:
        return None
    sizes = np.arange(1, n_most + 1)
    with one_thread():  # steps are too short for threads to pay
        candidates = [
            GaussianMixture(
                n, covariance_type="spherical", reg_covar=floor, n_init=N_STARTS, random_state=seed
            ).fit(points)
            for n in sizes.tolist()
        ]
    n_effective = len(points) / (1.0 + len(points) / COARSENING)
    # Each component has a mean, a variance and a fraction; the fractions sum to one.
    n_parameters = sizes * (points.shape[1] + 2) - 1
    cost = np.array([-2.0 * mixture.score(points) for mixture in candidates])
    best = int(np.argmin(n_effective * cost + n_parameters * np.log(n_effective)))
    return candidates[best] if best else None


def spread(coef: Float[np.ndarray, " points"]) -> tuple[float, float, float]:
    """16, 50 and 84 % quantiles over the points that have the term; NaN if none has it."""
    held = coef[coef != 0.0]
    low, middle, high = np.percentile(held, [16, 50, 84]) if held.size else [np.nan] * 3
    return low, middle, high


def _table(
    result: xr.Dataset,
    labels: Int[np.ndarray, " points"],
    confidence: Float[np.ndarray, " points"],
    weights: Float[np.ndarray, "points equations terms"],
    coef: Float[np.ndarray, "points equations terms"],
) -> pd.DataFrame:
    """One row per regime, equation and term: see `Regimes`."""
    rows: list[dict[str, object]] = []
    for regime in range(labels.max() + 1):
        inside = labels == regime
        for e, equation in enumerate(result["equation"].values):
            for k, term in enumerate(result["term"].values):
                values = coef[inside, e, k]
                low, middle, high = spread(values)
                weight, held = weights[inside, e, k], np.count_nonzero(values) / inside.sum()
                everywhere = held >= EVERYWHERE and low * high > 0.0
                rows.append(
                    {
                        "regime": regime,
                        "equation": str(equation),
                        "term": str(term),
                        "acts": bool(everywhere or np.median(np.abs(weight)) >= LEAST),
                        "in_support": held,
                        "weight": float(np.median(weight)),
                        "coef": middle,
                        "coef_low": low,
                        "coef_high": high,
                        "coef_units": str(result["coef_units"].values[e, k]),
                        "n_points": int(inside.sum()),
                        "confidence": float(confidence[inside].mean()),
                        "unsure": float((confidence[inside] < UNSURE).mean()),
                    }
                )
    return pd.DataFrame(rows)
