"""Files that are no files, that ask for too much, and that end the library that reads them."""

import os
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from ep2sindy.data.readers.registry import open_source
from ep2sindy.trust import guard

X = np.arange(6.0)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="pipes of POSIX")
def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.csv")
    for path in (tmp_path / "a.csv", Path("/dev/zero")):
        with pytest.raises(ValueError, match="a file or a folder must come"):
            open_source(path)


def test_values_in_other_files_are_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = X
    with h5py.File(tmp_path / "link.h5", "w") as file:
        file["x"] = h5py.ExternalLink("other.h5", "x")
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file.create_dataset("x", (6,), "f8", external=[(str(tmp_path / "raw"), 0, 48)])
    with h5py.File(tmp_path / "virtual.h5", "w") as file:
        layout = h5py.VirtualLayout((6,), "f8")
        layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "x", (6,))
        file.create_virtual_dataset("x", layout)
    for name, match in (
        ("link", "is in another"),
        ("raw", "are in other"),
        ("virtual", "are in other"),
    ):
        with pytest.raises(ValueError, match=f"{name}.h5 cannot be read: .*{match} file"):
            open_source(tmp_path / f"{name}.h5")


def test_an_array_larger_than_its_file_can_hold_is_refused(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("x", (2**40,), "f8", chunks=(1024,))
    with pytest.raises(ValueError, match=r"'/x' would take 8.8e\+12 bytes"):
        open_source(tmp_path / "a.h5")


def test_groups_too_deep_are_refused_and_a_circle_is_not_walked_twice(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "deep.h5", "w") as file:
        file["/".join("g" * 100) + "/x"] = X
    with pytest.raises(ValueError, match="more than 64 deep"):
        open_source(tmp_path / "deep.h5")
    with h5py.File(tmp_path / "circle.h5", "w") as file:
        file["g/x"] = X
        file["g/again"] = file["g"]
    assert "g/x" in open_source(tmp_path / "circle.h5").names


def test_json_too_deep_is_an_error_of_ours(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("[" * 100_000)
    with pytest.raises(ValueError, match="a.json cannot be read: maximum recursion"):
        open_source(tmp_path / "a.json")


def test_an_archive_that_unpacks_without_end_is_refused(tmp_path: Path) -> None:
    np.savez_compressed(tmp_path / "a.npz", x=np.zeros(2**26))
    with pytest.raises(ValueError, match="'x.npy' would take"):
        open_source(tmp_path / "a.npz")


def test_a_file_that_ends_its_library_ends_not_the_program(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Stood in for by a process that kills itself; the next file is read by a new one."""
    savemat(tmp_path / "a.mat", {"x": X})
    savemat(tmp_path / "b.mat", {"x": X})
    with monkeypatch.context() as patched:
        patched.setattr(guard, "_prober", killed_at_once)
        with pytest.raises(ValueError, match=r"a.mat cannot be read: .*breaks down .*SIGSEGV"):
            open_source(tmp_path / "a.mat")
    assert open_source(tmp_path / "b.mat").names == ["x"]


def test_a_process_that_ended_between_two_files_is_started_again(tmp_path: Path) -> None:
    """Ctrl-C in a notebook ends it: every file after it was refused for a broken pipe."""
    for name in ("a", "b"):
        savemat(tmp_path / f"{name}.mat", {"x": X})
    open_source(tmp_path / "a.mat")
    ended = guard._prober(os.getpid())
    ended.kill()
    ended.wait()
    assert open_source(tmp_path / "b.mat").names == ["x"]


def test_the_answer_on_an_interrupted_file_is_not_taken_for_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "damaged.mat").write_bytes(b"\0" * 200)
    savemat(tmp_path / "sound.mat", {"x": X})

    def interrupted(prober: object, patience_s: float) -> bool:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(guard, "_answers", interrupted)
        with pytest.raises(KeyboardInterrupt):
            guard.look_through_first(tmp_path / "damaged.mat", "HDF5")
    assert open_source(tmp_path / "sound.mat").names == ["x"]


def killed_at_once(process: int) -> object:
    import subprocess
    import sys

    dying = "import os, sys; sys.stdin.readline(); os.kill(os.getpid(), 11)"
    return subprocess.Popen(
        [sys.executable, "-c", dying], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )


killed_at_once.cache_clear = lambda: None  # type: ignore[attr-defined]
