"""The runner of all studies: folder, log, TensorBoard, tables, figures, page and summary."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from importlib import import_module
from pathlib import Path
from traceback import format_exc
from typing import Any

from omegaconf import DictConfig, OmegaConf

import ep2sindy.studies
from ep2sindy.app.precompile import precompile
from ep2sindy.app.schema import keys_of, study_of
from ep2sindy.app.targets import check_targets
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.report import Report
from ep2sindy.report.screen import Screen
from ep2sindy.report.tensorboard import Board
from ep2sindy.runtime.files import write_text
from ep2sindy.runtime.kept_pieces import PartDone
from ep2sindy.runtime.progress import Bars
from ep2sindy.studies.study import Experiment
from ep2sindy.trust.user_code import load_user_module


def run_config(config: DictConfig) -> Path:
    """Build the study that a config names, and run it; returns its run folder."""
    with Bars().stage(3, "step", "loading") as advance:
        check_targets(OmegaConf.to_container(config))
        advance(1)
        kind = study_class(config.get("study"))
        advance(1)
        study: Experiment = study_of(kind, config)  # an invalid setting leaves no run folder
        advance(1)
    precompile()
    with start_run(config) as report:
        try:
            study.run(report)
        except PartDone as done:
            report.say(str(done))
            return report.folder.path
        finish(study, report, config.get("formats", ["png"]))
    return report.folder.path


def finish(study: Experiment, report: Report, formats: Sequence[str]) -> None:
    """Write what a study reported, with the purpose and the settings of the one that acted."""
    kind = type(getattr(study, "acting", study))
    report.finish(purpose=purpose_of(kind), keys=keys_of(kind), formats=formats)


def purpose_of(kind: type) -> str:
    """The first paragraph of a study's docstring, in one line."""
    return " ".join((kind.__doc__ or "").split("\n\n")[0].split())


def study_class(name: object) -> type:
    """The class `Study` of a module of `ep2sindy.studies`, or of a user's module by dotted name.

    A user's module must lie below the current folder; if it is a folder, its module `study` holds
    the class.
    """
    text = str(name)
    inside = "." not in text or text.startswith("ep2sindy.")
    module = text if "." in text else f"ep2sindy.studies.{text}"
    load = import_module if inside else load_user_module
    try:
        found = load(module)
        if hasattr(found, "__path__") and not hasattr(found, "Study"):
            module = f"{module}.study"
            found = load(module)
        return found.Study
    except (ModuleNotFoundError, AttributeError) as error:
        if isinstance(error, ModuleNotFoundError) and not module.startswith(str(error.name)):
            raise  # the module exists, but one of its imports is missing
        raise ValueError(
            f"study must name a module of ep2sindy.studies that has a class Study, one of "
            f"{list_studies()}, or one of your own as package.module, below the folder that you "
            f"start in, got {name!r}"
        ) from error


def list_studies() -> list[str]:
    """Modules of `studies` that define a study; they are read as text, as imports take seconds."""
    (folder,) = ep2sindy.studies.__path__
    texts = {path.stem: path.read_text("utf-8") for path in sorted(Path(folder).glob("*.py"))}
    return [name for name, text in texts.items() if re.search(r"^class Study\b", text, re.M)]


@contextmanager
def start_run(config: DictConfig) -> Iterator[Report]:
    """A new run folder that already holds its config and provenance."""
    folder = RunFolder.create(Path(config.output), config.experiment, now=datetime.now())
    write_text(folder.file("config.yaml"), OmegaConf.to_yaml(config, resolve=True))
    provenance = folder.write_provenance(seed=config.seed, command=["ep2sindy", *sys.argv[1:]])
    screen = Screen(folder.path / "run.log")
    board = Board(folder.path / "tensorboard")
    settings: Any = OmegaConf.to_container(config, resolve=True)
    try:
        yield Report(config.experiment, config.seed, folder, screen, board, settings, provenance)
    except BaseException as error:
        screen.log(f"ended early: {type(error).__name__}: {error}\n{format_exc()}")
        raise
    finally:
        board.close()
        screen.close()
