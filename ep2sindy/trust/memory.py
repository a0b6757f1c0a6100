"""Check of memory and width before they are asked for: what is killed gives no message."""

from __future__ import annotations

import os
from pathlib import Path

UNCOUNTED = 2**28  # bytes up to which no check is made
MAX_WIDTH = 5000  # arrays or columns of a file, each of which takes its time
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


def check_width(n: int, what: str, limit: int = MAX_WIDTH) -> None:
    """Raise ValueError for a file of more than `limit` columns, or whatever `what` names."""
    if n > limit:
        raise ValueError(
            f"a file must have at most {limit} {what}, got {n}: keep what you need, and write a "
            "grid as one array, in NetCDF"
        )
