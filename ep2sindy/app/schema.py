"""From a config to a study: the study's signature is the schema of its config."""

from __future__ import annotations

import types
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, OmegaConf

from ep2sindy.app.build import deferred, instance_of, step_of
from ep2sindy.discovery.recipe import Recipe
from ep2sindy.studies.kinds import Deferred, Kind
from ep2sindy.studies.source import FieldSource, Source, Step

# Keys of conf/config.yaml that every run has.
COMMON = ("experiment", "study", "seed", "output")
# Fields of these types take their own fields from the top level: a recipe is five groups.
GATHERED = (Recipe, Source, FieldSource)
# Groups of conf/config.yaml that a study may leave aside.
GROUPS = (
    "data", "prepare", "trajectory", "formulation", "search", "bootstraps", "selection", "depth",
    "parallel",
)  # fmt: skip


def keys_of(study: type) -> set[str]:
    """The top-level keys of the config that a study takes."""
    found = set()
    for name, kind in _hints(study).items():
        found |= keys_of(kind) if kind in GATHERED else {name}
    return found


def study_of(study: type, config: DictConfig) -> Any:
    """Build a study from the config.

    Raises ValueError for a key that the study does not take, one that is missing, or a value of
    another kind than the study says.
    """
    known = {*COMMON, *GROUPS, *keys_of(study)}
    unknown = set(map(str, config)) - known
    if unknown:
        raise ValueError(f"unknown keys {sorted(unknown)}; there are {sorted(known)}")
    return _filled(study, config)


def _filled(study: type, config: DictConfig) -> Any:
    """A dataclass from the top level of the config."""
    arguments = {}
    for name, kind in _hints(study).items():
        if kind in GATHERED:
            arguments[name] = _filled(kind, config)
        elif name in config:
            arguments[name] = value_of(kind, _node(config, name), name)
        elif _is_required(study, name):
            raise ValueError(f"the config of this experiment must have {name!r}")
    return study(**arguments)


def value_of(kind: Any, node: Any, place: str) -> Any:
    """A value of this kind from a node of the config; place: its dotted path, for errors."""
    if get_origin(kind) is Annotated:
        base, rule = get_args(kind)
        value = _plain(node)
        if isinstance(rule, Kind) and not rule.fits(value):
            raise ValueError(f"{place} must be {rule.says}: {value!r} came")
        return value_of(base, node, place)
    if kind is Deferred:
        return deferred(node, place)
    if kind == Step:
        return step_of(node, place)
    if isinstance(node, DictConfig) and "_target_" in node:
        return instance_of(node, kind, place)
    if is_dataclass(kind) and isinstance(kind, type):
        return _dataclass(kind, node, place)
    return _container_or_scalar(kind, node, place)


def _container_or_scalar(kind: Any, node: Any, place: str) -> Any:
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, types.UnionType):
        return _one_of(parts, node, place)
    if origin is Literal:
        if _plain(node) not in parts:
            raise ValueError(f"{place} must be one of {list(parts)}: {_plain(node)!r} came")
        return node
    if origin is not None and issubclass(origin, Mapping):
        if not isinstance(node, DictConfig):
            raise ValueError(f"{place} must be like {{name: ...}}: {_plain(node)!r} came")
        items = {str(key): _node(node, key) for key in node}
        return {key: value_of(parts[1], each, f"{place}.{key}") for key, each in items.items()}
    if origin is not None and issubclass(origin, Sequence):
        if not OmegaConf.is_list(node):
            raise ValueError(f"{place} must be a list: {_plain(node)!r} came")
        nodes = [_node(node, k) for k in range(len(node))]
        return [value_of(parts[0], each, f"{place}[{k}]") for k, each in enumerate(nodes)]
    return _scalar(kind, node, place)


def _one_of(kinds: Sequence[Any], node: Any, place: str) -> Any:
    """A value of the first kind that it fits; the last says what is wrong."""
    if node is None and type(None) in kinds:
        return None
    kinds = [kind for kind in kinds if kind is not type(None)]
    for kind in kinds[:-1]:
        try:
            return value_of(kind, node, place)
        except ValueError:
            continue
    return value_of(kinds[-1], node, place)


NAMES = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}


def _scalar(kind: Any, node: Any, place: str) -> Any:
    value = _plain(node)
    if kind is Any or not isinstance(kind, type):
        return value
    fits = {
        float: type(value) in (int, float),
        int: type(value) is int,
        bool: type(value) is bool,
        str: isinstance(value, str),
    }
    if not fits.get(kind, isinstance(value, kind) or getattr(kind, "_is_protocol", False)):
        wanted = NAMES.get(kind, f"a {kind.__name__}, named by its _target_")
        raise ValueError(f"{place} must be {wanted}: {value!r} came")
    return float(value) if kind is float else value


def _dataclass(kind: type, node: Any, place: str) -> Any:
    """A mapping as a dataclass: no key may be missing, and none be there that does nothing."""
    names = [f.name for f in fields(kind) if f.init]
    needed = [name for name in names if _is_required(kind, name)]
    given = set(map(str, node)) if isinstance(node, DictConfig) else None
    if given is None or given - set(names) or set(needed) - given:
        came = sorted(given) if given is not None else _plain(node)
        if len(needed) == len(names):
            raise ValueError(f"{place} must have {_listed(needed)}: {came} came")
        raise ValueError(
            f"{place} may have {sorted(names)} and needs {_listed(needed)}: {came} came"
        )
    hints = _hints(kind)
    return kind(
        **{n: value_of(hints[n], _node(node, n), f"{place}.{n}") for n in names if n in given}
    )


def _listed(names: Sequence[str]) -> str:
    """`a, b and c`."""
    return " and ".join([", ".join(names[:-1]), *names[-1:]] if len(names) > 1 else names) or "none"


def _hints(kind: type) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {f.name: hints[f.name] for f in fields(kind) if f.init}


def _is_required(kind: type, name: str) -> bool:
    (field,) = (f for f in fields(kind) if f.name == name)
    return field.default is MISSING and field.default_factory is MISSING


def _node(parent: Any, key: Any) -> Any:
    """A child as a node, interpolations resolved by OmegaConf when its values are read."""
    return parent[key]


def _plain(node: Any) -> Any:
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
