"""The coefficients of an estimation, and what relations and roles make of them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import compress
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.library.library import Library
from ep2sindy.library.relations import Process, constraint


class Ties(NamedTuple):
    """coef = C free + fixed, in SI; leads: the coefficient in whose scale each free one is."""

    C: Float[np.ndarray, "coefficients free"]
    fixed: Float[np.ndarray, " coefficients"]
    leads: Int[np.ndarray, " free"]


def coefficients_of(
    library: Library,
    states: Sequence[str],
    processes: Sequence[Process],
) -> tuple[Int[np.ndarray, " coefficients"], Int[np.ndarray, " coefficients"], Ties | None]:
    """Equation and term of each coefficient of an estimation; see `scale_problem`.

    Third is what ties them together; None if all are free.
    The terms of an equation are those that are known, or all that are not excluded; under roles,
    those that processes or known roles bring into it.
    """
    facts, roles = library.facts, library.facts.roles
    asked = {
        state: facts.only.get(state) or list(compress(library.names, library.allowed(state)))
        for state in states
    }
    if roles is not None:
        moved = [*roles.known, *(place for process in processes for place in process.factors)]
        asked = {state: [term for s, term in moved if s == state] for state in states}
    places = [
        (equation, column)
        for equation, names in enumerate(asked.values())
        for column in sorted({library.index(term) for term in names})
    ]
    equation, column = np.array(places, dtype=np.int64).reshape(-1, 2).T
    ties = None
    if facts.relations:
        held = constraint(library, asked, facts.relations)
        ties = Ties(held.C, held.d, held.free)
    elif roles is not None:
        named = [(states[e], library.names[c]) for e, c in places]
        C = np.array([[process.factors.get(at, 0.0) for process in processes] for at in named])
        fixed = np.array([roles.known.get(at, 0.0) for at in named])
        ties = Ties(C, fixed, np.argmax(C != 0.0, axis=0))
    return equation, column, ties
