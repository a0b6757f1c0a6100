"""Kernels are compiled once, and a run says at once what it is."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numba.core import config, cpu

from ep2sindy.app import precompile
from ep2sindy.runtime import compilation, screen


def full() -> None:
    raise OSError(28, "No space left on device")


@pytest.fixture
def compilations(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[bool]:
    """What comes of each compilation, the next one first; the cache lies in `tmp_path`."""
    outcomes = [True, True, True]
    monkeypatch.setattr(screen, "SAID", set())
    monkeypatch.setenv("EP2SINDY_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(precompile, "collect", lambda *_: None if outcomes.pop(0) else full())
    return outcomes


def test_kernels_are_compiled_once_and_reported_to_be(
    compilations: list[bool], capsys: pytest.CaptureFixture[str]
) -> None:
    precompile.precompile()
    assert capsys.readouterr().err == f"{compilation.ANNOUNCEMENT}\n"
    precompile.precompile()
    assert capsys.readouterr().err == ""
    assert len(compilations) == 2


def test_numba_is_left_as_it_is_and_knows_that_arrays_are_separate() -> None:
    @compilation.compiled(**compilation.LOOPS)
    def double(values: Any, doubled: Any) -> None:
        for k in range(len(values)):
            doubled[k] = 2.0 * values[k]

    double._cache.disable()
    double(np.ones(2), np.empty(2))
    (llvm,) = double.inspect_llvm().values()
    heads = [line for line in llvm.splitlines() if line.startswith("define") and "double" in line]
    assert "ptr noalias" in heads[0].split("%arg.", 1)[1]
    assert not hasattr(cpu.CPUTargetOptions, "noalias")
    assert os.environ.get("NUMBA_CACHE_DIR", "") == config.CACHE_DIR


def test_kernels_are_compiled_again_where_a_source_has_changed(
    compilations: list[bool], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    source = tmp_path / "my_kernels.py"
    source.write_text("one")
    monkeypatch.setattr(precompile, "sources", lambda: [source])
    precompile.precompile()
    source.write_text("longer")
    precompile.precompile()
    assert len(compilations) == 1


def test_what_kernels_import_compiles_them_again_too() -> None:
    """Columns of a table and constants stand in other files, and are compiled in."""
    kernels = compilation._kernels_in(compilation.PACKAGE / "thruster" / "axial")
    watched = {path.name for path in (*kernels, *compilation._imported(kernels))}
    assert {"collision_kernels.py", "closures.py", "constants.py"} <= watched
    assert watched | {"compilation.py"} <= {path.name for path in compilation.sources()}


CHECKED = """
import numpy as np
from ep2sindy.app.precompile import PARTS
from ep2sindy.regression.gram_kernels import factorise
for part in PARTS:
    part()
try:
    factorise(np.eye(2), np.empty(1, dtype=np.int64), np.eye(2))
except IndexError:
    print("checked")
"""


@pytest.mark.slow
def test_no_kernel_reads_or_writes_past_its_arrays(tmp_path: Path) -> None:
    """Numba checks no index unless it is asked to, in kernels that are compiled for this."""
    env = {**os.environ, "NUMBA_BOUNDSCHECK": "1", "EP2SINDY_CACHE": str(tmp_path)}
    command = [sys.executable, "-c", CHECKED]
    done = subprocess.run(command, env=env, capture_output=True, text=True)
    assert done.stdout == "checked\n", done.stderr


CALL = """
import sys
sys.path.insert(0, sys.argv[1])
import my_kernels
"""


def called(
    folder: Path, *arguments: str, env: dict[str, str] | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run a kernel that calls another, or other arguments, by a process of its own."""
    env = (os.environ if env is None else env) | environment
    command = [sys.executable, *(arguments or ("-c", CALL, str(folder)))]
    return subprocess.run(command, env=env, capture_output=True, text=True, check=True)


@pytest.fixture
def kernels(tmp_path: Path) -> Path:
    folder = tmp_path / "own"
    folder.mkdir()
    start = "from ep2sindy.runtime.compilation import compiled\n"
    (folder / "inner.py").write_text(f"{start}@compiled\ndef inner(x):\n    return x + 1.0\n")
    program = (
        f"{start}from inner import inner\n@compiled\ndef twice(x):\n    return 2.0 * inner(x)\n"
    )
    own = "import numba\n@numba.njit\ndef own(x):\n    return x\n"
    (folder / "my_kernels.py").write_text(f"{own}{program}print(own(twice(1.5)))\n")
    return folder


