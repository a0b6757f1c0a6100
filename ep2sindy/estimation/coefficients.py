"""The coefficients of an estimation, and what relations and roles make of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.library.library import Library
from ep2sindy.library.relations import Process, Relation, constraint
from ep2sindy.library.roles import Roles


def asked_terms(
    library: Library,
    states: Sequence[str],
    terms: Mapping[str, Sequence[str]],
    exclude: Mapping[str, Sequence[str]],
) -> dict[str, Sequence[str]]:
    """Terms that may be in each equation: those that are known, or all that are not excluded."""
    barred = {state: {*map(library.index, names)} for state, names in exclude.items()}
    return {
        state: terms[state]
        if state in terms
        else [name for k, name in enumerate(library.names) if k not in barred.get(state, ())]
        for state in states
    }


class Coefficients(NamedTuple):
    """Equation and term of every coefficient that may be in the model, and what ties them."""

    equation: Int[np.ndarray, " coefficients"]
    column: Int[np.ndarray, " coefficients"]
    ties: Ties | None


def coefficients_of(
    library: Library,
    states: Sequence[str],
    terms: Mapping[str, Sequence[str]],
    exclude: Mapping[str, Sequence[str]],
    relations: Sequence[Relation],
    processes: Sequence[Process],
    roles: Roles | None,
) -> Coefficients:
    """The coefficients of an estimation; see `scale_problem`."""
    if roles is None:
        asked = asked_terms(library, states, terms, exclude)
    else:
        asked = moved_terms(states, processes, roles)
    ties = ties_of(library, asked, relations, processes, roles)
    return Coefficients(*places_of(library, asked), ties)


class Ties(NamedTuple):
    """coef = C free + fixed, in SI; leads: the coefficient in whose scale each free one is."""

    C: Float[np.ndarray, "coefficients free"]
    fixed: Float[np.ndarray, " coefficients"]
    leads: Int[np.ndarray, " free"]


def ties_of(
    library: Library,
    asked: Mapping[str, Sequence[str]],
    relations: Sequence[Relation],
    processes: Sequence[Process],
    roles: Roles | None,
) -> Ties | None:
    """What relations or roles make of the coefficients; None if all are free."""
    if relations:
        held = constraint(library, asked, relations)
        return Ties(held.C, held.d, held.free)
    if roles is None:
        return None
    states = list(asked)
    places = [
        (states[equation], library.names[column])
        for equation, column in zip(*places_of(library, asked), strict=True)
    ]
    C = np.array([[process.factors.get(at, 0.0) for process in processes] for at in places])
    fixed = np.array([roles.known.get(at, 0.0) for at in places])
    return Ties(C, fixed, np.argmax(C != 0.0, axis=0))


def moved_terms(
    states: Sequence[str], processes: Sequence[Process], roles: Roles
) -> dict[str, Sequence[str]]:
    """Terms that processes or known roles bring into each equation."""
    places = [*roles.known, *(place for process in processes for place in process.factors)]
    return {state: [term for s, term in places if s == state] for state in states}


def places_of(
    library: Library, asked: Mapping[str, Sequence[str]]
) -> tuple[Int[np.ndarray, " coefficients"], Int[np.ndarray, " coefficients"]]:
    """Equation and term of every coefficient that may be in the model."""
    pairs = [
        (equation, column)
        for equation, terms in enumerate(asked.values())
        for column in sorted({library.index(term) for term in terms})
    ]
    equation, column = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    return equation, column
