"""Chaotic systems with polynomial equations, from the package `dysts`, and how many are found.

    python -m benchmarks.collection --variants joint PySINDy_STLSQ    # of conf/definitions/pysindy
        [--noises 0.01 0.05 0.2] [--n 1] [--records 1] [--degree 4] [--figure benchmark_chaotic.png]

Prints for every variant and noise, over all systems and n draws of each: true equations on the
front, selected ones, and the median CPU time of a search. A draw starts anywhere on the attractor,
in each of its records.

Source: Gilpin 2021, arXiv:2110.05266. Kaptanoglu et al. 2023, arXiv:2302.10787, test searches for
equations on the polynomial ones. `pip install -e ".[benchmark]"` installs dysts and PySINDy.
"""

from __future__ import annotations

import argparse
import inspect
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import product
from pathlib import Path
from types import ModuleType

import numpy as np
import pandas as pd
from hydra import compose, initialize_config_dir
from hydra.utils import instantiate

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.identified import benchmark_figure
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.studies.benchmark import Variant, assessed, cells, published_cells
from ep2sindy.systems.draws import noisy_records
from ep2sindy.systems.systems import System

CONF = Path(__file__).resolve().parents[1] / "conf"
N_PERIODS, SAMPLES_PER_PERIOD = 10, 100
MAX_DEGREE = 5
ROUNDING = 1e-12  # of the largest coefficient: what expanding an equation leaves of a zero


@cache
def collected_names() -> tuple[str, ...]:
    """Names of the autonomous systems of the collection whose equations are polynomials."""
    from dysts.systems import get_attractor_list

    names = get_attractor_list(sys_class="continuous")
    return tuple(name for name in names if _equations(name) is not None)


@cache
def collected(name: str) -> System:
    """A system by its name in the collection, sampled over ten periods at 100 samples a period.

    Its library holds all products of the states up to the degree of the equations. Raises
    ValueError if there is no polynomial system of this name.
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


def on_attractor(name: str, rng: np.random.Generator) -> System:
    """A system of the collection that starts anywhere on its attractor."""
    system = collected(name)
    states = system.trajectory().states
    return replace(system, initial=states[rng.integers(len(states))])


def collected_draw(
    system: str,
    noise: float,
    number: int,
    *,
    n_trajectories: int = 1,
    degree: int | None = None,
    seed: int = 0,
) -> tuple[System, list[Trajectory]]:
    """As `ep2sindy.systems.draws.realization`, of a system of the collection."""
    rng = np.random.default_rng([seed, *system.encode(), number])
    draws = [on_attractor(system, rng) for _ in range(n_trajectories)]
    starts, streams = [draw.initial for draw in draws], rng.spawn(n_trajectories)
    return noisy_records(draws[0], starts, streams, noise, degree=degree)


def counted(
    variants: Mapping[str, Variant],
    names: Sequence[str],
    noises: Sequence[float],
    n: int,
    *,
    n_trajectories: int = 1,
    degree: int | None = None,
) -> pd.DataFrame:
    """`cells` of all systems together."""
    draw = partial(collected_draw, n_trajectories=n_trajectories, degree=degree)
    places = product(names, noises, range(n))
    tasks = [dict(zip(("system", "noise", "number"), place, strict=True)) for place in places]
    rows = [row for task in tasks for row in assessed(variants, draw, task, seed=0)]
    return cells(pd.DataFrame(rows).assign(system="dysts"))


def defined(names: Sequence[str]) -> dict[str, Variant]:
    """Variants by their names in conf/definitions/pysindy.yaml."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        known = compose("config", ["+exp=benchmark", "definitions=pysindy"]).definitions
    return {name: instantiate(known[name]) for name in names}


def _flows() -> ModuleType:
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


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--variants", nargs="+", default=["joint"])
    parser.add_argument("--noises", nargs="+", type=float, default=[0.01, 0.05, 0.2])
    parser.add_argument("--n", type=int, default=1, help="draws of each system")
    parser.add_argument("--records", type=int, default=1, help="records of each draw")
    parser.add_argument("--degree", type=int, help="of all libraries; otherwise each system's own")
    parser.add_argument("--figure", type=Path)
    asked = parser.parse_args()
    found = counted(
        defined(asked.variants),
        collected_names(),
        asked.noises,
        asked.n,
        n_trajectories=asked.records,
        degree=asked.degree,
    )
    print(found.to_string(index=False))
    if asked.figure:
        benchmark_figure(found, thesis=published_cells()).savefig(asked.figure)


if __name__ == "__main__":
    main()
