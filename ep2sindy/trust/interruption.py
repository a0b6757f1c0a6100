"""The end of a run by a signal: as Ctrl-C ends it, and its workers with it."""

from __future__ import annotations

import os
import signal
import threading
import time
from functools import cache
from types import FrameType

ENDING = ("SIGTERM", "SIGHUP")  # of batch systems and of terminals that close

LOOK_S = 0.5  # between two looks of a worker at its parent


def end_as_interrupted() -> None:
    """Let signals that ask the process to end raise KeyboardInterrupt, as Ctrl-C does."""
    for name in ENDING:
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _interrupt)  # `nohup` asked to ignore it: then it is


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt(signal.Signals(number).name)


@cache
def end_with(parent: int) -> None:
    """End this process soon after its parent: a run that was killed tells its workers nothing.

    May be called before every piece of work; one watch is kept.
    """
    if hasattr(os, "getppid"):
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os._exit(1)
