"""A file layer in every process of a run: it counts the writes below some folders, and one fails.

Python imports this at its start where the folder of this file is on PYTHONPATH, workers too. A
letter of every write goes to the file `writes`: o, a new file; a, an old one; m, a folder; r, a
rename. The write of the number `fail` is refused, or its file is one of a device that is full.
"""

import errno
import json
import os
import sys

ASKED = json.loads(os.environ["EP2SINDY_ATTACK"])  # folder; fail; full
BELOW = tuple(os.path.join(ASKED["folder"], name, "") for name in ("out", "kept", "cache"))


def _heard(event: str, given: tuple) -> None:
    if event not in ("open", "os.rename", "os.mkdir"):
        return
    place = given[event == "os.rename"]
    if not isinstance(place, str | bytes | os.PathLike):
        return  # an open file's number
    path = os.path.abspath(os.fsdecode(place))
    letter = _letter(event, path, given) if os.path.join(path, "").startswith(BELOW) else ""
    if letter and _number(letter) == ASKED["fail"]:
        _fail(path, full=ASKED["full"] and letter == "o")


def _letter(event: str, path: str, given: tuple) -> str:
    """What kind of write this is; empty for none."""
    there = os.path.lexists(path)
    if event == "open":
        writes = given[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        return ("a" if there else "o") if writes else ""
    return "r" if event == "os.rename" else "" if there else "m"


def _number(letter: str) -> int:
    """Of this write among those of all processes: what is appended is appended at once."""
    counts = os.open(
        os.path.join(ASKED["folder"], "writes"), os.O_WRONLY | os.O_APPEND | os.O_CREAT
    )
    os.write(counts, letter.encode())
    number = os.lseek(counts, 0, os.SEEK_CUR)
    os.close(counts)
    return number


def _fail(path: str, *, full: bool) -> None:
    with open(os.path.join(ASKED["folder"], "failed"), "w", encoding="utf-8") as file:
        file.write(path)
    if full:
        os.symlink("/dev/full", path)
    else:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


sys.addaudithook(_heard)
