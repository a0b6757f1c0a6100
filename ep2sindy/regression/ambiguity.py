"""Detection of terms that the data cannot distinguish: zero, repeated, nearly so, dependent."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.library.library import Library
from ep2sindy.regression.gram_kernels import independent_terms, invert_gram
from ep2sindy.regression.least_squares import LeastSquares
from ep2sindy.regression.rows import RegressionRows

# Bounds on one minus the cosine between two columns: at 1e-10 they differ by 1e-5 of their size.
SAME = 1e-10

ALIKE = 1e-3

# A term is left out if it combines at most this many simpler terms. Without noise, every term on a
# periodic orbit is nearly a combination of many others, and may itself give the shorter law.
MAX_PARTS = 3
MAX_SHOWN = 5  # of the terms of a longer combination, in its message

Gram = Float[np.ndarray, "terms terms"]
Theta = Callable[[], Float[np.ndarray, "rows terms"]]  # makes the columns of the terms

# With fewer rows per term of the library than this, a search would fit the noise of its rows...
FEW = 3

# ...so equations are limited to this many rows per coefficient, the least that is considered
# sufficient (Vittinghoff & McCulloch 2007, doi:10.1093/aje/kwk052).
ROWS_PER_COEFFICIENT = 5


@dataclass(frozen=True)
class Ambiguity:
    """A finding about some terms, in words for the user.

    exact: true if the finding holds exactly on these rows and restricts the search; otherwise it
    depends on the noise.
    """

    terms: tuple[str, ...]
    message: str
    exact: bool


def usable_terms(problem: RegressionRows) -> Bool[np.ndarray, " terms"]:
    """Terms that are neither zero nor a combination of a few simpler ones on the training rows.

    A term is simpler if its degree is lower, or if it is earlier in the library.
    """
    xx = problem.train_gram.xx
    usable = _distinct(problem.library, xx)
    for j, parts in _combinations(problem.library, lambda: problem.train_theta, xx):
        usable[j] = len(parts) > MAX_PARTS
    return usable


def row_limit(n_terms: int, n_rows: int) -> int:
    """Largest number of terms in an equation: all usable ones, or fewer if there are few rows."""
    return n_terms if n_rows >= FEW * n_terms else max(1, n_rows // ROWS_PER_COEFFICIENT)


def few_rows(problem: RegressionRows) -> tuple[Ambiguity, ...]:
    """Message for the user if `row_limit` limits the equations; empty otherwise."""
    n_terms = int(usable_terms(problem).sum())
    largest = row_limit(n_terms, problem.n_train)
    if largest == n_terms:
        return ()
    message = (
        f"{problem.n_train} rows are few for {n_terms} terms: equations of "
        f"{', '.join(problem.equations)} were searched with at most {largest}"
    )
    return (Ambiguity((), message, True),)


def order_by_degree(library: Library) -> Int[np.ndarray, " terms"]:
    """Terms by degree, and of one degree in the order of the library."""
    return np.argsort(library.degrees, kind="stable")


def _distinct(library: Library, xx: Gram) -> Bool[np.ndarray, " terms"]:
    """Terms that are not zero and do not repeat a simpler one."""
    order = order_by_degree(library)
    distinct = np.diag(xx) > 0.0
    repeats = np.triu(np.abs(xx[np.ix_(order, order)]) > 1.0 - SAME, k=1)
    for first, second in order[np.argwhere(repeats)]:
        distinct[second] &= not distinct[first]
    return distinct


def ambiguities(problem: RegressionRows) -> tuple[Ambiguity, ...]:
    """All ambiguities between terms on the training rows."""
    return find_ambiguities(problem.library, lambda: problem.train_theta, problem.train_gram.xx)


def find_ambiguities(library: Library, theta: Theta, xx: Gram) -> tuple[Ambiguity, ...]:
    """All ambiguities between terms of a library.

    theta: returns the columns of the library's terms, of unit norm or zero; it is called only where
    the Gram matrix xx does not tell.
    """
    return (*_zero(library, xx), *_alike(library, xx), *_dependent(library, theta, xx))


def _zero(library: Library, xx: Gram) -> list[Ambiguity]:
    return [
        Ambiguity((name,), f"{name!r} is zero on every row and is left out", True)
        for name, square in zip(library.names, np.diag(xx), strict=True)
        if square == 0.0
    ]


def _alike(library: Library, xx: Gram) -> list[Ambiguity]:
    """Pairs of proportional terms, the simpler one first; a term left out is reported once."""
    names, order = library.names, order_by_degree(library)
    kept = _distinct(library, xx)
    cosines = np.abs(xx[np.ix_(order, order)])
    found = []
    for i, j in order[np.argwhere(np.triu(cosines > 1.0 - ALIKE, k=1))]:
        pair = (names[i], names[j])
        exact = abs(xx[i, j]) > 1.0 - SAME
        if not kept[i] or (not exact and not kept[j]):
            continue
        if exact:
            message = f"{pair[1]!r} is a multiple of {pair[0]!r} on every row and is left out"
        else:
            message = (
                f"{pair[0]!r} and {pair[1]!r} are nearly proportional "
                f"(1 - |cosine| = {1.0 - abs(xx[i, j]):.1e}): either may stand for the other"
            )
        found.append(Ambiguity(pair, message, bool(exact)))
    return found


def _dependent(library: Library, theta: Theta, xx: Gram) -> list[Ambiguity]:
    """Terms that are linear combinations of simpler ones, with the terms they consist of."""
    names = library.names
    found = []
    for j, columns in _combinations(library, theta, xx):
        parts = [names[i] for i in columns]
        left_out = (
            " and is left out"
            if len(parts) <= MAX_PARTS
            else ": no data of this kind tell them apart"
        )
        shown = ", ".join(parts if len(parts) <= MAX_SHOWN else [*parts[:MAX_SHOWN], "..."])
        of = shown if len(parts) <= MAX_SHOWN else f"{len(parts)} other terms ({shown})"
        message = f"{names[j]} is a linear combination of {of} on every row{left_out}"
        found.append(Ambiguity((names[j], *parts), message, True))
    return found


def _combinations(library: Library, theta: Theta, xx: Gram) -> list[tuple[int, list[int]]]:
    """Distinct terms that depend on simpler ones, each with the indices of those terms."""
    order = order_by_degree(library)
    columns = order[_distinct(library, xx)[order]]
    independent = independent_terms(xx[np.ix_(columns, columns)])
    found = []
    for rank in np.flatnonzero(~independent):
        basis = np.sort(columns[:rank][independent[:rank]])
        weights = invert_gram(xx[np.ix_(basis, basis)]) @ xx[basis, columns[rank]]
        if (np.abs(weights) > 1e-6).sum() > MAX_PARTS:
            # The Gram matrix has lost half the digits; a fit on the rows may need fewer parts.
            values = theta()
            weights = LeastSquares.of_rows(values[:, basis], values[:, columns[rank]]).coef
        found.append((int(columns[rank]), basis[np.abs(weights) > 1e-6].tolist()))
    return found
