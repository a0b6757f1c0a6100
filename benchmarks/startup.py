"""What a person waits for: CPU time of whole processes, the first word, the longest silence.

    python -m benchmarks.startup [--against OTHER_CHECKOUT] [--only NAME ...]

Silences are those of a terminal: a pseudo-terminal notes when output comes. With another checkout,
both run in turn, and ratios are printed. Wall time of an idle machine; ratios are what travels.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import pty
import resource
import struct
import subprocess
import sys
import tempfile
import termios
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks.same_results import TOYS, write_data

HERE = Path(__file__).resolve().parents[1]
FIRST_USE = (
    "import numpy as np, ep2sindy as ep\n"
    "t = np.arange(0, 30, 0.05)\n"
    "ep.discover((t, np.column_stack([np.sin(t), np.cos(t)])))\n"
)
CSV = [
    "+exp=discover", "data=file", "data.path=run.csv", "data.z.name=null",
    "data.variables.n_i.name=null", "data.variables.n_n.name=null",
    "+data.variables.x.name=x", "+data.variables.x.unit=1",
    "+data.variables.y.name=y", "+data.variables.y.unit=1", "trajectory.states=[x,y]",
]  # fmt: skip
PYTHON, PROGRAM = [sys.executable], [sys.executable, "-m", "ep2sindy.app.main"]
# Experiments that take minutes at full size run at that of `same_results`.
AT_TOY_SIZE = (
    "benchmark", "weak", "weak_windows", "frontier", "constrained", "ils", "parametric", "predict",
    "pointwise", "simulate",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A command. cold: with nothing compiled, run once. watched: on a terminal as well."""

    command: Sequence[str]
    cold: bool = False
    watched: bool = False


@dataclass(frozen=True)
class Waited:
    """What one run took. first_s, silence_s: until the first output, and without any after it."""

    cpu_s: float
    first_s: float = float("nan")
    silence_s: float = float("nan")


def cases(data: dict[str, Path]) -> dict[str, Case]:
    """By name; `data`: files of the toys."""
    found = {
        "import ep2sindy": Case([*PYTHON, "-c", "import ep2sindy"]),
        "import, and the first discover": Case([*PYTHON, "-c", FIRST_USE]),
        "the same, with nothing compiled": Case([*PYTHON, "-c", FIRST_USE], cold=True),
        "ep2sindy --help": Case([*PROGRAM, "--help"]),
        "+exp=discover on a CSV": Case([*PROGRAM, *CSV], watched=True),
        "+exp=breathing": Case([*PROGRAM, "+exp=breathing"], watched=True),
        "+exp=trace": Case([*PROGRAM, "+exp=trace"], watched=True),
    }
    places = {**data, "cache": data["folder"] / "cache"}
    for name in AT_TOY_SIZE:
        overrides = [text.format(**places) for text in TOYS[name]]
        found[f"+exp={name}, small"] = Case([*PROGRAM, *overrides], watched=True)
    return found


def run(case: Case, checkout: Path, folder: Path) -> Waited:
    """One run of a case by the code of a checkout; it must succeed."""
    environment = dict(os.environ) | {"PYTHONPATH": str(checkout), "COLUMNS": "120"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # as installed: bytecode is kept
    with tempfile.TemporaryDirectory() as cache:
        if case.cold:
            environment["NUMBA_CACHE_DIR"] = cache
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        times = (watched if case.watched else silent)(case.command, folder, environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if not case.watched:
        return Waited(cpu_s)
    return Waited(cpu_s, times[1] - times[0], longest_gap(times[1:]))


def silent(command: Sequence[str], folder: Path, environment: dict[str, str]) -> list[float]:
    subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
    return []


def watched(command: Sequence[str], folder: Path, environment: dict[str, str]) -> list[float]:
    """When it began, when output came on its terminal, and when it ended, in s."""
    reader, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
    times = [time.perf_counter()]
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stdin=terminal, stdout=terminal, stderr=terminal
    )
    os.close(terminal)
    try:
        while os.read(reader, 65536):
            times.append(time.perf_counter())
    except OSError:  # the terminal of a process that has ended
        pass
    finally:
        os.close(reader)
    if process.wait():
        raise RuntimeError(f"{command} ended with status {process.returncode}")
    return [*times, time.perf_counter()]


def longest_gap(times: Sequence[float]) -> float:
    """The longest time between two moments that follow each other; zero where there is one."""
    return max((later - sooner for sooner, later in pairwise(times)), default=0.0)


def measured(case: Case, checkouts: Sequence[Path], folder: Path, n_runs: int) -> list[Waited]:
    """The median of some runs of each checkout, in turn."""
    for checkout in checkouts:
        if not case.cold:
            run(case, checkout, folder)  # warm: files read, kernels compiled, simulations kept
    turns = 1 if case.cold else n_runs
    runs = [[run(case, checkout, folder) for checkout in checkouts] for _ in range(turns)]
    return [
        Waited(*np.median([(w.cpu_s, w.first_s, w.silence_s) for w in of_one], axis=0).tolist())
        for of_one in zip(*runs, strict=True)
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--against", type=Path, help="a checkout to compare with")
    parser.add_argument("--only", nargs="*", help="parts of the names of cases")
    parser.add_argument("--runs", type=int, default=3, help="counted runs of each case")
    given = parser.parse_args()
    checkouts = [HERE, *([given.against.resolve()] if given.against else [])]
    print(f"{'':32} {'CPU s':>7} {'first s':>8} {'silence':>8} {'other':>8} {'ratio':>6}")
    with tempfile.TemporaryDirectory() as root:
        folder = Path(root)
        data = write_data(folder)
        t = np.arange(0.0, 30.0, 0.05)
        table = np.column_stack([t, np.sin(t), np.cos(t)])
        np.savetxt(folder / "run.csv", table, delimiter=",", header="time,x,y", comments="")
        for name, case in cases(data).items():
            if given.only and not any(part in name for part in given.only):
                continue
            ours, *other = measured(case, checkouts, folder, given.runs)
            line = f"{name:32} {ours.cpu_s:7.2f} {ours.first_s:8.2f} {ours.silence_s:8.2f}"
            for theirs in other:
                line += f" {theirs.cpu_s:8.2f} {ours.cpu_s / theirs.cpu_s:6.2f}"
            print(line.replace("nan", "  -"), flush=True)


if __name__ == "__main__":
    main()
