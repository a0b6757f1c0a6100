"""Compile every kernel once, before test workers start: each would compile all of them again."""

import subprocess
import sys
from pathlib import Path

import numpy as np

import ep2sindy as ep

PACKAGE = Path(ep.__file__).parent


def search() -> None:
    """Kernels of the smoother, the rows and the searches."""
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=np.random.default_rng(0))
    ep.discover(run)
    for method in (ep.AdaptiveLasso(), ep.STLSQ(), ep.BestSubset()):
        ep.discover(run, recipe=ep.Recipe(ep.Differential(), method, ep.Bootstraps(n=2), ep.Knee()))


def simulation() -> None:
    """Kernels of the simulator and of the refinement."""
    settings = {"duration_s": 2e-5, "warm_up_s": 0.0, "sample_s": 1e-6, "n_cells": 20}
    ep.simulate(ep.Thruster(), ep.OperatingPoint(300.0, 5.0), progress=False, **settings)
    system = ep.lotka_volterra()
    ep.refine(system.model, [system.trajectory()], window=20, n_windows=2, rng=0)


def plane() -> None:
    """Kernels of the (z, r) simulator."""
    settings = {"duration_s": 2e-5, "warm_up_s": 0.0, "sample_s": 1e-6, "n_z": 12, "n_r": 12}
    ep.simulate_2d(progress=False, **settings)


def compile_kernels() -> None:
    """Where a source is newer than what was compiled of it; both at once: there are two cores."""
    sources = [*PACKAGE.rglob("*kernels.py"), *PACKAGE.glob("*/gram_fits.py")]
    if not any(is_stale(source) for source in sources if "@compiled" in source.read_text()):
        return
    parts = [
        subprocess.Popen([sys.executable, "-m", "tests.warm", name])
        for name in ("search", "simulation", "plane")
    ]
    for part in parts:
        part.wait()  # one that fails fails again in its test, which then says why


def is_stale(source: Path) -> bool:
    kept = (source.parent / "__pycache__").glob(f"{source.stem}.*.nbi")
    return max((path.stat().st_mtime for path in kept), default=0.0) < source.stat().st_mtime


if __name__ == "__main__":
    {"search": search, "simulation": simulation, "plane": plane}[sys.argv[1]]()
