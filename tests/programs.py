"""Experiments run inside a test, without the command line; and, where asked, without figures."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra import compose, initialize_config_dir
from omegaconf import DictConfig

from ep2sindy.app.runner import started_run, study_class
from ep2sindy.app.schema import study_of
from ep2sindy.report.page import page_html

ROOT = Path(__file__).resolve().parents[1]
EXPERIMENTS = sorted(path.stem for path in (ROOT / "conf" / "exp").glob("*.yaml"))


def composed(*overrides: str) -> DictConfig:
    """The config of the command line `ep2sindy OVERRIDES`."""
    with initialize_config_dir(str(ROOT / "conf"), version_base="1.3"):
        return compose("config", overrides=list(overrides))


@dataclass(frozen=True)
class Computed:
    """What a study finds and says: all but figures, which take most of a toy run's time."""

    outcome: Any
    log: str
    page: str
    folder: Path

    @property
    def summary(self) -> dict[str, Any]:
        return self.outcome.summary()


def computed(config: DictConfig) -> Computed:
    with started_run(config) as run:
        outcome = study_of(study_class(config.study), config).compute(run)
        sections = outcome.sections()
        run.screen.show(sections)
        page = page_html(config.experiment, sections, {})
        log = (run.folder.path / "run.log").read_text()
    return Computed(outcome, log, page, run.folder.path)
