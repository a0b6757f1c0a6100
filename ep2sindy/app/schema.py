"""Build a study from a config; the study's signature is the schema of its config.

A config is made plain once: mappings, lists and values, with interpolations resolved. The module
holds the only type checker of configs, for fields of studies and arguments of `_target_`s.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import partial
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, OmegaConf

from ep2sindy._stubs import place_of
from ep2sindy.app.targets import target_of
from ep2sindy.discovery.method import AnyMethod, method_of
from ep2sindy.report.folder import FORMATS
from ep2sindy.runtime.screen import joined, near_words
from ep2sindy.studies.source import Source, Step
from ep2sindy.studies.study import Check, Deferred, ZeroOrMore
from ep2sindy.trust.user_code import nodes_of


def _are_formats(value: Any) -> bool:
    return isinstance(value, list) and "png" in value and {*value} <= {*FORMATS}


# Keys of conf/config.yaml that every run has, with their types.
COMMON: Mapping[str, Any] = {
    "experiment": Annotated[
        str,
        Check("a name for a folder, of letters, digits and _", lambda x: str(x).isidentifier()),
    ],
    "study": str,
    "seed": ZeroOrMore,
    "output": Annotated[str, Check("a folder's name", bool)],
    "formats": Annotated[
        Any,
        Check(f"a list of {', '.join(FORMATS)} with png, which pages are made of", _are_formats),
    ],
    "verbose": bool,
}
# Fields of these types are made of the top-level groups that these functions take.
GATHERED: Mapping[Any, Callable[..., Any]] = {AnyMethod: method_of, Source: Source}
# Groups of conf/config.yaml that a study may leave aside.
GROUPS = frozenset(
    name for call in GATHERED.values() for name in inspect.signature(call).parameters
)


def keys_of(study: type) -> set[str]:
    """The top-level keys of a study's config."""
    hints = hints_of(study).items()
    gathered = {
        group for _, kind in hints if kind in GATHERED for group in hints_of(GATHERED[kind])
    }
    return gathered | {name for name, kind in hints if kind not in GATHERED}


def study_of(study: type, config: DictConfig) -> Any:
    """Build a study from the config.

    Raises ValueError for a key that the study does not take, a missing key, or a value whose type
    differs from the study's.
    """
    used = keys_of(study)
    known = {*COMMON, *GROUPS, "parallel", *used}
    if unknown := {*map(str, config)} - known:
        hint = ""
        if "thruster" in unknown:  # a file of ./conf/thruster that lacks its first line
            hint = "; a file of conf/thruster begins with the line '# @package data.thruster'"
        near = "".join(near_words(name, known) for name in sorted(unknown))
        raise ValueError(f"unknown keys {sorted(unknown)}{near}; keys are {sorted(known)}{hint}")
    first = (config.get("points") or [None])[0]
    if isinstance(first, str) and OmegaConf.is_missing(config.data, "path"):
        config.data.path = None  # the points name the files
    nodes = nodes_of(OmegaConf.to_container(config))
    if unset := [at for at, node in nodes if node == "???" and re.split(r"\W", at)[0] in used]:
        raise ValueError(f"{joined(unset)} must be set, got '???'")
    settings = plain(config)
    for name in {*COMMON} & {*settings}:
        value_of(COMMON[name], settings[name], name)
    return _filled(study, settings)


def plain(config: Any) -> Any:
    """A config as mappings, lists and values, with interpolations resolved."""
    return OmegaConf.to_container(config, resolve=True)


def _filled(call: Callable[..., Any], settings: Mapping[str, Any]) -> Any:
    """A study, or a method or source made of groups, from the top level of the config."""
    takes = inspect.signature(call).parameters
    arguments = {}
    for name, kind in hints_of(call).items():
        if kind in GATHERED:
            arguments[name] = _filled(GATHERED[kind], settings)
        elif name in settings:
            arguments[name] = value_of(kind, settings[name], name)
        elif takes[name].default is inspect.Parameter.empty:
            way = f": choose one with {name}=NAME, see --help" if name in GROUPS else ""
            raise ValueError(f"the config of this experiment must have {name!r}{way}")
    return call(**arguments)


