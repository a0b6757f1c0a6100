"""How long a person waits: CPU time of whole processes, children included.

python -m benchmarks.startup
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

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
# What -> command, and the CPU seconds that it should stay below.
CASES = {
    "import ep2sindy": ([*PYTHON, "-c", "import ep2sindy"], 0.15),
    "import, and the first discover": ([*PYTHON, "-c", FIRST_USE], 1.5),
    "the same after installation (compiles)": ([*PYTHON, "-c", FIRST_USE], 8.0),
    "ep2sindy --help": ([*PROGRAM, "--help"], 1.0),
    "ep2sindy +exp=discover on a CSV": ([*PROGRAM, *CSV], 4.0),
}


def cpu_s(command: list[str], *, folder: str, cache: str | None = None) -> float:
    """User and system time of a process that must succeed."""
    environment = dict(os.environ) | ({"NUMBA_CACHE_DIR": cache} if cache else {})
    environment.pop("PYTHONDONTWRITEBYTECODE", None)  # as installed: bytecode is kept
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    subprocess.run(command, cwd=folder, env=environment, check=True, capture_output=True)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    root = str(Path(__file__).resolve().parents[1])
    os.environ["PYTHONPATH"] = os.pathsep.join([root, os.environ.get("PYTHONPATH", "")])
    with tempfile.TemporaryDirectory() as folder:
        t = np.arange(0.0, 30.0, 0.05)
        table = np.column_stack([t, np.sin(t), np.cos(t)])
        path = f"{folder}/run.csv"
        np.savetxt(path, table, delimiter=",", header="time,x,y", comments="")
        print(f"{'CPU seconds':40} {'median':>8} {'least':>8} {'bound':>8}")
        for name, (command, bound) in CASES.items():
            compiles = "compiles" in name
            if not compiles:
                cpu_s(command, folder=folder)  # warm: files read, kernels compiled
            runs = []
            for k in range(1 if compiles else 5):
                cache = f"{folder}/cache_{k}" if compiles else None
                runs.append(cpu_s(command, folder=folder, cache=cache))
            print(f"{name:40} {np.median(runs):8.2f} {min(runs):8.2f} {bound:8.2f}")


if __name__ == "__main__":
    main()
