"""Rows in weak form: their fits on a file, and how long their windows should be."""

from pathlib import Path

import pytest

from tests.programs import composed, computed, on_file


def weak_on(path: Path, output: Path) -> list[str]:
    """Overrides that run `+exp=weak` on a file."""
    return ["+exp=weak", *on_file(path, output), "n_windows=500", "n_points=[10,50]"]


def test_weak_forms_find_predator_and_prey(predator_prey: Path, tmp_path: Path) -> None:
    found = computed(composed(*weak_on(predator_prey, tmp_path)))
    summary = found.summary
    forms = ["differential", "n_points_10", "n_points_50", "automatic", "automatic_weighted"]
    assert list(summary["settings"]) == forms
    for name, setting in summary["settings"].items():
        # Differences: as in the test of breathing. Trapezia: (omega dt)^2 / 12 = 0.13 % for a sine,
        # and the wave has harmonics. Smooth windows: as good as exact.
        rel = {"differential": 0.02, "n_points_10": 5e-3, "n_points_50": 5e-3}.get(name, 1e-4)
        equations = setting["equations"]
        assert equations["n_i"] == pytest.approx({"n_i": -1.64e5, "n_i*n_n": 4.66e-14}, rel=rel)
        assert equations["n_n"] == pytest.approx({"n_n": 4.39e4, "n_i*n_n": -4.66e-14}, rel=rel)
        assert setting["f_error"] == pytest.approx(0.0, abs=0.01)
        assert setting["f_error"] == found.outcome.runs[name].f_error  # of the cycle
    assert list(found.outcome.models()) == forms
    automatic = summary["settings"]["automatic_weighted"]
    for state, half_width in automatic["half_width"].items():
        assert automatic["half_width_s"][state] == pytest.approx(1.5e-6 * half_width)
        low, high = automatic["intervals"][state][state]
        assert low < automatic["equations"][state][state] < high
    assert len(found.outcome.tables()["settings"]) == 2 * len(forms)
    assert "thesis, Eq. 24: n_i' = -1.51e+05 n_i + 4.21e-14 n_i n_n" in found.log
    assert found.page.count("95 % from") == 1  # of the weighted fit
    found.check_figures("trajectories", "phase", "derivatives", "spectra")


def test_weak_windows_runs_at_toy_size(tmp_path: Path) -> None:
    overrides = ["n_windows=[100,300]", "n_points=[10,30]", "noises=[0.0,0.1]", "parallel=serial"]
    config = composed("+exp=weak_windows", *overrides, "n_realizations=2", f"output={tmp_path}")
    errors = computed(config)
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
