"""How large a library may be: counted before it is made."""

from __future__ import annotations

from collections.abc import Sequence
from math import comb, prod

from ep2sindy.trust.memory import check_memory

LARGEST_DEGREE = 100
MOST_TERMS = 20_000  # whose products with each other take 3 GB
MOST_EXPONENTS = 4_000_000  # all terms that there may be, of 200 variables


def check_degrees(degree: int, function_degree: int, n_variables: int, n_functions: int) -> None:
    """Raise ValueError for degrees that are none, or whose products are more than can be held."""
    if not isinstance(degree, int) or degree < 0:
        raise ValueError(f"degree must be a whole number, zero or more: {degree!r} came")
    if not isinstance(function_degree, int) or function_degree < 1:
        raise ValueError(f"function_degree must be one or more: {function_degree!r} came")
    if function_degree > 1 and not n_functions:
        raise ValueError(f"function_degree={function_degree} needs functions, such as ['sin']")
    _check_size("degree", degree, n_variables)
    _check_size("function_degree", function_degree, n_variables + n_functions)


def _check_size(name: str, degree: int, n_factors: int) -> None:
    if degree > LARGEST_DEGREE:
        raise ValueError(f"{name} must be {LARGEST_DEGREE} or less: {degree} came")
    if (n_terms := comb(n_factors + degree, degree)) <= MOST_TERMS:
        check_exponents(n_terms, n_factors)
        return
    fits = next(d for d in range(degree, -1, -1) if comb(n_factors + d, d) <= MOST_TERMS)
    raise ValueError(
        f"a library may have up to {MOST_TERMS} terms: {name}={degree} of {n_factors} variables "
        f"and functions makes {n_terms:.4g}; {name}={fits} makes {comb(n_factors + fits, fits)}"
    )


def check_exponents(n_terms: int, n_factors: int) -> None:
    """Raise ValueError for more terms than a library may hold of so many factors."""
    if n_terms * n_factors > MOST_EXPONENTS:
        raise ValueError(
            f"a library may have up to {MOST_EXPONENTS / 1e6:g} million exponents, one for every "
            f"term and variable or function: {n_terms} terms of {n_factors} came; leave out terms, "
            "or variables that no term has"
        )


def check_values(n_terms: int, shape: Sequence[int]) -> None:
    """Raise ValueError where the terms at so many samples, (..., variables), exceed memory."""
    n_samples = prod(shape[:-1])
    check_memory(
        24.0 * n_terms * n_samples,  # and what they are made of
        f"{n_terms} terms at {n_samples} samples",
        way_out="take every second sample (ep2sindy.prepare.decimate), or fewer terms",
        each=24.0 * n_terms,
    )
