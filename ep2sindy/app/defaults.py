"""What a config leaves to its targets, written out, so that it can be changed by its place."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any

from omegaconf import DictConfig, OmegaConf

from ep2sindy._stubs import place_of


def write_defaults(node: DictConfig, place: str, target: Callable[[Any], Any]) -> None:
    """Add what stands at a dotted place by default, if the targets on the way have it.

    target: what a node with a `_target_` names. `thruster.transport.c_plume` in a thruster that
    says nothing of its transport becomes all of the transport that it has by default.
    """
    *outer, last = place.split(".")
    for name in (*outer, last):
        if not isinstance(node, DictConfig):
            return
        if name not in node and "_target_" in node:
            values = defaults_of(target(node))
            if name in values:
                OmegaConf.update(node, name, plain(values[name]), force_add=True)
        if name not in node:
            return
        node = node[name]


def defaults_of(call: Any) -> dict[str, Any]:
    """Arguments of a class or function that have a default, with it."""
    if is_dataclass(call):
        found = {}
        for each in fields(call):
            if each.init and each.default is not MISSING:
                found[each.name] = each.default
            elif each.init and each.default_factory is not MISSING:
                found[each.name] = each.default_factory()
        return found
    try:
        takes = inspect.signature(call).parameters.values()
    except (TypeError, ValueError):  # compiled, it does not say what it takes
        return {}
    return {each.name: each.default for each in takes if each.default is not each.empty}


def plain(value: Any) -> Any:
    """A value as a config has it: a dataclass as a node that names its class."""
    if is_dataclass(value) and not isinstance(value, type):
        members = {each.name: plain(getattr(value, each.name)) for each in fields(value)}
        taken = {each.name for each in fields(value) if each.init}
        return {"_target_": _name(type(value))} | {n: m for n, m in members.items() if n in taken}
    if isinstance(value, Mapping):
        return {str(name): plain(member) for name, member in value.items()}
    return [plain(each) for each in value] if isinstance(value, list | tuple) else value


def _name(kind: type) -> str:
    """By the package's stubs where they have it: modules may move."""
    return place_of(kind) or f"{kind.__module__}.{kind.__qualname__}"  # a user's
