"""Right-hand sides from the terms that a model has, where its library has more."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from ep2sindy.library.library import Library, polynomial


def rates(
    library: Library,
    coef: Float[np.ndarray, "terms n_states"],
    values: Float[np.ndarray, "... variables"],
) -> Float[np.ndarray, "... n_states"]:
    """library(values) coef; NaN outside the domain of a function that has a coefficient."""
    used, coef = used_terms(library, coef)
    return used.evaluate(values) @ coef


def used_terms(
    library: Library, coef: Float[np.ndarray, "terms n_states"]
) -> tuple[Library, Float[np.ndarray, "_ n_states"]]:
    """Terms with a coefficient, where there are functions: others may have no value there."""
    used = np.flatnonzero(coef.any(axis=1))
    if not library.functions or len(used) == len(coef):
        return library, coef
    if len(used):
        return library.take(used), coef[used]
    return polynomial(library.variables, degree=0), coef[:1]
