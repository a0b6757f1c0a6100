"""Test of files in a separate process, since a damaged file can crash the library that reads it."""

from __future__ import annotations

import json
import os
import select
import signal
import subprocess
from functools import cache, lru_cache
from pathlib import Path
from threading import Lock

from ep2sindy.trust.limits import size_of
from ep2sindy.trust.user_code import isolate

PATIENCE_S = 20.0  # plus the time at SPEED, which is slower than any disk
SPEED = 1e7  # bytes per s

_LOCK = Lock()


def look_through_first(path: Path, reader: str) -> None:
    """Raise ValueError for a file that cannot be read to its end, or that crashes its library.

    reader: name of the reader that will open the file. The test process is started once and kept.
    A file is not tested again until its size or date changes.
    """
    stat = path.stat()
    if said := _verdict(path.absolute(), reader, stat.st_size, stat.st_mtime_ns):
        raise ValueError(f"a file must be readable to its end: {said}")


@lru_cache(maxsize=1000)  # bounded, because a process may read files for weeks
def _verdict(path: Path, reader: str, size: int, changed_ns: int) -> str:
    with _LOCK:
        prober = _prober(os.getpid())
        if prober.poll() is not None:  # it may have ended since, as by Ctrl-C in a notebook
            _end(prober)
            prober = _prober(os.getpid())
        patience_s = PATIENCE_S + size_of(path) / SPEED
        try:
            line = _ask(prober, [str(path), reader], patience_s)
        except BaseException:  # or a late answer would be taken as the one for the next file
            _end(prober)
            raise
        if line:
            return str(json.loads(line))
        status = _end(prober)
    if line is None:
        return f"reading it was given up after {patience_s:.0f} s"
    by = signal.Signals(-status).name if status < 0 else f"status {status}"
    return f"the library that reads it breaks down over it ({by})"


def _ask(prober: subprocess.Popen, file: list[str], patience_s: float) -> bytes | None:
    """Answer of the test process about a file; empty if it crashes, None if it takes too long."""
    assert prober.stdin is not None
    assert prober.stdout is not None
    prober.stdin.write(json.dumps(file).encode() + b"\n")
    prober.stdin.flush()
    return prober.stdout.readline() if _answers(prober, patience_s) else None


def _end(prober: subprocess.Popen) -> int:
    """Kill the test process if it still runs, and return its exit status."""
    _prober.cache_clear()
    prober.kill()
    return prober.wait()


def _answers(prober: subprocess.Popen, patience_s: float) -> bool:
    """True if the test process answers or ends in time."""
    if os.name == "nt":
        return True  # on Windows, select does not work with pipes
    assert prober.stdout is not None
    return bool(select.select([prober.stdout], [], [], patience_s)[0])


@cache
def _prober(process: int) -> subprocess.Popen:
    """Start the test process, one for each of our processes: a fork must not share its parent's."""
    command, environment = isolate("ep2sindy.trust.probe")
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        env={**environment, "MALLOC_PERTURB_": "165"},  # makes reads of freed memory fail reliably
    )
