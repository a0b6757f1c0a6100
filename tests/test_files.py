import errno
import json
import os
from datetime import datetime
from pathlib import Path

import numpy as np
import pytest

from ep2sindy.report.folder import RunFolder
from ep2sindy.runtime.files import WriteError, fingerprint, replacing, write_json, write_text

NOW = datetime(2026, 1, 2, 3, 4, 5)


@pytest.mark.parametrize("end", [KeyboardInterrupt, ValueError, OSError])
def test_an_interrupted_write_leaves_the_old_file(tmp_path: Path, end: type) -> None:
    target = tmp_path / "result.json"
    write_text(target, "old")

    def write() -> None:
        with replacing(target) as temporary:
            temporary.write_text("half of the n")
            raise end

    with pytest.raises(end):
        write()
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["result.json"]


def test_a_file_is_on_the_disk_before_it_takes_its_name_and_then_its_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[str] = []
    names = {tmp_path.stat().st_ino: "folder"}
    fsync, replace = os.fsync, os.replace

    def synced(number: int) -> None:
        done.append(f"sync {names.get(os.fstat(number).st_ino, 'file')}")
        fsync(number)

    def renamed(source: Path, target: Path) -> None:
        done.append("rename")
        replace(source, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    write_text(tmp_path / "b.txt", "text")
    assert done == ["sync file", "rename", "sync folder"]


def test_a_disk_that_is_full_at_the_sync_leaves_the_old_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = tmp_path / "a.txt"
    write_text(target, "old")

    def full(number: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(WriteError, match="a.txt could not be written .No space"):
        write_text(target, "new")
    assert target.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_a_fingerprint_knows_settings_and_source(tmp_path: Path) -> None:
    (tmp_path / "deeper").mkdir()
    source = tmp_path / "deeper" / "formula.py"
    source.write_text("x = 1")
    first = fingerprint("{}", sources=tmp_path)
    assert fingerprint("{}", sources=tmp_path) == first
    assert fingerprint("{a}", sources=tmp_path) != first
    source.write_text("x = 2")
    assert fingerprint("{}", sources=tmp_path) != first


def test_two_runs_in_one_second_get_two_folders(tmp_path: Path) -> None:
    first = RunFolder.create(tmp_path, "breathing", now=NOW)
    second = RunFolder.create(tmp_path, "breathing", now=NOW)
    assert first.path == tmp_path / "breathing" / "2026-01-02_030405"
    assert second.path == tmp_path / "breathing" / "2026-01-02_030405_2"


def test_a_folder_that_cannot_be_written_is_an_error_with_a_way_out(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file")
    with pytest.raises(OSError, match="a run needs a folder it can write to.*output=PATH"):
        RunFolder.create(tmp_path / "taken", "breathing", now=NOW)


def test_json_has_null_for_what_is_not_a_number(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"a": [1.0, float("nan")], "b": {"c": float("inf")}})
    content = json.loads((tmp_path / "a.json").read_text())
    assert content == {"a": [1.0, None], "b": {"c": None}}


def test_provenance_names_commit_and_versions(tmp_path: Path) -> None:
    folder = RunFolder.create(tmp_path, "x", now=NOW)
    folder.write_provenance(seed=3, command=["run", "+exp=x"])
    content = json.loads((folder.path / "provenance.json").read_text())
    assert content["seed"] == 3
    assert content["commit"]
    assert content["versions"]["numpy"] == np.__version__
