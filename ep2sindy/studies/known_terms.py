"""Models whose terms are known: the terms of every state, and relations among coefficients."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from operator import add
from typing import Annotated

import numpy as np

from ep2sindy.library.library import Library, named_terms
from ep2sindy.library.terms import variables_of
from ep2sindy.studies.study import Check

Terms = Mapping[str, Sequence[int | str]]  # by state; the constant, 1, may come as a number
Relations = Annotated[
    Sequence[str],
    Check(
        "a list of relations, such as ['x: x*y == -1 * y: x*y']",
        lambda value: isinstance(value, list) and bool(value),
    ),
]


def terms_of(
    given: Terms, *, states: Sequence[str], key: str = "model"
) -> tuple[Library, dict[str, list[str]]]:
    """The terms of every state, and a library that holds each of them once.

    key: what the config calls this model, for the message.
    """
    if set(given) != set(states) or not all(given.values()):
        came = {state: list(names) for state, names in given.items()}
        raise ValueError(
            f"{key} must list the terms of every state of {list(states)}, such as "
            f"{{x: [x, x*y]}}: {came} came"
        )
    terms = {state: [str(name) for name in given[state]] for state in states}
    factors = [
        variable for names in terms.values() for name in names for variable in variables_of(name)
    ]
    variables = list(dict.fromkeys([*states, *factors]))
    named = reduce(add, (named_terms(variables, names) for names in terms.values()))
    return named.take(np.argsort(named.degrees, kind="stable")), terms
