"""Checks on what config files may set, since a config may come from an untrusted source.

Keys below `hydra:` can name callbacks, log handlers, the shell lines of a cluster job, variables
of the environment and folders to write to; they are accepted from the command line alone. Folders
for runs and caches outside the current folder must be typed as well, and so must schedulers, whose
answers are trusted. The size of a file's content is computed before anchors and references are
expanded.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from functools import partial
from pathlib import Path
from typing import Any

import hydra._internal.hydra as program
import yaml
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import ConfigRepository
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigResult
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ep2sindy.app.arguments import explained

FOLDERS = ("output", "keep", "cache")  # keys, at any depth, of folders that a run writes to
SERVERS = ("address",)
# Hydra's own notes on a run, which have no effect.
NOTED = ("runtime.choices", "runtime.config_sources", "job.override_dirname")
# Settings that nobody may change, as they name what is called or created.
SILENT = {"version": 1, "root": {"level": "ERROR"}, "disable_existing_loggers": True}
FIXED: Mapping[str, Any] = {"callbacks": {}, "job_logging": SILENT, "hydra_logging": SILENT}

MAX_VALUES = 100_000  # values in one file, with its anchors expanded
MAX_CHARACTERS = 1_000_000  # characters of one setting, with its references expanded

BRACES = re.compile(r"\$\{(.*)\}", re.DOTALL)
WORD = re.compile(r"[^\s.,:$'\"(){}\[\]]+")


class CheckedLoader(ConfigLoaderImpl):
    """Hydra's loader of configs, which checks each config before any of it takes effect.

    To separate typed settings from those of files, it composes once more without the users'
    folders. A file can reach `hydra:` by keys, packages, defaults and group names; the composed
    result shows all of these.
    """

    def __init__(self, config_search_path: ConfigSearchPath) -> None:
        super().__init__(config_search_path)
        self.repository = CheckedFiles(config_search_path)
        self._without_files: dict[tuple[Any, ...], DictConfig] = {}  # shared by the jobs of a sweep

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        hydras = [text for text in overrides if re.match(r"[+~]*hydra[./=]", text)]
        typed = partial(self._typed, config_name, hydras, run_mode, from_shell)
        if not validate_sweep_overrides:  # Hydra asks for the mode only, before composing
            return typed() if hydras else OmegaConf.create({"hydra": {"mode": None}})
        compose = partial(self._composed, config_name, run_mode, from_shell)
        with explained(overrides, compose):
            found = compose(overrides)
        tasks = [text for text in overrides if text not in hydras]
        check_hydra(_settings(found), _settings(typed()) | {"overrides.task": tasks})
        check_references(_written(found))
        if "output" in found:  # Hydra makes a sweep's folder in it. A job checks the others:
            check_output(found)  # only once it begins can the whole config be resolved
            check_places([("output", found.output)], overrides)
        return found

    def _composed(
        self, config_name: str | None, run_mode: RunMode, from_shell: bool, overrides: list[str]
    ) -> DictConfig:
        return super().load_configuration(config_name, overrides, run_mode, from_shell)

    def _typed(
        self, config_name: str | None, hydras: list[str], run_mode: RunMode, from_shell: bool
    ) -> DictConfig:
        """Settings of the command line and the package, without files from elsewhere."""
        key = (run_mode, *hydras)
        if key not in self._without_files:
            loader = _without_folders(self, hydras)
            self._without_files[key] = loader.load_configuration(
                config_name, hydras, run_mode, from_shell, validate_sweep_overrides=False
            )
        return self._without_files[key]


def _without_folders(loader: ConfigLoaderImpl, hydras: Sequence[str]) -> ConfigLoaderImpl:
    """A loader of the package's and Hydra's configs only, as a folder may reuse their names.

    If the command line names a group of Hydra's, such as a launcher, the folders are trusted too.
    """
    path = deepcopy(loader.config_search_path)
    if not any("/" in text.partition("=")[0] for text in hydras):
        path.get_path()[:] = [p for p in path.get_path() if p.provider != "command-line"]
    return ConfigLoaderImpl(path)


@contextmanager
def checked_loader() -> Iterator[None]:
    """A context in which Hydra composes only configs that have been checked."""
    before = program.ConfigLoaderImpl
    program.ConfigLoaderImpl = CheckedLoader  # type: ignore[misc]
    try:
        yield
    finally:
        program.ConfigLoaderImpl = before  # type: ignore[misc]


def check_hydra(found: Mapping[str, Any], typed: Mapping[str, Any]) -> None:
    """Raise ValueError for a setting below `hydra` that does not come from the command line.

    found: all settings of a config, by dotted place. typed: settings of the command line and the
    package without that config.
    """
    for name, value in FIXED.items():
        fixed = dict(_leaves(value, name))
        for place in found:
            if place.startswith(name) and found[place] != fixed.get(place):
                raise ValueError(
                    f"hydra.{name} must stay as it is, for it names what is called: "
                    f"hydra.{place}={found[place]!r} came; leave it out"
                )
    for place in [*found, *typed]:
        if not place.startswith(NOTED) and found.get(place) != typed.get(place):
            raise ValueError(
                f"a config must not set hydra.{place}, for it may run or write anything: "
                f"{found.get(place)!r} came; give it on the command line"
            )


def check_output(config: DictConfig) -> None:
    """Raise ValueError for an output that is not text; a group's text would become a folder."""
    output = config.get("output")
    if not isinstance(output, str) or not output:
        raise ValueError(f"output must be a folder's name: {output!r} came")


