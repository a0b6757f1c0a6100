"""One thread: sums come in one order, and threads do not wait for each other over small arrays.

What is independent runs side by side in processes instead (`parallel.py`).
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache

from threadpoolctl import ThreadpoolController

# Read by OpenMP and by the libraries of linear algebra when they are loaded.
NUMBERS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def start_on_one_thread() -> None:
    """Keep this process, and those that it starts, on one thread each; before NumPy is imported."""
    os.environ.update(dict.fromkeys(NUMBERS, "1"))


@contextmanager
def one_thread() -> Iterator[None]:
    """Compute on one thread, also in PyTorch if it is loaded; then on as many as before.

    Serves as a decorator too.
    """
    torch = sys.modules.get("torch")  # nobody need wait for it here
    n_threads = torch.get_num_threads() if torch else 1
    with _pools(len(sys.modules)).limit(limits=1):
        try:
            if torch:
                torch.set_num_threads(1)
            yield
        finally:
            if torch:
                torch.set_num_threads(n_threads)


@lru_cache(maxsize=1)
def _pools(n_modules: int) -> ThreadpoolController:
    """The pools of threads of all libraries, which are looked for again once more are loaded."""
    return ThreadpoolController()
