"""What only the command line may say, and no file: a config may come from anybody.

Below `hydra:` one can name callbacks, log handlers, the shell lines of a cluster job, variables
of the environment and folders to write to. Folders for runs and caches that lie elsewhere, and
schedulers, whose answers are trusted, are typed as well.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from copy import deepcopy
from pathlib import Path
from typing import Any

import hydra._internal.hydra as program
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_search_path import ConfigSearchPath
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ep2sindy.app.yaml_files import CheckedFiles, check_references

FOLDERS = ("output", "keep", "cache")  # keys, at any depth, of what a run writes to
SERVERS = ("address",)
# What Hydra itself notes of a run, and nobody obeys.
NOTED = ("runtime.choices", "runtime.config_sources", "job.override_dirname")
# What nobody may set, for it names what is called or made.
SILENT = {"version": 1, "root": {"level": "ERROR"}, "disable_existing_loggers": True}
FIXED: Mapping[str, Any] = {"callbacks": {}, "job_logging": SILENT, "hydra_logging": SILENT}


class CheckedLoader(ConfigLoaderImpl):
    """Hydra's loader of configs, which looks at each before anything of it is obeyed."""

    def __init__(self, config_search_path: ConfigSearchPath) -> None:
        super().__init__(config_search_path)
        self.repository = CheckedFiles(config_search_path)

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        how = (run_mode, from_shell, validate_sweep_overrides)
        hydras = [text for text in overrides if re.match(r"[+~]*hydra[./=]", text)]
        without = _without_folders(self, hydras).load_configuration(config_name, hydras, *how)
        if not validate_sweep_overrides:  # Hydra asks for its mode alone, before it composes
            return without
        found = super().load_configuration(config_name, overrides, *how)
        typed = _settings(without)
        typed["overrides.task"] = [text for text in overrides if text not in hydras]
        check_hydra(_settings(found), typed)
        written = _written(found)
        check_references(written)
        check_places(_places(found, written), overrides)
        return found


def _without_folders(loader: ConfigLoaderImpl, hydras: Sequence[str]) -> ConfigLoaderImpl:
    """A loader of the package's and Hydra's own configs, for a folder may hold some of their names.

    With a group of Hydra's on the command line, such as a launcher, folders are trusted with it.
    """
    path = deepcopy(loader.config_search_path)
    if not any("/" in text.partition("=")[0] for text in hydras):
        path.get_path()[:] = [p for p in path.get_path() if p.provider != "command-line"]
    return ConfigLoaderImpl(path)


@contextmanager
def checked_loader() -> Iterator[None]:
    """Within, Hydra's program composes no config that has not been checked."""
    before = program.ConfigLoaderImpl
    program.ConfigLoaderImpl = CheckedLoader  # type: ignore[misc]
    try:
        yield
    finally:
        program.ConfigLoaderImpl = before  # type: ignore[misc]


def check_hydra(found: Mapping[str, Any], typed: Mapping[str, Any]) -> None:
    """Raise ValueError for a setting below `hydra` that does not come from the command line.

    found: all that a config says, by dotted place. typed: what the command line and the package
    say without it.
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


def check_places(settings: Iterable[tuple[str, Any]], overrides: Sequence[str]) -> None:
    """Raise ValueError for a folder elsewhere, or a server, that nobody has typed.

    settings: plain values by their dotted place.
    """
    here = Path.cwd().resolve()
    for place, value in settings:
        key = place.rpartition(".")[2]
        if key not in FOLDERS + SERVERS or _is_typed(place, overrides):
            continue
        for each in value if isinstance(value, list) else [value]:
            if not isinstance(each, str) or each == "???":
                continue  # whoever takes it refuses it
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
    """All that a config says, by dotted place, as a run will read it: text may make a group."""
    for key in config:
        with suppress(OmegaConfBaseException):  # told better by whoever reads it
            node = config[key]
            is_group = OmegaConf.is_config(node)
            plain = OmegaConf.to_container(node, resolve=True) if is_group else node
            yield from _leaves(plain, str(key))


def _written(config: DictConfig) -> dict[str, Any]:
    """All that a config says but Hydra's own, as it is written."""
    written: Any = OmegaConf.to_container(config, resolve=False)
    return {key: value for key, value in written.items() if key != "hydra"}


def _places(config: DictConfig, written: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """The same before all of it can be resolved: Hydra makes a folder first."""
    for place, value in _leaves(written, ""):
        known = place.rpartition(".")[2] in FOLDERS + SERVERS and "${" in str(value)
        yield place, OmegaConf.select(config, place) if known else value


def _is_typed(place: str, overrides: Sequence[str]) -> bool:
    """Whether the command line gave a value; `data=mine` chooses a file, which is none."""
    for text in overrides:
        key, _, value = text.lstrip("+~").partition("=")
        if place == key or (place.startswith(f"{key}.") and value.strip().startswith(("{", "["))):
            return True
    return False


def _settings(config: DictConfig) -> dict[str, Any]:
    """All below `hydra`, by dotted place, interpolations as they are written."""
    return dict(_leaves(OmegaConf.to_container(config.hydra, resolve=False), ""))


def _leaves(value: Any, place: str) -> Iterator[tuple[str, Any]]:
    """Values by their dotted place; an empty group is one."""
    dot = f"{place}." if place else ""
    if isinstance(value, Mapping) and value:
        for name, each in value.items():
            yield from _leaves(each, f"{dot}{name}")
    elif isinstance(value, list) and any(isinstance(each, Mapping | list) for each in value):
        for k, each in enumerate(value):
            yield from _leaves(each, f"{place}[{k}]")
    else:
        yield place, value
