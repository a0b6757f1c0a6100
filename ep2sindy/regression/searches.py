"""Searches that propose supports to be fitted; they use Gram matrices only."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.regression.exchanges import exchanged_supports
from ep2sindy.regression.gram_kernels import fit_masks, independent_terms
from ep2sindy.regression.search_kernels import best_subsets, lasso_path
from ep2sindy.runtime.values import set_counts
from ep2sindy.trust.memory import check_memory

MOST_WORK = 2e9  # multiplications of one search for a proof, a few seconds

Gram = Float[np.ndarray, "terms terms"]
Products = Float[np.ndarray, " terms"]
Masks = Bool[np.ndarray, "supports terms"]


@runtime_checkable
class Search(Protocol):
    """Interface that turns the Gram matrix of one equation into candidate supports.

    xx: (terms, terms) and xy: (terms,) of columns with unit norm; yy: squared norm of the target.
    A column of zeros is a term that is not available, and must not appear in a support.
    """

    def supports(self, xx: Gram, xy: Products, yy: float) -> Masks: ...


@dataclass(frozen=True)
class AdaptiveLasso:
    """All supports on the exact path of the adaptive lasso.

    Each coefficient is penalised by |b_ols|^-gamma. The path is piecewise linear and needs only
    the Gram matrix; it does not depend on the units of the columns.
    max_terms: number of terms at which the path stops; None for all terms.
    Source: Zou 2006, doi:10.1198/016214506000000735; the thesis, Eq. 8.
    """

    gamma: float = 1.0
    max_terms: int | None = None

    def __post_init__(self) -> None:
        if self.gamma <= 0.0:
            raise ValueError(f"gamma must be positive: {self.gamma} came")
        set_counts(self, _where_set(self.max_terms))

    def supports(self, xx: Gram, xy: Products, yy: float) -> Masks:
        # Scaling each column by |b_ols|^gamma makes this a plain lasso. A term that depends on
        # earlier ones has no least-squares coefficient of its own and never joins.
        coef = fit_masks(xx, xy, independent_terms(xx)[None])[0]
        scale = np.abs(coef) ** self.gamma
        return lasso_path(xx * np.outer(scale, scale), xy * scale, self.max_terms or len(xy))


@dataclass(frozen=True)
class STLSQ:
    """Sequentially thresholded least squares, over a sweep of thresholds.

    Thresholds are fractions of the norm of the target, for columns of unit norm, spaced evenly in
    the logarithm. Each is iterated until no coefficient is below it.
    Source: Brunton, Proctor & Kutz 2016, doi:10.1073/pnas.1517384113.
    """

    lowest: float = 1e-4
    highest: float = 10.0
    n_thresholds: int = 100
    max_terms: int | None = None

    def __post_init__(self) -> None:
        if not 0.0 < self.lowest < self.highest:
            raise ValueError(
                "a threshold sweep needs 0 < lowest < highest: "
                f"lowest={self.lowest}, highest={self.highest} came"
            )
        set_counts(self, {"n_thresholds": 2} | _where_set(self.max_terms))

    def supports(self, xx: Gram, xy: Products, yy: float) -> Masks:
        thresholds = np.sqrt(yy) * self._shares[:, None]
        masks = np.repeat(independent_terms(xx)[None], self.n_thresholds, axis=0)
        while True:
            kept = masks & (np.abs(fit_masks(xx, xy, masks)) > thresholds)
            if np.array_equal(kept, masks):
                break
            masks = kept
        return masks[masks.sum(axis=1) <= (self.max_terms or len(xy))]

    @cached_property
    def _shares(self) -> Float[np.ndarray, " thresholds"]:
        return np.geomspace(self.lowest, self.highest, self.n_thresholds)


class Unproven(UserWarning):
    """Warning that supports are the best found, and not proven best."""


@dataclass(frozen=True)
class BestSubset:
    """The supports of least residual of every size, proven best by branch and bound.

    The work grows with the number of subsets of up to max_terms terms: a library of 10 terms
    takes a tenth of a millisecond, 20 terms with all sizes a tenth of a second. If a proof would
    take more than a few seconds, as with more than about sixty terms, the search goes on from the
    best supports found by exchanges of terms, and warns with `Unproven`.
    n_best: number of supports of each size.
    """

    max_terms: int = 6
    n_best: int = 1

    def __post_init__(self) -> None:
        set_counts(self, {"max_terms": 1, "n_best": 1})

    def supports(self, xx: Gram, xy: Products, yy: float) -> Masks:
        return self.shared_supports(xx[None], xy[None], np.array([yy]))

    def shared_supports(
        self,
        xx: Float[np.ndarray, "problems terms terms"],
        xy: Float[np.ndarray, "problems terms"],
        yy: Float[np.ndarray, " problems"],
    ) -> Masks:
        """Supports common to several problems, with separate coefficients in each.

        The best supports minimise the product of residuals. If every problem has Gaussian errors
        of its own variance and the same number of rows, this maximises the likelihood. No
        weights are needed, since the scale of one problem multiplies all products alike.
        """
        found, proven = subsets_within(
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
        return exchanged_supports(
            xx, xy, yy, max_terms=self.max_terms, n_best=self.n_best, known=found
        )


def subsets_within(
    xx: Float[np.ndarray, "problems terms terms"],
    xy: Float[np.ndarray, "problems terms"],
    yy: Float[np.ndarray, " problems"],
    *,
    max_terms: int,
    n_best: int,
    most_work: float,
) -> tuple[Masks, bool]:
    """The best supports of every size, as for `BestSubset`, and whether they are proven best.

    most_work: multiplications after which the search ends with the best supports so far.
    """
    depth, n_terms = min(max_terms, xy.shape[1]), xy.shape[1]
    check_memory(
        8.0 * (depth + 1) * len(xy) * (n_terms + 1.0) ** 2,
        f"Gram matrices of {n_terms} terms at each of {depth} sizes",
        way_out="lower max_terms, take fewer terms, or a lower degree",
    )
    # Branches are cut sooner if the columns closest to the targets come first.
    order = np.argsort(-np.square(xy).sum(axis=0), kind="stable")
    ordered = xx.take(order, axis=1).take(order, axis=2), xy.take(order, axis=1), yy
    found, proven = best_subsets(*ordered, max_terms, n_best, most_work)
    masks = np.zeros_like(found)
    masks[:, order] = found
    return masks, proven


def _where_set(max_terms: int | None) -> dict[str, int]:
    """The least value of max_terms; nothing for None, which means all terms."""
    return {} if max_terms is None else {"max_terms": 1}
