from pathlib import Path

import numpy as np
import pytest
from omegaconf import DictConfig

from ep2sindy.app.schema import study_of
from ep2sindy.studies.constrained import Study
from tests import programs

JUDGED = {
    "text", "f_kHz", "f_error", "nrmse", "amplitude_ratio", "status", "ci95", "cpu_s",
}  # fmt: skip


def on_file(path: Path, output: Path) -> list[str]:
    """Overrides that run `+exp=constrained` on a file."""
    return ["+exp=constrained", *programs.on_file(path, output, "R_ion", "u_iz")]


def constrained(path: Path, output: Path, *overrides: str) -> DictConfig:
    return programs.composed(*on_file(path, output), *overrides)


def test_constrained_models_share_their_coefficient(predator_prey: Path, tmp_path: Path) -> None:
    given = ("~models.ionization", "figures.duration_s=1e-4")
    found = programs.computed(constrained(predator_prey, tmp_path, *given))
    summary = found.summary
    assert (summary["data"]["n_samples"], summary["data"]["n_held_out"]) == (1200, 300)
    models = summary["models"]
    assert list(models) == ["predator_prey", "velocity"]
    for name, model in models.items():
        shared = "n_i*n_n" if name == "predator_prey" else "n_i*n_n*R_ion"
        pairs = {kind: fit["equations"] for kind, fit in model.items()}
        assert set(pairs) == {"base", "constrained"}
        assert pairs["constrained"]["n_i"][shared] == -pairs["constrained"]["n_n"][shared]
        assert pairs["base"]["n_i"][shared] != -pairs["base"]["n_n"][shared]
        assert all(set(fit) >= JUDGED for fit in model.values())
    exact = models["predator_prey"]["constrained"]["equations"]
    # Second-order differences at 1.5 us on a 14 kHz wave: (omega dt)^2 / 6 = 0.3 %, and the
    # smoothing window flattens peaks by about 1 %.
    assert exact["n_i"] == pytest.approx({"n_i": -1.64e5, "n_i*n_n": 4.66e-14}, rel=0.02)
    assert exact["n_n"] == pytest.approx({"n_n": 4.39e4, "n_i*n_n": -4.66e-14}, rel=0.02)
    assert len(found.outcome.tables()["methods"]) == 8
    assert "relation: n_i: n_i*n_n == -1 * n_n: n_i*n_n" in found.log
    for name in ("trajectories", "trajectories_started"):
        (ax, *_) = reversed(found.outcome.figures()[name].draw().axes)
        assert ax.get_xlabel() == "time since start of held-out part (µs)"
        ends = [np.asarray(line.get_xdata())[[0, -1]] for line in ax.lines]
        assert np.min(ends) == 0.0
        assert np.max(ends) <= 100.0


def test_the_constant_may_come_as_a_number(tmp_path: Path) -> None:
    """As Hydra reads it from a command line."""
    given = "models.velocity.terms.n_n=[1,n_i*n_n*R_ion]"
    study = study_of(Study, constrained(tmp_path / "none.nc", tmp_path, given))
    _, (base, _) = study.models["velocity"].constraints("velocity", study.source.states)
    assert [term for state, term in base.coefficients if state == "n_n"] == ["1", "n_i*n_n*R_ion"]
