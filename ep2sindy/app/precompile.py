"""`ep2sindy precompile`: compile every kernel once, so that no run waits for compilation.

Runs of the command line begin with it; once it is done, it takes no time.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from hashlib import sha256
from pathlib import Path

import numpy as np

import ep2sindy as ep
from ep2sindy.model.many import WindowSteps, run_many
from ep2sindy.model.vector_field import VectorField
from ep2sindy.runtime.compilation import ANNOUNCEMENT, UNKEPT, digest, not_kept, sources
from ep2sindy.runtime.files import cache_folder
from ep2sindy.runtime.parallel import Loky, collect
from ep2sindy.runtime.progress import Bars
from ep2sindy.runtime.screen import say, say_once

ABOUT = """Compiles all kernels of the package, once after installation: a minute on two cores.
Runs of the command line do so by themselves; in Python, a call compiles what it uses."""


def main(arguments: Sequence[str]) -> None:
    """Compile, and report where the kernels are kept."""
    argparse.ArgumentParser("ep2sindy precompile", description=ABOUT).parse_args(arguments)
    try:
        place = _stamp().parent
        precompile()
    except OSError as error:
        sys.exit(f"error: {error}")
    say(f"all kernels are compiled; they are kept in {place}")


def precompile() -> None:
    """Compile all kernels with a message, unless this machine has compiled these sources."""
    try:
        stamp = _stamp()
    except OSError as error:  # every process compiles what it uses
        say_once(ANNOUNCEMENT)
        say_once(not_kept(error))
        return
    if stamp.exists():
        return
    say_once(ANNOUNCEMENT)
    with suppress(OSError):  # on a full disk, the next run repeats this half minute
        collect(Loky(), _compile, PARTS, Bars().stage(len(PARTS), "part"))
        stamp.mkdir()


def _stamp() -> Path:
    """A folder that is there once all kernels are compiled from these sources, on this machine.

    Raises OSError if kernels cannot be kept.
    """
    import numba
    from llvmlite.binding import get_host_cpu_name

    versions = f"{digest(sources())}{numba.__version__}{sys.version}{get_host_cpu_name()}"
    return cache_folder("kernels", f"warm_{sha256(versions.encode()).hexdigest()[:16]}")


def _compile(part: Callable[[], None]) -> None:
    part()
    for error in UNKEPT[:1]:
        raise error


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
    cycle = ep.model.limit_cycle(oscillator, np.array([2.0, 0.0]), period_s=7.63)
    assert cycle is not None
    ep.model.basin_stability(oscillator, cycle, n_starts=1)


def _refinement() -> None:
    """Compile refinement, trial runs, and the simulator along the axis."""
    point, step_s = ep.thruster.OperatingPoint(300.0, 5.0), 1e-7
    for n_samples in (20, 60):  # in one piece, and in several pieces, which are slices
        ep.thruster.simulate(
            ep.thruster.Thruster(), point, duration_s=n_samples * step_s, warm_up_s=0.0,
            sample_s=step_s, n_cells=20, progress=False,
        )  # fmt: skip
    system = ep.lotka_volterra()
    for step in (ep.refinement.RungeKutta(), ep.refinement.FusedRungeKutta()):
        method = ep.refinement.MultipleShooting(step=step)
        ep.refine(system.model, system.trajectory(), window=20, n_windows=2, method=method)
    steps = WindowSteps.along(np.array([0.0, 0.1]), None, np.zeros(1, np.int64), 2, 1)
    model = system.model
    field = VectorField.of(model.library, model.states, model.coef[None])
    run_many(field, np.ones((1, 2)), steps, centre=np.ones(2), reach=np.ones(2))


def _plane() -> None:
    """Compile the (z, r) simulator."""
    ep.thruster.simulate_2d(
        duration_s=2e-5, warm_up_s=0.0, sample_s=1e-6, n_z=12, n_r=12, progress=False
    )


PARTS = (_search, _refinement, _plane)
