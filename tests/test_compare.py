"""Run folders side by side, and the jobs of a sweep."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.app.compare import main as compare
from ep2sindy.runtime.files import write_json

CONFIG = (
    "experiment: discover\nseed: 0\n"
    "search: {_target_: ep2sindy.TrajectorySearch, max_terms: MOST}\n"
)


def model(slope: float, width: float, *more: str) -> ep.SparseModel:
    """x' = slope x, known to within `width`, and 1 for every other term."""
    library = ep.polynomial(["x", "y"], degree=2)
    coef = ep.model.coef_matrix(library, [{"x": slope}, dict.fromkeys(more, 1.0)])
    n = int(np.count_nonzero(coef))
    covariance = np.diag(np.full(n, (width / 1.96) ** 2))
    return ep.SparseModel(library, ["x", "y"], coef, {"x": "m", "y": "1"}, {}, covariance)


def run_folder(
    folder: Path, found: Mapping[str, ep.SparseModel], *, most: int, headline: Mapping[str, float]
) -> Path:
    (folder / "figures").mkdir(parents=True)
    for name, each in found.items():
        each.save(folder / "models" / f"{name}.json")
    (folder / "config.yaml").write_text(CONFIG.replace("MOST", str(most)))
    summary = {"experiment": "discover", "seed": 0, "headline": headline}
    (folder / "summary.json").write_text(json.dumps(summary))
    provenance = {"commit": "c" * 40, "versions": {"numpy": f"2.{most}"}}
    (folder / "provenance.json").write_text(json.dumps(provenance))
    return folder


@pytest.fixture
def runs(tmp_path: Path) -> tuple[Path, Path]:
    close, apart = model(-2.0, 0.1, "y"), model(-3.0, 0.1, "y", "x*y")
    first, second = {"one": close, "same": close}, {"one": apart, "same": close, "extra": apart}
    return (
        run_folder(tmp_path / "first", first, most=3, headline={"one/f_kHz": 1.5, "one/r2": 0.5}),
        run_folder(tmp_path / "second", second, most=4, headline={"one/f_kHz": 2.0}),
    )


def test_two_runs_are_set_side_by_side(
    runs: tuple[Path, Path], capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    compare([*map(str, runs), "--page", str(tmp_path / "both.html")])
    printed = capsys.readouterr().out
    rows = [" ".join(line.replace("│", " ").split()) for line in printed.splitlines()]
    for row in (
        "search.max_terms 3 4",
        "one: frequency 1.5 kHz 2 kHz +33 %",
        "x' x -2 ±0.1 -3 ±0.1 apart",
        "y' y 1 ±0.1 1 ±0.1 overlap",
        "y' x y - 1 ±0.1 -",
    ):
        assert row in rows


def test_the_jobs_of_a_sweep_are_compared_but_for_those_that_failed(
    runs: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sweep, page = tmp_path / "sweep", tmp_path / "page.html"
    records = {2: {"folder": str(runs[1])}, 10: {"error": "no"}, 11: {}}  # the last: a part
    for job, record in records.items():
        write_json(sweep / "jobs" / f"{job}.json", record)
    with pytest.raises(ValueError, match="to compare takes two runs or more"):
        compare([str(sweep)])
    write_json(sweep / "jobs" / "0.json", {"folder": str(runs[0])})
    capsys.readouterr()
    compare([str(sweep), "--page", str(page)])
    printed = capsys.readouterr().out
    left_out = "left out: job 10 failed: no\nleft out: job 11 has no result of its own\n"
    assert printed.startswith(left_out)
    assert "search.max_terms" in printed
    assert page.is_file()
    write_json(sweep / "jobs" / "3.json", {"folder": 1})
    with pytest.raises(ValueError, match=r"3\.json cannot be read: it is damaged"):
        compare([str(sweep)])
