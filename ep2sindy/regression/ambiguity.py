"""Terms that the data cannot tell apart: zero, repeated, nearly repeated, dependent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from ep2sindy.library.library import Library
from ep2sindy.regression.gram_fits import independent_terms
from ep2sindy.regression.rows import RegressionRows

# One minus the cosine between two columns: at 1e-10 they differ by 1e-5 of their size.
SAME = 1e-10

ALIKE = 1e-3

# Simpler terms that a term is left out for. Without noise, every term on a periodic orbit is nearly
# a combination of many others, and the law may be the shorter for it.
MAX_PARTS = 3

# Rows per term of the library below which a search would fit the noise of its rows...
FEW = 3

# ...unless each coefficient has this many rows to itself: the least that is held to do
# (Vittinghoff & McCulloch 2007, doi:10.1093/aje/kwk052).
ROWS_PER_COEFFICIENT = 5


@dataclass(frozen=True)
class Ambiguity:
    """A finding about some terms, in words for the user.

    exact: it holds of these rows whatever their noise, and the search keeps to it; otherwise it
    is a matter of noise.
    """

    terms: tuple[str, ...]
    message: str
    exact: bool


def usable_terms(problem: RegressionRows) -> Bool[np.ndarray, " terms"]:
    """Terms that are not zero and are no combination of a few simpler ones on the training rows.

    Simpler is of lower degree, or earlier in the library.
    """
    xx = problem.train_gram.xx[0]
    usable = _distinct(problem.library, xx)
    for j, parts in _combinations(problem.library, problem.train_theta, xx):
        usable[j] = len(parts) > MAX_PARTS
    return usable


def largest_support(problem: RegressionRows) -> int:
    """How many terms an equation may have: all that are usable, unless the rows are few."""
    n_terms, n_rows = int(usable_terms(problem).sum()), len(problem.train_rows)
    return n_terms if n_rows >= FEW * n_terms else max(1, n_rows // ROWS_PER_COEFFICIENT)


def few_rows(problem: RegressionRows) -> tuple[Ambiguity, ...]:
    """What is said where `largest_support` holds equations down."""
    largest, n_terms = largest_support(problem), int(usable_terms(problem).sum())
    if largest == n_terms:
        return ()
    message = (
        f"{len(problem.train_rows)} rows are few for {n_terms} terms: equations of "
        f"{', '.join(problem.equations)} were searched with at most {largest}"
    )
    return (Ambiguity((), message, True),)


def _simplest_first(library: Library) -> Int[np.ndarray, " terms"]:
    return np.argsort(library.degrees, kind="stable")


def _distinct(library: Library, xx: Float[np.ndarray, "terms terms"]) -> Bool[np.ndarray, " terms"]:
    """Terms that are not zero and do not repeat a simpler one."""
    order = _simplest_first(library)
    distinct = np.diag(xx) > 0.0
    repeats = np.triu(np.abs(xx[np.ix_(order, order)]) > 1.0 - SAME, k=1)
    for first, second in order[np.argwhere(repeats)]:
        distinct[second] &= not distinct[first]
    return distinct


def ambiguities(problem: RegressionRows) -> tuple[Ambiguity, ...]:
    """Everything that keeps terms from being told apart, over the training rows."""
    return find_ambiguities(problem.library, problem.train_theta, problem.train_gram.xx[0])


def find_ambiguities(
    library: Library,
    theta: Float[np.ndarray, "rows terms"],
    xx: Float[np.ndarray, "terms terms"],
) -> tuple[Ambiguity, ...]:
    """Everything that keeps terms from being told apart.

    theta: of the library's terms, columns of unit norm, or of zeros. xx: its Gram matrix.
    """
    return (*_zero(library, xx), *_alike(library, xx), *_dependent(library, theta, xx))


def _zero(library: Library, xx: Float[np.ndarray, "terms terms"]) -> list[Ambiguity]:
    return [
        Ambiguity((name,), f"{name!r} is zero on every row and is left out", True)
        for name, square in zip(library.names, np.diag(xx), strict=True)
        if square == 0.0
    ]


def _alike(library: Library, xx: Float[np.ndarray, "terms terms"]) -> list[Ambiguity]:
    """Pairs of terms that are proportional, the simpler one first; what is left out only once."""
    names, order = library.names, _simplest_first(library)
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


def _dependent(
    library: Library,
    theta: Float[np.ndarray, "rows terms"],
    xx: Float[np.ndarray, "terms terms"],
) -> list[Ambiguity]:
    """Each term that is a combination of simpler ones, with the terms that make it up."""
    names = library.names
    found = []
    for j, columns in _combinations(library, theta, xx):
        parts = [names[i] for i in columns]
        left_out = " and is left out" if len(parts) <= MAX_PARTS else ""
        message = f"{names[j]!r} is a linear combination of {parts} on every row{left_out}"
        found.append(Ambiguity((names[j], *parts), message, True))
    return found


def _combinations(
    library: Library,
    theta: Float[np.ndarray, "rows terms"],
    xx: Float[np.ndarray, "terms terms"],
) -> list[tuple[int, list[int]]]:
    """Distinct terms that depend on simpler ones, each with those that it is made of."""
    order = _simplest_first(library)
    columns = order[_distinct(library, xx)[order]]
    independent = independent_terms(xx[np.ix_(columns, columns)])
    found = []
    for rank in np.flatnonzero(~independent):
        basis = np.sort(columns[:rank][independent[:rank]])
        weights = np.linalg.solve(xx[np.ix_(basis, basis)], xx[basis, columns[rank]])
        if (np.abs(weights) > 1e-6).sum() > MAX_PARTS:
            # A Gram matrix has lost half the digits: by rows, many parts may turn out few.
            weights = np.linalg.lstsq(theta[:, basis], theta[:, columns[rank]], rcond=None)[0]
        found.append((int(columns[rank]), basis[np.abs(weights) > 1e-6].tolist()))
    return found
