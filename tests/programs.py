"""Experiments run inside a test, without the command line; and, where asked, without figures."""

import json
import sys
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any
from unittest.mock import patch

from hydra import compose, initialize_config_dir
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig

from ep2sindy.app.arguments import mend
from ep2sindy.app.main import main
from ep2sindy.app.runner import finish, start_run, study_class
from ep2sindy.app.schema import study_of
from ep2sindy.report.report import Report

ROOT = Path(__file__).resolve().parents[1]
EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "exp").glob("*.yaml"))


def on_file(path: Path, output: Path, *variables: str) -> list[str]:
    """Overrides that open a file of densities and of these variables, by the names we use."""
    names = (f"data.variables.{name}.name={name}" for name in variables)
    return ["data=file", f"data.path={path}", *names, f"output={output}"]


def composed(*overrides: str) -> DictConfig:
    """The config of the command line `ep2sindy OVERRIDES`.

    Hydra composes each choice of groups once, which takes long, and sets the values as it would.
    """
    parsed = OverridesParser.create().parse_overrides(list(map(mend, overrides)))
    chosen = [o for o in parsed if (ROOT / "conf" / o.key_or_group).is_dir()]
    config = deepcopy(composed_of(tuple(str(o.input_line) for o in chosen)))
    ConfigLoaderImpl._apply_overrides_to_config([o for o in parsed if o not in chosen], config)
    return config


@cache
def composed_of(groups: tuple[str, ...]) -> DictConfig:
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("config", overrides=list(groups))


@dataclass(frozen=True)
class Computed:
    """What a study finds and says: all but figures, which take most of a toy run's time."""

    report: Report
    log: str
    page: str

    @property
    def folder(self) -> Path:
        return self.report.folder.path

    @property
    def summary(self) -> dict[str, Any]:
        return summary_of(self.folder)

    @property
    def warnings(self) -> Sequence[str]:
        return self.report.warnings

    def check_figures(self, *names: str) -> None:
        """Each of these can be drawn; that it can be printed, the full run of a study shows."""
        for name in names:
            assert self.report.figures[name].draw().axes, name


def computed(config: DictConfig) -> Computed:
    """A study. Bands of its forecasts are calibrated by few starts: many take most of the time."""
    forecasts = import_module("ep2sindy.forecasting.forecast")
    with patch.object(forecasts, "N_STARTS", 10), start_run(config) as report:
        study = study_of(study_class(config.study), config)
        study.run(report)
        finish(study, report, ())
        assert report.result is not None
        assert len(report.result.title.split()) <= 12, report.result.title  # the verdict alone
    log, page = ((report.folder.path / name).read_text() for name in ("run.log", "report.html"))
    return Computed(report, log, page)


def summary_of(folder: Path) -> dict[str, Any]:
    """What a run left in its folder for other programs."""
    return json.loads((folder / "summary.json").read_text())


def ended(*arguments: str) -> str:
    """How the command line `ep2sindy ARGUMENTS` ends in this process: its error, or nothing."""
    with patch.object(sys, "argv", ["ep2sindy", *arguments]):
        try:
            main()
        except SystemExit as error:
            return str(error)
    return ""
