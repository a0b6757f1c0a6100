"""Models whose terms the config gives: `n_i: [n_i*u_iz, n_i*n_n*R_ion]`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from operator import add
from typing import Any

import numpy as np

from ep2sindy.library.library import Library, named_terms
from ep2sindy.library.names import split_factors


def terms_of(
    given: Mapping[str, Any], *, states: Sequence[str], key: str = "model"
) -> tuple[Library, dict[str, list[str]]]:
    """The terms of every state, and a library that holds each of them once.

    key: what the config calls this model, for the message.
    Raises ValueError unless every state, and no other name, has a list of terms.
    """
    if set(given) != set(states) or not all(
        isinstance(names, list) and names for names in given.values()
    ):
        raise ValueError(
            f"{key} must list the terms of every state of {list(states)}, such as "
            f"{{x: [x, x*y]}}: {dict(given)} came"
        )
    terms = {state: [str(name) for name in given[state]] for state in states}
    factors = [
        variable
        for names in terms.values()
        for name in names
        if name.strip() != "1"
        for variable, _ in split_factors(name)
    ]
    variables = list(dict.fromkeys([*states, *factors]))
    named = reduce(add, (named_terms(variables, names) for names in terms.values()))
    by_degree = np.argsort(named.exponents.sum(axis=1), kind="stable")
    return Library(variables, named.exponents[by_degree]), terms
