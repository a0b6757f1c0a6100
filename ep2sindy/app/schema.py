"""Build a study from a config; the study's signature is the schema of its config.

The module holds the only type checker of configs, for fields of studies and arguments of
`_target_`s.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import MISSING, dataclass, fields, is_dataclass
from functools import partial
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, ListConfig, OmegaConf

from ep2sindy._stubs import place_of
from ep2sindy.app.targets import target_of
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.discovery.recipe import method_of
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
    known = {*COMMON, *GROUPS, *keys_of(study)}
    unknown = set(map(str, config)) - known
    if unknown:
        hint = ""
        if "thruster" in unknown:  # a file of ./conf/thruster that lacks its first line
            hint = "; a file of conf/thruster begins with the line '# @package data.thruster'"
        near = "".join(near_words(name, known) for name in sorted(unknown))
        raise ValueError(f"unknown keys {sorted(unknown)}{near}; there are {sorted(known)}{hint}")
    _open_by_points(config)
    return _fill(study, _without_formats(config, has_own="figures" in keys_of(study)))


def _open_by_points(config: DictConfig) -> None:
    """A path of the data that is to be set need not be, where the points name the files."""
    by_files = isinstance(config.get("points"), str)
    if by_files and "data" in config and OmegaConf.is_missing(config.data, "path"):
        config.data.path = None


def _without_formats(config: DictConfig, *, has_own: bool) -> DictConfig:
    """The config without `figures.formats`, the list of file formats, which the runner uses."""
    own = {name: v for name, v in (config.get("figures") or {}).items() if name != "formats"}
    if own and not has_own:
        first = f"figures.{next(iter(own))}"
        raise ValueError(f"unknown key {first!r}: this experiment has figures.formats alone")
    found = config.copy()
    OmegaConf.set_struct(found, False)
    found.figures = own
    return found


def _fill(study: type, config: DictConfig) -> Any:
    """Fill a dataclass from the top level of the config."""
    arguments = {}
    for name, kind in hints_of(study).items():
        if kind in GATHERED:
            arguments[name] = _gather_groups(kind, config)
        elif name in config or OmegaConf.is_missing(config, name):
            arguments[name] = value_of(kind, child(config, name, name), name)
        elif is_required(study, name):
            raise ValueError(f"the config of this experiment must have {name!r}")
    return study(**arguments)


def _gather_groups(kind: Any, config: DictConfig) -> Any:
    """Build a method or source from its groups; one left out (`~search`) gets no default."""
    groups = _groups(kind)
    if lacking := [name for name in groups if name not in config]:
        raise ValueError(
            f"the config of this experiment must have {lacking[0]!r}: choose one with "
            f"{lacking[0]}=NAME, see --help"
        )
    return GATHERED[kind](
        **{name: value_of(each, child(config, name, name), name) for name, each in groups.items()}
    )


def _groups(kind: Any) -> dict[str, Any]:
    """The groups that make up a value of this type, each with its required type."""
    hints = get_type_hints(GATHERED[kind], include_extras=True)
    return {name: hint for name, hint in hints.items() if name != "return"}


# From nodes of a config to values: the only place where the type of a setting is checked.
#
# The type comes from the signature that takes the setting: a field of a study, or an argument of a
# `_target_`. Only plain arguments are checked here, since the class or function itself reports
# errors in the others best.


PLAIN = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}


def value_of(kind: Any, node: Any, place: str) -> Any:
    """A value of this type from a node of the config. place: its dotted path, for errors."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        value = contents(node)
        if isinstance(parts[1], Check) and not parts[1].test(value):
            raise ValueError(f"{place} must be {parts[1].message}: {value!r} came")
        return value_of(parts[0], node, place)
    if kind is Any:
        return contents(node)
    if kind is Deferred:
        return Configured(node, place)
    if kind == Step:
        return bind_step(node, place)
    if origin in (Union, UnionType):
        return _one_of(parts, node, place)
    if isinstance(node, DictConfig) and "_target_" in node:
        return instantiate(node, origin or kind, place)
    if isinstance(kind, type) and is_dataclass(kind):
        return _dataclass(kind, node, place)
    if origin is not None:
        return _container(origin, parts, node, place)
    return _scalar(kind, node, place)


