"""The command line: `ep2sindy +exp=breathing`, or `python -m experiments.run +exp=breathing`.

Only Hydra is imported here: `--help` must not wait for the numerics.
"""

from __future__ import annotations

import gc
import os
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException

PACKAGE = Path(__file__).resolve().parents[1]


class JobError(Exception):
    """A job that ended early, for a reason that is in the message."""


def main() -> None:
    """Errors of the user's making end in one message; all others keep their traceback."""
    gc.set_threshold(100_000, 50, 100)  # imports make objects that stay: looking costs 0.6 s a run
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors come here: Hydra would print its own words
    sweeps: list[Path] = []
    try:
        conf = conf_folder()
        add_own_configs(conf)

        @hydra.main(config_path=str(conf), config_name="config", version_base="1.3")
        def job(config: DictConfig) -> None:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                sweeps[:] = [Path(HydraConfig.get().sweep.dir)]
            run_job(config, conf)

        job()
    except (JobError, HydraException, OmegaConfBaseException, OSError, ValueError) as error:
        sys.exit(f"error: {error}")
    except KeyboardInterrupt:
        sys.exit("interrupted: files under their final names are whole")
    finally:
        for sweep in sweeps:
            from ep2sindy.app.sweep import index_text

            print(index_text(sweep))


def conf_folder() -> Path:
    """The package's configs: beside it in a checkout, inside it where it is installed."""
    places = (PACKAGE.parent / "conf", PACKAGE / "conf")
    for place in places:
        if (place / "config.yaml").is_file():
            return place
    raise OSError(
        f"the package's configs must lie in one of {list(map(str, places))}: none of them has a "
        "config.yaml; install the package again"
    )


def add_own_configs(conf: Path) -> None:
    """Configs in ./conf are found beside the package's own, as with `--config-dir ./conf`."""
    own = Path.cwd() / "conf"
    named = any(text.startswith(("--config-dir", "-cd")) for text in sys.argv[1:])
    if own.is_dir() and own.resolve() != conf.resolve() and not named:
        sys.argv[1:] = ["--config-dir", str(own), *sys.argv[1:]]


def run_job(config: DictConfig, conf: Path) -> None:
    """One run; in a sweep its end is noted in the index, and the other jobs go on."""
    from ep2sindy.app.sweep import noted_job

    with noted_job() as done:
        try:
            if config.experiment is None:
                raise ValueError(f"choose an experiment with +exp=NAME; there are {known(conf)}")
            from ep2sindy.app.runner import run_config

            finished = run_config(config, overrides=HydraConfig.get().overrides.task)
        except (ValueError, OSError, HydraException, OmegaConfBaseException) as error:
            raise JobError(str(error)) from error
        done(finished.folder, finished.headline)
    print(finished.folder)


def known(conf: Path) -> str:
    """Experiments that there are to choose from."""
    folders = {conf, Path.cwd() / "conf"}
    return ", ".join(sorted({path.stem for each in folders for path in each.glob("exp/*.yaml")}))


if __name__ == "__main__":
    main()
