"""Many short runs in one process: memory, files, threads and processes do not grow.

`python -m tests.attack.soak WHAT N FOLDER` runs N rounds of one kind, and says what grew.
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import psutil

from tests.attack.results import Outcome
from tests.attack.runs import LIMIT_S, ROOT

WARM_UP = 4  # rounds: what is imported, compiled and kept once is there after them
# Of 200 rounds of free runs and 24 of searches, which keep no object, memory went up and down by
# 5 and 40 MiB: allocators keep what was freed. A run of the program keeps 7 small objects.
MEMORY = 64 * 2**20  # bytes, of any number of rounds: 50 tell what leaves more than 1.3 MiB
OBJECTS = 20  # a round
HELD = "held: "  # before what is measured, among what a run says


def discover() -> None:
    import ep2sindy as ep

    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    ep.discover(run)
    ep.discover(
        run, method=ep.Regression(ep.WeightedWeak(), ep.BestSubset(), bootstraps=ep.Bootstraps(n=2))
    )


def simulate() -> None:
    import ep2sindy as ep

    ep.thruster.simulate(
        ep.thruster.Thruster(), ep.thruster.OperatingPoint(300.0, 5.0), duration_s=2e-4,
        warm_up_s=0.0, sample_s=1e-6, n_cells=30, progress=False,
    )  # fmt: skip


def refine() -> None:
    import ep2sindy as ep

    system = ep.lotka_volterra()
    ep.refine(system.model, [system.trajectory(noise=0.02, rng=0)], n_windows=4, seed=0)


def run_freely() -> None:
    import ep2sindy as ep

    system = ep.lotka_volterra()
    data = system.trajectory()
    system.model.simulate(data.t, data.states[0])
    ep.free_run(system.model, data)


def files() -> None:
    """Every kind is written and read, those of C libraries in a process of their own first."""
    import ep2sindy as ep
    from tests.attack.files import SAME, file_ending, read, whole

    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for ending in whole(folder):
            (folder / ending).mkdir()
            path = (folder / f"a.{ending}").rename(folder / ending / f"b.{file_ending(ending)}")
            assert read(path)[0] == SAME, path
        model = ep.lorenz().model
        model.save(folder / "model.json")
        assert ep.SparseModel.load(folder / "model.json").to_json() == model.to_json()


def program() -> None:
    """A whole run with its folder, figures, page and TensorBoard, pieces in two workers."""
    import ep2sindy as ep
    from benchmarks.regions import three_regions
    from ep2sindy.app.runner import run_config
    from tests.attack.runs import RUNS
    from tests.programs import composed

    with tempfile.TemporaryDirectory() as name:
        os.chdir(name)
        ep.write_field(three_regions(n_z=4, n_r=3, n_samples=300).field, Path("data/grid.nc"))
        run_config(composed("+exp=pointwise", *RUNS["pointwise"], "parallel.n_jobs=2"))
        os.chdir("/")


KINDS: dict[str, Callable[[], None]] = {
    each.__name__: each for each in (discover, simulate, refine, run_freely, files, program)
}


def soaked(folder: Path) -> Callable[[str], Outcome]:
    """The attack on case KIND-N: N rounds of one kind in a process of its own."""

    def attacked(case: str) -> Outcome:
        kind, _, rounds = case.partition("-")
        temporary = folder / f"tmp_{kind}"
        temporary.mkdir(exist_ok=True)
        own = {"OMP_NUM_THREADS": "1", "TMPDIR": str(temporary), "PYTHONPATH": str(ROOT)}
        own["JOBLIB_TEMP_FOLDER"] = str(temporary)
        done = subprocess.run(
            [sys.executable, "-m", "tests.attack.soak", kind, rounds, str(temporary)],
            env={**os.environ, **own}, capture_output=True, text=True, check=False,
            timeout=LIMIT_S * WARM_UP + LIMIT_S / 10 * int(rounds),
        )  # fmt: skip
        if done.returncode:
            return "failed", done.stderr[-300:]
        held_of = [line for line in done.stdout.splitlines() if line.startswith(HELD)]
        first, last = (json.loads(line.removeprefix(HELD)) for line in held_of)
        grown = [name for name in first if last[name] > first[name] + allowed(name, int(rounds))]
        words = ", ".join(f"{name} {first[name]} -> {last[name]}" for name in first)
        return ("grows" if grown else "no growth"), f"{grown or ''} {words}"

    return attacked


def allowed(name: str, rounds: int) -> int:
    """By how much a measure may be larger after some rounds."""
    return {"memory": MEMORY, "objects": OBJECTS * rounds}.get(name, 0)


def held(folder: Path) -> dict[str, int]:
    """What this process holds. memory: its own, of no other process, in bytes."""
    gc.collect()
    this = psutil.Process()
    return {
        "memory": this.memory_full_info().uss,
        "objects": len(gc.get_objects()),
        "open files": this.num_fds() if hasattr(this, "num_fds") else 0,
        "threads": this.num_threads(),
        "children": len(this.children(recursive=True)),
        "temporary files": sum(len(names) for _, _, names in os.walk(folder)),
    }


def main() -> None:
    kind, rounds, folder = KINDS[sys.argv[1]], int(sys.argv[2]), Path(sys.argv[3])
    for n in (WARM_UP, rounds):
        for _ in range(n):
            kind()
        print(f"{HELD}{json.dumps(held(folder))}", flush=True)


if __name__ == "__main__":
    main()
