"""Runs of which one write fails: they say so, and earlier files are whole; or they recover."""

from __future__ import annotations

import random
import subprocess
from collections.abc import Callable
from pathlib import Path

from tests.attack.left import amiss, contents, half_written, is_temporary, living, lost, run_folder
from tests.attack.results import Outcome
from tests.attack.runs import LIMIT_S, RUNS, Reference, reference, start

REASON = "No space left on device"
WAYS_OUT = (
    "make room",
    "choose another",
    "where a run writes is chosen with output=PATH",
    "start the same run again",
)


def failing(folder: Path) -> Callable[[str], Outcome]:
    """The attack on case RUN-NUMBER-HOW: the write of that number is refused, or finds no room."""

    def attacked(case: str) -> Outcome:
        name, number, how = case.split("-")
        whole = reference(folder, name)
        place = whole.copied(folder / "failing")
        before = contents(place)
        run = start(name, place, fail=int(number), full=how == "full", said=subprocess.PIPE)
        try:
            printed, errors = run.communicate(timeout=LIMIT_S)
        except subprocess.TimeoutExpired:
            run.kill()
            return "hang", f"over {LIMIT_S:g} s {living(place)}"
        if not (place / "failed").exists():
            return "fewer writes", ""
        failed = Path((place / "failed").read_text()).relative_to(place)
        wrong = living(place)
        if run.returncode == 0:
            wrong += amiss(contents(place), run_folder(printed), whole.files)
            return ("swallowed" if wrong else "recovered"), f"{failed} {wrong or ''}"
        wrong += _left(place, before, whole)
        if wrong:
            return wrong[0].partition(":")[0], f"{failed} {wrong}"
        return _spoken(run.returncode, errors, failed)

    return attacked


def _left(place: Path, before: dict[str, str], whole: Reference) -> list[str]:
    after = contents(place)
    wrong = lost(after, before) + half_written(place, after, before, whole.files)
    return wrong + [f"left over: {name}" for name in after if is_temporary(name)]


def _spoken(status: int, errors: str, failed: Path) -> Outcome:
    """Whether a run ended in words: which file, or its folder, why, and the way out."""
    said = (errors.strip().splitlines() or [""])[-1]
    named = any(str(p) in said for p in (failed, failed.parent) if p != Path("."))
    way_out = any(way in said for way in WAYS_OUT)
    good = status == 1 and said.startswith("error: ") and named and REASON in said and way_out
    foreign = "Traceback" in errors
    return ("refused with path" if good and not foreign else "foreign"), (
        f"{failed} status {status} {'with a traceback ' * foreign}{said}"
    )


def drawn(folder: Path, n: int, seed: int) -> list[str]:
    """Some of all writes of all runs, each once before one comes again.

    A new file finds a device that is full, and is refused when it comes again; any other write,
    and all where there is no such device, can only be refused.
    """
    chance, has_full = random.Random(seed), Path("/dev/full").exists()
    first, again = [], []
    for name in RUNS:
        for k, letter in enumerate(reference(folder, name).writes, start=1):
            twice = letter == "o" and has_full
            first.append(f"{name}-{k}-{'full' if twice else 'refused'}")
            again += [f"{name}-{k}-refused"] * twice
    for each in (first, again):
        chance.shuffle(each)
    return [*first, *again][:n]
