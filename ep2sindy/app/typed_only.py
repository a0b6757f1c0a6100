"""What only the command line may say, and no file: a config may come from anybody.

Below `hydra:` one can name callbacks, log handlers, the shell lines of a cluster job, variables
of the environment and folders to write to. Folders for runs and caches that lie elsewhere, and
schedulers, whose answers are trusted, are typed as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra._internal.hydra as program
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

FOLDERS = ("output", "keep", "cache")  # keys, at any depth, of what a run writes to
SERVERS = ("address",)
# What Hydra itself notes of a run.
NOTED = ("runtime", "overrides", "mode", "job.override_dirname", "job.num", "job.id")
# What nobody may set, for it names what is called or made.
SILENT = {"version": 1, "root": {"level": "ERROR"}, "disable_existing_loggers": True}
FIXED: Mapping[str, Any] = {"callbacks": {}, "job_logging": SILENT, "hydra_logging": SILENT}


class CheckedLoader(ConfigLoaderImpl):
    """Hydra's loader of configs, which looks at each before anything of it is obeyed."""

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        how = (run_mode, from_shell, validate_sweep_overrides)
        found = super().load_configuration(config_name, overrides, *how)
        typed = [text for text in overrides if text.lstrip("+~").startswith("hydra")]
        without = super().load_configuration(config_name, typed, *how)
        check_hydra(_settings(found), _settings(without))
        check_places(found, overrides)
        return found


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


def check_places(config: DictConfig, overrides: Sequence[str]) -> None:
    """Raise ValueError for a folder elsewhere, or a server, that nobody has typed."""
    here = Path.cwd().resolve()
    written: Any = OmegaConf.to_container(config, resolve=False)
    for place, value in _leaves({k: v for k, v in written.items() if k != "hydra"}, ""):
        key = place.rpartition(".")[2]
        if (
            key not in FOLDERS + SERVERS
            or not isinstance(value, str)
            or _is_typed(place, overrides)
        ):
            continue
        value = OmegaConf.select(config, place) if "${" in str(value) else value
        if key in SERVERS and value != "???":
            raise ValueError(
                f"a config must not set {place}, for what answers there is trusted: {value!r} "
                f"came; give it on the command line: {place}={value}"
            )
        if key in FOLDERS and not (here / str(value)).resolve().is_relative_to(here):
            raise ValueError(
                f"a config must set {place} to a folder below the one that you start in: "
                f"{value!r} came; give it on the command line: {place}={value}"
            )


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
