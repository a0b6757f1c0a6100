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

    A `TrajectorySearch` takes the rule and the depth, unless its own are set, and ignores the
    formulation: it makes no rows, but experiments may make some beside it.
    Raises ValueError for bootstraps that do not go with the search, or a rule or depth that differs
    from the search's own.
    """
    if not isinstance(search, TrajectorySearch):
        return Regression(formulation, search, selection, bootstraps, depth)
    _check_no_bootstraps(bootstraps)
    plain = TrajectorySearch()  # a group of a config always has a value, perhaps the default
    return _with_settings(
        search,
        None if selection == plain.selection else selection,
        None if depth == plain.depth else depth,
    )


def _check_no_bootstraps(bootstraps: Bootstraps | None) -> None:
    if bootstraps is not None and bootstraps.n:
        raise ValueError(
            f"a search of trajectories draws no bootstraps: {bootstraps!r} came; take "
            "Bootstraps(n=0) (bootstraps=none), or a regression"
        )


def _with_settings(
    search: TrajectorySearch, selection: SystemSelection | Selection | None, depth: int | None
) -> TrajectorySearch:
    """The search with another rule and depth; None leaves its own.

    Raises ValueError for a setting that the search has already, with another value.
    """
    plain = TrajectorySearch()
    for name, own, default, given in (
        ("selection", search.selection, plain.selection, selection),
        ("depth", search.depth, plain.depth, depth),
    ):
        if given is not None and own not in (default, given):
            raise ValueError(
                f"{name} must be set once: {own!r} came in the search (search.{name}), and "
                f"{given!r} beside it; leave one of them out"
            )
    return replace(
        search,
        selection=search.selection if selection is None else selection,
        depth=search.depth if depth is None else depth,
    )


def Recipe(  # has the name of the class that it replaces
    formulation: Formulation | None = None,
    search: TrajectorySearch | Search | None = None,
    bootstraps: Bootstraps | None = None,
    selection: SystemSelection | Selection | None = None,
    depth: int | None = None,
) -> AnyMethod:
    """Old way to write a method, for one more version: it warns, and writes out the new one.

    It returns a search of trajectories, unless a setting of a regression is given. depth: None
    leaves the search's own, or 1 for a regression.
    Raises ValueError for settings of a regression beside a search of trajectories.
    """
    of_rows = formulation is not None or bootstraps is not None
    if search is None and (of_rows or not isinstance(selection, Evidence | None)):
        search = BestSubset()
    found: AnyMethod
    if search is None or isinstance(search, TrajectorySearch):
        if formulation is not None:
            raise ValueError(
                f"a search of trajectories makes no rows: {formulation!r} came; leave the "
                "formulation out, or take a search of rows, such as BestSubset()"
            )
        _check_no_bootstraps(bootstraps)
        found = _with_settings(search or TrajectorySearch(), selection, depth)
    else:
        found = Regression(
            WeightedWeak() if formulation is None else formulation,
            search,
            EBIC() if selection is None else selection,
            Bootstraps(n=0) if bootstraps is None else bootstraps,
            1 if depth is None else depth,
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
