"""`ep2sindy warm`: compile every kernel once, so that no run waits for compilation.

Runs of the command line begin with it; once it is done, it takes no time.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from hashlib import sha256
from pathlib import Path

import numpy as np

import ep2sindy as ep
from ep2sindy.model.many import DrivenWindows, Ensemble
from ep2sindy.runtime.compilation import ANNOUNCEMENT, digest, sources, tell_each_kernel
from ep2sindy.runtime.progress import Bars
from ep2sindy.runtime.screen import say
from ep2sindy.runtime.user_cache import cache_folder
from ep2sindy.trust.user_code import isolate

ABOUT = """Compiles all kernels of the package, once after installation: a minute on two cores.
Runs of the command line do so by themselves; in Python, a call compiles what it uses."""


def main(arguments: Sequence[str]) -> None:
    """Compile, and report where the kernels are kept."""
    argparse.ArgumentParser("ep2sindy warm", description=ABOUT).parse_args(arguments)
    try:
        place = _stamp().parent
    except OSError as error:
        sys.exit(f"error: {error}")
    warm()
    say(f"all kernels are compiled; they are kept in {place}")


def warm() -> None:
    """Compile all kernels with a message, unless this machine has compiled these sources."""
    try:
        stamp = _stamp()
    except OSError:  # every process compiles what it uses, and says so
        return
    if stamp.exists():
        return
    say(ANNOUNCEMENT, error=True)
    if not _compiled_side_by_side():
        return
    with suppress(OSError):  # on a full disk, the next run repeats this half minute
        stamp.mkdir()


def _stamp() -> Path:
    """A folder that is there once all kernels are compiled from these sources, on this machine.

    Raises OSError if kernels cannot be kept.
    """
    import numba
    from llvmlite.binding import get_host_cpu_name

    versions = f"{digest(sources())}{numba.__version__}{sys.version}{get_host_cpu_name()}"
    return cache_folder("kernels", f"warm_{sha256(versions.encode()).hexdigest()[:16]}")


def _compiled_side_by_side() -> bool:
    """Run all parts in separate processes; returns whether all succeeded, and reports failures."""
    inlined = '\n@compiled(inline="always")'  # compiled as part of their callers
    texts = [path.read_text("utf-8") for path in sources()]
    n_kernels = sum(text.count("\n@compiled") - text.count(inlined) for text in texts)
    reader, writer = os.pipe()
    command, environment = isolate("ep2sindy.app.warm")
    parts = [subprocess.Popen([*command, each], stdout=writer, env=environment) for each in PARTS]
    os.close(writer)
    with open(reader, encoding="utf-8") as lines, Bars().stage(n_kernels, "kernel") as advance:
        names: set[str] = set()  # parts share some names
        for name in lines:
            advance(int(name not in names))
            names.add(name)
    statuses = [part.wait() for part in parts]
    return not any(statuses)


def _search() -> None:
    """Compile smoothers, rows, searches, estimates, free runs, forecasts and runs to a cycle."""
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    found = ep.discover(run)
    for method in (ep.AdaptiveLasso(), ep.STLSQ(), ep.BestSubset()):
        ep.discover(
            run, method=ep.Regression(ep.Differential(), method, ep.Knee(), ep.Bootstraps(n=2))
        )
    found.model.simulate(run.t, run.states[0])
    found.forecast(run, 1.0)
    oscillator = ep.systems.van_der_pol(mu=2.0).model
    cycle = ep.limit_cycle(oscillator, np.array([2.0, 0.0]), period_s=7.63)
    assert cycle is not None
    ep.share_reaching(oscillator, cycle, n_starts=1)


def _refinement() -> None:
    """Compile refinement, trial runs, and the simulator along the axis."""
    point, step_s = ep.thruster.OperatingPoint(300.0, 5.0), 1e-7
    for n_samples in (20, 60):  # in one piece, and in several pieces, which are slices
        brief = partial(
            ep.thruster.simulate, duration_s=n_samples * step_s, warm_up_s=0.0, sample_s=step_s
        )
        brief(ep.thruster.Thruster(), point, n_cells=20, progress=False)
    system = ep.lotka_volterra()
    for step in (ep.refinement.RungeKutta(), ep.refinement.HermiteSimpson()):
        method = ep.refinement.MultipleShooting(step=step)
        ep.refine(system.model, system.trajectory(), window=20, n_windows=2, method=method)
    model = system.model
    windows = DrivenWindows.free(np.ones((2, 1)), step_s=0.1, n_samples=3)
    Ensemble(model.library, model.states, model.coef[..., None]).paths(
        windows, centre=np.ones(2), spread=np.ones(2)
    )


def _plane() -> None:
    """Compile the (z, r) simulator."""
    step_s = 1e-6
    brief = partial(ep.thruster.simulate_2d, duration_s=20 * step_s, warm_up_s=0.0, sample_s=step_s)
    brief(n_z=12, n_r=12, progress=False)


PARTS: Mapping[str, Callable[[], None]] = {
    "search": _search,
    "refinement": _refinement,
    "plane": _plane,
}


if __name__ == "__main__":
    tell_each_kernel(lambda name: print(name, flush=True))
    PARTS[sys.argv[1]]()
