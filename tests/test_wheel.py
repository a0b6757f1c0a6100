"""The wheel, installed where nothing else is: its program runs from an empty folder."""

import json
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from tests.test_trust_folder import CSV

ROOT = Path(__file__).resolve().parents[1]

pytestmark = pytest.mark.slow


def run(*command: object, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        list(map(str, command)), cwd=cwd, capture_output=True, text=True, check=False
    )


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """`ep2sindy` in a fresh virtual environment, from the wheel and the tested set."""
    folder = tmp_path_factory.mktemp("wheel")
    steps: Sequence[Sequence[object]] = [
        [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", folder, ROOT],
        [sys.executable, "-m", "venv", folder / "venv"],
        [folder / "venv/bin/pip", "install", "-q", "-c", ROOT / "constraints.txt", "torch"],
        [folder / "venv/bin/pip", "install", "-q", "-c", ROOT / "constraints.txt", "WHEEL"],
    ]
    for step in steps:
        wheel = next(folder.glob("*.whl"), "WHEEL")
        result = run(*(wheel if part == "WHEEL" else part for part in step), cwd=folder)
        assert result.returncode == 0, result.stderr
    return folder / "venv" / "bin" / "ep2sindy"


def test_the_wheel_brings_its_configs_and_says_so(program: Path, tmp_path: Path) -> None:
    result = run(program, "--help", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "exp: benchmark, breathing, constrained, discover" in result.stdout
    assert "--config-dir" in result.stdout


def test_the_wheel_brings_its_stubs(program: Path, tmp_path: Path) -> None:
    code = (
        "import ep2sindy as ep\n"
        "from importlib.resources import files\n"
        "assert (files('ep2sindy') / 'py.typed').is_file()\n"
        "assert (files('ep2sindy') / 'thruster' / '__init__.pyi').is_file()\n"
        "print(ep.thruster.Thruster().channel_length, ep.prepare.crop.__name__)\n"
    )
    result = run(program.parent / "python", "-c", code, cwd=tmp_path)
    assert result.stdout == "0.025 crop\n", result.stderr


def test_the_main_job_runs_from_an_empty_folder(program: Path, tmp_path: Path) -> None:
    short = ["data.duration_s=0.3e-3", "data.warm_up_s=0.0", "data.n_cells=30"]
    result = run(program, "+exp=breathing", *short, "libraries.ionization.degree=2", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    folder = tmp_path / Path(result.stdout.splitlines()[-1].removeprefix("open: ")).parent
    assert (folder / "summary.json").is_file()
    assert (folder / "report.html").is_file()


def test_one_bad_job_of_three_leaves_two_results_and_its_error(
    program: Path, tmp_path: Path
) -> None:
    t = np.arange(0.0, 30.0, 0.05)
    table = np.column_stack([t, np.sin(t), np.cos(t)])
    np.savetxt(tmp_path / "run.csv", table, delimiter=",", header="time,x,y", comments="")
    result = run(program, "-m", *CSV, "seed=0,-1,1", cwd=tmp_path)
    assert result.returncode == 1
    paths = sorted(tmp_path.glob("outputs/multirun/*/jobs/*.json"))
    jobs = [json.loads(path.read_text()) for path in paths]
    assert jobs[1]["error"].startswith("seed must be a whole number, zero or more: -1")
    for k in (0, 2):
        summary = json.loads((tmp_path / jobs[k]["folder"] / "summary.json").read_text())
        found = summary["headline"]["model/f_kHz"]
        assert found == pytest.approx(1e-3 / (2 * np.pi), rel=0.01)
    assert "ep2sindy compare outputs/multirun/" in result.stdout
