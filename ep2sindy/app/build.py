"""From nodes of a config that name a `_target_` to objects."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass
from types import UnionType
from typing import Any

from hydra.errors import HydraException
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from ep2sindy.studies.source import Step


def innermost(error: BaseException) -> BaseException:
    """Hydra wraps what a constructor raised; the user needs the constructor's own words."""
    while isinstance(error, HydraException) and error.__cause__ is not None:
        error = error.__cause__
    return error


def instantiated(node: DictConfig, **how: Any) -> Any:
    """What `_target_` makes of the rest of the node, with the errors that it raised itself."""
    try:
        return instantiate(node, _convert_="all", **how)
    except HydraException as error:
        cause = innermost(error)
        if isinstance(cause, TypeError):  # an argument that the target does not know
            raise ValueError(str(cause)) from error
        raise cause from error


def instance_of(node: DictConfig, kind: Any, place: str) -> Any:
    """The object that a node names, if it is of this kind."""
    value = instantiated(node)
    if isinstance(kind, type | UnionType) and not isinstance(value, kind):
        name = getattr(kind, "__name__", str(kind))
        raise ValueError(f"{place} must name a _target_ that is a {name}: {value!r} came")
    return value


def step_of(node: Any, place: str) -> Step:
    """A step of `prepare`; an argument that it does not know is refused here."""
    if not isinstance(node, DictConfig) or "_target_" not in node:
        raise ValueError(
            f"{place} must be like {{_target_: ep2sindy.crop, start_s: 0}}: {node!r} came"
        )
    step = instantiated(node, _partial_=True)
    try:
        inspect.signature(step.func).bind(None, **step.keywords)
    except TypeError as error:
        raise ValueError(f"{place}, {step.func.__name__}: {error}") from error
    return step


@dataclass(frozen=True, eq=False)
class Configured:
    """A node that names a `_target_`, built when asked for: see `Deferred`."""

    node: DictConfig
    place: str

    @property
    def settings(self) -> Mapping[str, Any]:
        plain = OmegaConf.to_container(self.node, resolve=True)
        assert isinstance(plain, dict)
        return {str(key): value for key, value in plain.items()}

    def build(self) -> Any:
        return instantiated(self.node)

    def changed(
        self, places: Mapping[str, Any], more: Mapping[str, Any] | None = None
    ) -> Configured:
        node = deepcopy(self.node)
        missing = object()
        for place, value in places.items():
            if OmegaConf.select(node, place, default=missing) is missing:
                raise ValueError(f"{self.place}.{place} must be there to be changed: it is not")
            OmegaConf.update(node, place, value)
        merged = OmegaConf.merge(node, dict(more or {}))
        assert isinstance(merged, DictConfig)
        return Configured(merged, self.place)

    def __str__(self) -> str:
        return OmegaConf.to_yaml(self.node, resolve=True, sort_keys=True)


def deferred(node: Any, place: str) -> Configured:
    if not isinstance(node, DictConfig) or "_target_" not in node:
        raise ValueError(f"{place} must name a _target_: {node!r} came")
    return Configured(node, place)
