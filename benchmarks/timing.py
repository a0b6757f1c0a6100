"""CPU time of a call."""

import time
from collections.abc import Callable

import numpy as np


def cpu_s(run: Callable[[], object], *, n_runs: int) -> float:
    """Median CPU time of a few runs, after one that warms caches."""
    run()
    times = []
    for _ in range(n_runs):
        start = time.process_time()
        run()
        times.append(time.process_time() - start)
    return float(np.median(times))
