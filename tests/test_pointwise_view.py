from html import unescape
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from omegaconf import OmegaConf

from ep2sindy.app.runner import start_run
from ep2sindy.discovery.regimes import find_regimes
from ep2sindy.studies.pointwise import add_result
from tests.models import point_study
from tests.programs import summary_of

TERMS = {"1": "m^-3 s^-1", "n_n": "s^-1", "n_i*u_iz": "m^-1"}


def study() -> xr.Dataset:
    """12 points: n_i' = -40 n_i u_iz, but 0 at two of them; n_n' = 10^22..10^23 or 3e4 n_n.

    A quarter of the points with n_n has a small constant next to it. The last point is no plasma.
    """
    coef, weight = np.zeros((2, 2, 3, 12))
    coef[0, 2], weight[0, 2] = -40.0, -1.0
    coef[0, 2, [1, 4]] = weight[0, 2, [1, 4]] = 0.0
    coef[1, 0, :3], weight[1, 0, :3] = 1e22, 1.0
    coef[1, 0, 1] = 1e23
    coef[1, 1, 3:], weight[1, 1, 3:] = 3e4, 1.0
    coef[1, 0, 5:7], weight[1, 0, 5:7], weight[1, 1, 5:7] = 1e20, 0.05, 0.95
    draws = np.stack([weight] * 2)
    draws[:, 1, :, 0] = [0.0, 1.0, 0.0]  # the bootstraps put this point into the other regime
    coef, weight, draws = (v.reshape(*v.shape[:-1], 4, 3) for v in (coef, weight, draws))
    lost = np.zeros((4, 3), dtype=bool)
    lost[-1, -1] = True
    return point_study(coef, weight, lost, terms=TERMS, fraction=np.abs(weight), draws=draws)


def written(result: xr.Dataset, folder: Path) -> Path:
    """The folder of a run with this result."""
    config = OmegaConf.create({"experiment": "toy", "seed": 0, "output": str(folder)})
    with start_run(config) as report:
        found = find_regimes(result, rng=np.random.default_rng(0), max_regimes=4)
        add_result(report, result, found, wall_s=1.0)
        report.finish(formats=())
    return report.folder.path


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(study(), tmp_path_factory.mktemp("outputs"))


def stated(folder: Path) -> tuple[str, str]:
    """The log in one line, and the page."""
    log = " ".join((folder / "run.log").read_text().split())
    return log, unescape((folder / "report.html").read_text())


def test_equations_without_terms_are_counted(folder: Path) -> None:
    assert summary_of(folder)["no_terms"] == {"n_i": 2}
    for text in stated(folder):
        assert "11 fitted, 1 no plasma; no term in n_i' at 2" in text


def test_medians_come_with_their_spread_and_the_share_of_points(folder: Path) -> None:
    html = stated(folder)[1]
    lines = (folder / "run.log").read_text().splitlines()
    rows = [[cell.strip() for cell in line.split("│")] for line in lines]
    for acts, cells in (
        ("bold", ["n_n'", "1", "100 %", "1e+22", "1e+22", "7.12e+22", "m^-3 s^-1"]),
        # Two of seven points have it, and it does not act.
        ("", ["n_n'", "1", "29 %", "1e+20", "1e+20", "1e+20", "m^-3 s^-1"]),
    ):
        assert cells in rows
        state, term, fraction = cells[:3]
        row = f'<td class="short">{state}</td><td class="short">{term}</td>'
        row += f'<td class="number">{fraction}</td>'
        assert f'<tr class="{acts}">{row}' in html


def test_points_of_low_confidence_are_counted(folder: Path) -> None:
    for text in stated(folder):
        assert "3 regimes; confidence below 0.5 at 9 % of points" in text
        assert "Regime 1: 3 points, confidence 0.67, below 0.5 at 33 %" in text


def test_a_study_without_any_term_has_no_table_of_them(tmp_path: Path) -> None:
    result = study()
    for name in ("coef", "weight", "weight_draws", "n_terms"):
        result[name] *= 0.0
    folder = written(result, tmp_path)
    assert summary_of(folder)["no_terms"] == {"n_i": 11, "n_n": 11}
    assert "points that have it</th>" not in stated(folder)[1]