def _container(origin: type, parts: Sequence[Any], node: Any, place: str) -> Any:
    if issubclass(origin, Mapping):
        if not OmegaConf.is_dict(node):
            raise ValueError(f"{place} must be like {{name: ...}}: {contents(node)!r} came")
        if parts[1] is Deferred or is_dataclass(parts[1]):
            check_names(map(str, node), place)
        places = {key: f"{place}.{key}" for key in node}
        return {str(k): value_of(parts[1], child(node, k, at), at) for k, at in places.items()}
    if not OmegaConf.is_list(node):
        raise ValueError(f"{place} must be a list: {contents(node)!r} came")
    places = {k: f"{place}[{k}]" for k in range(len(node))}
    return [value_of(parts[0], child(node, k, at), at) for k, at in places.items()]


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
    """A plain value. A value without a `_target_` never has a type that is not plain."""
    value = check_plain((kind,), node, place)
    return float(value) if kind is float else value


def check_plain(kinds: Collection[type], node: Any, place: str) -> Any:
    """The value of a node; raises ValueError if it has none of these types."""
    value = contents(node)
    if not any(_is_plain(value, kind) for kind in kinds):
        wanted = [PLAIN.get(kind, f"a {kind.__name__}, named by its _target_") for kind in kinds]
        raise ValueError(f"{place} must be {' or '.join(wanted)}: {value!r} came")
    return value


def _is_plain(value: object, kind: type) -> bool:
    """Whether a value has a plain type; an int also counts as a float, a bool does not."""
    return type(value) is kind or (kind, type(value)) == (float, int)


def _dataclass(kind: type, node: Any, place: str) -> Any:
    """A mapping as a dataclass; missing keys and unused keys are errors."""
    names = [f.name for f in fields(kind) if f.init]
    needed = [name for name in names if is_required(kind, name)]
    given = set(map(str, node)) if isinstance(node, DictConfig) else None
    if given is None or given - set(names) or set(needed) - given:
        came = sorted(given) if given is not None else contents(node)
        near = "".join(near_words(each, names) for each in sorted((given or set()) - set(names)))
        if len(needed) == len(names):
            how = f"must have {joined(needed)}"
            if given is not None and given >= set(needed):  # nothing is lacking
                how = f"may have {joined(needed)} alone"
            raise ValueError(f"{place} {how}: {came} came{near}")
        raise ValueError(
            f"{place} may have {sorted(names)} and needs {joined(needed) or 'none'}: {came} came"
            f"{near}"
        )
    hints = hints_of(kind)
    return kind(
        **{
            name: value_of(hints[name], child(node, name, at), at)
            for name, at in ((name, f"{place}.{name}") for name in names)
            if name in given
        }
    )


def hints_of(kind: type) -> dict[str, Any]:
    """Type annotations of a dataclass's init fields, by name."""
    hints = get_type_hints(kind, include_extras=True)
    return {f.name: hints[f.name] for f in fields(kind) if f.init}


def is_required(kind: type, name: str) -> bool:
    (field,) = (f for f in fields(kind) if f.name == name)
    return field.default is MISSING and field.default_factory is MISSING


def child(parent: Any, key: Any, place: str) -> Any:
    """A child of a node, with interpolations resolved."""
    if OmegaConf.is_missing(parent, key):
        raise ValueError(f"{place} must be set: it is still '???'")
    return parent[key]


def contents(node: Any) -> Any:
    """The plain value of a node, with interpolations resolved."""
    return OmegaConf.to_container(node, resolve=True) if OmegaConf.is_config(node) else node


def instantiate(node: DictConfig, kind: type, place: str) -> Any:
    """The object that a node names, checked to be of this type."""
    value = bind(node, place)()
    if not isinstance(value, kind):
        raise ValueError(f"{place} must name a _target_ that is a {kind.__name__}: {value!r} came")
    return value


def bind_step(node: Any, place: str) -> Step:
    """A step of `prepare`; unknown arguments are refused here."""
    if not isinstance(node, DictConfig) or "_target_" not in node:
        raise ValueError(
            f"{place} must be like {{_target_: ep2sindy.prepare.crop, start_s: 0}}: {node!r} came"
        )
    return bind(node, place, None)


