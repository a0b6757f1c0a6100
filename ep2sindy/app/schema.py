"""From a config to a study: the study's signature is the schema of its config."""

from __future__ import annotations

import re
import types
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, OmegaConf

from ep2sindy.app.build import PLAIN, Configured, instance_of, is_plain, step_of
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.discovery.recipe import Recipe, method_of
from ep2sindy.studies.kinds import Deferred, Kind
from ep2sindy.studies.source import Source, Step

# Keys of conf/config.yaml that every run has.
COMMON = ("experiment", "study", "seed", "output", "figures")
# Fields of these types are made of groups at the top level, by what stands beside them: a method is
# five groups. Recipe is the old way to write AnyMethod, for one version more.
GATHERED: Mapping[Any, Callable[..., Any]] = {
    AnyMethod: method_of, Recipe: method_of, Source: Source,
}  # fmt: skip
# Groups of conf/config.yaml that a study may leave aside.
GROUPS = (
    "data", "prepare", "trajectory", "formulation", "search", "bootstraps", "selection", "depth",
    "parallel",
)  # fmt: skip


def keys_of(study: type) -> set[str]:
    """The top-level keys of the config that a study takes."""
    found: set[str] = set()
    for name, kind in _hints(study).items():
        found |= set(_groups(kind)) if kind in GATHERED else {name}
    return found


def study_of(study: type, config: DictConfig) -> Any:
    """Build a study from the config.

    Raises ValueError for a key that the study does not take, one that is missing, or a value of
    another kind than the study says.
    """
    known = {*COMMON, *GROUPS, *keys_of(study)}
    unknown = set(map(str, config)) - known
    if unknown:
        hint = ""
        if "thruster" in unknown:  # a file of ./conf/thruster without its first line
            hint = "; a file of conf/thruster begins with the line '# @package data.thruster'"
        raise ValueError(f"unknown keys {sorted(unknown)}; there are {sorted(known)}{hint}")
    return _filled(study, _without_formats(config, has_own="figures" in keys_of(study)))


def _without_formats(config: DictConfig, *, has_own: bool) -> DictConfig:
    """What is left to a study: `figures.formats`, the files that are made, is the runner's."""
    own = {name: v for name, v in (config.get("figures") or {}).items() if name != "formats"}
    if own and not has_own:
        first = f"figures.{next(iter(own))}"
        raise ValueError(f"{first!r} would do nothing: this experiment has figures.formats alone")
    found = config.copy()
    OmegaConf.set_struct(found, False)
    found.figures = own
    return found


def _filled(study: type, config: DictConfig) -> Any:
    """A dataclass from the top level of the config."""
    arguments = {}
    for name, kind in _hints(study).items():
        if kind in GATHERED:
            arguments[name] = _gathered(kind, config)
        elif name in config or OmegaConf.is_missing(config, name):
            arguments[name] = value_of(kind, _node(config, name, name), name)
        elif _is_required(study, name):
            raise ValueError(f"the config of this experiment must have {name!r}")
    return study(**arguments)


def _gathered(kind: Any, config: DictConfig) -> Any:
    """A method or source from its groups: one left out (`~search`) must not turn into a default."""
    groups = _groups(kind)
    if lacking := [name for name in groups if name not in config]:
        raise ValueError(
            f"the config of this experiment must have {lacking[0]!r}: choose one with "
            f"{lacking[0]}=NAME, see --help"
        )
    return GATHERED[kind](
        **{name: value_of(each, _node(config, name, name), name) for name, each in groups.items()}
    )


def _groups(kind: Any) -> dict[str, Any]:
    """The groups that make a value of this kind, each with the kind that it must be."""
    hints = get_type_hints(GATHERED[kind], include_extras=True)
    return {name: hint for name, hint in hints.items() if name != "return"}


def value_of(kind: Any, node: Any, place: str) -> Any:
    """A value of this kind from a node of the config; place: its dotted path, for errors."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        value = _plain(node)
        if isinstance(parts[1], Kind) and not parts[1].fits(value):
            raise ValueError(f"{place} must be {parts[1].says}: {value!r} came")
        return value_of(parts[0], node, place)
    if kind is Any:
        return _plain(node)
    if kind is Deferred:
        return Configured(node, place)
    if kind == Step:
        return step_of(node, place)
    if origin in (Union, types.UnionType):
        return _one_of(parts, node, place)
    if isinstance(node, DictConfig) and "_target_" in node:
        return instance_of(node, origin or kind, place)
    if isinstance(kind, type) and is_dataclass(kind):
        return _dataclass(kind, node, place)
    if origin is not None:
        return _container(origin, parts, node, place)
    return _scalar(kind, node, place)


def _container(origin: type, parts: Sequence[Any], node: Any, place: str) -> Any:
    if issubclass(origin, Mapping):
        if not OmegaConf.is_dict(node):
            raise ValueError(f"{place} must be like {{name: ...}}: {_plain(node)!r} came")
        if parts[1] is Deferred or is_dataclass(parts[1]):
            check_names(map(str, node), place)
        places = {key: f"{place}.{key}" for key in node}
        return {str(k): value_of(parts[1], _node(node, k, at), at) for k, at in places.items()}
    if not OmegaConf.is_list(node):
        raise ValueError(f"{place} must be a list: {_plain(node)!r} came")
    places = {k: f"{place}[{k}]" for k in range(len(node))}
    return [value_of(parts[0], _node(node, k, at), at) for k, at in places.items()]


def check_names(names: Iterable[str], place: str) -> None:
    """Raise ValueError for a name, of what files and headings are called by, that is more."""
    for name in names:
        if not re.fullmatch(r"\w[\w .,+-]{,99}", name):
            raise ValueError(
                f"{place} must be named by words, for files are named so: letters, digits and "
                f"_ . , + -, not {name!r}"
            )


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


def _scalar(kind: Any, node: Any, place: str) -> Any:
    """A plain value. One that names no `_target_` is never of a type that is not plain."""
    value = _plain(node)
    if not is_plain(value, kind):
        wanted = PLAIN.get(kind, f"a {kind.__name__}, named by its _target_")
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
        **{
            name: value_of(hints[name], _node(node, name, at), at)
            for name, at in ((name, f"{place}.{name}") for name in names)
            if name in given
        }
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


def _node(parent: Any, key: Any, place: str) -> Any:
    """A child, interpolations resolved."""
    if OmegaConf.is_missing(parent, key):
        raise ValueError(f"{place} must be set: it is still '???'")
    return parent[key]


def _plain(node: Any) -> Any:
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node
