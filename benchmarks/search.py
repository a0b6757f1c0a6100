"""CPU time and memory of `ep.discover` on ten million samples: `python -m benchmarks.search`.

Lorenz with 5 % noise and a library of ten terms, by the thesis's method, by one threshold sweep,
and by the default with a limit of a minute, each in a process of its own: its peak of memory is
that of one call. A name runs that call alone. Prints the table of docs/scale.md.
"""

import resource
import subprocess
import sys
import time
import warnings

import numba
import numpy as np
from threadpoolctl import threadpool_limits

import ep2sindy as ep
from ep2sindy.discovery.result import DiscoveryMethod

N_SAMPLES = 10_000_000
METHODS: dict[str, DiscoveryMethod] = {
    "STLSQ": ep.Regression(ep.Differential(), ep.STLSQ(), ep.Knee(), ep.Bootstraps(n=0)),
    "thesis": ep.Regression(
        ep.Differential(), ep.AdaptiveLasso(), ep.Knee(), ep.Bootstraps(n=32, n_culled=1)
    ),
    "limit_s=60": ep.TrajectorySearch(limit_s=60.0),
}


def measure(name: str) -> None:
    """Print time and peak memory of one call."""
    start = ep.lorenz().trajectory()
    states = lorenz_states(N_SAMPLES, start.states[0], start.dt_s)
    rng = np.random.default_rng(0)
    for column in states.T:
        column += 0.05 * column.std() * rng.normal(size=N_SAMPLES)
    states.flags.writeable = False  # so that the record takes it, and no copy
    run = ep.Trajectory(start.dt_s * np.arange(N_SAMPLES), states, start.state_names)
    del states
    with threadpool_limits(limits=1), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        # Compiles or loads what it needs.
        ep.discover(run.window(0, 3000), method=METHODS[name], seed=0)
        before_GiB, began, began_cpu = peak_GiB(), time.monotonic(), time.process_time()
        found = ep.discover(run, method=METHODS[name], seed=0)
    cpu_s, wall_s = time.process_time() - began_cpu, time.monotonic() - began
    print(
        f"{N_SAMPLES} samples, {name}: {cpu_s:.0f} CPU-s, {wall_s:.0f} s, {peak_GiB():.2f} GiB at "
        f"most (before the call {before_GiB:.2f})\n{found}",
        flush=True,
    )


@numba.njit
def lorenz_states(n: int, start: np.ndarray, step_s: float) -> np.ndarray:
    """States of Lorenz's system at n samples, by classical Runge-Kutta steps."""
    states, slope = np.empty((n, 3)), np.zeros(3)
    states[0] = start
    for k in range(1, n):
        x, total = states[k - 1], np.zeros(3)
        for lead, weight in ((0.0, 1.0), (0.5, 2.0), (0.5, 2.0), (1.0, 1.0)):
            u, v, w = x + lead * step_s * slope
            slope = np.array([10.0 * (v - u), u * (28.0 - w) - v, u * v - 8.0 / 3.0 * w])
            total += weight / 6.0 * step_s * slope
        states[k] = x + total
    return states


def peak_GiB() -> float:
    """Largest memory of this process so far; kilobytes on Linux, bytes on macOS."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    if names := sys.argv[1:]:
        measure(*names)
    else:
        for name in METHODS:
            subprocess.run([sys.executable, "-m", "benchmarks.search", name], check=True)


if __name__ == "__main__":
    main()
