"""Termination of a run by a signal, handled like Ctrl-C, and termination of its workers."""

from __future__ import annotations

import os
import signal
import threading
import time
from functools import cache
from types import FrameType

ENDING = ("SIGTERM", "SIGHUP")  # sent by batch systems, and by terminals that close

LOOK_S = 0.5  # interval at which a worker checks its parent


def end_as_interrupted() -> None:
    """Make termination signals raise KeyboardInterrupt, as Ctrl-C does."""
    for name in ENDING:
        number = getattr(signal, name, None)  # Windows has no SIGHUP
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, _interrupt)  # not if `nohup` has set the signal to be ignored


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt(signal.Signals(number).name)


def is_interruption(error: BaseException) -> bool:
    """True for an interruption, also one that came while a compiled kernel was called.

    Numba reports that as a SystemError, which the interruption caused, perhaps by way of others.
    """
    cause: BaseException | None = error
    while isinstance(cause, SystemError):
        cause = cause.__cause__
    return isinstance(cause, KeyboardInterrupt)


@cache
def end_with(parent: int) -> None:
    """End this process soon after its parent, because a killed run cannot notify its workers.

    May be called before every piece of work; only one watching thread is started.
    """
    if hasattr(os, "getppid"):
        threading.Thread(target=_watch, args=(parent,), daemon=True).start()


def _watch(parent: int) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_S)
    os._exit(1)
