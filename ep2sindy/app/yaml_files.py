"""Configs as files: what one of them asks for is counted before it is written out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml
from hydra._internal.config_repository import ConfigRepository
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigResult
from omegaconf.errors import OmegaConfBaseException

MOST_VALUES = 100_000  # of one file, with all that its anchors stand for


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
            raise ValueError(said if str(path) in said else f"{path}: {said}") from error


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
