"""The Python of README and docs runs as it stands, block after block of a page."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

from ep2sindy.data.open import write_field
from ep2sindy.synthetic.regions import three_regions

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
WITH_PYTHON = [page for page in PAGES if "```python" in page.read_text("utf-8")]

pytestmark = pytest.mark.slow


def blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text("utf-8"), re.DOTALL)


@pytest.mark.parametrize("page", WITH_PYTHON, ids=lambda page: page.name)
def test_the_python_of_a_page_runs(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In an empty folder that holds the files which pages open: run.h5 and grid.nc."""
    monkeypatch.chdir(tmp_path)
    write_field(three_regions(n_z=6, n_r=5, n_samples=300).field, tmp_path / "grid.nc")
    write_h5(tmp_path / "run.h5")
    known: dict = {}
    threads = torch.get_num_threads()
    for block in blocks(page):
        exec(compile(block, page.name, "exec"), known)
    torch.set_num_threads(threads)


def write_h5(path: Path) -> None:
    """What docs/data.md opens: names and units of its own."""
    import h5py

    with h5py.File(path, "w") as file:
        file["t"], file["z"] = np.linspace(0.0, 400.0, 201), np.linspace(1.0, 3.0, 11)
        wave = 1.0 + 0.5 * np.sin(np.linspace(0.0, 40.0, 201))[:, None] * np.ones(11)
        for name in ("ni", "nn", "rate", "uz"):
            file[name] = 1e12 * wave


def test_pysindys_examples_take_no_more_lines_here() -> None:
    page = (ROOT / "docs" / "pysindy.md").read_text("utf-8")
    pairs = [re.findall(r"```python\n(.*?)```", row, re.DOTALL) for row in page.split("<tr>")]
    compared = [pair for pair in pairs if len(pair) == 2]
    assert len(compared) == 6
    for theirs, ours in compared:
        assert "ps." in theirs or "model." in theirs
        assert "ps." not in ours
        assert len(ours.splitlines()) <= len(theirs.splitlines()), ours
