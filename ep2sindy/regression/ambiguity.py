"""Terms that the data cannot tell apart: zero, repeated, nearly repeated, dependent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.regression.gram_fits import independent_terms
from ep2sindy.regression.rows import Regression

# One minus the cosine between two columns: at 1e-10 they differ by 1e-5 of their size.
SAME = 1e-10

ALIKE = 1e-3


@dataclass(frozen=True)
class Ambiguity:
    """A finding about some terms, in words for the user.

    exact: no data of this kind could tell; otherwise it is a matter of noise.
    """

    terms: tuple[str, ...]
    message: str
    exact: bool


def usable_terms(problem: Regression) -> Bool[np.ndarray, " terms"]:
    """Terms that are not zero and do not repeat an earlier one, over the training rows."""
    xx = problem.train_gram.xx[0]
    usable = np.diag(xx) > 0.0
    repeats = np.triu(np.abs(xx) > 1.0 - SAME, k=1)
    for first, second in np.argwhere(repeats):
        usable[second] &= not usable[first]
    return usable


def ambiguities(problem: Regression) -> tuple[Ambiguity, ...]:
    """Everything that keeps terms from being told apart, over the training rows."""
    xx = problem.train_gram.xx[0]
    return (*_zero(problem, xx), *_alike(problem, xx), *_dependent(problem, xx))


def _zero(problem: Regression, xx: Float[np.ndarray, "terms terms"]) -> list[Ambiguity]:
    return [
        Ambiguity((name,), f"{name!r} is zero on every row and is left out", True)
        for name, square in zip(problem.term_names, np.diag(xx), strict=True)
        if square == 0.0
    ]


def _alike(problem: Regression, xx: Float[np.ndarray, "terms terms"]) -> list[Ambiguity]:
    names = problem.term_names
    found = []
    for i, j in np.argwhere(np.triu(np.abs(xx) > 1.0 - ALIKE, k=1)):
        pair = (names[i], names[j])
        exact = abs(xx[i, j]) > 1.0 - SAME
        if exact:
            message = f"{pair[1]!r} is a multiple of {pair[0]!r} on every row and is left out"
        else:
            message = (
                f"{pair[0]!r} and {pair[1]!r} are nearly proportional "
                f"(1 - |cosine| = {1.0 - abs(xx[i, j]):.1e}): either may stand for the other"
            )
        found.append(Ambiguity(pair, message, bool(exact)))
    return found


def _dependent(problem: Regression, xx: Float[np.ndarray, "terms terms"]) -> list[Ambiguity]:
    """Each term that is a combination of earlier ones, with the terms that make it up."""
    names = problem.term_names
    columns = np.flatnonzero(usable_terms(problem))
    usable = xx[np.ix_(columns, columns)]
    independent = independent_terms(usable)
    found = []
    for j in np.flatnonzero(~independent):
        basis = np.flatnonzero(independent[:j])
        weights = np.linalg.solve(usable[np.ix_(basis, basis)], usable[basis, j])
        parts = [names[columns[i]] for i in basis[np.abs(weights) > 1e-6]]
        name = names[columns[j]]
        message = f"{name!r} is a linear combination of {parts} on every row"
        found.append(Ambiguity((name, *parts), message, True))
    return found
