"""Runs that are killed, and runs of which one write fails: what is left is whole.

`python -m tests.attack.runs K ARGUMENTS` runs the command line with its K-th opening of a file for
writing failing, as on a full disk.
"""

from __future__ import annotations

import builtins
import errno
import io
import json
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import psutil

from tests.attack.results import Outcome

TOY = (
    "+exp=pointwise", "data=file", "data.r.name=r", "parallel=loky", "parallel.n_jobs=2",
    "bootstraps.n=6", "block_points=5", "max_regimes=3",
    *(f"data.variables.{name}.name={name}" for name in ("u_iz", "u_ir", "R_ion")),
)  # fmt: skip


def arguments(folder: Path) -> list[str]:
    """A toy run that searches a grid, keeps finished blocks and writes NetCDF."""
    from ep2sindy.data.open import write_field
    from ep2sindy.synthetic.regions import three_regions

    grid = folder / "grid.nc"
    if not grid.exists():
        write_field(three_regions(n_z=6, n_r=5, n_samples=300).field, grid)
    return [*TOY, f"data.path={grid}", f"output={folder / 'out'}", f"keep={folder / 'kept'}"]


def damage_in(folder: Path) -> list[str]:
    """Files under their final names that are not whole."""
    import h5py
    import numpy as np

    wrong = []
    for path in sorted(folder.rglob("*")):
        if not path.is_file() or path.name.startswith("."):
            continue
        try:
            if path.suffix == ".json":
                json.loads(path.read_text("utf-8"))
            elif path.suffix == ".nc":
                with h5py.File(path) as file:
                    file.visititems(lambda name, item: item[()] if hasattr(item, "dtype") else None)
            elif path.suffix == ".npz":
                with np.load(path) as arrays:
                    dict(arrays)
            elif path.suffix in (".png", ".pdf", ".html"):
                ends = {".png": b"IEND\xaeB`\x82", ".pdf": b"%%EOF", ".html": b"</html>"}
                if not path.read_bytes().rstrip().endswith(ends[path.suffix]):
                    wrong.append(path.name)
        except Exception as error:
            wrong.append(f"{path.name}: {error!r}")
    return wrong


def kill(folder: Path, seed: int) -> Callable[[str], Outcome]:
    """The attack on case K: a run is ended at a random moment by a random signal."""
    line = [sys.executable, "-m", "experiments.run", *arguments(folder)]

    def attacked(case: str) -> Outcome:
        chance = random.Random(f"{seed} {case}")
        moment_s = chance.uniform(1.0, 20.0)
        name = chance.choice(["SIGINT", "SIGTERM", "SIGHUP", "SIGKILL"])
        run = subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        time.sleep(moment_s)
        if run.poll() is not None:
            return "ended before", f"{moment_s:.1f} s"
        workers = psutil.Process(run.pid).children(recursive=True)
        run.send_signal(getattr(signal, name))
        run.wait()
        _, alive = psutil.wait_procs(workers, timeout=10.0)
        wrong = damage_in(folder)
        for each in alive:
            each.kill()
        if wrong or alive:
            return ("half-written" if wrong else "workers alive"), f"{name}: {wrong or alive}"
        return "whole", f"{name} after {moment_s:.1f} s"

    return attacked


def fail(folder: Path) -> Callable[[str], Outcome]:
    """The attack on case K: the K-th write of a run fails."""
    line = [sys.executable, "-m", "tests.attack.runs"]

    def attacked(case: str) -> Outcome:
        run = subprocess.run(
            [*line, case, *arguments(folder)], capture_output=True, text=True, check=False
        )
        said = run.stderr.strip().splitlines()[-1] if run.stderr.strip() else ""
        if wrong := damage_in(folder):
            return "half-written", str(wrong)
        if "WRITE FAILED" not in run.stdout:
            return "fewer writes", ""
        if run.returncode == 0:
            return "went on", said
        spoken = run.returncode == 1 and said.startswith("error: ") and str(folder) in said
        return ("refused with path" if spoken else "foreign"), f"{run.returncode} {said}"

    return attacked


def main() -> None:
    """The command line, with a file layer whose K-th write under the output fails."""
    left = [int(sys.argv[1])]
    sys.argv[1:] = sys.argv[2:]
    places = [text.partition("=")[2] for text in sys.argv if text.startswith(("output=", "keep="))]
    opened = io.open

    def opening(file: Any, mode: str = "r", *rest: Any, **named: Any) -> Any:
        found = opened(file, mode, *rest, **named)
        writes = set(mode) & set("wax+") and str(file).startswith(tuple(places))
        left[0] -= bool(writes)
        if writes and left[0] == 0:
            left[0] = -1
            found.close()
            print("WRITE FAILED", file, flush=True)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return found

    io.open = builtins.open = opening  # type: ignore[assignment]
    from ep2sindy.app.main import main as run

    run()


if __name__ == "__main__":
    main()
