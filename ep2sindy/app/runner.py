"""One runner for all studies: folder, log, TensorBoard, tables, figures, page and summary."""

from __future__ import annotations

import re
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules
from traceback import format_exc
from typing import Any

from omegaconf import DictConfig, OmegaConf

import ep2sindy.studies
from ep2sindy.app.schema import GROUPS, keys_of, study_of
from ep2sindy.report.document import Section, Text
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.page import page_html
from ep2sindy.report.run import Run
from ep2sindy.report.screen import Screen
from ep2sindy.report.tensorboard import Board
from ep2sindy.studies.study import Experiment, Outcome


@dataclass(frozen=True)
class Finished:
    """A run that came to its end: where it lies, and the numbers it is compared by."""

    folder: Path
    headline: Mapping[str, float]


def run_config(config: DictConfig, *, overrides: Iterable[str] = ()) -> Finished:
    """Build the study that a config names, compute it, and write all that it leaves.

    overrides: what was set on the command line; one that the study does not use is an error.
    """
    check_common(config)
    kind = study_class(config.get("study"))
    check_overrides(overrides, used=keys_of(kind), experiment=config.experiment)
    study: Experiment = study_of(kind, config)  # a setting that cannot be leaves no run folder
    with started_run(config) as run:
        outcome = study.compute(run)
        headline = write(run, outcome, hparams_of(run.settings, keys_of(kind)))
    return Finished(run.folder.path, headline)


def study_class(name: object) -> type:
    """The class `Study` of a module of `ep2sindy.studies`, or of one's own by its dotted name.

    A folder holds it in its module `study`.
    """
    module = str(name) if "." in str(name) else f"ep2sindy.studies.{name}"
    try:
        found = import_module(module)
        if hasattr(found, "__path__") and not hasattr(found, "Study"):
            module = f"{module}.study"
            found = import_module(module)
        return found.Study
    except (ModuleNotFoundError, AttributeError) as error:
        if isinstance(error, ModuleNotFoundError) and not module.startswith(str(error.name)):
            raise  # the module is there, but one that it needs is not
        raise ValueError(
            f"study must name a module of ep2sindy.studies that has a class Study, one of "
            f"{known_studies()}, or one of your own as package.module: {name!r} came"
        ) from error


def known_studies() -> list[str]:
    """Modules of the room that define a study; read as text, for importing them takes seconds."""
    folder = Path(ep2sindy.studies.__file__ or "").parent
    found = []
    for module in iter_modules([str(folder)]):
        path = folder / (f"{module.name}/study.py" if module.ispkg else f"{module.name}.py")
        if path.is_file() and re.search(r"^class Study\b", path.read_text("utf-8"), re.M):
            found.append(module.name)
    return found


def check_common(config: DictConfig) -> None:
    """Raise ValueError for a seed or a name that cannot be."""
    if not isinstance(config.seed, int) or isinstance(config.seed, bool) or config.seed < 0:
        raise ValueError(f"seed must be a whole number, zero or more: {config.seed!r} came")
    if not str(config.experiment).isidentifier():
        raise ValueError(
            f"experiment names a folder: letters, digits and _, not {config.experiment!r}"
        )


def check_overrides(overrides: Iterable[str], *, used: Collection[str], experiment: str) -> None:
    """Raise ValueError for a key of conf/config.yaml that was set but that a study does not use."""
    for text in overrides:
        key = re.split(r"[.=@]", text.lstrip("+~/"))[0]
        if key in set(GROUPS) - set(used):
            raise ValueError(
                f"{text!r} would do nothing: {experiment} does not use {key!r}; leave it out"
            )


@contextmanager
def started_run(config: DictConfig) -> Iterator[Run]:
    """A new run folder that already holds its config and provenance."""
    folder = RunFolder.create(Path(config.output), config.experiment, now=datetime.now())
    folder.write_text("config.yaml", OmegaConf.to_yaml(config, resolve=True))
    folder.write_provenance(seed=config.seed, command=["ep2sindy", *sys.argv[1:]])
    screen = Screen(folder.path / "run.log")
    board = Board(folder.path / "tensorboard")
    settings: Any = OmegaConf.to_container(config, resolve=True)
    try:
        yield Run(config.experiment, config.seed, folder, screen, board, settings)
    except BaseException as error:
        screen.log(f"ended early: {type(error).__name__}: {error}\n{format_exc()}")
        raise
    finally:
        board.close()
        screen.close()


def write(run: Run, outcome: Outcome, hparams: Mapping[str, Any]) -> dict[str, float]:
    """Everything of an outcome into the run folder; what no view may lose comes first."""
    folder, board = run.folder, run.board
    models = outcome.models()
    for name, model in models.items():
        folder.write_model(name, model)
    for name, table in outcome.tables().items():
        folder.write_table(name, table)
    sections = outcome.sections()
    run.screen.show(sections)
    figures = outcome.figures()
    for name, figure in figures.items():
        board.image(name, folder.write_figure(name, figure.draw()))
    for name, model in models.items():
        board.text(name, model.text())
    headline = dict(outcome.headline())
    board.settings(hparams, headline)
    warned = [Section("Warnings", [Text(text, warning=True) for text in run.warnings])]
    said = [Section("Data and method", [Text(text) for text in run.said])]
    page = [*(warned if run.warnings else []), *(said if run.said else []), *sections]
    folder.write_text("report.html", page_html(run.title, page, figures))
    named = {"experiment": run.title, "seed": run.seed}
    named |= {"warnings": run.warnings} if run.warnings else {}
    folder.write_json("summary.json", named | outcome.summary())
    return headline


def hparams_of(settings: Mapping[str, Any], keys: set[str]) -> dict[str, Any]:
    """The settings by which runs are compared: numbers, names and lists of them, and groups."""
    found: dict[str, Any] = {"seed": settings["seed"]}
    for key in sorted(keys & set(settings)):
        value = settings[key]
        if isinstance(value, dict) and "_target_" in value:
            value = ", ".join(f"{k}={each}" for k, each in value.items())
        if isinstance(value, list) and not any(isinstance(each, dict) for each in value):
            value = str(value)
        if isinstance(value, int | float | str | bool):
            found[key] = value
    return found