def bind(node: DictConfig, place: str, *first: Any) -> partial[Any]:
    """The node's `_target_`, with the remaining entries, built, as its arguments.

    place: the node's dotted path, for errors. first: leading arguments, given when it is called.
    Raises ValueError if the target cannot be called so, and errors that a nested target raises.
    """
    settings = {name: child(node, name, f"{place}.{name}") for name in map(str, node)}
    target = target_of(node, place)
    kinds = _plain_arguments(target)
    call = partial(
        target,
        **{
            name: _argument(kinds.get(name, ()), value, f"{place}.{name}")
            for name, value in settings.items()
            if name != "_target_"
        },
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


def _plain_arguments(target: Any) -> dict[str, tuple[type, ...]]:
    """Arguments of a target that can only be plain values or None, with their types."""
    try:
        hints = get_type_hints(getattr(target, "__init__") if isinstance(target, type) else target)  # noqa: B009
    except Exception:  # an annotation that does not exist at run time; no annotations
        return {}
    alternatives = {name: _alternatives(hint) for name, hint in hints.items()}
    return {name: kinds for name, kinds in alternatives.items() if set(kinds) <= set(PLAIN)}


def _alternatives(hint: Any) -> tuple[Any, ...]:
    """The types of a union without None; a single type by itself."""
    parts = get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)
    return tuple(part for part in parts if part is not type(None))


def _argument(kinds: Collection[type], node: Any, place: str) -> Any:
    """An argument of a target, with nested targets built. kinds: its types, empty for any."""
    if kinds and node is not None:
        return check_plain(kinds, node, place)
    if isinstance(node, ListConfig):
        places = [f"{place}[{k}]" for k in range(len(node))]
        return [_argument((), child(node, k, at), at) for k, at in enumerate(places)]
    if not isinstance(node, DictConfig):
        return node
    if "_target_" not in set(node):  # `in` on a DictConfig denies a key whose value is missing
        named = {key: f"{place}.{key!s}" for key in node}
        return {key: _argument((), child(node, key, at), at) for key, at in named.items()}
    call = bind(node, place)
    try:
        return call()
    except TypeError as error:
        raise ValueError(f"{place} cannot be made: {error}") from error


def check_set(node: DictConfig) -> None:
    """Raise ValueError for a value, at any depth, that a config leaves for the user to set."""
    if missing := sorted(OmegaConf.missing_keys(node)):
        raise ValueError(f"{missing[0]} must be set: it is still '???'")


@dataclass(frozen=True, eq=False)
class Configured:
    """A node that names a `_target_`, built on request; see `Deferred`."""

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
        return bind(self.node, self.place)()

    def changed(
        self, places: Mapping[str, Any], more: Mapping[str, Any] | None = None
    ) -> Configured:
        node = deepcopy(self.node)
        missing = object()
        for place, value in places.items():
            write_defaults(node, place, root=self.place)
            if OmegaConf.select(node, place, default=missing) is missing:
                raise ValueError(f"{self.place}.{place} must be there to be changed: it is not")
            OmegaConf.update(node, place, value)
        OmegaConf.set_struct(node, False)  # unknown keys are refused when it is built
        merged: Any = OmegaConf.merge(node, dict(more or {}))
        return Configured(merged, self.place)

    def __str__(self) -> str:
        return OmegaConf.to_yaml(self.node, resolve=True, sort_keys=True)


def write_defaults(node: DictConfig, place: str, *, root: str) -> None:
    """Add the default value at a dotted place, if the targets on the way have one.

    root: the place of the node itself, for errors. For example, `thruster.transport.c_plume` in a
    thruster without a transport adds the whole default transport.
    """
    *outer, last = place.split(".")
    for name in (*outer, last):
        if not isinstance(node, DictConfig):
            return
        if name not in node and "_target_" in node:
            values = defaults_of(target_of(node, root))
            if name in values:
                OmegaConf.update(node, name, as_node(values[name]), force_add=True)
        if name not in node:
            return
        node = node[name]


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
