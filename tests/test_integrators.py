"""What integrates: compiled steps refine candidates, and torchdiffeq what is published."""

from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.operating import point_fits
from ep2sindy.refinement import steps
from ep2sindy.selection import systems
from tests.programs import composed, computed
from tests.test_experiment_fits import ils
from tests.test_experiment_libraries import breathing


@pytest.fixture
def refined(monkeypatch: pytest.MonkeyPatch) -> set[bytes]:
    """Coefficients of models whose refinement was integrated by torchdiffeq alone."""
    calls, coefs = {"odeint": 0, "fused": 0}, set[bytes]()

    def counted(name: str, function: Any) -> Any:
        def count(*arguments: Any, **settings: Any) -> Any:
            calls[name] += 1
            return function(*arguments, **settings)

        return count

    def recorded(refine: Any) -> Any:
        def record(*arguments: Any, **settings: Any) -> Any:
            calls.update(odeint=0, fused=0)
            found = refine(*arguments, **settings)
            if calls["odeint"] and not calls["fused"]:
                results = found if isinstance(found, list | tuple) else [found]
                coefs.update(each.model.coef.tobytes() for each in results)
            return found

        return record

    monkeypatch.setattr(steps, "odeint", counted("odeint", steps.odeint))
    monkeypatch.setattr(steps, "advance", counted("fused", steps.advance))
    for module in (systems, point_fits, import_module("ep2sindy.refinement.refine")):
        monkeypatch.setattr(module, "refine", recorded(module.refine))
    return coefs


def test_breathing_publishes_a_model_that_torchdiffeq_integrated(
    predator_prey: Path, tmp_path: Path, refined: set[bytes]
) -> None:
    found = computed(composed(*breathing(predator_prey, tmp_path)))
    assert found.report.models["simple_sustained"].coef.tobytes() in refined


def test_ils_publishes_models_that_torchdiffeq_integrated(
    predator_prey: Path, tmp_path: Path, refined: set[bytes]
) -> None:
    models = computed(composed(*ils(predator_prey, tmp_path))).report.models
    names = [name for name in models if "refined" in name]
    assert names
    assert all(models[name].coef.tobytes() in refined for name in names)


def test_points_of_a_law_are_models_that_torchdiffeq_integrated(refined: set[bytes]) -> None:
    growth = (0.5, 0.8, 1.1)
    runs = [ep.lotka_volterra(a=a).trajectory(noise=0.02, rng=0) for a in growth]
    runs = [replace(run, parameters={"a": a}) for run, a in zip(runs, growth, strict=True)]
    found = ep.discover(runs, law=1)
    assert found.law is not None
    assert len(found.points) == 3
    fits = next(t.fits for t in found.law_choice.trials if t.fits.statuses)
    assert all(model.coef.tobytes() in refined for model in fits.models)
    assert np.isfinite(found.law.at(a=0.7).coef).all()
