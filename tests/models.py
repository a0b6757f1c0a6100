"""Models and rows of a few numbers, for any test."""

from collections.abc import Mapping, Sequence

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library, named_terms
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.regression.rows import RegressionRows


def model_of(
    equations: Mapping[str, Mapping[str, float]], inputs: Sequence[str] = ()
) -> SparseModel:
    """A model with a library of its own terms alone."""
    names = list(dict.fromkeys(name for terms in equations.values() for name in terms))
    library = named_terms([*equations, *inputs], names)
    return SparseModel(library, list(equations), coef_matrix(library, [*equations.values()]))


def plain_rows(
    theta: np.ndarray,
    target: np.ndarray,
    terms: Library | Sequence[str],
    equations: Sequence[str] = ("y",),
) -> RegressionRows:
    """Rows that share no samples, none held out; terms that are names are variables."""
    library = terms if isinstance(terms, Library) else named_terms(terms, terms)
    n = len(theta)
    return RegressionRows(theta, target, library, equations, np.arange(n), np.zeros(n, dtype=bool))


def lienard(a: float) -> Trajectory:
    """van der Pol's states after Lienard, on their cycle; a period takes seven seconds."""
    model = model_of({"p": {"p": a, "q": -1.0, "p^3": -0.3}, "q": {"p": 1.0}})
    t = 0.1 * np.arange(1000)
    return Trajectory(t[:700], model.simulate(t, [1.0, 0.0]).states[300:], ["p", "q"])