def hints_of(call: Any) -> dict[str, Any]:
    """Type annotations of a function's or class's arguments by name; empty if there are none."""
    try:
        hints = get_type_hints(
            getattr(call, "__init__") if isinstance(call, type) else call,  # noqa: B009
            include_extras=True,
        )
    except Exception:  # an annotation that does not exist at run time; a compiled function
        return {}
    return {name: kind for name, kind in hints.items() if name != "return"}


# From plain settings to values: the only place where the type of a setting is checked.
#
# The type comes from the signature that takes the setting: a field of a study, or an argument of a
# `_target_`. Of the latter only plain arguments are checked here, since the class or function
# itself reports errors in the others best.


PLAIN = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}


def value_of(kind: Any, node: Any, place: str) -> Any:
    """A value of this type from a setting. place: its dotted path, for errors.

    Any takes a node as it is, object builds all targets in it.
    """
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        if isinstance(parts[1], Check) and not parts[1].test(node):
            raise ValueError(f"{place} must be {parts[1].message}: got {node!r}")
        return value_of(parts[0], node, place)
    if kind is Any:
        return node
    if kind is Deferred:
        return Configured(node, place)
    if kind == Step:
        return bind(node, place, None)
    if origin in (Union, UnionType):
        return _one_of(parts, node, place)
    if _names_target(node):
        return _built(node, origin or kind, place)
    if is_dataclass(kind):
        if not isinstance(node, Mapping):
            raise ValueError(f"{place} must have {[*hints_of(kind)]}: got {node!r}")
        return _call(kind, node, place, hints_of(kind))()
    if origin is not None:
        return _container(origin, parts, node, place)
    if kind is object:
        if isinstance(node, Mapping):
            return {key: value_of(object, each, f"{place}.{key}") for key, each in node.items()}
        return _container(list, (object,), node, place) if isinstance(node, list) else node
    # A whole number counts as a number, too; a truth value does not.
    if type(node) is not kind and (kind, type(node)) != (float, int):
        wanted = PLAIN.get(kind, f"a {kind.__name__}, named by its _target_")
        raise ValueError(f"{place} must be {wanted}: got {node!r}")
    return float(node) if kind is float else node


def _names_target(node: Any) -> bool:
    return isinstance(node, Mapping) and "_target_" in node


def _check_target(node: Any, place: str) -> None:
    if not _names_target(node):
        raise ValueError(
            f"{place} must name a _target_, like {{_target_: ep2sindy.data.crop, start_s: 0}}: "
            f"got {node!r}"
        )


def _container(origin: type, parts: Sequence[Any], node: Any, place: str) -> Any:
    if not issubclass(origin, Mapping):
        if not isinstance(node, list):
            raise ValueError(f"{place} must be a list: got {node!r}")
        return [value_of(parts[0], each, f"{place}[{k}]") for k, each in enumerate(node)]
    if not isinstance(node, Mapping):
        raise ValueError(f"{place} must be like {{name: ...}}: got {node!r}")
    if parts[1] is Deferred or is_dataclass(parts[1]):
        for name in node:
            if not re.fullmatch(r"\w[\w .,+-]{,99}", str(name)):
                raise ValueError(
                    f"{place} must be named by words, for files are named so: letters, digits and "
                    f"_ . , + -, not {name!r}"
                )
    return {str(k): value_of(parts[1], each, f"{place}.{k}") for k, each in node.items()}


def _one_of(kinds: Sequence[Any], node: Any, place: str) -> Any:
    """A value of the first type that fits; if none fits, the error is that of the last."""
    if node is None and NoneType in kinds:
        return None
    *others, last = [kind for kind in kinds if kind is not NoneType]
    for kind in others:
        try:
            return value_of(kind, node, place)
        except ValueError:
            continue
    return value_of(last, node, place)


def _built(node: Mapping[str, Any], kind: type, place: str) -> Any:
    """The object that a node names, checked to be of this type."""
    call = bind(node, place)
    try:
        value = call()
    except TypeError as error:
        raise ValueError(f"{place} cannot be made: {error}") from error
    if not isinstance(value, kind):
        raise ValueError(f"{place} must name a _target_ that is a {kind.__name__}: got {value!r}")
    return value


