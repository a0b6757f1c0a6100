"""Build a study from a config; the study's signature is the schema of its config.

A config is made plain once: mappings, lists and values, with interpolations resolved. The module
holds the only type checker of configs, for fields of studies and arguments of `_target_`s.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import partial
from types import NoneType, UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, OmegaConf

from ep2sindy._stubs import place_of
from ep2sindy.app.targets import nodes_of, target_of
from ep2sindy.discovery.method import AnyMethod, method_of
from ep2sindy.runtime.screen import joined, near_words
from ep2sindy.studies.source import Source, Step
from ep2sindy.studies.study import Check, Deferred

# Keys of conf/config.yaml that every run has.
COMMON = ("experiment", "study", "seed", "output", "figures", "verbose")
# Fields of these types are made of the top-level groups listed with them: a method is five groups.
GATHERED: Mapping[Any, Callable[..., Any]] = {AnyMethod: method_of, Source: Source}
# Groups of conf/config.yaml that a study may leave aside.
GROUPS = (
    "data", "prepare", "trajectory", "formulation", "search", "bootstraps", "selection", "depth",
    "parallel",
)  # fmt: skip


def keys_of(study: type) -> set[str]:
    """The top-level keys of a study's config."""
    found: set[str] = set()
    for name, kind in hints_of(study).items():
        found |= set(_groups(kind)) if kind in GATHERED else {name}
    return found


def study_of(study: type, config: DictConfig) -> Any:
    """Build a study from the config.

    Raises ValueError for a key that the study does not take, a missing key, or a value whose type
    differs from the study's.
    """
    used = keys_of(study)
    known = {*COMMON, *GROUPS, *used}
    unknown = set(map(str, config)) - known
    if unknown:
        hint = ""
        if "thruster" in unknown:  # a file of ./conf/thruster that lacks its first line
            hint = "; a file of conf/thruster begins with the line '# @package data.thruster'"
        near = "".join(near_words(name, known) for name in sorted(unknown))
        raise ValueError(f"unknown keys {sorted(unknown)}{near}; there are {sorted(known)}{hint}")
    _open_by_points(config)
    typed: Any = OmegaConf.to_container(config)
    for place, value in nodes_of({name: typed[name] for name in typed if name in used}):
        if value == "???":
            raise ValueError(f"{place} must be set: it is still '???'")
    hints = hints_of(study)
    needed = [name for name in hints if is_required(study, name)]
    return _fill(study, hints, needed, _without_formats(plain(config), has_own="figures" in used))


def plain(config: Any) -> Any:
    """A config as mappings, lists and values, with interpolations resolved."""
    return OmegaConf.to_container(config, resolve=True)


def _open_by_points(config: DictConfig) -> None:
    """A path of the data that is to be set need not be, where the points name the files."""
    by_files = isinstance(config.get("points"), str)
    if by_files and "data" in config and OmegaConf.is_missing(config.data, "path"):
        config.data.path = None


def _without_formats(settings: dict[str, Any], *, has_own: bool) -> dict[str, Any]:
    """Settings without `figures.formats`, the list of file formats, which the runner uses."""
    own = {name: v for name, v in (settings.get("figures") or {}).items() if name != "formats"}
    if own and not has_own:
        first = f"figures.{next(iter(own))}"
        raise ValueError(f"unknown key {first!r}: this experiment has figures.formats alone")
    return settings | {"figures": own}


def _fill(
    call: Callable[..., Any],
    hints: Mapping[str, Any],
    needed: Collection[str],
    settings: Mapping[str, Any],
) -> Any:
    """A study, or a method or source made of groups, from the top level of the config.

    A group that is left out (`~search`) gets no default.
    """
    arguments = {}
    for name, kind in hints.items():
        if kind in GATHERED:
            groups = _groups(kind)
            arguments[name] = _fill(GATHERED[kind], groups, groups, settings)
        elif name in settings:
            arguments[name] = value_of(kind, settings[name], name)
        elif name in needed:
            way = f": choose one with {name}=NAME, see --help" if name in GROUPS else ""
            raise ValueError(f"the config of this experiment must have {name!r}{way}")
    return call(**arguments)


def _groups(kind: Any) -> dict[str, Any]:
    """The groups that make up a value of this type, each with its required type."""
    hints = get_type_hints(GATHERED[kind], include_extras=True)
    return {name: hint for name, hint in hints.items() if name != "return"}


