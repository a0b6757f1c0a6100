"""Bootstraps: a search repeated on resampled rows; its supports are pooled, their terms counted.

Rows are drawn with replacement, in blocks of neighbours if neighbours are correlated.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.regression.ambiguity import row_limit, usable_terms
from ep2sindy.regression.gram_kernels import explained_squares, fit_masks
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import Search
from ep2sindy.runtime.progress import Advance, nothing
from ep2sindy.runtime.values import set_counts

MOST_WEIGHTS = 2**24  # weights of rows, over the draws that are made at once


@dataclass(frozen=True)
class Bootstraps:
    """Repeated draws of rows and of a reduced library, so that no support depends on a few rows.

    Each draw takes, with replacement, a random fraction of the training groups, and leaves out some
    random terms. The search runs once per draw.

    Parameters
    ----------
    n : int, default 32
        Number of draws. 0 means one search on all training rows and terms.
    n_culled : int, default 1
        Number of random terms left out of each draw.
    smallest : float, default 0.2
        Smallest fraction of the training groups in a draw.
    largest : float, default 0.8
        Largest fraction. A draw of fewer rows than there are scatters more than the whole record
        would.
    block : int, default 1
        Number of neighbouring training groups drawn together. 1 draws single groups, as in the
        thesis, and understates the scatter for a time series, whose neighbours are correlated. More
        than 1 is allowed for one trajectory only.

    Raises
    ------
    ValueError
        If a number is negative, block is below one, or not 0 < smallest <= largest.

    Notes
    -----
    The search sees the pair of products

        X^T W_k X,   X^T W_k y

    of draw k, with W_k the diagonal of how often each row was drawn. Assumes that the groups of
    rows are exchangeable; with block above 1, that rows farther apart than a block are
    uncorrelated.

    Source: the thesis, II-C and II-H; Kuensch 1989, doi:10.1214/aos/1176347265, for blocks.

    Examples
    --------
    >>> thesis = ep.Regression(ep.Differential(), ep.AdaptiveLasso(), ep.Knee(), ep.Bootstraps(50))
    >>> run = ep.lotka_volterra().trajectory(noise=0.01, rng=0)
    >>> ep.discover(run, method=thesis, seed=0).chosen["x"].fraction  # of draws with these terms
    0.64
    """

    n: int = 32
    n_culled: int = 1
    smallest: float = 0.2
    largest: float = 0.8
    block: int = 1

    def __post_init__(self) -> None:
        set_counts(self, {"n": 0, "n_culled": 0, "block": 1})
        if not 0.0 < self.smallest <= self.largest:
            raise ValueError(
                "fractions must satisfy 0 < smallest <= largest, got "
                f"smallest={self.smallest}, largest={self.largest}"
            )

    def draw(
        self, problem: RegressionRows, terms: Bool[np.ndarray, " terms"], rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "draws columns columns"], Bool[np.ndarray, "draws terms"]]:
        """Products of all columns (`resampled_products`) and kept terms of every bootstrap.

        The terms are chosen among the usable `terms`.
        """
        if self.n == 0:
            return problem.train_products[None], terms[None]
        if self.block > 1 and len(problem.trajectories) > 1:
            raise ValueError(
                f"blocks of {self.block} would cross from one trajectory to the next, got "
                f"{len(problem.trajectories)} trajectories; use block=1"
            )
        if self.n > 1 and self.n * problem.n_train > MOST_WEIGHTS:  # the draws come one by one
            halves = [replace(self, n=n) for n in (self.n // 2, self.n - self.n // 2)]
            parts = [half.draw(problem, terms, rng) for half in halves]
            return np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
        group = problem.groups[~problem.test]
        if (group[1:] > group[:-1]).all():  # each row alone, which is found at a tenth of the cost
            counts, kept = self.draw_groups(len(group), terms, rng)
            return problem.resampled_products(counts), kept
        numbers, group = np.unique(group, return_inverse=True)
        counts, kept = self.draw_groups(len(numbers), terms, rng)
        return problem.resampled_products(counts.take(group, axis=1)), kept

    def draw_groups(
        self, n_groups: int, terms: Bool[np.ndarray, " terms"], rng: np.random.Generator
    ) -> tuple[Float[np.ndarray, "draws groups"], Bool[np.ndarray, "draws terms"]]:
        """How often every training group occurs in each bootstrap, and the terms that it keeps."""
        usable = np.flatnonzero(terms)
        if self.n_culled >= len(usable):
            raise ValueError(
                f"n_culled must leave a term: {self.n_culled} of {len(usable)} would go; lower it "
                "or use a larger library"
            )
        counts, kept = np.empty((self.n, n_groups)), np.repeat(terms[None], self.n, axis=0)
        for k in range(self.n):
            fraction = self.smallest + (self.largest - self.smallest) * rng.random()
            n_drawn = max(1, round(fraction * n_groups))
            counts[k] = count_block_draws(n_groups, n_drawn=n_drawn, block=self.block, rng=rng)
            kept[k, rng.permutation(usable)[: self.n_culled]] = False
        return counts, kept


@dataclass(frozen=True, eq=False)
class Supports:
    """Supports that the bootstraps found for one equation, pooled.

    masks: (supports, terms), each once. fraction: (supports,), fraction of bootstraps that found
    the support. inclusion: (terms + 1, terms); row k is the fraction of bootstraps, among those
    whose library held the term, in which the term was in a support of k terms. Without bootstraps
    both are NaN.
    """

    equation: str
    masks: Bool[np.ndarray, "supports terms"]
    fraction: Float[np.ndarray, " supports"]
    inclusion: Float[np.ndarray, "sizes terms"]


@dataclass(frozen=True, eq=False)
class Resamples:
    """Bootstraps of one problem, with columns scaled to unit norm in every draw.

    xx: (draws, terms, terms), xy: (draws, equations, terms), yy: (draws, equations); a term that
    is missing from a draw is a column of zeros. scale: factors from the problem's scaled columns to
    these, zero for terms that are culled or zero on the draw's rows. kept: (draws, terms), true for
    terms that were not culled. counted: False for one search on all rows. largest: largest number
    of terms that the number of rows allows in a support.
    """

    equations: Sequence[str]
    xx: Float[np.ndarray, "draws terms terms"]
    xy: Float[np.ndarray, "draws equations terms"]
    yy: Float[np.ndarray, "draws equations"]
    scale: Float[np.ndarray, "draws terms"]
    kept: Bool[np.ndarray, "draws terms"]
    counted: bool
    largest: int

    def search(
        self,
        search: Search,
        equation: int,
        advance: Advance = nothing,
        *,
        allowed: Bool[np.ndarray, " terms"] | None = None,
    ) -> list[Bool[np.ndarray, "_ terms"]]:
        """Supports that a search proposes in every draw, without those that are too large.

        allowed: terms that the equation may have; None for all. The others are searched as culled
        ones are, as columns of zeros.
        """
        xx, xy = self.xx, np.ascontiguousarray(self.xy[:, equation])
        yy = self.yy[:, equation]
        if allowed is not None and not allowed.all():
            xx, xy = xx * (allowed[:, None] & allowed), xy * allowed
        found = []
        for draw in zip(xx, xy, yy.tolist(), strict=True):
            found.append(search.supports(*draw))
            advance(1)
        if self.largest >= xy.shape[1]:
            return found
        return [masks[masks.sum(axis=1) <= self.largest] for masks in found]

    def fits(
        self,
        equation: int,
        found: Sequence[Bool[np.ndarray, "_ terms"]],
        support: Bool[np.ndarray, " terms"],
    ) -> Float[np.ndarray, "draws terms"]:
        """Fit, in each draw, the draw's best support of the same size as the given one.

        found: the result of `search`. A draw without a support of that size fits the given one,
        restricted to the terms in the draw. Coefficients are those of the problem's scaled columns.
        """
        coef = np.empty(self.scale.shape)
        for k, masks in enumerate(found):
            same_size = masks[masks.sum(axis=1) == support.sum()]
            if not len(same_size):
                same_size = (support & (self.scale[k] > 0.0))[None]
            xx, xy = self.xx[k], self.xy[k, equation]
            fits = fit_masks(xx, xy, same_size)
            best = fits[np.argmax(explained_squares(fits, xx, xy))]
            coef[k] = best * self.scale[k]
        return coef


def draw_resamples(
    problem: RegressionRows, bootstraps: Bootstraps, *, rng: np.random.Generator
) -> Resamples:
    """Draw bootstraps of the training rows, once for all equations.

    Terms that are zero, or depend on simpler ones, are left out (see `ambiguities`).
    """
    if bootstraps.n:
        problem.check_grams(bootstraps.n)  # before the work on terms, which may take minutes
    usable = usable_terms(problem)
    products, kept = bootstraps.draw(problem, usable, rng)
    squares, n_terms = products.diagonal(axis1=1, axis2=2), len(problem.library)
    # Resampling changes the norms, so columns are scaled to unit norm again; then the search does
    # not depend on units or draws. A culled term becomes a column of zeros.
    kept_squares = np.where(kept, squares[:, :n_terms], 0.0)
    scale = np.where(kept_squares > 0.0, 1.0 / np.sqrt(zero_to_one(kept_squares)), 0.0)
    return Resamples(
        equations=problem.equations,
        xx=products[:, :n_terms, :n_terms] * (scale[:, :, None] * scale[:, None, :]),
        xy=products[:, n_terms:, :n_terms] * scale[:, None, :],
        yy=squares[:, n_terms:].copy(),
        scale=scale,
        kept=kept,
        counted=bootstraps.n > 0,
        largest=row_limit(int(usable.sum()), problem.n_train),
    )


def pool_supports(
    problem: RegressionRows, search: Search, bootstraps: Bootstraps, *, rng: np.random.Generator
) -> tuple[Supports, ...]:
    """Search every bootstrap of the training rows, and return one `Supports` per equation."""
    draws = draw_resamples(problem, bootstraps, rng=rng)
    return tuple(pool(draws, k, draws.search(search, k)) for k in range(len(draws.equations)))


def pool(draws: Resamples, equation: int, found: Sequence[Bool[np.ndarray, "_ terms"]]) -> Supports:
    """Count the supports and terms that `search` found over the draws of one equation."""
    masks, which = _distinct(np.concatenate(found))
    in_draw = np.zeros((len(found), len(masks)), dtype=np.bool_)
    in_draw[np.repeat(np.arange(len(found)), [len(each) for each in found]), which] = True
    sizes, n_terms = masks.sum(axis=1), masks.shape[1]
    held = np.zeros((n_terms + 1, n_terms))
    for size in np.unique(sizes):
        own = sizes == size
        held[size] = (in_draw[:, own].astype(np.float64) @ masks[own] > 0.0).sum(axis=0)
    # One search on all rows does not tell how often another search would agree.
    unknown = 0.0 if draws.counted else np.nan
    return Supports(
        equation=draws.equations[equation],
        masks=masks,
        fraction=in_draw.mean(axis=0) + unknown,
        inclusion=held / np.maximum(draws.kept.sum(axis=0), 1) + unknown,
    )


def _distinct(
    masks: Bool[np.ndarray, "masks terms"],
) -> tuple[Bool[np.ndarray, "distinct terms"], Int[np.ndarray, " masks"]]:
    """The distinct masks by size, then by terms, and the number of each mask among them."""
    sizes = masks.sum(axis=1).astype(">u4")  # whose bytes are in the order of the numbers
    keys = np.column_stack([sizes[:, None].view(np.uint8), np.packbits(masks, axis=1)])
    whole = np.ascontiguousarray(keys).view(f"V{keys.shape[1]}")[:, 0]
    _, first, which = np.unique(whole, return_index=True, return_inverse=True)
    return masks[first], which


def count_block_draws(
    n_rows: int, *, n_drawn: int, block: int, rng: np.random.Generator
) -> Int[np.ndarray, " rows"]:
    """Number of times each row occurs in a draw of `n_drawn` rows, made of runs of `block` rows.

    A row may stand for a group of rows that are drawn together.
    Every run lies within the rows; the last run is cut to length. block: 1 draws single rows; for
    a time series choose it long enough that rows farther apart are uncorrelated.
    Raises ValueError for a block that is not between one row and all of them.
    Source: Kuensch 1989, doi:10.1214/aos/1176347265.
    """
    if not 1 <= block <= n_rows:
        raise ValueError(
            f"a block must hold between one and all {n_rows} groups of training rows, got {block}"
            "; shorten it, or use more data"
        )
    first = rng.integers(n_rows - block + 1, size=-(-n_drawn // block))
    drawn = (first[:, None] + np.arange(block)).ravel()[:n_drawn]
    return np.bincount(drawn, minlength=n_rows)
