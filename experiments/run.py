"""Run one experiment from its config: python -m experiments.run +exp=breathing."""

import sys
from importlib import import_module
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

from experiments.build import check_overrides

CONF = Path(__file__).resolve().parents[1] / "conf"
# Modules of this package; only the one asked for is imported, for some take seconds.
STUDIES = (
    "libraries", "benchmark", "weak", "weak_windows", "frontier", "constrained", "ils",
    "parametric", "pointwise",
)  # fmt: skip


@hydra.main(config_path=str(CONF), config_name="config", version_base="1.3")
def main(config: DictConfig) -> None:
    """Errors of the user's making end in one message; all others keep their traceback."""
    if config.experiment is None:
        known = ", ".join(sorted(path.stem for path in (CONF / "exp").glob("*.yaml")))
        sys.exit(f"error: choose an experiment with +exp=NAME; there are {known}")
    if config.study not in STUDIES:
        sys.exit(f"error: study must be one of {sorted(STUDIES)}: {config.study!r} came")
    try:
        study = import_module(f"experiments.{config.study}")
        overrides = HydraConfig.get().overrides.task
        check_overrides(overrides, used=study.USES, experiment=config.experiment)
        folder = study.run(config)
    except KeyboardInterrupt:
        sys.exit("interrupted: files under their final names are whole")
    except (ValueError, OSError, HydraException, OmegaConfBaseException) as error:
        sys.exit(f"error: {innermost(error)}")
    print(folder)


def innermost(error: BaseException) -> BaseException:
    """Hydra wraps what a constructor raised; the user needs the constructor's own words."""
    while isinstance(error, HydraException) and error.__cause__ is not None:
        error = error.__cause__
    return error


if __name__ == "__main__":
    main()
