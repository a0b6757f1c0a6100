"""The wheel, installed where nothing else is: its program runs from an empty folder."""

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import pytest

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
        "print(ep.thruster.Thruster().channel_length, ep.data.crop.__name__)\n"
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
