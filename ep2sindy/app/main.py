"""The command line: `ep2sindy +exp=breathing`, or `python -m experiments.run +exp=breathing`.

`ep2sindy compare RUN RUN` compares run folders instead. `ep2sindy inspect PATH` inspects files,
and `ep2sindy precompile` compiles, once after installation, all that needs compiling.

Only Hydra is imported here: `--help` must not wait for the numerics.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
from collections.abc import Sequence
from importlib import import_module
from itertools import pairwise
from pathlib import Path
from shlex import quote
from typing import Any

import hydra
from hydra import compose, initialize_config_dir
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ep2sindy.app.arguments import COMMANDS, JOBS, explain, options_first
from ep2sindy.app.config_files import FileConfigSource, conf_folder
from ep2sindy.runtime.files import read_json, write_json
from ep2sindy.runtime.screen import listed, near_words, plain, say
from ep2sindy.runtime.threads import start_on_one_thread
from ep2sindy.trust.interruption import end_as_interrupted


def main() -> None:
    """Run the command line; user errors end in one message, all others keep their traceback."""
    gc.set_threshold(100_000, 50, 100)  # imports make many objects that are never freed
    atexit.register(gc.freeze)  # a last collection over all of them takes a second
    end_as_interrupted()
    SourcesRegistry.instance().types["file"] = FileConfigSource
    start_on_one_thread()
    # Errors are reported here, not in Hydra's words; and a file of the user's that is called like a
    # module of Python, such as signal.py, must not take its place in workers.
    os.environ |= {"HYDRA_FULL_ERROR": "1", "PYTHONSAFEPATH": "1"}
    try:
        errors = [] if command(sys.argv[1:]) else run(conf_folder())
    except (HydraException, OmegaConfBaseException, ValueError, YAMLError) as error:
        errors = [str(error) or type(error).__name__]
    except OSError as error:
        errors = [
            f"{error}; where a run writes is chosen with output=PATH, and where it keeps what it "
            "can use again with data.cache=PATH"
        ]
    except KeyboardInterrupt:
        say("interrupted: files under their final names are whole", error=True)
        os._exit(1)  # at once: a thread that waits, as for a file, would keep the process
    if errors:
        why = errors[0] if len(errors) == 1 else f"{len(errors)} jobs failed"
        sys.exit(plain(f"error: {why}"))


def command(arguments: Sequence[str]) -> bool:
    """Carry out the command that the first argument names; returns whether it names one."""
    name = "".join(arguments[:1])
    if name in COMMANDS:
        import_module(f"ep2sindy.app.{COMMANDS[name]}").main(arguments[1:])  # takes seconds
    return name in COMMANDS


def run(conf: Path) -> list[str]:
    """Run the job, or the jobs of a sweep, that the command line sets; returns their errors.

    Configs in ./conf are found as if `--config-dir conf` were given.
    Raises ValueError for settings that cannot be composed.
    """
    options, settings = options_first(sys.argv[1:])
    own = Path.cwd() / "conf"
    if "--config-dir" not in options and own.is_dir() and own.resolve() != conf.resolve():
        options += ["--config-dir", str(own)]
    sys.argv[1:] = [*options, *settings]
    jobs: list[list[str]] = []  # their errors; Hydra too would report an error that left a job
    HydraConfig.instance().cfg = None

    @hydra.main(config_path=str(conf), config_name="config", version_base="1.3")
    def job(config: DictConfig) -> None:
        jobs.append([])
        jobs[-1] += run_job(config, conf)

    def composed(settings: list[str]) -> DictConfig:
        folders = [value for name, value in pairwise(options) if name == "--config-dir"]
        places = [f"file://{Path(folder).absolute()}" for folder in folders]
        with initialize_config_dir(str(conf), version_base="1.3"):
            return compose("config", [f"hydra.searchpath={places}", *settings])

    try:
        job()
    except HydraException as error:
        raise ValueError(explain(error, settings, composed)) from error
    except RuntimeError as error:
        if jobs:
            raise
        raise ValueError(
            f"the launcher must be able to run the jobs, got: {error}; hydra/launcher=slurm needs "
            "SLURM, and hydra/launcher=submitit_local runs the same jobs on this machine"
        ) from error
    finally:
        sweep = sweep_folder()
        if sweep is not None and any(sweep.glob(f"{JOBS}/*.json")):
            say(f"the jobs side by side: ep2sindy compare {quote(str(sweep))}")
    if sweep is None or jobs:
        return [error for errors in jobs for error in errors]
    return job_errors(sweep)


class KnownSweep(Callback):
    """Makes Hydra's settings of a sweep known to this process also if others run its jobs."""

    def on_multirun_start(self, config: DictConfig, **_: Any) -> None:
        HydraConfig.instance().set_config(config)


def sweep_folder() -> Path | None:
    """The folder of the sweep that this process has begun; None if it has begun no sweep."""
    if not HydraConfig.initialized() or HydraConfig.get().mode != RunMode.MULTIRUN:
        return None
    return Path(HydraConfig.get().sweep.dir)


def job_errors(sweep: Path) -> list[str]:
    """Print and return the errors in the records of jobs that ran in other processes."""
    paths = {int(path.stem): path for path in sweep.glob(f"{JOBS}/*.json")}
    records = {job: read_json(paths[job].read_text("utf-8")) for job in sorted(paths)}
    errors = {job: record["error"] for job, record in records.items() if "error" in record}
    for job, error in errors.items():
        say(f"job {job} failed: {error}")
    return list(errors.values())


def run_job(config: DictConfig, conf: Path) -> list[str]:
    """Run one job; returns why it ended early, if it did. A sweep notes that and continues.

    In a sweep, its record for `compare` is written when it ends, in whichever way.
    """
    run = HydraConfig.get()
    job = f"job {run.job.num}" if run.mode == RunMode.MULTIRUN else ""
    record: dict[str, Any] = {"overrides": list(run.overrides.task)}
    if job:
        say(f"{job}: {' '.join(record['overrides'])}")
    try:
        if config.experiment is None:
            raise _no_experiment(record["overrides"], conf)
        folder = Path(str(config.get("output")), str(config.experiment))
        study = config.get("study")  # the imports below take seconds
        say(f"{config.experiment}: loading study={study}; writes below {folder}/")
        from ep2sindy.app.runner import run_config

        path = run_config(config)
        if (path / "summary.json").is_file():  # a part of a study has no result of its own
            record["folder"] = str(path)
    except (ValueError, OSError, HydraException, OmegaConfBaseException) as error:
        record["error"] = str(error)
    except BaseException as error:
        record["error"] = str(error) or type(error).__name__
        raise
    finally:
        if job and "error" in record:
            say(f"{job} failed: {record['error']}")
        if job:
            write_json(Path(run.sweep.dir) / JOBS / f"{run.job.num}.json", record)
    return [record["error"]] if "error" in record else []


def _no_experiment(typed: Sequence[str], conf: Path) -> ValueError:
    """The error of a command that names no experiment, with all that there are."""
    folders = {conf, Path.cwd() / "conf"}
    names = sorted({path.stem for each in folders for path in each.glob("exp/*.yaml")})
    for text in typed:
        key, _, value = text.lstrip("+").partition("=")
        if value in names and near_words(key, ["exp", "experiment"]):
            return ValueError(f"an experiment is chosen with +exp={value}, got {text!r}")
    return ValueError(
        f"choose an experiment with +exp=NAME: {listed(names)}. A config of your own "
        "begins with the line '# @package _global_'"
    )


if __name__ == "__main__":
    main()
