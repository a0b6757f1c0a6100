"""Supports of every size by exchanges of one term for another, for libraries too large for a proof.

Each size starts from the best support of the size below and its best further term. Terms are then
exchanged, the best exchange first, as long as the residual falls. From the largest size the search
goes back: where the best support of a size, less a term, is better than those of the size below,
exchanges go on from there.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.regression.gram_kernels import DEPENDENT, invert_gram

ROUNDING = 1e-14  # of the target's square: a smaller residual is rounding
MAX_EXCHANGES = 50  # at one size; a handful is usual


def exchange_terms(
    xx: Float[np.ndarray, "problems terms terms"],
    xy: Float[np.ndarray, "problems terms"],
    yy: Float[np.ndarray, " problems"],
    *,
    max_terms: int,
    n_best: int,
    known: Bool[np.ndarray, "supports terms"] | None = None,
) -> Bool[np.ndarray, "supports terms"]:
    """The best `n_best` supports found of every size up to max_terms, the empty one first.

    One support serves all problems, each with coefficients of its own; the product of their
    residuals is minimised. known: supports to start from as well.
    """
    n_terms = xy.shape[1]
    starts: dict[int, list[frozenset[int]]] = {}
    for mask in () if known is None else known:
        starts.setdefault(int(mask.sum()), []).append(frozenset(np.flatnonzero(mask).tolist()))
    by_size: list[dict[frozenset[int], float]] = []
    best = frozenset[int]()
    for size in range(1, min(max_terms, n_terms) + 1):
        grown = _add_best(xx, xy, yy, best)
        if grown is None:
            break
        seen = {support: _measure(xx, xy, yy, support) for support in starts.get(size, [])}
        seen |= _descend(xx, xy, yy, min([*seen.items(), grown], key=lambda each: each[1]))
        best = min(seen, key=lambda support: seen[support])
        by_size.append(seen)
    for fewer, more in reversed([*pairwise(by_size)]):
        shrunk = _drop_least(xx, xy, yy, min(more, key=lambda support: more[support]))
        if shrunk[1] < min(fewer.values()):
            fewer |= _descend(xx, xy, yy, shrunk)
    found = [frozenset[int]()]
    for seen in by_size:
        found += sorted(seen, key=lambda support: seen[support])[:n_best]
    masks = np.zeros((len(found), n_terms), dtype=np.bool_)
    for mask, support in zip(masks, found, strict=True):
        mask[list(support)] = True
    return masks


def _descend(
    xx: np.ndarray, xy: np.ndarray, yy: np.ndarray, start: tuple[frozenset[int], float]
) -> dict[frozenset[int], float]:
    """Exchange terms while the residual falls; residuals of the last support and its neighbours."""
    best, least = start
    for _ in range(MAX_EXCHANGES):
        near = {best: least}
        for term in best:
            kept = best - {term}
            residuals = _try_each(xx, xy, yy, sorted(kept))
            for other in np.argsort(residuals)[: len(best) + 1].tolist():
                if np.isfinite(residuals[other]):
                    near.setdefault(kept | {other}, float(residuals[other]))
        support = min(near, key=lambda each: near[each])
        if not near[support] < least:
            return near
        best, least = support, near[support]
    return near


def _add_best(
    xx: np.ndarray, xy: np.ndarray, yy: np.ndarray, support: frozenset[int]
) -> tuple[frozenset[int], float] | None:
    """The support with its best further term, and the residual; None if no term adds anything."""
    residuals = _try_each(xx, xy, yy, sorted(support))
    term = int(np.argmin(residuals))
    return (support | {term}, float(residuals[term])) if np.isfinite(residuals[term]) else None


def _drop_least(
    xx: np.ndarray, xy: np.ndarray, yy: np.ndarray, support: frozenset[int]
) -> tuple[frozenset[int], float]:
    """The support without the term whose loss costs least, and the residual."""
    terms = sorted(support)
    inverse = invert_gram(xx[:, terms][:, :, terms])
    coef = np.einsum("pst,pt->ps", inverse, xy[:, terms])
    losses = np.square(coef) / zero_to_one(np.einsum("pss->ps", inverse))
    left = yy - np.einsum("ps,ps->p", coef, xy[:, terms])
    residuals = np.log(np.maximum(left[:, None] + losses, ROUNDING * yy[:, None])).sum(axis=0)
    smaller = support - {terms[int(np.argmin(residuals))]}
    return smaller, _measure(xx, xy, yy, smaller)


def _measure(xx: np.ndarray, xy: np.ndarray, yy: np.ndarray, support: frozenset[int]) -> float:
    first, *others = sorted(support)
    return float(_try_each(xx, xy, yy, others)[first])


def _try_each(
    xx: Float[np.ndarray, "problems terms terms"],
    xy: Float[np.ndarray, "problems terms"],
    yy: Float[np.ndarray, " problems"],
    chosen: Sequence[int],
) -> Float[np.ndarray, " terms"]:
    """Residual if each term joins the chosen ones; infinite for one that depends on them.

    Of several problems it is the sum of the residuals' logarithms.
    """
    columns, target = xx[:, :, chosen], xy[:, chosen]
    inverse = invert_gram(columns[:, chosen])
    share = columns @ inverse
    square = np.einsum("pjj->pj", xx)
    own = square - np.einsum("pjs,pjs->pj", share, columns)
    adds = own > DEPENDENT * square
    gain = np.square(xy - np.einsum("pjs,ps->pj", share, target)) / np.where(adds, own, 1.0)
    left = yy - np.einsum("ps,pst,pt->p", target, inverse, target)
    residuals = np.maximum(left[:, None] - np.where(adds, gain, 0.0), ROUNDING * yy[:, None])
    total = residuals[0] if len(yy) == 1 else np.log(residuals).sum(axis=0)
    total = np.where(adds.any(axis=0), total, np.inf)
    total[list(chosen)] = np.inf
    return total
