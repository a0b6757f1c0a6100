"""Methods from single settings: the groups of a config."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from ep2sindy.discovery.method import AnyMethod, Regression, TrajectorySearch
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.rows import Formulation
from ep2sindy.regression.searches import Search
from ep2sindy.selection.rule import Selection


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
    selection: Selection,
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
    if bootstraps.n:
        raise ValueError(
            f"a search of trajectories draws no bootstraps: {bootstraps!r} came; take "
            "Bootstraps(n=0) (bootstraps=none), or a regression"
        )
    plain = TrajectorySearch()
    return replace(
        search,
        selection=_once("selection", search.selection, selection, plain.selection),
        depth=_once("depth", search.depth, depth, plain.depth),
    )


def _once(name: str, own: Any, given: Any, default: Any) -> Any:
    """A setting of the search, or what was given beside it: a config always has a value there.

    Raises ValueError for a setting that the search has already, with another value.
    """
    if given == default:
        return own
    if own not in (default, given):
        raise ValueError(
            f"{name} must be set once: {own!r} came in the search (search.{name}), and "
            f"{given!r} beside it; leave one of them out"
        )
    return given
