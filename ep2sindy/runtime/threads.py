"""Restriction of linear algebra and PyTorch to one thread.

Sums are then always added in the same order, and no time is lost on synchronising threads over
small arrays. Independent work runs in parallel processes instead (`parallel.py`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from threading import Lock
from typing import Any

from threadpoolctl import ThreadpoolController

# Environment variables that OpenMP and linear algebra libraries read when they are loaded.
NUMBERS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def start_on_one_thread() -> None:
    """Limit this process and its children to one thread each; call before NumPy is imported."""
    os.environ.update(dict.fromkeys(NUMBERS, "1"))


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread within this context, also in PyTorch if it is loaded.

    The previous number of threads is restored by the last to leave, since threads of Python that
    compute at once . Also works as a decorator.
    """
    torch = sys.modules.get("torch")  # not imported here, since the import is slow
    n_threads = torch.get_num_threads() if torch else 1
    with _INSIDE.lock:
        if not _INSIDE.count:
            _INSIDE.limits, _INSIDE.n_before = _pools(len(sys.modules)).limit(limits=1), n_threads
        _INSIDE.count += 1
    try:
        if torch:
            torch.set_num_threads(1)
        yield
    finally:
        with _INSIDE.lock:
            _INSIDE.count -= 1
            if not _INSIDE.count:
                _INSIDE.limits.restore_original_limits()
                n_threads = max(n_threads, _INSIDE.n_before)
        if torch:
            torch.set_num_threads(n_threads)


@dataclass
class _Inside:
    """Who computes on one thread now; the limits of the pools, and PyTorch's threads before."""

    lock: Lock = field(default_factory=Lock)
    count: int = 0
    limits: Any = None
    n_before: int = 1


_INSIDE = _Inside()


@lru_cache(maxsize=1)
def _pools(n_modules: int) -> ThreadpoolController:
    """Thread pools of all loaded libraries, found anew when the number of modules changes."""
    return ThreadpoolController()
