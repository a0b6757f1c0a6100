import re
from pathlib import Path

import pytest
from omegaconf import DictConfig

from ep2sindy.app.runner import run_config
from tests import programs


def composed(*overrides: str) -> DictConfig:
    return programs.composed("+exp=weak_windows", *overrides)


def test_weak_windows_runs_at_toy_size(tmp_path: Path) -> None:
    overrides = ["n_windows=[100,300]", "n_points=[10,30]", "noises=[0.0,0.1]", "parallel=serial"]
    config = composed(*overrides, "n_realizations=2", f"output={tmp_path}")
    errors = programs.computed(config)
    found = errors.summary["cells"]
    assert len(found) == 2 * (4 + 3)
    assert {cell["setting"] for cell in found if cell["n_points"] is None} == {
        "differential",
        "automatic",
        "automatic_weighted",
    }
    for cell in found:
        assert cell["n"] == 2
        assert {"n_windows", "noise", "error_mean", "error_std"} <= set(cell)
    errors.check_figures("errors")


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["n_points=[10,3001]"], "n_points=3001 was asked of 3000 samples"),
        (["boxes.test_functions.n_windows=9"], "boxes.test_functions.n_windows is what n_windows"),
    ],
)
def test_weak_windows_settings_that_cannot_work_are_refused(
    overrides: list[str], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=re.escape(message)):
        run_config(composed(*overrides, f"output={tmp_path}"))
