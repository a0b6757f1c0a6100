"""Config files: where they are, and that what they say is counted before it is expanded."""

from __future__ import annotations

from pathlib import Path

import yaml
from hydra._internal.core_plugins import file_config_source
from hydra.plugins.config_source import ConfigResult

from ep2sindy.runtime.files import read_bytes
from ep2sindy.trust.user_code import PACKAGE

MAX_NODES, MAX_DEPTH = 100_000, 50  # of a config; the largest of ours has 200, 6 deep


class FileConfigSource(file_config_source.FileConfigSource):
    """Hydra's files of configs, each of them checked; of this name Hydra keeps what it has."""

    def load_config(self, config_path: str) -> ConfigResult:
        check_config(Path(self.path, self._normalize_file_name(config_path)))
        return super().load_config(config_path)


def conf_folder() -> Path:
    """Folder of the package's configs: next to it in a checkout, inside it when installed."""
    places = (PACKAGE.parent / "conf", PACKAGE / "conf")
    for place in places:
        if (place / "config.yaml").is_file():
            return place
    raise ValueError(
        f"the package's configs must lie in one of {list(map(str, places))}: none of them has a "
        "config.yaml; install the package again"
    )


def check_config(path: Path) -> None:
    """Raise ValueError for YAML that is nested too deep, or too large once anchors are expanded.

    A few hundred bytes of anchors within anchors may stand for more than any memory holds.
    """
    sizes: dict[str | None, float] = {}  # number of nodes that an anchor stands for
    inside: list[tuple[str | None, float]] = []  # anchors around a node, and nodes before them
    n = 0.0
    for event in yaml.parse(read_bytes(path), Loader=yaml.SafeLoader):
        if isinstance(event, yaml.CollectionEndEvent):
            anchor, before = inside.pop()
            sizes[anchor] = n - before
        elif isinstance(event, yaml.AliasEvent):  # without end, if it stands inside its anchor
            n += sizes.get(event.anchor, float("inf"))
        elif isinstance(event, yaml.CollectionStartEvent):
            inside.append((event.anchor, n))
        elif isinstance(event, yaml.ScalarEvent):
            sizes[event.anchor] = 1.0
            n += 1.0
        if n > MAX_NODES or len(inside) > MAX_DEPTH:
            raise ValueError(
                f"{path} must hold {MAX_NODES} values or fewer with its anchors expanded, at most "
                f"{MAX_DEPTH} deep, got more; write out what it needs"
            )
