"""The command line: `ep2sindy +exp=breathing`, or `python -m experiments.run +exp=breathing`.

`ep2sindy compare RUN RUN` sets run folders side by side instead.
`ep2sindy inspect PATH` looks into files instead, and `ep2sindy warm` compiles what is compiled
once after installation.

Only Hydra is imported here: `--help` must not wait for the numerics.
"""

from __future__ import annotations

import atexit
import gc
import os
import sys
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from hydra.types import RunMode
from omegaconf import DictConfig
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ep2sindy.app.safety import check_places, checked_loader, resolved
from ep2sindy.runtime.screen import plain, say
from ep2sindy.runtime.threads import start_on_one_thread
from ep2sindy.trust.interruption import end_as_interrupted
from ep2sindy.trust.user_code import PACKAGE, isolate_children

USUAL_WARNING = warnings.formatwarning


def run() -> None:
    """Errors of the user's making end in one message; all others keep their traceback."""
    gc.set_threshold(100_000, 50, 100)  # imports make many objects, and all of them stay
    atexit.register(gc.freeze)  # to look through them all once more at the end takes a second
    sys.excepthook, warnings.formatwarning = _print_error, _warning_text
    end_as_interrupted()
    start_on_one_thread()
    os.environ["HYDRA_FULL_ERROR"] = "1"  # errors come here: Hydra would print its own words
    sweeps: list[Path] = []
    failed: list[str] = []  # told at the end: an error that left a job would be told by Hydra too
    try:
        conf = conf_folder()
        if command(sys.argv[1:], conf):
            return
        prepare_arguments(conf)

        @hydra.main(config_path=str(conf), config_name="config", version_base="1.3")
        def job(config: DictConfig) -> None:
            if HydraConfig.get().mode == RunMode.MULTIRUN:
                sweeps[:] = [Path(HydraConfig.get().sweep.dir)]
            failed.extend(run_job(config, conf))

        with checked_loader(), isolate_children(), said_as_text():
            job()
    except (HydraException, OmegaConfBaseException, ValueError, YAMLError) as error:
        sys.exit(plain(f"error: {str(error) or type(error).__name__}"))
    except OSError as error:
        where = (
            "where a run writes is chosen with output=PATH, and where it keeps what it can use "
            "again with data.cache=PATH or keep=PATH"
        )
        sys.exit(plain(f"error: {error}; {where}"))
    except KeyboardInterrupt:
        sys.exit("interrupted: files under their final names are whole")
    finally:
        for sweep in sweeps:
            from ep2sindy.app.sweep import index_text

            say(index_text(sweep))
    if failed:
        why = failed[0] if len(failed) == 1 else f"{len(failed)} jobs failed"
        sys.exit(plain(f"error: {why}"))


@contextmanager
def said_as_text() -> Iterator[None]:
    """What Hydra prints instead of a run, such as names of configs for --help, is said as text."""
    given, _ = get_args_parser().parse_known_args()
    if not (given.help or given.hydra_help or given.cfg or given.info):
        yield
        return
    text = StringIO()
    try:
        with redirect_stdout(text):
            yield
    finally:
        say(text.getvalue().rstrip("\n"))


def _print_error(*error: Any) -> None:
    """As Python does, but for what would steer a terminal."""
    print(plain("".join(traceback.format_exception(*error))), end="", file=sys.stderr)


def _warning_text(
    message: Warning | str, category: type[Warning], filename: str, lineno: int,
    line: str | None = None,
) -> str:  # fmt: skip
    return plain(USUAL_WARNING(message, category, filename, lineno, line))


def command(arguments: Sequence[str], conf: Path) -> bool:
    """Whether the first argument names a command, which has been carried out then."""
    name, rest = "".join(arguments[:1]), arguments[1:]
    if name == "compare":
        from ep2sindy.app.compare import main as compare_runs

        compare_runs(rest)
    elif name == "inspect":
        from ep2sindy.app.inspection import main as inspect_files

        inspect_files(rest, conf)
    elif name == "warm":
        from ep2sindy.app.warm import main as compile_kernels

        compile_kernels(rest)
    return name in ("compare", "inspect", "warm")


