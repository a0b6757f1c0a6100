"""Methods from single settings: the groups of a config, and the old `Recipe`."""

from __future__ import annotations

import warnings
from dataclasses import fields, replace

from ep2sindy.discovery.method import AnyMethod, Regression, TrajectorySearch
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.rows import Formulation
from ep2sindy.regression.searches import BestSubset, Search
from ep2sindy.regression.weak import WeightedWeak
from ep2sindy.selection.criteria import EBIC, Evidence
from ep2sindy.selection.rule import Selection, SystemSelection


def regression_of(method: AnyMethod) -> Regression:
    """The method if it is a regression. Raises ValueError for a search of trajectories."""
    if isinstance(method, TrajectorySearch):
        raise ValueError(
            "a search of trajectories fits them whole, and serves discover() and the experiments "
            f"discover, breathing and benchmark: {method!r} came; use "
            "Regression(search=BestSubset()) here (search=best_subset)"
        )
    return method


def method_of(
    formulation: Formulation,
    search: TrajectorySearch | Search,
    bootstraps: Bootstraps,
    selection: SystemSelection | Selection,
    depth: int,
) -> AnyMethod:
    """The method for settings that are chosen one by one, such as the groups of a config.

    A `TrajectorySearch` takes the rule and the depth, and ignores the formulation.
    Raises ValueError for bootstraps that do not go with the search.
    """
    if not isinstance(search, TrajectorySearch):
        return Regression(formulation, search, selection, bootstraps, depth)
    if bootstraps.n:
        raise ValueError(
            f"a search of trajectories draws no bootstraps: {bootstraps!r} came; take "
            "Bootstraps(n=0) (bootstraps=none), or a regression"
        )
    return replace(search, selection=selection, depth=depth)


def Recipe(  # has the name of the class that it replaces
    formulation: Formulation | None = None,
    search: TrajectorySearch | Search | None = None,
    bootstraps: Bootstraps | None = None,
    selection: SystemSelection | Selection | None = None,
    depth: int = 1,
) -> AnyMethod:
    """Old way to write a method, for one more version: it warns, and writes out the new one.

    It returns a search of trajectories, unless a setting of a regression is given.
    """
    of_rows = formulation is not None or bootstraps is not None
    if search is None and (of_rows or not isinstance(selection, Evidence | None)):
        search = BestSubset()
    joint = search if isinstance(search, TrajectorySearch) else TrajectorySearch()
    of_trajectories = search is None or isinstance(search, TrajectorySearch)
    found = method_of(
        WeightedWeak() if formulation is None else formulation,
        joint if search is None else search,
        Bootstraps(n=0) if bootstraps is None else bootstraps,
        (joint.selection if of_trajectories else EBIC()) if selection is None else selection,
        depth,
    )
    warnings.warn(
        f"ep.Recipe(...) goes with the next version: write {_call_of(found)}, and pass it to "
        "ep.discover as method=...",
        FutureWarning,
        stacklevel=2,
    )
    return found


def _call_of(method: AnyMethod) -> str:
    """Source text of a method, default arguments left out."""
    plain = type(method)()
    names = [f.name for f in fields(method) if getattr(method, f.name) != getattr(plain, f.name)]
    given = ", ".join(f"{name}={getattr(method, name)!r}" for name in names)
    return f"ep.{type(method).__name__}({given})"
