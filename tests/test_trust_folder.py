"""A folder full of what others wrote: nothing of it is run but what is named."""

import subprocess
import sys
import sysconfig
from collections.abc import Iterator, Sequence
from pathlib import Path

import h5py
import numpy as np
import pytest

from ep2sindy.report.folder import commit
from ep2sindy.runtime.parallel import Loky
from ep2sindy.trust.user_code import load_user_module, own_packages

PROGRAM = Path(sysconfig.get_path("scripts")) / "ep2sindy"
SPY = "with open({ran!r}, 'a') as file:\n    print(__name__, file=file)\n"
CSV = (
    "+exp=discover", "data=file", "data.path=run.csv", "data.z.name=null",
    "data.variables.n_i.name=null", "data.variables.n_n.name=null",
    "+data.variables.x.name=x", "+data.variables.x.unit=1",
    "+data.variables.y.name=y", "+data.variables.y.unit=1", "trajectory.states=[x,y]",
)  # fmt: skip
RUNS: dict[str, Sequence[str]] = {
    "inspect": ("inspect", "run.h5"),
    "discover": CSV,
    "workers": (
        "+exp=benchmark", "systems=[oscillator]", "noises=[0]", "variants=[STLSQ]",
        "n_realizations=2", "parallel=loky",
    ),
    "compare": ("compare", "run.h5"),
    "theirs": ("+exp=theirs",),
}  # fmt: skip
FAST = ("inspect", "theirs")
REFUSED = ("compare", "theirs")
CALL = "{{_target_: os.system, command: 'echo called >> {ran}'}}"
CONFIGS = {
    "theirs": f"defaults: [discover]\nexperiment: theirs\nprepare: [{CALL}]\n",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every module that there is stands here by its name, and notes that it is run."""
    folder = tmp_path_factory.mktemp("downloads")
    spy = SPY.format(ran=str(folder / "ran"))
    loaded = {name.partition(".")[0] for name in sys.modules}
    for name in {*sys.stdlib_module_names, *loaded, "cupy", "sitecustomize"} - {"ep2sindy"}:
        (folder / f"{name}.py").write_text(spy)
    for package in ("ep2sindy", "hydra_plugins", "json5", "sparse"):
        (folder / package).mkdir()
        (folder / package / "__init__.py").write_text(spy)
        (folder / package / "mine.py").write_text(spy)
    (folder / "conf" / "exp").mkdir(parents=True)
    for name, text in CONFIGS.items():
        config = "# @package _global_\n" + text.format(ran=folder / "ran")
        (folder / "conf" / "exp" / f"{name}.yaml").write_text(config)
    t, x, _ = write_csv(folder / "run.csv").T
    with h5py.File(folder / "run.h5", "w") as file:
        file["time"], file["x"] = t, x
    return folder


def write_csv(path: Path) -> np.ndarray:
    t = 0.05 * np.arange(400)
    rows = np.column_stack([t, np.sin(t) + 2.0, np.cos(t)])
    np.savetxt(path, rows, delimiter=",", header="time,x,y", comments="")
    return rows


CASES = [pytest.param(run, marks=() if run in FAST else pytest.mark.slow) for run in RUNS]


@pytest.mark.parametrize("run", CASES)
def test_nothing_of_the_folder_is_imported(run: str, folder: Path) -> None:
    command = [sys.executable, str(PROGRAM), *RUNS[run]]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert not (folder / "ran").exists(), (folder / "ran").read_text()
    assert done.returncode == (run in REFUSED), done.stderr


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder for modules of one's own, of which none is left behind."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    yield tmp_path
    for module in own_packages():
        for name in [each for each in sys.modules if each.partition(".")[0] == module.__name__]:
            del sys.modules[name]


def test_modules_of_a_folder_import_each_other_by_its_name(here: Path) -> None:
    (here / "studies").mkdir()
    (here / "studies" / "tools.py").write_text("value = 2\n")
    (here / "studies" / "mine.py").write_text("from studies.tools import value\n")
    assert load_user_module("studies.mine").value == 2
    (here / "pack").mkdir()
    (here / "pack" / "__init__.py").write_text("from pack.inner import value\n")
    (here / "pack" / "inner.py").write_text("value = 3\n")
    assert load_user_module("pack").value == 3


@pytest.mark.parametrize("name", ["json", "numpy"])
def test_a_module_by_the_name_of_another_is_refused(name: str, here: Path) -> None:
    (here / f"{name}.py").write_text("raise AssertionError('this ran')\n")
    with pytest.raises(ModuleNotFoundError, match=f"{name!r} is another's; rename it"):
        load_user_module(name)


@pytest.mark.slow
def test_workers_get_the_code_of_ones_own(here: Path) -> None:
    (here / "mine.py").write_text("def double(x):\n    return 2 * x\n")
    found = Loky(2).run(load_user_module("mine").double, range(3))
    assert sorted(found) == [(0, 0), (1, 2), (2, 4)]


def test_the_commit_is_not_that_of_a_folder_around(tmp_path: Path) -> None:
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    (tmp_path / "inside").mkdir()
    assert commit(tmp_path / "inside") == "unknown: not a git checkout"
