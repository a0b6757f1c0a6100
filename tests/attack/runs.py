"""Small runs of the experiments: how each is started, and what it leaves undisturbed."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from ep2sindy.runtime.threads import NUMBERS
from tests.attack.left import EARLIER, contents, finished, run_folder

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S = 600.0  # for a run of seconds on a machine that does other things

SIMULATED = (
    "data.cache=cache", "data.progress=false", "data.duration_s=2.0e-3", "data.warm_up_s=1.0e-3",
    "data.n_cells=30",
)  # fmt: skip
RUNS = {
    "discover": ("data=recognised", "data.path=data/lorenz.csv", "trajectory.states=[x,y,z]"),
    "simulate": (
        *SIMULATED, "thruster=two_cycles", "data.operating_point.neutral_speed=280.0",
        "data.stretch=1.0", "data.duration_s=6.0e-4",
        "data.warm_up_s=0.0", "data.n_cells=24", "scan={operating_point.voltage:[250.0,300.0]}",
    ),
    "pointwise": (
        "data=file", "data.path=data/grid.nc", "data.r.name=r", "bootstraps.n=6",
        "block_points=5", "max_regimes=3", "keep=kept",
        *(f"data.variables.{name}.name={name}" for name in ("u_iz", "u_ir", "R_ion")),
    ),
    "weak": (*SIMULATED, "n_windows=500", "n_points=[10,50]"),
    "breathing": (
        *SIMULATED, "bootstraps.n=4", "~libraries.velocity", "living=free",
        "living.search.max_terms=3",
        "living.search.n_best=1", "living.depth=1",
    ),
    "parametric": (
        *SIMULATED, "bootstraps.n=2", "bootstrap.n_draws=40", "refining.n_windows=20",
        "library.variables=[n_i,n_n,R_ion]",
        "points=[{V_D_V: 200.0, mdot_mg_s: 5.0},{V_D_V: 300.0, mdot_mg_s: 5.0},"
        "{V_D_V: 300.0, mdot_mg_s: 2.0}]",
    ),
    "predict": (
        *SIMULATED, "degrees=[1]", "windows.n_windows=4", "windows.periods=1.0", "map_points=2",
        "points=[{V_D_V: [280.0, 320.0], mdot_mg_s: [5.0, 5.5]}]",
    ),
}  # fmt: skip


def start(
    name: str,
    folder: Path,
    *,
    fail: int = 0,
    full: bool = False,
    threads: int = 1,
    cores: int = 0,
    said: int = subprocess.DEVNULL,
) -> subprocess.Popen[str]:
    """Start a small run in a folder, in which all its paths lie.

    fail: which of its writes fails; full: on a full device, instead of at the opening. threads:
    what the environment asks for. cores: on how many of the machine's it runs; 0, on all.
    """
    temporary = folder / "tmp"
    temporary.mkdir(exist_ok=True)
    own = {
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parent / "layer"), str(ROOT)]),
        "EP2SINDY_ATTACK": json.dumps({"folder": str(folder), "fail": fail, "full": full}),
        **dict.fromkeys(NUMBERS, str(threads)),
        "TMPDIR": str(temporary),
        "JOBLIB_TEMP_FOLDER": str(temporary),
    }
    line = [f"+exp={name}", "output=out", *RUNS[name]]
    return subprocess.Popen(
        [sys.executable, "-m", "ep2sindy.app.main", *line],
        cwd=folder, env={**os.environ, **own}, stdin=subprocess.DEVNULL, stdout=said, stderr=said,
        text=True, preexec_fn=partial(_as_from_a_terminal, cores),
    )  # fmt: skip


def _as_from_a_terminal(cores: int) -> None:
    """A job in the background, and nohup, have signals ignored, and that is inherited."""
    for each in (signal.SIGINT, signal.SIGHUP):
        signal.signal(each, signal.SIG_DFL)
    if cores:
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:cores])


@dataclass(frozen=True)
class Reference:
    """A run that nothing disturbed. files: what it left, by name; writes: a letter for each."""

    place: Path
    duration_s: float
    files: dict[str, str]
    writes: str

    def copied(self, folder: Path) -> Path:
        """A folder with its data and an earlier run folder: where the same run may start."""
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(self.place / "data", folder / "data")
        for run in (self.place / "out").glob("*/*"):
            shutil.copytree(run, folder / "out" / run.parent.name / EARLIER)
        return folder


@cache
def reference(folder: Path, name: str) -> Reference:
    """Made twice, for the first may compile, and the same bytes must come; kept in a folder.

    Of other code, and other settings, it is another one.
    """
    place = folder / f"{name}_{_code(name)}"
    kept = place / "reference.json"
    if not kept.exists():
        print(f"the reference of {name}, twice ...", file=sys.stderr, flush=True)
        found = [_undisturbed(name, place) for _ in range(2)]
        duration_s, files = found[1]
        if differing := sorted({n for n, _ in files.items() ^ found[0][1].items()}):
            raise SystemExit(f"{name}: two undisturbed runs differ in {differing}; see {place}")
        writes = (place / "writes").read_text()
        kept.write_text(json.dumps({"duration_s": duration_s, "files": files, "writes": writes}))
    return Reference(place, **json.loads(kept.read_text()))


def _undisturbed(name: str, place: Path) -> tuple[float, dict[str, str]]:
    shutil.rmtree(place, ignore_errors=True)
    prepare(place / "data")
    (place / "out" / name).mkdir(parents=True)  # as where there was an earlier run
    begin = time.monotonic()
    run = start(name, place, said=subprocess.PIPE)
    printed, errors = run.communicate(timeout=LIMIT_S)
    if run.returncode:
        raise SystemExit(f"{name} must run when nothing disturbs it:\n{errors}")
    duration_s = time.monotonic() - begin
    return duration_s, finished(contents(place), run_folder(printed))


def _code(name: str) -> str:
    """What a reference depends on."""
    from ep2sindy.runtime.files import fingerprint

    configs = [path.read_text("utf-8") for path in sorted((ROOT / "conf").rglob("*.yaml"))]
    return fingerprint(json.dumps([RUNS[name], configs]), sources=ROOT / "ep2sindy")


def prepare(folder: Path) -> None:
    """The data of all runs, the same bytes each time."""
    import pandas as pd

    import ep2sindy as ep
    from benchmarks.regions import three_regions

    folder.mkdir(parents=True)
    ep.write_field(three_regions(n_z=6, n_r=5, n_samples=300).field, folder / "grid.nc")
    run = ep.lorenz().trajectory(noise=0.02, rng=0)
    table = pd.DataFrame(run.states[:1000], columns=list(run.state_names))
    table.insert(0, "time", run.t[:1000])
    table.to_csv(folder / "lorenz.csv", index=False)
