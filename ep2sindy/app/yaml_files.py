"""Configs as files: what one of them asks for is counted before it is written out."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from hydra._internal.config_repository import ConfigRepository
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigResult
from omegaconf.errors import OmegaConfBaseException

MOST_VALUES = 100_000  # of one file, with all that its anchors stand for
MOST_CHARACTERS = 1_000_000  # of one setting, with all that its references stand for

BRACES = re.compile(r"\$\{(.*)\}", re.DOTALL)
WORD = re.compile(r"[^\s.,:$'\"(){}\[\]]+")


class CheckedFiles(ConfigRepository):
    """Hydra's folders of configs; what is wrong with a file is said with its name."""

    def load_config(self, config_path: str) -> ConfigResult | None:
        source = self._find_object_source(config_path, ObjectType.CONFIG)
        if source is None or source.scheme() != "file":
            return super().load_config(config_path)
        path = Path(source.path, source._normalize_file_name(config_path))
        try:
            check_yaml(path)
            return super().load_config(config_path)
        except RecursionError as error:
            raise ValueError(f"{path} must not be nested hundreds of levels deep") from error
        except (ValueError, OmegaConfBaseException) as error:
            said = str(error) or type(error).__name__
            if str(path) in said:
                raise
            raise ValueError(f"{path} cannot be read as a config: {said}") from error


def check_yaml(path: Path) -> None:
    """Raise ValueError for anchors within anchors that stand for more than anybody writes."""
    text = path.read_text("utf-8")
    if "&" not in text or "*" not in text:
        return
    if (n := _size(yaml.compose(text, Loader=yaml.SafeLoader), {})) > MOST_VALUES:
        raise ValueError(
            f"{path} may hold up to {MOST_VALUES} values: with its anchors written out it has "
            f"{n:.3g}; write what it needs"
        )


def _size(node: Any, known: dict[int, int]) -> int:
    """Values below a node, each as often as it is written out; an anchor in itself has no end."""
    if id(node) not in known:
        known[id(node)] = MOST_VALUES + 1  # until it is known
        inner = node.value if isinstance(node, yaml.CollectionNode) else []
        each = [part for pair in inner for part in (pair if isinstance(pair, tuple) else [pair])]
        known[id(node)] = 1 + sum(_size(part, known) for part in each)
    return known[id(node)]


def check_references(settings: Any) -> None:
    """Raise ValueError for references to references that stand for more than anybody writes.

    settings: a config's groups and values as they are written. A name in `${...}` counts as the
    longest of the settings whose key it is, for what it stands for need not be known here.
    """
    most = MOST_CHARACTERS + 10 * len(str(settings))
    named: dict[str, list[Any]] = {}
    known: dict[int, int] = {}
    try:
        _name(settings, named)
        lengths = {key: max(_length(v, named, known) for v in named[key]) for key in named}
    except RecursionError as error:
        raise ValueError("a config must not refer hundreds of levels deep") from error
    if too_long := [key for key, n in lengths.items() if n > most]:
        raise ValueError(
            f"{too_long[0]} may stand for up to {most} characters: with all that its ${{...}} "
            f"stand for it has {lengths[too_long[0]]:.3g}; write what it needs"
        )


def _name(node: Any, named: dict[str, list[Any]]) -> None:
    """Gather what stands under every key, in whatever group, and in every place of a list."""
    inner = enumerate(node) if isinstance(node, list) else node.items()
    for key, value in inner:
        named.setdefault(str(key), []).append(value)
        if isinstance(value, dict | list):
            _name(value, named)


def _length(node: Any, named: Mapping[str, Sequence[Any]], known: dict[int, int]) -> int:
    """Characters of a value with its references written out; those in a circle count once."""
    if id(node) in known:
        return known[id(node)]
    known[id(node)] = 0  # until it is known
    if isinstance(node, dict | list):
        parts = list(node.values()) if isinstance(node, dict) else node
        n = len(parts) + sum(_length(part, named, known) for part in parts)
    else:
        words = WORD.findall(" ".join(BRACES.findall(node))) if isinstance(node, str) else []
        n = len(str(node))
        n += sum(max(_length(v, named, known) for v in named[w]) for w in words if w in named)
    known[id(node)] = n
    return n
