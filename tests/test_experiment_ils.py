from pathlib import Path

import numpy as np
import pytest
from omegaconf import DictConfig

from ep2sindy.app.runner import run_config
from ep2sindy.library.library import polynomial
from ep2sindy.library.relations import constraint
from ep2sindy.refinement.problem import Iteration
from ep2sindy.studies.ils import watcher
from tests import programs
from tests.programs import summary_of
from tests.test_experiment_constrained import JUDGED

EXACT = {"n_i": {"n_i": -1.64e5, "n_i*n_n": 4.66e-14}, "n_n": {"n_n": 4.39e4, "n_i*n_n": -4.66e-14}}


def toy(path: Path, output: Path) -> list[str]:
    """Overrides that run `+exp=ils` on a file, at toy size."""
    return [
        "+exp=ils",
        *programs.on_file(path, output),
        "n_windows=6",
        "windows=[60]",
        "living=free",  # predator and prey conserve nothing
        "living.search.max_terms=2",  # as many as the truth has
        "+living.selection.n_windows=6",
        "+living.selection.n_folds=2",
        "n_draws=2",
        "weak.test_functions.n_windows=500",
        "weak.test_functions.n_points=50",
    ]


def ils(path: Path, output: Path, *overrides: str) -> DictConfig:
    return programs.composed(*toy(path, output), *overrides)


@pytest.fixture(scope="module")
def toy_run(predator_prey: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_config(ils(predator_prey, tmp_path_factory.mktemp("outputs")))


def test_integral_least_squares_returns_predator_and_prey(toy_run: Path) -> None:
    summary = summary_of(toy_run)
    methods = summary["methods"]
    refinements = ("ils", "ils_constrained", "living")
    assert list(methods) == ["base", "weak", "constrained", *refinements]
    for name, found in methods.items():
        assert set(found) >= JUDGED
        # Second-order differences at 1.5 us on a 14 kHz wave: (omega dt)^2 / 6 = 0.3 %, and the
        # smoothing window flattens peaks by about 1 %. A refinement has the error of one
        # Runge-Kutta step alone, (omega dt)^4 / 120 = 3e-6 for a sine, and the wave has harmonics.
        refined = name in refinements
        for state, terms in EXACT.items():
            rel = 1e-4 if refined else 0.02
            assert found["equations"][state] == pytest.approx(terms, rel=rel)
        assert found["status"] == ("converged" if refined else None)
        assert (found["ci95"] is None) != refined
        # Of a Hann window on some four periods: 1 % of a bin at most.
        assert found["f_error"] == pytest.approx(0.0, abs=0.02 if not refined else 1e-3)
        assert found["amplitude_ratio"] == pytest.approx(1.0, abs=0.1 if not refined else 1e-3)
        assert (toy_run / "models" / f"{name}.json").is_file()
        if refined:
            spread = found["spread"]
            assert (spread["n_draws"], spread["n_living"]) == (2, 2)
            assert spread["f_error"] == pytest.approx([0.0, 0.0], abs=1e-3)
            assert spread["waveform"][0] <= spread["waveform"][1] < 1e-2
    for name in ("constrained", "ils_constrained"):
        equations = methods[name]["equations"]
        assert equations["n_i"]["n_i*n_n"] == -equations["n_n"]["n_i*n_n"]
    low, high = methods["ils"]["ci95"]["n_i"]["n_i"]
    assert low <= methods["ils"]["equations"]["n_i"]["n_i"] <= high
    swept = summary["loss_against_window"]
    assert [row["method"] for row in swept] == ["ils", "ils_constrained"]
    assert [row["window"] for row in swept] == [60, 60]
    assert all(row["loss"] < 1e-6 for row in swept)


def test_page_and_terminal_show_every_method_and_the_page_its_figures(toy_run: Path) -> None:
    page, log = (toy_run / "report.html").read_text(), (toy_run / "run.log").read_text()
    for name in ("trajectories", "trajectories_started", "phase", "spectra", "loss_against_window"):
        assert (toy_run / "figures" / f"{name}.png").is_file()
    assert page.count("95 % from") == 3  # of the refinements
    assert "95 % from" not in log


def test_every_iteration_is_told_one_scalar_each() -> None:
    library = polynomial(["x", "y"], degree=2)
    relations = constraint(
        library, {"x": ["x", "x*y"], "y": ["y", "x*y"]}, ["x: x*y == -1 * y: x*y"]
    )
    told: list[tuple[int, dict[str, float]]] = []
    watch = watcher(lambda scalars, *, step: told.append((step, scalars)), "ils", relations)
    for loss in (0.5, 0.25):
        watch(Iteration(0, 25, loss, np.array([1.0, 2.0, 3.0]), 0.1, 1e-9))
    assert [step for step, _ in told] == [0, 1, 2]
    fit = {"ils/loss": 0.25, "ils/step": 0.1, "ils/defect": 1e-9, "ils/window_stage": 25}
    scalings = {"ils/scaling/x/x": 1.0, "ils/scaling/x/x.y": 2.0, "ils/scaling/y/y": 3.0}
    assert told[2][1] == fit | scalings
    assert told[0][1] == dict.fromkeys(scalings, 1.0)


def test_iterations_go_to_tensorboard(toy_run: Path) -> None:
    events = b"".join(p.read_bytes() for p in (toy_run / "tensorboard").glob("events*"))
    for tag in (b"ils/scaling/n_i/n_i.n_n", b"ils_constrained/loss"):
        assert tag in events
