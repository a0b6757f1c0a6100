"""The estimator: what scikit-learn asks of one, and what the package finds without it."""

from functools import cache
from typing import Any

import numpy as np
import pandas as pd
import pytest
from sklearn.model_selection import GridSearchCV, KFold, TimeSeriesSplit
from sklearn.utils.estimator_checks import check_estimator

import ep2sindy as ep
from tests.models import model_of

SINDy = ep.discovery.SINDy
ROWS = ep.Regression()


class WithTimes(SINDy):  # type: ignore[misc]
    """The estimator as the checks can call it: of y they bring it takes the length alone."""

    def fit(self, X: Any, y: Any = None) -> "WithTimes":
        return super().fit(X, None if y is None else np.arange(float(len(y))))

    def score(self, X: Any, y: Any = None) -> float:
        return super().score(X, None if y is None else np.arange(float(len(y))))


@cache
def record() -> ep.Trajectory:
    return ep.lotka_volterra().trajectory(noise=0.01, rng=0)


def test_the_checks_of_scikit_learn_pass_with_times() -> None:
    check_estimator(WithTimes(degree=1, method=ROWS), on_skip=None)


def test_it_finds_what_discover_finds() -> None:
    run = record()
    found = SINDy().fit(run.states, run.t, feature_names=["x", "y"])
    assert found.model_ == ep.discover(run).model
    assert found.discovery_.model == found.model_
    assert np.array_equal(found.predict(run.states), found.model_.predict(run.states))
    assert found.score(run.states, run.t) == found.model_.score(run)
    path = found.simulate(run.states[0], run.t[:50])
    assert np.array_equal(path, found.model_.simulate(run.t[:50], run.states[0]).states)
    assert list(found.get_feature_names_out()) == ["1", "x", "y", "x^2", "x*y", "y^2"]
    with pytest.raises(ValueError, match="should match those of fit"):
        found.get_feature_names_out(["a", "b"])


def test_names_come_from_the_columns_of_a_table() -> None:
    run = record()
    table = pd.DataFrame(run.states, columns=["prey", "hunters"])
    found = SINDy(method=ROWS).fit(table, run.t)
    assert found.model_.states == ("prey", "hunters")
    assert found.predict(table).shape == run.states.shape
    plain = SINDy(method=ROWS).fit(run.states, run.dt_s)  # a step in place of times
    assert plain.model_.states == ("x0", "x1")
    assert plain.model_.coef == pytest.approx(found.model_.coef, rel=1e-6)


def test_several_trajectories_are_fitted_together() -> None:
    runs = [record().window(0, 300), record().window(400, 900)]
    states, times = [run.states for run in runs], [run.t for run in runs]
    found = SINDy(method=ROWS).fit(states, times, feature_names=["x", "y"])
    assert found.model_ == ep.discover(runs, method=ROWS).model
    assert found.score(states, times) == found.model_.score(runs)
    assert [each.shape for each in found.predict(states)] == [(300, 2), (500, 2)]
    with pytest.raises(ValueError, match=r"each of 2 trajectories needs .* lists of 1 and 2"):
        found.fit(states, times[:1])


@pytest.mark.parametrize("names", [["v", "b", "a"], ["v", "b"]])
def test_inputs_of_a_library_are_found_by_name_in_the_columns(names: list[str]) -> None:
    t = np.linspace(0.0, 20.0, 401)
    u = np.stack([np.cos(1.9 * t), np.sin(0.7 * t)], axis=1)  # a, then b
    truth = model_of({"v": {"v": -0.5, "b": 2.0}}, inputs=["a", "b"])
    v = truth.simulate(t, [1.0], u).states
    found = SINDy(library=ep.polynomial(names, degree=1), method=ROWS)
    found.fit(v, t, u=u, feature_names=["v", "a", "b"])
    assert found.predict(v, u) == pytest.approx(-0.5 * v + 2.0 * u[:, 1:], abs=1e-2)
    assert found.simulate([1.0], t, u) == pytest.approx(v, abs=1e-3)
    assert found.score(v, t, u=u) > 0.999
    with pytest.raises(ValueError, match=r"u must have a column for each of \['a', 'b'\]"):
        found.predict(v, u[:, 1])


def test_settings_are_chosen_by_cross_validation() -> None:
    run = record()
    for folds in (TimeSeriesSplit(3), KFold(3)):
        grid = GridSearchCV(SINDy(method=ROWS), {"degree": [1, 2]}, cv=folds)
        grid.fit(run.states, run.t)
        assert grid.best_params_ == {"degree": 2}
        assert set(grid.best_estimator_.model_.terms("x0")) == {"x0", "x0*x1"}


def test_a_run_that_diverges_ends_in_nan() -> None:
    t = np.linspace(0.0, 0.9, 200)
    x = 1.0 / (1.0 - t)  # of x' = x^2, which ends at t = 1
    found = SINDy(method=ROWS).fit(x[:, None], t)
    path = found.simulate([1.0], np.linspace(0.0, 3.0, 50))
    assert path.shape == (50, 1)
    assert np.isfinite(path[:10]).all()
    assert np.isnan(path[-10:]).all()
