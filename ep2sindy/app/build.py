"""From nodes of a config that name a `_target_` to objects."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from functools import partial
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, ListConfig, OmegaConf

from ep2sindy.app.defaults import write_defaults
from ep2sindy.app.targets import target_of
from ep2sindy.studies.source import Step

PLAIN = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}


def is_plain(value: object, kind: type) -> bool:
    """Whether a value is of a plain kind; a whole number is a number too, true is none."""
    return type(value) is kind or (kind, type(value)) == (float, int)


def check_set(node: DictConfig) -> None:
    """Raise ValueError for a value, at any depth, that a config leaves to its user."""
    if missing := sorted(OmegaConf.missing_keys(node)):
        raise ValueError(f"{missing[0]} must be set: it is still '???'")


def check_arguments(node: Any, place: str) -> None:
    """Raise ValueError for an argument, at any depth, that is not of the plain kind it must be."""
    if isinstance(node, ListConfig):
        for k in range(len(node)):
            check_arguments(node[k], f"{place}[{k}]")
    if not isinstance(node, DictConfig):
        return
    kinds = _plain_kinds(node, place) if "_target_" in node else {}
    for name in map(str, node):
        value, wanted = node[name], kinds.get(name, ())
        if wanted and value is not None and not any(is_plain(value, kind) for kind in wanted):
            words = " or ".join(PLAIN[kind] for kind in wanted)
            raise ValueError(f"{place}.{name} must be {words}: {value!r} came")
        check_arguments(value, f"{place}.{name}")


def _plain_kinds(node: DictConfig, place: str) -> dict[str, tuple[type, ...]]:
    """Arguments of a target that can only be plain values, or None: by name, their kinds."""
    target = target_of(node, place)
    try:
        hints = get_type_hints(getattr(target, "__init__") if isinstance(target, type) else target)  # noqa: B009
    except Exception:  # an annotation that is not there while the program runs; no annotations
        return {}
    found = {name: _alternatives(hint) for name, hint in hints.items()}
    return {name: kinds for name, kinds in found.items() if set(kinds) <= set(PLAIN)}


def _alternatives(hint: Any) -> tuple[Any, ...]:
    """The kinds of a union but None; of another hint itself."""
    parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return tuple(part for part in parts if part is not type(None))


def call_of(node: DictConfig, place: str, *first: Any) -> partial[Any]:
    """What a node's `_target_` names, with the rest of the node, built, as its arguments.

    place: the node's dotted path, for errors. first: arguments that it is given when called.
    Raises ValueError where it cannot be called so, or what a nested target raised itself.
    """
    check_set(node)
    check_arguments(node, place)
    target = target_of(node, place)
    call = partial(target, **_arguments(node, place))
    try:
        takes = inspect.signature(target)
    except ValueError:  # compiled, it does not say what it takes
        return call
    try:
        takes.bind(*first, **call.keywords)
    except TypeError as error:
        name = getattr(target, "__name__", target)
        names = list(takes.parameters)[len(first) :]
        raise ValueError(f"{place}, {name}: {error}; it takes {names}") from error
    return call


def _arguments(node: DictConfig, place: str) -> dict[str, Any]:
    return {k: _built(node[k], f"{place}.{k}") for k in map(str, node) if k != "_target_"}


def _built(node: Any, place: str) -> Any:
    """A value of a config, with what it names at any depth made."""
    if isinstance(node, ListConfig):
        return [_built(each, f"{place}[{k}]") for k, each in enumerate(node)]
    if not isinstance(node, DictConfig):
        return node
    if "_target_" not in node:
        return {key: _built(node[key], f"{place}.{key!s}") for key in node}
    call = call_of(node, place)
    try:
        return call()
    except TypeError as error:
        raise ValueError(f"{place} cannot be made: {error}") from error


def instance_of(node: DictConfig, kind: type, place: str) -> Any:
    """The object that a node names, if it is of this kind."""
    value = call_of(node, place)()
    if not isinstance(value, kind):
        raise ValueError(f"{place} must name a _target_ that is a {kind.__name__}: {value!r} came")
    return value


def step_of(node: Any, place: str) -> Step:
    """A step of `prepare`; an argument that it does not know is refused here."""
    if not isinstance(node, DictConfig) or "_target_" not in node:
        raise ValueError(
            f"{place} must be like {{_target_: ep2sindy.prepare.crop, start_s: 0}}: {node!r} came"
        )
    return call_of(node, place, None)


@dataclass(frozen=True, eq=False)
class Configured:
    """A node that names a `_target_`, built when asked for: see `Deferred`."""

    node: Any
    place: str

    def __post_init__(self) -> None:
        if not isinstance(self.node, DictConfig) or "_target_" not in self.node:
            raise ValueError(f"{self.place} must name a _target_: {self.node!r} came")
        check_set(self.node)

    @property
    def settings(self) -> Mapping[str, Any]:
        plain: Any = OmegaConf.to_container(self.node, resolve=True)
        return {str(key): value for key, value in plain.items()}

    def build(self) -> Any:
        return call_of(self.node, self.place)()

    def changed(
        self, places: Mapping[str, Any], more: Mapping[str, Any] | None = None
    ) -> Configured:
        node = deepcopy(self.node)
        missing = object()
        for place, value in places.items():
            write_defaults(node, place, partial(target_of, place=self.place))
            if OmegaConf.select(node, place, default=missing) is missing:
                raise ValueError(f"{self.place}.{place} must be there to be changed: it is not")
            OmegaConf.update(node, place, value)
        OmegaConf.set_struct(node, False)  # a key that it does not take is refused when it is built
        merged: Any = OmegaConf.merge(node, dict(more or {}))
        return Configured(merged, self.place)

    def __str__(self) -> str:
        return OmegaConf.to_yaml(self.node, resolve=True, sort_keys=True)
