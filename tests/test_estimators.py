from dataclasses import replace

import numpy as np
import pytest
from sklearn.utils.estimator_checks import parametrize_with_checks

from ep2sindy.regression.estimators import AdaptiveLassoRegressor
from ep2sindy.systems.systems import lorenz, lotka_volterra

TRUTH = np.array([[0.0, 3.0, 0.0, -1.5, 0.0, 0.0], [2.0, 0.0, 0.0, 0.0, 0.0, 0.7]])


@pytest.fixture
def estimator() -> AdaptiveLassoRegressor:
    return AdaptiveLassoRegressor()


def library_rows(noise: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    theta = rng.normal(size=(200, 6)) + 0.5 * rng.normal(size=(200, 1))
    return theta, theta @ TRUTH.T + noise * rng.normal(size=(200, 2))


@parametrize_with_checks([AdaptiveLassoRegressor()])
def test_scikit_learn_accepts_the_estimator(estimator, check) -> None:
    check(estimator)


def test_exact_data_give_exact_coefficients(estimator) -> None:
    theta, target = library_rows()
    estimator.fit(theta, target)
    assert estimator.coef_ == pytest.approx(TRUTH, rel=1e-12, abs=0.0)
    assert np.array_equal(estimator.support_, TRUTH != 0.0)
    assert estimator.predict(theta) == pytest.approx(target, rel=1e-12, abs=1e-12)


def test_each_target_is_fitted_on_its_own(estimator) -> None:
    theta, target = library_rows(noise=0.3)
    together = estimator.fit(theta, target).coef_
    alone = [estimator.fit(theta, column).coef_ for column in target.T]
    assert together == pytest.approx(np.array(alone), rel=1e-12, abs=0.0)


def test_units_rescale_the_coefficients_and_nothing_else(estimator) -> None:
    theta, target = library_rows(noise=0.3)
    scale, target_scale = np.array([1e18, 1e-14, 1.0, 1e200, 1e-5, 3.0]), 1e20
    plain = estimator.fit(theta, target).coef_
    scaled = estimator.fit(theta * scale, target * target_scale).coef_
    assert scaled * scale / target_scale == pytest.approx(plain, rel=1e-12, abs=0.0)


def test_columns_that_are_zero_or_repeated_are_left_out(estimator) -> None:
    theta, target = library_rows()
    wide = np.concatenate([np.zeros((200, 1)), theta, theta[:, 1:2]], axis=1)
    coef = estimator.fit(wide, target).coef_
    assert coef[:, 1:7] == pytest.approx(TRUTH, rel=1e-12, abs=0.0)
    assert not coef[:, [0, 7]].any()


def test_a_target_of_zeros_has_no_terms(estimator) -> None:
    theta, _ = library_rows()
    assert not estimator.fit(theta, np.zeros(200)).coef_.any()


def test_an_error_below_the_tolerance_earns_no_term() -> None:
    theta, target = library_rows()
    y = target[:, 0] + 1e-3 * theta[:, 4]  # a share of about 1e-7 of the target's square
    assert AdaptiveLassoRegressor().fit(theta, y).support_.tolist() == (TRUTH[0] != 0).tolist()
    keen = AdaptiveLassoRegressor(tolerance=1e-9).fit(theta, y)
    assert np.flatnonzero(keen.support_).tolist() == [1, 3, 4]


def test_max_terms_ends_the_path() -> None:
    theta, target = library_rows()
    found = AdaptiveLassoRegressor(max_terms=1).fit(theta, target)
    assert found.support_.sum(axis=1).tolist() == [1, 1]


@pytest.mark.parametrize(
    ("estimator", "message"),
    [
        (AdaptiveLassoRegressor(gamma=-1.0), "gamma must be positive"),
        (AdaptiveLassoRegressor(max_terms=0), "max_terms must be a whole number, one or more"),
        (AdaptiveLassoRegressor(tolerance=0.0), r"tolerance must lie in \(0, 1\): 0.0 came"),
    ],
)
def test_impossible_settings_are_refused(estimator, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        estimator.fit(*library_rows())


def test_pysindy_finds_lorenz_to_the_order_of_its_differences(estimator) -> None:
    pysindy = pytest.importorskip("pysindy")
    errors = []
    for rate_Hz in (300.0, 600.0):
        system = replace(lorenz(), rate_Hz=rate_Hz)
        run = system.trajectory()
        optimizer = pysindy.optimizers.WrappedOptimizer(estimator, unbias=False)
        model = pysindy.SINDy(optimizer=optimizer)
        model.fit(run.states, t=run.t, feature_names=list(run.state_names))
        names = [name.replace(" ", "*") for name in model.get_feature_names()]
        truth = system.model.coef[[system.model.library.index(name) for name in names]].T
        assert np.array_equal(model.coefficients() != 0.0, truth != 0.0)
        errors.append(np.abs(model.coefficients() - truth).max())
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.05)  # dt**2


def test_pysindy_keeps_the_small_coefficients_of_large_states(estimator) -> None:
    pysindy = pytest.importorskip("pysindy")
    run = lotka_volterra().trajectory()
    found = []
    for unit in (1.0, 1e-18):
        optimizer = pysindy.optimizers.WrappedOptimizer(estimator, unbias=False)
        model = pysindy.SINDy(optimizer=optimizer).fit(run.states / unit, t=run.t)
        degree = np.array([0, 1, 1, 2, 2, 2])  # 1, x, y, x^2, x y, y^2
        found.append(model.coefficients() * unit ** (1.0 - degree))
    assert np.count_nonzero(found[0]) == 4
    assert found[1] == pytest.approx(found[0], rel=1e-9, abs=0.0)