# From plain settings to values: the only place where the type of a setting is checked.
#
# The type comes from the signature that takes the setting: a field of a study, or an argument of a
# `_target_`. Only plain arguments are checked here, since the class or function itself reports
# errors in the others best.


PLAIN = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}


def value_of(kind: Any, node: Any, place: str) -> Any:
    """A value of this type from a setting. place: its dotted path, for errors."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        if isinstance(parts[1], Check) and not parts[1].test(node):
            raise ValueError(f"{place} must be {parts[1].message}: {node!r} came")
        return value_of(parts[0], node, place)
    if kind is Any:
        return node
    if kind is Deferred:
        return Configured(node, place)
    if kind == Step:
        return bind_step(node, place)
    if origin in (Union, UnionType):
        return _one_of(parts, node, place)
    if _names_target(node):
        return _instance(node, origin or kind, place)
    if is_dataclass(kind):
        return _dataclass(kind, node, place)
    if origin is not None:
        return _container(origin, parts, node, place)
    value = check_plain((kind,), node, place)  # without a `_target_` its type is always plain
    return float(value) if kind is float else value


def _names_target(node: Any) -> bool:
    return isinstance(node, Mapping) and "_target_" in node


def _container(origin: type, parts: Sequence[Any], node: Any, place: str) -> Any:
    if issubclass(origin, Mapping):
        if not isinstance(node, Mapping):
            raise ValueError(f"{place} must be like {{name: ...}}: {node!r} came")
        if parts[1] is Deferred or is_dataclass(parts[1]):
            check_names(map(str, node), place)
        return {str(k): value_of(parts[1], each, f"{place}.{k}") for k, each in node.items()}
    if not isinstance(node, list):
        raise ValueError(f"{place} must be a list: {node!r} came")
    return [value_of(parts[0], each, f"{place}[{k}]") for k, each in enumerate(node)]


def check_names(names: Iterable[str], place: str) -> None:
    """Raise ValueError for a name that cannot serve in file names and headings."""
    for name in names:
        if not re.fullmatch(r"\w[\w .,+-]{,99}", name):
            raise ValueError(
                f"{place} must be named by words, for files are named so: letters, digits and "
                f"_ . , + -, not {name!r}"
            )


def _one_of(kinds: Sequence[Any], node: Any, place: str) -> Any:
    """A value of the first type that fits; if none fits, the error is that of the last."""
    if node is None and NoneType in kinds:
        return None
    kinds = [kind for kind in kinds if kind is not NoneType]
    for kind in kinds[:-1]:
        try:
            return value_of(kind, node, place)
        except ValueError:
            continue
    return value_of(kinds[-1], node, place)


def check_plain(kinds: Collection[type], node: Any, place: str) -> Any:
    """The value of a setting; raises ValueError if it has none of these types."""
    # A whole number counts as a number, too; a truth value does not.
    if not any(type(node) is kind or (kind, type(node)) == (float, int) for kind in kinds):
        wanted = [PLAIN.get(kind, f"a {kind.__name__}, named by its _target_") for kind in kinds]
        raise ValueError(f"{place} must be {' or '.join(wanted)}: {node!r} came")
    return node


def _dataclass(kind: Any, node: Any, place: str) -> Any:
    """A mapping as a dataclass; missing keys and unused keys are errors."""
    hints = hints_of(kind)
    needed = [name for name in hints if is_required(kind, name)]
    given = set(node) if isinstance(node, Mapping) else None
    if given is None or given - set(hints) or set(needed) - given:
        came = sorted(given) if given is not None else node
        near = "".join(near_words(each, hints) for each in sorted((given or set()) - set(hints)))
        raise ValueError(
            f"{place} may have {sorted(hints)} and needs {joined(needed) or 'none'}: {came} came"
            f"{near}"
        )
    named = {name: node[name] for name in hints if name in node}
    return kind(**{n: value_of(hints[n], each, f"{place}.{n}") for n, each in named.items()})


def hints_of(kind: type) -> dict[str, Any]:
    """Type annotations of a dataclass's init fields, by name."""
    hints = get_type_hints(kind, include_extras=True)
    return {f.name: hints[f.name] for f in fields(kind) if f.init}


def is_required(kind: type, name: str) -> bool:
    (field,) = (f for f in fields(kind) if f.name == name)
    return field.default is MISSING and field.default_factory is MISSING