def check_places(settings: Iterable[tuple[str, Any]], overrides: Sequence[str]) -> None:
    """Raise ValueError for a folder elsewhere, or a server, that was not typed.

    settings: plain values by their dotted place.
    """
    here = Path.cwd().resolve()
    for place, value in settings:
        key = place.rpartition(".")[2]
        if key not in FOLDERS + SERVERS or _is_typed(place, overrides):
            continue
        for each in value if isinstance(value, list) else [value]:
            if not isinstance(each, str) or each == "???":
                continue  # refused where it is used
            if key in SERVERS:
                raise ValueError(
                    f"a config must not set {place}, for what answers there is trusted: {each!r} "
                    f"came; give it on the command line: {place}={each}"
                )
            if "\0" in each or not (here / each).resolve().is_relative_to(here):
                raise ValueError(
                    f"a config must set {place} to a folder below the one that you start in: "
                    f"{each!r} came; give it on the command line: {place}={each}"
                )


def resolved(config: DictConfig) -> Iterator[tuple[str, Any]]:
    """All settings by dotted place, resolved as a run reads them; text may become a group."""
    for key in config:
        try:
            node = config[key]
            is_group = OmegaConf.is_config(node)
            plain = OmegaConf.to_container(node, resolve=True) if is_group else node
            yield from _leaves(plain, str(key))
        except OmegaConfBaseException:  # reported where it is read; but it may be valid by then,
            yield from _resolved_one_by_one(config, key)  # so it must not hide a folder


def _resolved_one_by_one(config: DictConfig, key: Any) -> Iterator[tuple[str, Any]]:
    """Settings below a key as written; only folders and servers are resolved as in a run."""
    for place, value in _leaves(_written(config).get(key), str(key)):
        known = place.rpartition(".")[2] in FOLDERS + SERVERS and "${" in str(value)
        yield place, OmegaConf.select(config, place) if known else value


def _written(config: DictConfig) -> dict[str, Any]:
    """All settings of a config as written, without Hydra's own."""
    written: Any = OmegaConf.to_container(config, resolve=False)
    return {key: value for key, value in written.items() if key != "hydra"}


def _is_typed(place: str, overrides: Sequence[str]) -> bool:
    """Whether the command line gave a value; `data=mine` chooses a file and does not count."""
    for text in overrides:
        key, _, value = text.lstrip("+~").partition("=")
        if place == key or (place.startswith(f"{key}.") and value.strip().startswith(("{", "["))):
            return True
    return False


def _settings(config: DictConfig) -> dict[str, Any]:
    """All settings below `hydra`, by dotted place, with interpolations as written."""
    return dict(_leaves(OmegaConf.to_container(config.hydra, resolve=False), ""))


def _leaves(value: Any, place: str) -> Iterator[tuple[str, Any]]:
    """Values by their dotted place; an empty group counts as a value."""
    dot = f"{place}." if place else ""
    if isinstance(value, Mapping) and value:
        for name, each in value.items():
            yield from _leaves(each, f"{dot}{name}")
    elif isinstance(value, list) and any(isinstance(each, Mapping | list) for each in value):
        for k, each in enumerate(value):
            yield from _leaves(each, f"{place}[{k}]")
    else:
        yield place, value


class CheckedFiles(ConfigRepository):
    """Hydra's folders of configs; errors name the file."""

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
    """Raise ValueError for nested anchors that expand to an unreasonable number of values."""
    text = path.read_text("utf-8")
    if "&" not in text or "*" not in text:
        return
    if (n := _size(yaml.compose(text, Loader=yaml.SafeLoader), {})) > MAX_VALUES:
        raise ValueError(
            f"{path} may hold up to {MAX_VALUES} values: with its anchors written out it has "
            f"{n:.3g}; write what it needs"
        )


def _size(node: Any, known: dict[int, int]) -> int:
    """Number of values below a node with anchors expanded; an anchor in itself is unlimited."""
    if id(node) not in known:
        known[id(node)] = MAX_VALUES + 1  # until it is computed
        inner = node.value if isinstance(node, yaml.CollectionNode) else []
        each = [part for pair in inner for part in (pair if isinstance(pair, tuple) else [pair])]
        known[id(node)] = 1 + sum(_size(part, known) for part in each)
    return known[id(node)]


def check_references(settings: Any) -> None:
    """Raise ValueError for nested references that expand to an unreasonable length.

    settings: a config's groups and values as written. A name in `${...}` counts as the longest
    setting with that key, since its actual target need not be known here.
    """
    most = MAX_CHARACTERS + 10 * len(str(settings))
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
    """Collect the values under every key of any group, and at every position of a list."""
    inner = enumerate(node) if isinstance(node, list) else node.items()
    for key, value in inner:
        named.setdefault(str(key), []).append(value)
        if isinstance(value, dict | list):
            _name(value, named)


def _length(node: Any, named: Mapping[str, Sequence[Any]], known: dict[int, int]) -> int:
    """Characters of a value with references expanded; circular references count once."""
    if id(node) in known:
        return known[id(node)]
    known[id(node)] = 0  # until it is computed
    if isinstance(node, dict | list):
        parts = list(node.values()) if isinstance(node, dict) else node
        n = len(parts) + sum(_length(part, named, known) for part in parts)
    else:
        words = WORD.findall(" ".join(BRACES.findall(node))) if isinstance(node, str) else []
        n = len(str(node))
        n += sum(max(_length(v, named, known) for v in named[w]) for w in words if w in named)
    known[id(node)] = n
    return n
