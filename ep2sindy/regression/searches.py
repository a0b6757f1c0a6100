"""Searches that propose supports to be fitted; they use Gram matrices only."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.regression.gram_kernels import DEPENDENT, fit_masks, independent_terms, invert_gram
from ep2sindy.regression.search_kernels import lasso_path, search_subsets, threshold_terms
from ep2sindy.runtime.values import set_counts
from ep2sindy.trust.memory import check_memory

MOST_WORK = 2e9  # multiplications of one search for a proof, a few seconds

Gram = Float[np.ndarray, "terms terms"]
Products = Float[np.ndarray, " terms"]
Masks = Bool[np.ndarray, "supports terms"]

# The same of several problems at once.
Grams = Float[np.ndarray, "problems terms terms"]
Moments = Float[np.ndarray, "problems terms"]
Squares = Float[np.ndarray, " problems"]


@runtime_checkable
class Search(Protocol):
    """Interface that turns the Gram matrix of one equation into candidate supports.

    One of your own in twenty lines is in docs/contributing.md.
    xx: (terms, terms) and xy: (terms,) of columns with unit norm; yy: squared norm of the target.
    A column of zeros is a term that is not available, and must not appear in a support.
    """

    def supports(self, xx: Gram, xy: Products, yy: float) -> Masks: ...


@dataclass(frozen=True)
class AdaptiveLasso:
    """All supports on the exact path of the adaptive lasso.

    The path needs only the Gram matrix, and does not depend on the units of the columns.

    Parameters
    ----------
    gamma : float, default 1.0
        Exponent of the weights, positive.
    max_terms : int, optional
        Number of terms at which the path stops. None continues to all terms.

    Raises
    ------
    ValueError
        If gamma is not positive, or max_terms is below one.

    Notes
    -----
    As the penalty lambda falls to zero,

        minimise |y - X b|^2 + lambda sum_j |b_j| / |b_ols,j|^gamma over b

    Assumes that the least squares b_ols of all terms are consistent: large where a term is true,
    small where it is not. Noise in the terms and nearly dependent columns violate this. The path is
    piecewise linear in lambda (`search_kernels.lasso_path`).

    Source: Zou 2006, doi:10.1198/016214506000000735; the thesis, Eq. 8.

    Examples
    --------
    >>> xx, xy = np.array([[1.0, 0.6], [0.6, 1.0]]), np.array([0.9, 0.3])
    >>> ep.AdaptiveLasso().supports(xx, xy, 1.0).tolist()
    [[False, False], [True, False], [True, True]]
    """

    gamma: float = 1.0
    max_terms: int | None = None

    def __post_init__(self) -> None:
        if self.gamma <= 0.0:
            raise ValueError(f"gamma must be positive, got {self.gamma}")
        set_counts(self, {"max_terms": 1})

    def supports(self, xx: Gram, xy: Products, yy: float) -> Masks:
        # Scaling each column by |b_ols|^gamma makes this a plain lasso. A term that depends on
        # earlier ones has no least-squares coefficient of its own and never joins.
        coef = fit_masks(xx, xy, independent_terms(xx)[None])[0]
        scale = np.abs(coef) ** self.gamma
        return lasso_path(xx * np.outer(scale, scale), xy * scale, self.max_terms or len(xy))


@dataclass(frozen=True)
class STLSQ:
    """Sequentially thresholded least squares, over a sweep of thresholds.

    At each threshold, terms with a smaller coefficient are dropped and the others are fitted again,
    until no term is dropped. If neighbouring thresholds end at one support, it is returned once.

    Parameters
    ----------
    lowest : float, default 0.0001
        Lowest threshold, as a fraction of the norm of the target, for columns of unit norm.
    highest : float, default 10.0
        Highest threshold, in the same unit.
    n_thresholds : int, default 100
        Number of thresholds, spaced evenly in the logarithm.
    max_terms : int, optional
        Larger supports are left out. None leaves out none.

    Raises
    ------
    ValueError
        If not 0 < lowest < highest, there are fewer than two thresholds, or max_terms is below one.

    Notes
    -----
    The iteration is

        S <- {j in S: |b_j| > threshold},   b = least squares of y on X_S

    and its fixed points are local minima of

        |y - X b|^2 + threshold^2 |S|

    Assumes that the terms are nearly orthogonal, so that a false one has a small coefficient from
    the first fit on: a term that was dropped never returns.

    Source: Brunton, Proctor & Kutz 2016, doi:10.1073/pnas.1517384113; Zhang & Schaeffer 2019,
    doi:10.1137/18M1189828, for the objective.

    Examples
    --------
    >>> xx, xy = np.array([[1.0, 0.6], [0.6, 1.0]]), np.array([0.9, 0.3])
    >>> ep.STLSQ(lowest=0.1, highest=0.5, n_thresholds=3).supports(xx, xy, 1.0).tolist()
    [[True, True], [True, False]]
    """

    lowest: float = 1e-4
    highest: float = 10.0
    n_thresholds: int = 100
    max_terms: int | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.lowest < self.highest:
            raise ValueError(
                "a threshold sweep needs 0 < lowest < highest, got "
                f"lowest={self.lowest}, highest={self.highest}"
            )
        set_counts(self, {"n_thresholds": 2, "max_terms": 1})

    def supports(self, xx: Gram, xy: Products, yy: float) -> Masks:
        start, thresholds = independent_terms(xx), np.sqrt(yy) * self._fractions
        # The first fit, of all terms, is the same at every threshold.
        masks = start & (np.abs(fit_masks(xx, xy, start[None])) > thresholds[:, None])
        threshold_terms(xx, xy, thresholds, masks)
        masks = masks[np.append(True, (masks[1:] != masks[:-1]).any(axis=1))]
        return masks[masks.sum(axis=1) <= (self.max_terms or len(xy))]

    @cached_property
    def _fractions(self) -> Float[np.ndarray, " thresholds"]:
        return np.geomspace(self.lowest, self.highest, self.n_thresholds)


class Unproven(UserWarning):
    """Warning that supports are the best found, and not proven best."""


@dataclass(frozen=True)
class BestSubset:
    """The supports of least residual of every size, proven best by branch and bound.

    If a proof would take more than a few seconds, as with more than about sixty terms, the search
    continues from the best supports found by exchanges of terms, and warns with `Unproven`. Which
    size is right is left to the selection rule.

    Parameters
    ----------
    max_terms : int, default 6
        Largest size of a support.
    n_best : int, default 1
        Number of supports of each size.

    Raises
    ------
    ValueError
        If a number is below one.

    Notes
    -----
    For k = 0 ... max_terms,

        minimise |y - X_S b|^2 over b and over all supports S of k terms

    Assumes Gaussian residuals that are independent from row to row, of one variance; then the best
    support of a size is the likeliest. The work grows with the number of subsets of up to max_terms
    terms: a library of 10 terms takes a tenth of a millisecond, 20 terms with all sizes a tenth of
    a second.

    Source: Furnival & Wilson 1974, doi:10.1080/00401706.1974.10489231.

    Examples
    --------
    >>> xx, xy = np.array([[1.0, 0.6], [0.6, 1.0]]), np.array([0.9, 0.3])
    >>> ep.BestSubset(max_terms=1, n_best=2).supports(xx, xy, 1.0).tolist()
    [[False, False], [True, False], [False, True]]
    """

    max_terms: int = 6
    n_best: int = 1

    def __post_init__(self) -> None:
        set_counts(self, {"max_terms": 1, "n_best": 1})

    def supports(self, xx: Gram, xy: Products, yy: float) -> Masks:
        return self.shared_supports(xx[None], xy[None], np.array([yy]))

    def shared_supports(self, xx: Grams, xy: Moments, yy: Squares) -> Masks:
        """Supports common to several problems, with separate coefficients in each.

        The best supports minimise the product of residuals. If every problem has Gaussian errors
        of its own variance and the same number of rows, this maximises the likelihood. No
        weights are needed, since the scale of one problem multiplies all products alike.
        """
        found, proven = find_best_subsets(
            xx, xy, yy, max_terms=self.max_terms, n_best=self.n_best, most_work=MOST_WORK
        )
        if proven:
            return found
        warnings.warn(
            f"the best supports of {xy.shape[1]} terms were found by exchanges and are not "
            f"proven best: a proof for up to {min(self.max_terms, xy.shape[1])} terms would take "
            "too long; lower max_terms or take fewer terms for a proof",
            Unproven,
            stacklevel=2,
        )
        return exchange_terms(xx, xy, yy, max_terms=self.max_terms, n_best=self.n_best, known=found)


def find_best_subsets(
    xx: Grams, xy: Moments, yy: Squares, *, max_terms: int, n_best: int, most_work: float
) -> tuple[Masks, bool]:
    """The best supports of every size, as for `BestSubset`, and whether they are proven best.

    most_work: multiplications after which the search ends with the best supports so far.
    """
    depth, n_terms = min(max_terms, xy.shape[1]), xy.shape[1]
    check_memory(
        8.0 * (depth + 1) * len(xy) * (n_terms + 1.0) ** 2,
        f"Gram matrices of {n_terms} terms at each of {depth} sizes",
        hint="lower max_terms, take fewer terms, or a lower degree",
    )
    # Branches are cut sooner if the columns closest to the targets come first.
    order = np.argsort(-np.square(xy).sum(axis=0), kind="stable")
    ordered = xx.take(order, axis=1).take(order, axis=2), xy.take(order, axis=1), yy
    size, best = n_terms + 1, np.empty((depth + 1, n_best))
    best_masks = np.empty((depth + 1, n_best, n_terms), dtype=np.bool_)
    chosen, following = np.empty((2, depth + 1), dtype=np.int64)
    levels, smallest = np.empty((depth + 1, len(xy), size, size)), np.empty((len(xy), size))
    scratch = levels, smallest, np.empty((size, size)), chosen, following
    proven = search_subsets(*ordered, most_work, *scratch, best, best_masks)
    found = best_masks[best < np.inf]
    masks = np.zeros_like(found)
    masks[:, order] = found
    return masks, proven


ROUNDING = 1e-14  # of the target's square: a smaller residual is rounding
MAX_EXCHANGES = 50  # at one size; a handful is usual


Scored = tuple[frozenset[int], float]  # a support, and the residual that it leaves


def exchange_terms(
    xx: Grams,
    xy: Moments,
    yy: Squares,
    *,
    max_terms: int,
    n_best: int,
    known: Bool[np.ndarray, "_ terms"] | None = None,
) -> Masks:
    """The best `n_best` supports found of every size up to max_terms, the empty one first.

    For libraries too large for a proof. Each size starts from the best support of the size below
    and its best further term. Terms are then exchanged one for another, the best exchange first, as
    long as the residual falls. From the largest size the search goes back: where the best support
    of a size, less a term, is better than those of the size below, exchanges continue from there.
    One support serves all problems, each with coefficients of its own; the product of their
    residuals is minimised. known: supports to start from as well.
    """
    problems, n_terms = _Problems(xx, xy, yy), xy.shape[1]
    starts: dict[int, list[frozenset[int]]] = {}
    for mask in () if known is None else known:
        starts.setdefault(int(mask.sum()), []).append(frozenset(np.flatnonzero(mask).tolist()))
    by_size: list[dict[frozenset[int], float]] = []
    best = frozenset[int]()
    for size in range(1, min(max_terms, n_terms) + 1):
        grown = problems.add_best(best)
        if grown is None:
            break
        seen = {support: problems.measure(support) for support in starts.get(size, [])}
        seen |= problems.descend(min([*seen.items(), grown], key=lambda each: each[1]))
        best = min(seen, key=lambda support: seen[support])
        by_size.append(seen)
    for fewer, more in reversed([*pairwise(by_size)]):
        shrunk = problems.drop_least(min(more, key=lambda support: more[support]))
        if shrunk[1] < min(fewer.values()):
            fewer |= problems.descend(shrunk)
    found = [frozenset[int]()]
    for seen in by_size:
        found += sorted(seen, key=lambda support: seen[support])[:n_best]
    masks = np.zeros((len(found), n_terms), dtype=np.bool_)
    for mask, support in zip(masks, found, strict=True):
        mask[list(support)] = True
    return masks


@dataclass(frozen=True, eq=False)
class _Problems:
    """Gram matrices of several problems, and the residuals that supports leave.

    Of several problems a residual is the sum of the residuals' logarithms.
    """

    xx: Grams
    xy: Moments
    yy: Squares

    def descend(self, start: Scored) -> dict[frozenset[int], float]:
        """Exchange terms while the residual falls; the last support and its neighbours."""
        best, least = start
        for _ in range(MAX_EXCHANGES):
            near = {best: least}
            for term in best:
                kept = best - {term}
                residuals = self.try_each(sorted(kept))
                for other in np.argsort(residuals)[: len(best) + 1].tolist():
                    if np.isfinite(residuals[other]):
                        near.setdefault(kept | {other}, float(residuals[other]))
            support = min(near, key=lambda each: near[each])
            if not near[support] < least:
                return near
            best, least = support, near[support]
        return near

    def add_best(self, support: frozenset[int]) -> Scored | None:
        """The support with its best further term; None if no term adds anything."""
        residuals = self.try_each(sorted(support))
        term = int(np.argmin(residuals))
        is_one = np.isfinite(residuals[term])
        return (support | {term}, float(residuals[term])) if is_one else None

    def drop_least(self, support: frozenset[int]) -> Scored:
        """The support without the term whose loss costs least."""
        terms = sorted(support)
        inverse = invert_gram(self.xx[:, terms][:, :, terms])
        coef = np.einsum("pst,pt->ps", inverse, self.xy[:, terms])
        losses = np.square(coef) / zero_to_one(np.einsum("pss->ps", inverse))
        left = self.yy - np.einsum("ps,ps->p", coef, self.xy[:, terms])
        least = ROUNDING * self.yy[:, None]
        residuals = np.log(np.maximum(left[:, None] + losses, least)).sum(axis=0)
        smaller = support - {terms[int(np.argmin(residuals))]}
        return smaller, self.measure(smaller)

    def measure(self, support: frozenset[int]) -> float:
        first, *others = sorted(support)
        return float(self.try_each(others)[first])

    def try_each(self, chosen: Sequence[int]) -> Float[np.ndarray, " terms"]:
        """Residual if each term joins the chosen ones; infinite for one that depends on them."""
        columns, target = self.xx[:, :, chosen], self.xy[:, chosen]
        inverse = invert_gram(columns[:, chosen])
        projection = columns @ inverse
        square = np.einsum("pjj->pj", self.xx)
        own = square - np.einsum("pjs,pjs->pj", projection, columns)
        adds = own > DEPENDENT * square
        gain = np.square(self.xy - np.einsum("pjs,ps->pj", projection, target))
        left = self.yy - np.einsum("ps,pst,pt->p", target, inverse, target)
        residuals = left[:, None] - np.where(adds, gain / np.where(adds, own, 1.0), 0.0)
        residuals = np.maximum(residuals, ROUNDING * self.yy[:, None])
        total = residuals[0] if len(self.yy) == 1 else np.log(residuals).sum(axis=0)
        total = np.where(adds.any(axis=0), total, np.inf)
        total[list(chosen)] = np.inf
        return total
