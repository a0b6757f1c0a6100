"""Crafted configs, models and stores: each is refused in our words, or read as harmless data.

`python -m tests.attack.crafted NOTES ARGUMENTS` runs the command line, and notes on the way what
no file from someone else may bring about.
"""

from __future__ import annotations

import os
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import CodeType
from typing import Any

from tests.attack import crafted_configs, crafted_files
from tests.attack.payloads import CANARY, Case
from tests.attack.results import Outcome

ROOT = Path(__file__).resolve().parents[2]
LIMIT_S, MEMORY = 600.0, 3 * 2**30  # of seconds on a machine that does other things
CASES: Mapping[str, Case] = {**crafted_configs.cases(), **crafted_files.cases()}

# Processes that the package and its libraries start themselves, whatever they are given.
OURS = ("rev-parse", "status", "ep2sindy.trust.probe", "ep2sindy.app.warm", "uname", "fc-list")
RUNS = {"os.system", "os.exec", "os.posix_spawn", "os.startfile", "pty.spawn"}
TALKS = {"socket.connect", "socket.bind", "socket.getaddrinfo", "socket.sendto"}
CHANGES = {
    "os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.link", "os.symlink", "os.truncate",
    "os.chmod", "os.chown", "os.utime", "shutil.rmtree", "shutil.move", "shutil.copyfile",
}  # fmt: skip
MODULES = {"this", "antigravity", "idlelib.idle"}  # that nothing here needs


def attack(folder: Path) -> Callable[[str], Outcome]:
    """The attack on one case, in a folder of its own."""

    def attacked(name: str) -> Outcome:
        own = folder / re.sub(r"\W+", "_", name)
        shutil.rmtree(own, ignore_errors=True)  # of a time before
        return judged(CASES[name], own)

    return attacked


def cases(n: int) -> Iterator[str]:
    return iter(list(CASES)[:n])


def judged(case: Case, folder: Path) -> Outcome:
    """Run a case in a process that betrays what it does, and look at what is left."""
    here, notes = folder / "here", folder / "notes"
    for place in (here, folder / "elsewhere", folder / "tmp"):
        place.mkdir(parents=True, exist_ok=True)
    case.lay_down(here)
    before = _contents(folder)
    line = [sys.executable, "-m", "tests.attack.crafted", str(notes), *case.arguments]
    env = {
        "PYTHONPATH": str(ROOT), "PATH": os.environ["PATH"], "HOME": str(folder / "tmp"),
        "TMPDIR": str(folder / "tmp"), "MPLCONFIGDIR": str(folder.parent / ".caches"),
        "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1",
    }  # fmt: skip
    run = subprocess.Popen(
        line, cwd=here, env=env, text=True, errors="replace", start_new_session=True,
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    )  # fmt: skip
    try:
        said = run.communicate(timeout=LIMIT_S)[1]
    except subprocess.TimeoutExpired:
        os.killpg(run.pid, 9)
        run.communicate()
        return "hang", f"over {LIMIT_S:g} s"
    if noted := notes.read_text("utf-8").splitlines():
        return "ran or wrote", noted[0]
    after = _contents(folder)
    if changed := [path for path, what in before.items() if after.get(path) != what]:
        return "ran or wrote", f"{changed[0]} is not what it was"
    if found := [path for path in after if _is_foul(path) and path not in before]:
        return "ran or wrote", found[0]
    return _spoken(case, run.returncode, said)


def _spoken(case: Case, status: int, said: str) -> Outcome:
    """Whether an end is one of ours: a refusal that names what is wrong, or nothing done."""
    if status == 0:
        return ("harmless" if case.may_pass else "taken"), said[-300:]
    _, error, message = f"\n{said}".rpartition("\nerror: ")
    if status < 0:
        return "crash", f"signal {-status}"
    if status != 1 or not error or "Traceback" in said:
        return "foreign words", said[-500:]
    if case.names not in message:
        return "foreign words", f"{case.names!r} is not named: {message[:300]}"
    return "refused", message[:300]


def _contents(folder: Path) -> dict[str, bytes]:
    """Paths of files below a folder, but those that the run may write, with what is in them."""
    files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def _is_foul(path: str) -> bool:
    allowed = ("notes", "tmp/", "here/outputs/", "here/.cache/")
    return CANARY in path or not path.startswith(allowed)


def watch(notes: Path) -> None:
    """Note what is run, called or written elsewhere from here on."""
    here = Path.cwd()
    allowed = [here, *(Path(os.environ[n]) for n in ("TMPDIR", "MPLCONFIGDIR")), Path("/dev/null")]
    out = os.open(notes, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)

    def note(what: str) -> None:
        os.write(out, f"{what[:300]}\n".encode(errors="replace"))

    def is_ours(place: Any) -> bool:
        if not isinstance(place, str | bytes | os.PathLike):
            return True  # a file that is open already
        path = Path(os.path.realpath(os.fsdecode(place)))
        return any(path.is_relative_to(each) for each in allowed) or "__pycache__" in path.parts

    def hook(event: str, given: tuple[Any, ...]) -> None:
        if event == "open":
            place, mode, flags = given
            writes = set(mode or "") & set("wax+") or flags & (os.O_WRONLY | os.O_RDWR)
            if writes and not is_ours(place):
                note(f"opens {place} for writing")
        elif event in CHANGES and not all(map(is_ours, given[:2])):
            note(f"{event}{given}")
        elif event == "subprocess.Popen":
            if not any(word in map(str, given[1]) for word in OURS):
                note(f"starts {given[1]}")
        elif event == "exec" and isinstance(given[0], CodeType) and CANARY in repr(_all(given[0])):
            note(f"executes {given[0].co_filename}")
        elif event == "import" and given[0] in MODULES:
            note(f"imports {given[0]}")
        elif event in RUNS or event in TALKS:
            note(f"{event}{given}")

    sys.addaudithook(hook)


def _all(code: CodeType) -> list[Any]:
    """Constants and names of compiled code and of all in it, but what stands in files."""
    if os.path.exists(code.co_filename):
        return []
    inner = [_all(each) for each in code.co_consts if isinstance(each, CodeType)]
    return [code.co_consts, code.co_names, inner]


def main() -> None:
    notes = Path(sys.argv[1])
    sys.argv[1:] = sys.argv[2:]
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    watch(notes)
    from ep2sindy.app.main import main as run

    run()


if __name__ == "__main__":
    main()
