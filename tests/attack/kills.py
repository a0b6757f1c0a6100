"""Runs that are ended at random moments, and runs that share their folders: nothing is lost."""

from __future__ import annotations

import random
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

from tests.attack.left import amiss, contents, half_written, living, lost, run_folder
from tests.attack.results import Outcome
from tests.attack.runs import LIMIT_S, RUNS, Reference, reference, start

SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGKILL")


def killed(folder: Path, seed: int) -> Callable[[str], Outcome]:
    """The attack on case RUN-NUMBER: the run is ended by a signal, and started again."""

    def attacked(case: str) -> Outcome:
        name = case.partition("-")[0]
        whole = reference(folder, name)
        place = whole.copied(folder / "killed")
        chance = random.Random(f"{seed} {case}")
        moment_s, sign = chance.uniform(0.0, whole.duration_s), chance.choice(SIGNALS)
        wrong = _ended(name, place, whole, moment_s=moment_s, sign=sign)
        wrong = wrong or ended_well(start(name, place, said=subprocess.PIPE), place, whole)
        words = f"{sign} after {moment_s:.1f} of {whole.duration_s:.1f} s"
        return (wrong[0].partition(":")[0] if wrong else "same bytes"), f"{words} {wrong or ''}"

    return attacked


def _ended(name: str, place: Path, whole: Reference, *, moment_s: float, sign: str) -> list[str]:
    """What is wrong after a run was ended at a moment."""
    run = start(name, place)
    time.sleep(moment_s)
    before = contents(place)
    run.send_signal(getattr(signal, sign))
    try:
        run.wait(timeout=10.0)
    except subprocess.TimeoutExpired:
        run.kill()
        return [f"alive: the run itself {living(place)}"]
    alive = living(place)
    after = contents(place)
    return alive + lost(after, before) + half_written(place, after, before, whole.files)


def ended_well(run: subprocess.Popen[str], place: Path, whole: Reference) -> list[str]:
    """What is wrong with a run that is to come to its end as the reference did."""
    try:
        printed, errors = run.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        run.kill()
        return [f"hang: over {LIMIT_S:g} s {living(place)}"]
    if run.returncode:
        return [f"status {run.returncode}: {errors[-300:]}"]
    return amiss(contents(place), run_folder(printed), whole.files) + living(place)


def paired(folder: Path, seed: int) -> Callable[[str], Outcome]:
    """The attack on case RUN-NUMBER: two of the run at once, in the same folders."""

    def attacked(case: str) -> Outcome:
        name = case.partition("-")[0]
        whole = reference(folder, name)
        place = whole.copied(folder / "paired")
        before = contents(place)
        chance = random.Random(f"{seed} {case}")
        first = start(name, place, said=subprocess.PIPE)
        time.sleep(chance.choice([0.0, chance.uniform(0.0, whole.duration_s)]))
        second = start(name, place, said=subprocess.PIPE)
        ends = [_end_of(each) for each in (first, second)]
        after = contents(place)
        wrong = living(place) + lost(after, before)
        wrong += half_written(place, after, before, whole.files)
        for status, printed, errors in ends:
            if status == 0:
                wrong += amiss(after, run_folder(printed), whole.files)
            elif status != 1 or not errors.startswith("error: "):
                wrong.append(f"status {status}: {errors}")
        kind = "both ended" if all(status == 0 for status, _, _ in ends) else "one refused"
        return (wrong[0].partition(":")[0] if wrong else kind), f"{wrong or ''}"

    return attacked


def elsewhere(folder: Path, **machine: int) -> Callable[[str], Outcome]:
    """The attack on case RUN: another number of threads, or of cores and so of workers."""

    def attacked(case: str) -> Outcome:
        whole = reference(folder, case)
        place = whole.copied(folder / "elsewhere")
        wrong = ended_well(start(case, place, **machine, said=subprocess.PIPE), place, whole)
        return (wrong[0].partition(":")[0] if wrong else "same bytes"), f"{wrong or ''}"

    return attacked


def _end_of(run: subprocess.Popen[str]) -> tuple[int, str, str]:
    """Status, what it printed, and the last line of its errors."""
    try:
        printed, errors = run.communicate(timeout=LIMIT_S)
    except subprocess.TimeoutExpired:
        run.kill()
        return -1, "", "hang"
    return run.returncode, printed, (errors.strip().splitlines() or [""])[-1]


def in_turn(n: int) -> list[str]:
    names = list(RUNS)
    return [f"{names[k % len(names)]}-{k // len(names)}" for k in range(n)]
