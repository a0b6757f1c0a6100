"""From a config to a study: the study's signature is the schema of its config."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, get_type_hints

from omegaconf import DictConfig, OmegaConf

from ep2sindy.app.build import (
    child,
    hints_of,
    is_required,
    value_of,
)
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.discovery.recipe import Recipe, method_of
from ep2sindy.studies.source import Source

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
    for name, kind in hints_of(study).items():
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
    for name, kind in hints_of(study).items():
        if kind in GATHERED:
            arguments[name] = _gathered(kind, config)
        elif name in config or OmegaConf.is_missing(config, name):
            arguments[name] = value_of(kind, child(config, name, name), name)
        elif is_required(study, name):
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
        **{name: value_of(each, child(config, name, name), name) for name, each in groups.items()}
    )


def _groups(kind: Any) -> dict[str, Any]:
    """The groups that make a value of this kind, each with the kind that it must be."""
    hints = get_type_hints(GATHERED[kind], include_extras=True)
    return {name: hint for name, hint in hints.items() if name != "return"}
