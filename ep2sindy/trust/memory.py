"""Memory is counted before it is asked for: a program that is killed for it can say nothing."""

from __future__ import annotations

import os
from pathlib import Path

UNCOUNTED = 2**28  # bytes that are not worth a look
CGROUP = Path("/sys/fs/cgroup")


def free_bytes() -> int:
    """What may still be taken: of the machine, and of the group of processes that we run in."""
    pages = "SC_AVPHYS_PAGES" if "SC_AVPHYS_PAGES" in os.sysconf_names else "SC_PHYS_PAGES"
    free = os.sysconf(pages) * os.sysconf("SC_PAGE_SIZE")
    try:  # what the system keeps of files, and gives back, counts as free
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = next(1024 * int(line.split()[1]) for line in lines if line[:13] == "MemAvailable:")
    except (OSError, StopIteration, ValueError):
        pass
    try:
        limit, used = ((CGROUP / f"memory.{name}").read_text() for name in ("max", "current"))
        free = min(free, int(limit) - int(used))
    except (OSError, ValueError):  # there is none, or it is "max"
        pass
    return max(free, 0)


def check_memory(n_bytes: float, what: str, *, way_out: str, each: float = 0.0) -> None:
    """Raise ValueError where an array, or several, would take more than there is.

    what, way_out: for the message. each: bytes of one piece; the message says how many would fit.
    """
    if n_bytes <= UNCOUNTED or n_bytes <= (free := free_bytes()):
        return
    fit = f", which hold {int(free // each)}" if each else ""
    raise ValueError(
        f"{what} would take {n_bytes / 1e9:.3g} GB of memory: {free / 1e9:.3g} GB are free{fit}; "
        f"{way_out}"
    )