def _instance(node: Mapping[str, Any], kind: type, place: str) -> Any:
    """The object that a node names, checked to be of this type."""
    value = bind(node, place)()
    if not isinstance(value, kind):
        raise ValueError(f"{place} must name a _target_ that is a {kind.__name__}: {value!r} came")
    return value


def bind_step(node: Any, place: str) -> Step:
    """A step of `prepare`; unknown arguments are refused here."""
    if not _names_target(node):
        raise ValueError(
            f"{place} must be like {{_target_: ep2sindy.prepare.crop, start_s: 0}}: {node!r} came"
        )
    return bind(node, place, None)


def bind(node: Mapping[str, Any], place: str, *first: Any) -> partial[Any]:
    """The node's `_target_`, with the remaining entries, built, as its arguments.

    place: the node's dotted path, for errors. first: leading arguments, given when it is called.
    Raises ValueError if the target cannot be called so, and errors that a nested target raises.
    """
    target = target_of(node, place)
    kinds = _plain_arguments(target)
    given = {name: each for name, each in node.items() if name != "_target_"}
    call = partial(
        target,
        **{n: _argument(kinds.get(n, ()), each, f"{place}.{n}") for n, each in given.items()},
    )
    try:
        takes = inspect.signature(target)
    except ValueError:  # a compiled function may have no signature
        return call
    try:
        takes.bind(*first, **call.keywords)
    except TypeError as error:
        name = getattr(target, "__name__", target)
        names = list(takes.parameters)[len(first) :]
        near = "".join(near_words(each, names) for each in {*call.keywords} - {*names})
        raise ValueError(f"{place}, {name}: {error}{near}; it takes {names}") from error
    return call


def _plain_arguments(target: Any) -> dict[str, list[type]]:
    """Arguments of a target that can only be plain values or None, with their types."""
    try:
        hints = get_type_hints(getattr(target, "__init__") if isinstance(target, type) else target)  # noqa: B009
    except Exception:  # an annotation that does not exist at run time; no annotations
        return {}
    unions = {n: get_origin(hint) in (Union, UnionType) for n, hint in hints.items()}
    kinds = {n: get_args(hint) if unions[n] else (hint,) for n, hint in hints.items()}
    without = {n: [kind for kind in each if kind is not NoneType] for n, each in kinds.items()}
    return {n: each for n, each in without.items() if set(each) <= set(PLAIN)}


def _argument(kinds: Collection[type], node: Any, place: str) -> Any:
    """An argument of a target, with nested targets built. kinds: its types, empty for any."""
    if kinds and node is not None:
        return check_plain(kinds, node, place)
    if isinstance(node, list):
        return [_argument((), each, f"{place}[{k}]") for k, each in enumerate(node)]
    if not isinstance(node, Mapping):
        return node
    if "_target_" not in node:
        return {key: _argument((), each, f"{place}.{key}") for key, each in node.items()}
    call = bind(node, place)
    try:
        return call()
    except TypeError as error:
        raise ValueError(f"{place} cannot be made: {error}") from error


@dataclass(frozen=True, eq=False)
class Configured:
    """A node that names a `_target_`, built on request; see `Deferred`."""

    settings: Mapping[str, Any]
    place: str

    def __post_init__(self) -> None:
        if not _names_target(self.settings):
            raise ValueError(f"{self.place} must name a _target_: {self.settings!r} came")

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
    except (TypeError, ValueError):  # a compiled function may have no signature
        return {}
    return {each.name: each.default for each in takes if each.default is not each.empty}


def as_node(value: Any) -> Any:
    """A value as a config writes it; a dataclass becomes a node that names its class."""
    if is_dataclass(value) and not isinstance(value, type):
        members = {each.name: as_node(getattr(value, each.name)) for each in fields(value)}
        taken = {each.name for each in fields(value) if each.init}
        return {"_target_": _name(type(value))} | {n: m for n, m in members.items() if n in taken}
    if isinstance(value, Mapping):
        return {str(name): as_node(member) for name, member in value.items()}
    return [as_node(each) for each in value] if isinstance(value, list | tuple) else value


def _name(kind: type) -> str:
    """Name of a class in the package's stubs if it is there, since modules may move."""
    return place_of(kind) or f"{kind.__module__}.{kind.__qualname__}"  # a user's class