def bind(node: Any, place: str, *first: Any) -> partial[Any]:
    """The node's `_target_`, with the remaining entries, built, as its arguments.

    place: the node's dotted path, for errors. first: leading arguments, given when it is called.
    Raises ValueError if the target cannot be called so, and errors that a nested target raises.
    """
    _check_target(node, place)
    target = target_of(node, place)
    plain_or_none = {*PLAIN, NoneType}
    kinds = {
        name: kind
        for name, kind in hints_of(target).items()
        if {*(get_args(kind) if isinstance(kind, UnionType) else (kind,))} <= plain_or_none
    }
    settings = {name: each for name, each in node.items() if name != "_target_"}
    return _call(target, settings, place, kinds, *first)


def _call(
    target: Any, settings: Mapping[str, Any], place: str, kinds: Mapping[str, Any], *first: Any
) -> partial[Any]:
    """A call of a function or class with these settings. kinds: types of its arguments."""
    takes = inspect.signature(target)
    try:
        takes.bind(*first, **settings)
    except TypeError as error:
        name = getattr(target, "__name__", target)
        names = list(takes.parameters)[len(first) :]
        near = "".join(near_words(each, names) for each in {*settings} - {*names})
        raise ValueError(f"{place}, {name}: {error}{near}; it takes {names}") from error
    values = {n: value_of(kinds.get(n, object), v, f"{place}.{n}") for n, v in settings.items()}
    return partial(target, **values)


@dataclass(frozen=True, eq=False)
class Configured:
    """A node that names a `_target_`, built on request; see `Deferred`."""

    settings: Mapping[str, Any]
    place: str

    def __post_init__(self) -> None:
        _check_target(self.settings, self.place)

    def build(self) -> Any:
        return bind(self.settings, self.place)()

    def changed(
        self, places: Mapping[str, Any], more: Mapping[str, Any] | None = None
    ) -> Configured:
        settings: Any = deepcopy(self.settings)
        for place, value in places.items():
            *outer, last = place.split(".")
            node = settings
            for name in (*outer, last):
                parent, node = node, self._entry(node, name, place)
            parent[last] = _merged(node, value)
        return Configured(_merged(settings, more or {}), self.place)

    def _entry(self, node: Any, name: str, place: str) -> Any:
        """An entry of a node, which gets the default of its target if it has none.

        For example, `thruster.transport.c_plume` in a thruster without a transport adds the whole
        default transport.
        """
        if _names_target(node) and name not in node:
            defaults = defaults_of(target_of(node, self.place))
            node |= {name: as_node(defaults[name])} if name in defaults else {}
        if not isinstance(node, Mapping) or name not in node:
            raise ValueError(f"{self.place}.{place} must be there to be changed: it is not")
        return node[name]

    def __str__(self) -> str:
        return OmegaConf.to_yaml(OmegaConf.create(dict(self.settings)), sort_keys=True)


def _merged(value: Any, new: Any) -> Any:
    """A setting with another merged in: entry by entry if both are mappings, else the new one."""
    if not (isinstance(value, Mapping) and isinstance(new, Mapping)):
        return new
    return {**value, **{key: _merged(value.get(key), each) for key, each in new.items()}}


def defaults_of(call: Any) -> dict[str, Any]:
    """Arguments of a class or function that have a default, with that default."""
    takes = inspect.signature(call).parameters.values()
    found = {each.name: each.default for each in takes if each.default is not each.empty}
    for each in fields(call) if is_dataclass(call) else ():
        if each.init and each.default_factory is not MISSING:
            found[each.name] = each.default_factory()
    return found


def as_node(value: Any) -> Any:
    """A value as a config writes it; a dataclass becomes a node that names its class.

    Its name is that in the package's stubs if it is there, since modules may move.
    """
    if is_dataclass(value) and not isinstance(value, type):
        kind = type(value)
        name = place_of(kind) or f"{kind.__module__}.{kind.__qualname__}"
        members = {
            each.name: as_node(getattr(value, each.name)) for each in fields(value) if each.init
        }
        return {"_target_": name} | members
    if isinstance(value, Mapping):
        return {str(name): as_node(member) for name, member in value.items()}
    return [as_node(each) for each in value] if isinstance(value, list | tuple) else value
