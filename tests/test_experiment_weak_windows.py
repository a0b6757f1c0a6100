from pathlib import Path

from omegaconf import DictConfig

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
