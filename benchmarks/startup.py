"""What a person waits for: CPU time of whole processes, from the import to small experiments.

    python -m benchmarks.startup [--against OTHER_CHECKOUT] [--only NAME ...]

With another checkout, both run in turn, and ratios are printed, which is what travels.
"""

from __future__ import annotations

import argparse
import os
import resource
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks.same_results import HERE, TOYS, write_data

FIRST_USE = (
    "import numpy as np, ep2sindy as ep\n"
    "t = np.arange(0, 30, 0.05)\n"
    "ep.discover((t, np.column_stack([np.sin(t), np.cos(t)])))\n"
)
COLD = "import, and the first discover, with nothing compiled"
PYTHON, PROGRAM = [sys.executable], [sys.executable, "-m", "ep2sindy.app.main"]
# Experiments that take minutes at full size run at that of `same_results`.
AT_FULL_SIZE = ("breathing", "trace", "zones", "ils")
AT_TOY_SIZE = (
    "benchmark", "weak", "weak_windows", "frontier", "constrained", "parametric", "predict",
    "pointwise", "simulate",
)  # fmt: skip


def commands(folder: Path) -> dict[str, list[str]]:
    """Commands by name, with files that they read in a folder."""
    t = np.arange(0.0, 30.0, 0.05)
    table = np.column_stack([t, np.sin(t), np.cos(t)])
    np.savetxt(folder / "run.csv", table, delimiter=",", header="time_s,x,y", comments="")
    places = {**write_data(folder), "cache": folder / "cache"}
    csv = ["data=recognised", "data.path=run.csv", "trajectory.states=[x,y]"]
    found = {
        "import ep2sindy": [*PYTHON, "-c", "import ep2sindy"],
        "import, and the first discover": [*PYTHON, "-c", FIRST_USE],
        COLD: [*PYTHON, "-c", FIRST_USE],
        "ep2sindy --help": [*PROGRAM, "--help"],
        "+exp=discover on a CSV": [*PROGRAM, "+exp=discover", *csv],
    }
    for name in AT_FULL_SIZE:
        found[f"+exp={name}"] = [*PROGRAM, f"+exp={name}"]
    for name in AT_TOY_SIZE:
        overrides = [text.format(**places) for text in TOYS[name]]
        found[f"+exp={name}, small"] = [*PROGRAM, *overrides]
    return found


def cpu_s(command: Sequence[str], checkout: Path, folder: Path, *, cold: bool) -> float:
    """CPU time of a command by the code of a checkout; it must succeed."""
    environment = dict(os.environ) | {"PYTHONPATH": str(checkout), "COLUMNS": "120"}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # as installed: bytecode is kept
    with tempfile.TemporaryDirectory() as cache:
        if cold:
            environment["EP2SINDY_CACHE"] = cache
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measured(
    name: str, command: Sequence[str], checkouts: Sequence[Path], folder: Path, n_runs: int
) -> list[float]:
    """The median CPU time of some runs of each checkout in turn; once with nothing compiled."""
    cold = name == COLD
    if not cold:  # files read, kernels compiled, simulations kept
        for checkout in checkouts:
            cpu_s(command, checkout, folder, cold=False)
    times = [
        [cpu_s(command, checkout, folder, cold=cold) for checkout in checkouts]
        for _ in range(1 if cold else n_runs)
    ]
    return np.median(times, axis=0).tolist()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--against", type=Path, help="a checkout to compare with")
    parser.add_argument("--only", nargs="*", help="parts of the names of commands")
    parser.add_argument("--runs", type=int, default=3, help="counted runs of each command")
    given = parser.parse_args()
    checkouts = [HERE, *([given.against.resolve()] if given.against else [])]
    print(f"{'CPU-s':54} {'here':>7} {'other':>7} {'ratio':>6}")
    with tempfile.TemporaryDirectory() as folder:
        for name, command in commands(Path(folder)).items():
            if given.only and not any(part in name for part in given.only):
                continue
            ours, *other = measured(name, command, checkouts, Path(folder), given.runs)
            ratios = "".join(f" {theirs:7.2f} {ours / theirs:6.2f}" for theirs in other)
            print(f"{name:54} {ours:7.2f}{ratios}", flush=True)


if __name__ == "__main__":
    main()
