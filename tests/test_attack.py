"""The attack itself: what it must see, it sees."""

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests.attack import crafted, left
from tests.attack.payloads import Case
from tests.attack.writes import _spoken

RUN = Path("out/weak/2026-01-01_000000")
LAYER = Path(left.__file__).parent / "layer"
WRITES = """
import os, sys
from pathlib import Path

Path("out").mkdir(exist_ok=True)
for name in ("out/a", "elsewhere"):
    try:
        Path(name).write_text("x" * 10)
        os.replace(name, name + "b")
    except OSError as error:
        print(name, error.strerror)
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """What a run left: a result, a log, a page that says how long it took, and a kept block."""
    for name in ("summary.json", "run.log", "tensorboard/events", "report.html"):
        (tmp_path / RUN / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / RUN / name).write_text("{\n}\n")
    (tmp_path / "kept").mkdir()
    np.savez(tmp_path / "kept" / "z0.npz", a=np.ones(3))
    return tmp_path


def test_the_same_files_are_the_same_but_for_what_time_it_took(folder: Path) -> None:
    expected = left.finished(left.contents(folder), RUN)
    assert set(expected) == {"summary.json", "run.log", "report.html", "kept/z0.npz"}
    (folder / RUN / "summary.json").write_text('{\n  "wall_s": 2.5,\n}\n')
    assert left.amiss(left.contents(folder), RUN, expected) == []


def test_files_that_are_missing_changed_or_left_over_are_seen(folder: Path) -> None:
    expected = left.finished(left.contents(folder), RUN)
    (folder / RUN / "summary.json").write_text("{")
    (folder / RUN / "report.html").unlink()
    (folder / "kept" / ".z1-0-1.npz").write_text("")
    found = left.amiss(left.contents(folder), RUN, expected)
    assert {"differs: summary.json", "missing: report.html"} < set(found)
    assert "left over: kept/.z1-0-1.npz" in found


def test_what_was_whole_and_is_gone_is_lost(folder: Path) -> None:
    before = left.contents(folder)
    (folder / RUN / "run.log").write_text("a longer log")
    assert left.lost(left.contents(folder), before) == []
    (folder / "kept" / "z0.npz").unlink()
    (folder / RUN / "summary.json").write_text("{")
    found = left.lost(left.contents(folder), before)
    assert sorted(found) == ["lost: kept/z0.npz", f"lost: {RUN}/summary.json"]
    (folder / RUN / "pointwise.nc").write_text("")  # of which the block is a part
    assert len(left.lost(left.contents(folder), before)) == 1


def test_a_broken_run_may_leave_fewer_files_but_none_half(folder: Path) -> None:
    whole = left.contents(folder)
    expected = left.finished(whole, RUN)
    (folder / RUN / "report.html").unlink()
    assert left.half_written(folder, left.contents(folder), {}, expected) == []
    (folder / RUN / "summary.json").write_text("{")
    (folder / "kept" / "z0.npz").write_bytes((folder / "kept" / "z0.npz").read_bytes()[:-9])
    found = left.half_written(folder, left.contents(folder), {}, expected)
    assert set(found) == {"half-written: kept/z0.npz", f"half-written: {RUN}/summary.json"}


@pytest.mark.parametrize(
    ("fail", "full", "said", "there"),
    [
        (0, False, "", ["ab"]),
        (2, False, "out/a No space left on device\n", []),
        (3, False, "out/a No space left on device\n", ["a"]),
        pytest.param(
            2, True, "out/a No space left on device\n", ["a"],
            marks=pytest.mark.skipif(not Path("/dev/full").exists(), reason="no such device"),
        ),
    ],
)  # fmt: skip
def test_the_layer_fails_one_write_of_the_run(
    tmp_path: Path, fail: int, full: bool, said: str, there: list[str]
) -> None:
    asked = json.dumps({"folder": str(tmp_path), "fail": fail, "full": full})
    own = {"EP2SINDY_ATTACK": asked, "PYTHONPATH": str(LAYER)}
    done = subprocess.run(
        [sys.executable, "-c", WRITES], cwd=tmp_path, env={**os.environ, **own},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout == said
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == there
    assert (tmp_path / "elsewhereb").exists()
    assert (tmp_path / "writes").read_text() == ("mo" if fail == 2 else "mor")
    assert (tmp_path / "failed").exists() == bool(fail)


def test_processes_of_a_run_are_found_whoever_their_parent_is(tmp_path: Path) -> None:
    mark = {"EP2SINDY_ATTACK": json.dumps({"folder": str(tmp_path)})}
    with subprocess.Popen(
        [sys.executable, "-c", "input()"], stdin=subprocess.PIPE, env={**os.environ, **mark}
    ) as run:
        (found,) = left.living(tmp_path, timeout_s=0.0)
        assert f"alive: {run.pid}" in found
    assert run.returncode == -9
    assert left.living(tmp_path, timeout_s=0.0) == []


def test_an_end_in_foreign_words_is_told_from_one_in_ours() -> None:
    ours = "error: out/a.csv could not be written (No space left on device); make room there"
    failed = Path("out/a.csv")
    assert _spoken(1, f"a warning\n{ours}\n", failed)[0] == "refused with path"
    for status, errors in ((0, ours), (1, f"Traceback\n{ours}"), (1, "error: no space"), (1, "")):
        assert _spoken(status, errors, failed)[0] == "foreign"


SONGS = {
    "writes": ("open('../elsewhere/song', 'w').write('x')", "opens ../elsewhere/song for writing"),
    "runs": ("import os; os.system('true')", "os.system"),
    "starts": ("import subprocess; subprocess.run(['true'])", "starts ['true']"),
    "removes": ("import os; os.remove('../elsewhere/there')", "os.remove"),
    "talks": ("import socket; socket.socket(type=2).connect(('127.0.0.1', 9))", "socket.connect"),
}


@pytest.fixture(scope="module")
def betrayed(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, str]:
    """What is made of a run of a module that does all of this, and what was noted of it."""
    folder = tmp_path_factory.mktemp("sung")
    (folder / "elsewhere").mkdir()
    (folder / "elsewhere" / "there").write_text("")
    song = "\n".join(code for code, _ in SONGS.values())
    case = Case(("+exp=weak", "study=own.song"), {"own/song.py": song}, names="own")
    kind, _ = crafted.judged(case, folder)
    return kind, (folder / "notes").read_text("utf-8")


@pytest.mark.slow
@pytest.mark.parametrize("noted", [noted for _, noted in SONGS.values()], ids=SONGS)
def test_a_config_that_runs_something_is_betrayed(noted: str, betrayed: tuple[str, str]) -> None:
    """A module of one's own may be run, and stands here for what must not be."""
    kind, notes = betrayed
    assert kind == "ran or wrote", notes
    assert noted in notes
