"""What a person waits for: CPU time of whole processes, the first word, the longest silence.

    python -m benchmarks.startup [--against OTHER_CHECKOUT] [--only NAME ...]

Silences are those of a terminal: a pseudo-terminal notes when output comes, and every experiment
runs on it. The words before and after the longest silence are printed below the numbers. Where
others share the machine, waiting for a processor is not counted: a wait is its wall time or the
CPU time spent in it, whichever is less. With another checkout, both run in turn, and ratios are
printed, which is what travels.
"""

from __future__ import annotations

import argparse
import fcntl
import os
import pty
import re
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
AT_FULL_SIZE = ("breathing", "trace", "zones", "ils")
AT_TOY_SIZE = (
    "benchmark", "weak", "weak_windows", "frontier", "constrained", "parametric", "predict",
    "pointwise", "simulate",
)  # fmt: skip
# What a terminal does not show as text: colours, and movements of the cursor.
CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]")


@dataclass(frozen=True)
class Case:
    """A command. cold: with nothing compiled, run once. watched: on a terminal as well."""

    command: Sequence[str]
    cold: bool = False
    watched: bool = False


@dataclass(frozen=True)
class Output:
    """One output on a terminal. wall_s, cpu_s: since the command began."""

    wall_s: float
    cpu_s: float
    text: str = ""

    @property
    def words(self) -> list[str]:
        """The lines that can be read; a bar that is written again is a line of its own."""
        lines = re.split(r"[\r\n]+", CONTROL.sub("", self.text))
        return [line.strip() for line in lines if line.strip()]

    def after(self, before: Output) -> float:
        """Time since an earlier output without that spent waiting for a processor, in s."""
        return min(self.wall_s - before.wall_s, self.cpu_s - before.cpu_s)


@dataclass(frozen=True)
class Waited:
    """What one run took. first_s, silence_s: until the first output, and without any after it.

    between: the words before and after that silence.
    """

    cpu_s: float
    first_s: float = float("nan")
    silence_s: float = float("nan")
    between: str = ""


def cases(data: dict[str, Path]) -> dict[str, Case]:
    """By name; `data`: files of the toys."""
    found = {
        "import ep2sindy": Case([*PYTHON, "-c", "import ep2sindy"]),
        "import, and the first discover": Case([*PYTHON, "-c", FIRST_USE]),
        "the same, with nothing compiled": Case([*PYTHON, "-c", FIRST_USE], cold=True),
        "ep2sindy --help": Case([*PROGRAM, "--help"]),
        "+exp=discover on a CSV": Case([*PROGRAM, *CSV], watched=True),
    }
    for name in AT_FULL_SIZE:
        found[f"+exp={name}"] = Case([*PROGRAM, f"+exp={name}"], watched=True)
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
            environment["EP2SINDY_CACHE"] = cache
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        outputs = (watched if case.watched else silent)(case.command, folder, environment)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu_s = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    if not case.watched:
        return Waited(cpu_s)
    begin, *rest = outputs
    last, then = longest_silence(rest)
    between = (
        f"{last.words[-1:]} and {then.words[:1]}, {then.wall_s - last.wall_s:.1f} s by a clock"
    )
    return Waited(cpu_s, rest[0].after(begin), then.after(last), between)


def silent(command: Sequence[str], folder: Path, environment: dict[str, str]) -> list[Output]:
    subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
    return []


def watched(command: Sequence[str], folder: Path, environment: dict[str, str]) -> list[Output]:
    """Its begin, all that can be read on its terminal, and its end."""
    reader, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 40, 120, 0, 0))
    begin = time.perf_counter()
    process = subprocess.Popen(
        command, cwd=folder, env=environment, stdin=terminal, stdout=terminal, stderr=terminal,
        start_new_session=True,
    )  # fmt: skip
    os.close(terminal)
    outputs = [Output(0.0, 0.0)]
    try:
        while data := os.read(reader, 65536):
            wall_s, cpu_s = time.perf_counter() - begin, session_cpu_s(process.pid)
            output = Output(wall_s, cpu_s, data.decode("utf-8", "replace"))
            outputs += [output] if output.words else []
    except OSError:  # the terminal of a process that has ended
        pass
    finally:
        os.close(reader)
    cpu_s = session_cpu_s(process.pid)
    if process.wait():
        raise RuntimeError(f"{command} ended with status {process.returncode}: {outputs[-1].text}")
    return [*outputs, Output(time.perf_counter() - begin, cpu_s)]


def session_cpu_s(session: int) -> float:
    """CPU time of all processes of a session, and of those of their children that have ended."""
    ticks = 0
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            numbers = path.read_text().rpartition(")")[2].split()
        except OSError:  # it has ended in the meantime
            continue
        if int(numbers[3]) == session:
            ticks += sum(map(int, numbers[11:15]))
    return ticks / os.sysconf("SC_CLK_TCK")


def longest_silence(outputs: Sequence[Output]) -> tuple[Output, Output]:
    """The two outputs that follow each other with the longest wait between them."""
    return max(pairwise(outputs), key=lambda pair: pair[1].after(pair[0]))


def measured(case: Case, checkouts: Sequence[Path], folder: Path, n_runs: int) -> list[Waited]:
    """The run of median CPU time, of some runs of each checkout in turn."""
    for checkout in checkouts:
        if not case.cold:
            run(case, checkout, folder)  # warm: files read, kernels compiled, simulations kept
    turns = 1 if case.cold else n_runs
    runs = [[run(case, checkout, folder) for checkout in checkouts] for _ in range(turns)]
    return [
        sorted(of_one, key=lambda each: each.cpu_s)[len(of_one) // 2]
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
            if ours.between:
                print(f"    {ours.between}", flush=True)


if __name__ == "__main__":
    main()
