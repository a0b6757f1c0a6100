"""A run folder, read again."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ep2sindy.app.yaml_files import check_yaml
from ep2sindy.library.units import Clock
from ep2sindy.model.model import SparseModel
from ep2sindy.report.about import by_place
from ep2sindy.runtime.files import read_json

# What a page is made of.
SUMMARY = {"experiment": str, "seed": int, "headline": dict, "warnings": list, "data": dict}
PROVENANCE = {"commit": str, "versions": dict}
REQUIRED = {"experiment", "seed"}


@dataclass(frozen=True, eq=False)
class ReadRun:
    """A run folder, read. settings: by dotted place. label: what tables call it."""

    folder: Path
    label: str
    summary: dict[str, Any]
    provenance: dict[str, Any]
    settings: dict[str, Any]
    models: dict[str, SparseModel]

    @property
    def clock(self) -> Clock:
        """The unit that its times are read in."""
        return Clock.of(self.summary.get("data", {}).get("time_unit", "s"))

    @property
    def headline(self) -> dict[str, float]:
        """A figure that was not a number stands as null in the file."""
        found = self.summary.get("headline", {})
        return {name: float("nan") if v is None else float(v) for name, v in found.items()}


def read_run(folder: Path, number: int) -> ReadRun:
    """A run that came to its end. number: from zero; its label is A, B, ...

    Raises ValueError for a folder that is none, or a run that ended early.
    """
    if not folder.is_dir():
        raise ValueError(f"a run is a folder: {folder} is not there; {_nearby(folder)}")
    if (folder / "index.csv").is_file():
        raise ValueError(
            f"{folder} is a sweep, and compares its jobs in index.html; name the folders of two "
            "of its jobs, see index.csv"
        )
    if not (folder / "summary.json").is_file():
        said = "it ended early, see its run.log" if (folder / "run.log").is_file() else "no run"
        raise ValueError(f"{folder} has no summary.json: {said}; {_nearby(folder)}")
    paths = sorted((folder / "models").glob("[!.]*.json"))
    return ReadRun(
        folder=folder,
        label=chr(ord("A") + number),
        summary=_checked(folder / "summary.json", SUMMARY),
        provenance=_checked(folder / "provenance.json", PROVENANCE),
        settings=_settings(folder / "config.yaml"),
        models={path.stem: SparseModel.load(path) for path in paths},
    )


def _checked(path: Path, kinds: Mapping[str, Any]) -> dict[str, Any]:
    """An object of JSON whose keys hold what a page makes of them."""
    with _damage_named(path):
        found = read_json(path.read_text("utf-8"))
        if not isinstance(found, dict) or not REQUIRED & {*kinds} <= {*found}:
            raise ValueError(f"an object with {sorted(REQUIRED & {*kinds})} must stand there")
        for name, kind in kinds.items():
            if not isinstance(found.setdefault(name, kind()), kind):
                raise ValueError(f"{name} cannot be {found[name]!r:.80}")
        figures = found.get("headline", {})
        if not all(isinstance(each, int | float | None) for each in figures.values()):
            raise ValueError(f"headline must be of numbers: {figures!r:.80} came")
        Clock.of(found.get("data", {}).get("time_unit", "s"))
    return found


def _settings(path: Path) -> dict[str, Any]:
    """By dotted place."""
    with _damage_named(path):
        check_yaml(path)
        config: Any = OmegaConf.to_container(OmegaConf.load(path))
        if not isinstance(config, dict):
            raise ValueError("a mapping must stand there")
        return {k: v for key, each in config.items() for k, v in by_place(str(key), each).items()}


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, RecursionError, OmegaConfBaseException, YAMLError) as error:
        raise ValueError(f"{path} cannot be read ({error}): the run's folder is damaged") from error


def _nearby(folder: Path) -> str:
    """Runs that there are: below the folder itself, beside it, or where outputs go."""
    for place in (folder, folder.parent, Path("outputs")):
        found = sorted(path.parent for path in place.glob("**/summary.json"))[-3:]
        if found:
            return f"runs there are, for example {', '.join(map(str, found))}"
    return "a run's folder is the one that it prints last"


def link_to(run: ReadRun, beside: Path) -> str:
    """The run's page, as a page in this folder reaches it."""
    return os.path.relpath(run.folder / "report.html", beside)
