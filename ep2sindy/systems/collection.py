"""Chaotic systems with polynomial equations, read from the package `dysts`.

Source: Gilpin 2021, arXiv:2110.05266. Kaptanoglu et al. 2023, arXiv:2302.10787, test searches for
equations on the polynomial ones.
"""

from __future__ import annotations

import inspect
import warnings
from functools import cache
from importlib.util import find_spec
from types import ModuleType

import numpy as np

from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.systems.systems import System

N_PERIODS, SAMPLES_PER_PERIOD = 10, 100
MAX_DEGREE = 5
ROUNDING = 1e-12  # of the largest coefficient: what expanding an equation leaves of a zero


@cache
def collected_names() -> tuple[str, ...]:
    """Names of the autonomous systems of the collection whose equations are polynomials.

    Raises ValueError if the package `dysts` is not installed.
    """
    _flows()
    from dysts.systems import get_attractor_list

    names = get_attractor_list(sys_class="continuous")
    return tuple(name for name in names if _equations(name) is not None)


@cache
def collected(name: str) -> System:
    """A system by its name in the collection, sampled over ten periods at 100 samples a period.

    Its library holds all products of the states up to the degree of the equations. Raises
    ValueError if there is no polynomial system of this name, or `dysts` is not installed.
    """
    entry = getattr(_flows(), name, None)
    equations = None if entry is None else _equations(name)
    if entry is None or equations is None:
        raise ValueError(f"dysts must have a system of polynomial equations named {name!r}")
    states, degree, terms = equations
    library = polynomial(states, degree=degree)
    coef = coef_matrix(library, terms)
    model = SparseModel(library, states, coef, provenance={"truth": f"dysts, {name}"})
    start = np.asarray(entry().ic, dtype=np.float64)
    period_s = float(entry().period)
    return System(name, model, start, N_PERIODS * period_s, SAMPLES_PER_PERIOD / period_s)


def is_installed() -> bool:
    """True if the package `dysts` is installed."""
    return find_spec("dysts") is not None


def _flows() -> ModuleType:
    if not is_installed():
        raise ValueError(
            'systems=dysts needs the package dysts: pip install "ep2sindy[benchmark]", or name '
            "systems of this package, such as systems=[lorenz]"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of packages that it would use
        from dysts import flows
    return flows


@cache
def _equations(name: str) -> tuple[tuple[str, ...], int, list[dict[str, float]]] | None:
    """States, degree, and each equation as term -> coefficient; None if not polynomials."""
    import sympy

    entry = getattr(_flows(), name)()
    if entry.delay or entry.nonautonomous:
        return None
    rhs = getattr(entry._rhs, "py_func", entry._rhs)  # before its compilation
    # x, y, ..., t, and the parameters
    names, d = tuple(inspect.signature(rhs).parameters), entry.embedding_dimension
    states, symbols = names[:d], sympy.symbols(names[: d + 1])
    try:
        rates = rhs(*symbols, *(entry.params[each] for each in names[d + 1 :]))
        found = [sympy.Poly(sympy.sympify(rate), *symbols[:d]) for rate in rates]
    except (AttributeError, NotImplementedError, TypeError, sympy.PolynomialError):
        return None
    degree = max(each.total_degree() for each in found)
    if degree > MAX_DEGREE or any(each.free_symbols_in_domain for each in found):
        return None
    library = polynomial(states, degree=degree)
    place = {
        tuple(row): term
        for row, term in zip(library.exponents.tolist(), library.names, strict=True)
    }
    terms = []
    for each in found:
        values = {place[powers]: float(value) for powers, value in each.terms()}
        least = ROUNDING * max(map(abs, values.values()))
        terms.append({term: value for term, value in values.items() if abs(value) > least})
    return states, degree, terms