def homeless(folder: Path) -> dict[str, str]:
    """The environment of a user without a home, whom the system does not know either."""
    (folder / "sitecustomize.py").write_text("import pwd\npwd.getpwuid = {}.__getitem__\n")
    return {"PYTHONPATH": f"{folder}{os.pathsep}{compilation.PACKAGE.parent}"}


NO_HOME = compilation.not_kept(
    OSError("this user has no home folder; EP2SINDY_CACHE names a folder")
)


def test_a_user_without_a_home_can_call_kernels(kernels: Path) -> None:
    run = called(kernels, env=homeless(kernels))
    assert (run.stdout, run.stderr) == ("5.0\n", f"{compilation.ANNOUNCEMENT}\n{NO_HOME}\n")


def test_a_kernel_that_does_not_fit_on_the_disk_is_compiled(kernels: Path, tmp_path: Path) -> None:
    full = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))\n"
    run = called(kernels, "-c", full + CALL, str(kernels), EP2SINDY_CACHE=str(tmp_path / "cache"))
    assert run.stdout == "5.0\n"
    assert run.stderr.count("\n") == 2
    assert "ep2sindy: compiled kernels are not kept: " in run.stderr


@pytest.mark.slow
def test_a_program_without_a_home_says_once_that_nothing_is_kept(tmp_path: Path) -> None:
    """Two workers compile too, and say nothing."""
    study = (
        "+exp=benchmark variants=[ours] systems=[lotka_volterra] n_realizations=1 parallel.n_jobs=2"
    )
    command = ["-m", "ep2sindy.app.main", *study.split(), f"output={tmp_path}"]
    run = called(tmp_path, *command, env=homeless(tmp_path))
    assert "ours, selected exactly right" in run.stdout
    said = [line for line in run.stderr.splitlines() if line.startswith("ep2sindy: ")]
    assert said == [compilation.ANNOUNCEMENT, NO_HOME]


def test_a_kernel_is_kept_where_one_may_write_and_follows_what_it_calls(
    kernels: Path, tmp_path: Path
) -> None:
    cache = str(tmp_path / "cache")
    first = called(kernels, EP2SINDY_CACHE=cache)
    assert (first.stdout, first.stderr) == ("5.0\n", f"{compilation.ANNOUNCEMENT}\n")
    assert list((tmp_path / "cache" / "kernels").rglob("*.nbi"))
    again = called(kernels, EP2SINDY_CACHE=cache)
    assert (again.stdout, again.stderr) == ("5.0\n", "")
    inner = kernels / "inner.py"
    inner.write_text(inner.read_text().replace("x + 1.0", "x + 1.25"))
    assert called(kernels, EP2SINDY_CACHE=cache).stdout == "5.5\n"
    assert not list(kernels.rglob("*.nbi"))


def test_what_was_broken_off_is_taken_up_again(compilations: list[bool]) -> None:
    compilations.insert(0, False)
    precompile.precompile()
    precompile.precompile()
    assert len(compilations) == 2


def test_a_folder_that_cannot_be_written_costs_no_run(
    compilations: list[bool], tmp_path: Path
) -> None:
    (tmp_path / "cache").write_text("a file")
    precompile.precompile()
    assert len(compilations) == 3
    with pytest.raises(SystemExit, match="error: .*cannot be a cache: "):
        precompile.main([])


@pytest.mark.parametrize("part", precompile.PARTS)
def test_parts_of_the_package_that_call_kernels_run(part: Callable[[], None]) -> None:
    part()


@pytest.mark.slow
def test_every_kernel_is_compiled_and_then_none_is(tmp_path: Path) -> None:
    """From nothing; and a search, a refinement and a simulation find all that they call."""
    environment = os.environ | {"EP2SINDY_CACHE": str(tmp_path)}
    command = [sys.executable, "-m", "ep2sindy.app.main", "precompile"]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert compilation.ANNOUNCEMENT in run.stderr
    kept = {path.name.split("-")[0] for path in tmp_path.rglob("*.nbi")}
    texts = {
        path.stem: path.read_text("utf-8").split("\n@compiled")[1:] for path in precompile.sources()
    }
    names = {
        f"{stem}.{part.split('def ', 1)[1].split('(', 1)[0]}"
        for stem, parts in texts.items()
        for part in parts
        if not part.startswith('(inline="always")')  # part of those that call them
    }
    assert names - kept == set()
    again = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert again.stderr == ""
