"""What runs leave in a folder: which files, the same bytes or not, and processes that live on."""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import psutil

EARLIER = "2000-01-01_000000"  # a run folder that was there before
# Lines that are not the same in two runs, for what they hold: seconds of work, that a run went on,
# and the commit, which may change while the attack goes on.
OF_TIME = re.compile(
    rb'^.*("wall_s"|"points_per_s"|points in [\d.]+ s \(|going on with \d+ of|"commit"|<p>Code: )'
    rb".*\n",
    re.M,
)
OF_TIME_ALONE = ("tensorboard/",)  # the time of every event; host and process in the name
GROWS = ("run.log", *OF_TIME_ALONE)  # written line by line, so that it may be watched


def run_folder(printed: str) -> Path:
    """Folder of a run, from the last line that it prints: `open: FOLDER/report.html`."""
    return Path(printed.splitlines()[-1].removeprefix("open: ")).parent


def contents(folder: Path) -> dict[str, str]:
    """A digest of every file that the runs of a folder made, by its path."""
    found = {}
    for place in ("out", "kept", "cache"):
        for path in sorted((folder / place).rglob("*")):
            try:
                if path.is_symlink():
                    found[str(path.relative_to(folder))] = "a link"
                elif path.is_file():
                    content = path.read_bytes()
                    if path.suffix in (".json", ".html", ".log"):
                        content = OF_TIME.sub(b"", content)
                    found[str(path.relative_to(folder))] = hashlib.sha256(content).hexdigest()[:16]
            except FileNotFoundError:
                continue  # of a run at work
    return found


def is_temporary(name: str) -> bool:
    return Path(name).name.startswith(".")


def finished(files: Mapping[str, str], run: Path) -> dict[str, str]:
    """Files of one run folder, by their names in it, and what is kept beside it."""
    inside = f"{run}/"
    return {
        name.removeprefix(inside): digest
        for name, digest in files.items()
        if (name.startswith(inside) or not name.startswith("out/"))
        and not name.removeprefix(inside).startswith(OF_TIME_ALONE)
    }


def amiss(files: Mapping[str, str], run: Path, expected: Mapping[str, str]) -> list[str]:
    """What is not as in the reference after a run that came to its end."""
    found = finished(files, run)
    return [
        *(f"missing: {name}" for name in expected.keys() - found.keys()),
        *(f"left over: {name}" for name in found.keys() - expected.keys()),
        *(f"differs: {n}" for n in found.keys() & expected.keys() if found[n] != expected[n]),
        *(f"left over: {name}" for name in files if is_temporary(name)),
    ]


def half_written(
    folder: Path, files: Mapping[str, str], before: Mapping[str, str], expected: Mapping[str, str]
) -> list[str]:
    """Files of a broken run that are not whole under their final name.

    What lies in run folders and caches must be as in the reference, which has no kept blocks left:
    those must open.
    """
    new = [name for name in files if before.get(name) != files[name] and not is_temporary(name)]
    wrong = []
    for name in new:
        if name.startswith("kept/"):
            whole = _opens(folder / name)
        else:
            inside = _inside(name)
            whole = inside.startswith(GROWS) or files[name] == expected.get(inside)
        if not whole:
            wrong.append(f"half-written: {name}")
    return wrong


def _opens(block: Path) -> bool:
    try:
        with np.load(block) as arrays:
            return bool(dict(arrays))
    except FileNotFoundError:
        return True  # cleared meanwhile
    except Exception:
        return False


def _inside(name: str) -> str:
    """The name of a file in its run folder `out/EXPERIMENT/TIME`."""
    return "/".join(Path(name).parts[3:]) if name.startswith("out/") else name


def lost(files: Mapping[str, str], before: Mapping[str, str]) -> list[str]:
    """What was whole, and is no more; blocks may go when the result that they make is there."""
    made = any(name.endswith("/pointwise.nc") and EARLIER not in name for name in files)
    return [
        f"lost: {name}"
        for name in before
        if files.get(name) != before[name]
        and not is_temporary(name)
        and not _inside(name).startswith(GROWS)
        and not (made and name.startswith("kept/"))
    ]


def living(folder: Path, *, timeout_s: float = 10.0) -> list[str]:
    """Processes of the runs in a folder that have not ended after a while: they are ended here."""
    end = time.monotonic() + timeout_s
    while (alive := _started_in(folder)) and time.monotonic() < end:
        time.sleep(0.2)
    words = [f"alive: {each.pid} {each.name()}" for each in alive]
    for each in alive:
        each.kill()
    return words


def _started_in(folder: Path) -> list[psutil.Process]:
    """By their environment, which all of a tree inherit: parents may have gone."""
    found = []
    for each in psutil.process_iter():
        try:
            mark = each.environ().get("EP2SINDY_ATTACK", "")
            if f'"{folder}"' in mark and each.status() != psutil.STATUS_ZOMBIE:
                found.append(each)
        except psutil.Error:
            continue
    return found
