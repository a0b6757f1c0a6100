"""Check of memory before it is allocated: a process killed for lack of memory gives no message."""

from __future__ import annotations

import os
from pathlib import Path

UNCOUNTED = 2**28  # bytes up to which no check is made
CGROUP = Path("/sys/fs/cgroup")


def free_bytes() -> int:
    """Free memory in bytes: of the machine, or of our control group if that has less."""
    pages = "SC_AVPHYS_PAGES" if "SC_AVPHYS_PAGES" in os.sysconf_names else "SC_PHYS_PAGES"
    free = os.sysconf(pages) * os.sysconf("SC_PAGE_SIZE")
    try:  # MemAvailable includes the page cache, which the system gives back on demand
        lines = Path("/proc/meminfo").read_text().splitlines()
        free = next(1024 * int(line.split()[1]) for line in lines if line[:13] == "MemAvailable:")
    except (OSError, StopIteration, ValueError):
        pass
    try:
        limit, used = ((CGROUP / f"memory.{name}").read_text() for name in ("max", "current"))
        free = min(free, int(limit) - int(used))
    except (OSError, ValueError):  # there is no limit, or it reads "max"
        pass
    return max(free, 0)


def check_memory(n_bytes: float, what: str, *, hint: str, each: float = 0.0) -> None:
    """Raise ValueError if one or several arrays would take more memory than is free.

    what, hint: texts for the message. each: bytes per piece; if given, the message says how
    many pieces would fit.
    """
    if n_bytes <= UNCOUNTED or n_bytes <= (free := free_bytes()):
        return
    fit = f", which hold {int(free // each)}" if each else ""
    raise ValueError(
        f"{what} would take {n_bytes / 1e9:.3g} GB of memory: {free / 1e9:.3g} GB are free{fit}; "
        f"{hint}"
    )