def conf_folder() -> Path:
    """The package's configs: beside it in a checkout, inside it where it is installed."""
    places = (PACKAGE.parent / "conf", PACKAGE / "conf")
    for place in places:
        if (place / "config.yaml").is_file():
            return place
    raise ValueError(
        f"the package's configs must lie in one of {list(map(str, places))}: none of them has a "
        "config.yaml; install the package again"
    )


def prepare_arguments(conf: Path) -> None:
    """Flags may stand anywhere, and configs in ./conf are found as with `--config-dir ./conf`."""
    flags = [text for text in sys.argv[1:] if text in ("-m", "--multirun")]
    sys.argv[1:] = [*flags, *(text for text in sys.argv[1:] if text not in flags)]
    primary = ("--config-path", "-cp", "--config-name", "-cn")
    if other := [text for text in sys.argv[1:] if text.startswith(primary)]:
        raise ValueError(
            f"every run begins with the package's own config.yaml, not with {other[0]!r}; "
            "--config-dir FOLDER adds configs of yours"
        )
    own = Path.cwd() / "conf"
    named = any(text.startswith(("--config-dir", "-cd")) for text in sys.argv[1:])
    if own.is_dir() and own.resolve() != conf.resolve() and not named:
        sys.argv[1:] = ["--config-dir", str(own), *sys.argv[1:]]


def run_job(config: DictConfig, conf: Path) -> list[str]:
    """One run, and why it ended early, if it did; a sweep notes that and goes on."""
    with note_job() as (done, ended_early):
        try:
            if config.experiment is None:
                raise ValueError(
                    "choose an experiment with +exp=NAME; there are "
                    f"{list_experiments(conf)}. A config of "
                    "your own begins with the line '# @package _global_'"
                )
            typed = HydraConfig.get().overrides.task
            check_places(resolved(config), typed)
            say(first_word(config))  # what follows takes seconds to load
            from ep2sindy.app.runner import run_config

            finished = run_config(config, overrides=typed)
        except (ValueError, OSError, HydraException, OmegaConfBaseException) as error:
            ended_early(error)
            return [str(error)]
        done(finished.folder, finished.headline)
    say(str(finished.folder))
    return []


@contextmanager
def note_job() -> Iterator[
    tuple[Callable[[Path, Mapping[str, float]], None], Callable[[BaseException], None]]
]:
    """In a sweep: say which job begins, and note how it ended; otherwise do nothing.

    The first of what comes is told the run folder and the headline figures of a job that came to
    its end, the second the error of one that did not.
    """
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        yield (lambda folder, headline: None), (lambda error: None)
        return
    job, overrides = HydraConfig.get().job.num, list(HydraConfig.get().overrides.task)
    sweep = Path(HydraConfig.get().sweep.dir)
    record: dict[str, Any] = {"job": job, "overrides": overrides, "status": "failed"}
    say(f"job {job}: {' '.join(overrides)}")

    def done(folder: Path, headline: Mapping[str, float]) -> None:
        record.update(status="done", folder=str(folder), headline=dict(headline))

    def ended_early(error: BaseException) -> None:
        record["error"] = f"{error}" or type(error).__name__
        say(f"job {job} failed: {record['error']}")

    try:
        yield done, ended_early
    except BaseException as error:
        ended_early(error)
        raise
    finally:
        from ep2sindy.app.sweep import note_end  # pandas and more, when a job has ended

        note_end(sweep, record)


def first_word(config: DictConfig) -> str:
    """What a run is, and where it will write."""
    folder = Path(str(config.get("output")), str(config.experiment))
    return f"{config.experiment}: loading study={config.get('study')}; writes below {folder}/"


def list_experiments(conf: Path) -> str:
    """Experiments that there are to choose from."""
    folders = {conf, Path.cwd() / "conf"}
    return ", ".join(sorted({path.stem for each in folders for path in each.glob("exp/*.yaml")}))
