"""Targets that a config may name: those that the stubs or the user mark for configs.

Values, readers and simulators are marked. Functions that write to a given place, or run what they
are given, are not.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from typing import Any

from ep2sindy._stubs import dotted_names
from ep2sindy.trust.user_code import load_marked, nodes_of

# Full names: `ep2sindy.EBIC`, `ep2sindy.thruster.Thruster`.
FOR_CONFIGS = frozenset(name for name, entry in dotted_names().items() if entry.for_configs)


def target_of(node: Mapping[str, Any], place: str) -> Callable[..., Any]:
    """The object that a node's `_target_` names.

    Raises ValueError for a name that configs may not use, before anything of it is imported.
    """
    name = str(node["_target_"])
    return dotted_names()[name].load() if name in FOR_CONFIGS else _own(name, place)


def _own(name: str, place: str) -> Callable[..., Any]:
    """An object that the user has marked; only files below the current folder are imported."""
    place = place or "the config"
    module, _, last = name.rpartition(".")
    if module.partition(".")[0] in ("", "ep2sindy"):
        alike = get_close_matches(last, {each.rpartition(".")[2] for each in FOR_CONFIGS})
        near = sorted(each for each in FOR_CONFIGS if each.rpartition(".")[2] in alike)
        raise ValueError(
            f"{place} must name a _target_ that there is, such as ep2sindy.EBIC, and that is for "
            f"configs: got {name!r}; near it: {', '.join(near or sorted(FOR_CONFIGS))}"
        )
    try:
        return load_marked(name)
    except (ModuleNotFoundError, AttributeError, ValueError) as error:
        raise ValueError(
            f"{place} must name a _target_ of ep2sindy that is for configs, such as ep2sindy.EBIC, "
            f"or one of yours below the folder that you start in: got {name!r}, and {error}"
        ) from error


def check_targets(settings: Any) -> None:
    """Raise ValueError for a `_target_`, at any depth, that configs may not name.

    Interpolated names are checked when they are built. Targets of this package are not imported
    yet: a definition that a run leaves out may need an extra.
    """
    for place, node in nodes_of(settings):
        if isinstance(node, Mapping) and "_target_" in node:
            name = str(node["_target_"])
            if name not in FOR_CONFIGS and "${" not in name:
                _own(name, place)
