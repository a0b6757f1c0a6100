"""Methods from single settings: the groups of a config."""

from __future__ import annotations

from dataclasses import replace

from ep2sindy.discovery.method import AnyMethod, Regression, TrajectorySearch
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.rows import Formulation
from ep2sindy.regression.searches import Search
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
    if bootstraps.n:
        raise ValueError(
            f"a search of trajectories draws no bootstraps: {bootstraps!r} came; take "
            "Bootstraps(n=0) (bootstraps=none), or a regression"
        )
    plain = TrajectorySearch()  # a group of a config always has a value, perhaps the default
    return _with_settings(
        search,
        None if selection == plain.selection else selection,
        None if depth == plain.depth else depth,
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
