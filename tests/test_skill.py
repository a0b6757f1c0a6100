"""What a sentence about forecasts says: better than an autoregression, or nothing of the kind."""

from dataclasses import replace

import numpy as np
import pytest

from ep2sindy.forecasting.baselines import standard_error
from ep2sindy.forecasting.forecast import Forecast
from ep2sindy.forecasting.skill import EXCEEDS, SURE, ForecastSkill

N_HORIZONS = 40
AHEAD = Forecast(
    t=np.ones(1), states=np.ones((1, 1)), draws=np.ones((1, 1, 1)), noise_std=np.zeros(1),
    width=np.ones((1, 1)), state_names=("x",), units={"x": "1"},
)  # fmt: skip


def skill(apart_s: float = 1.0, **squared: np.ndarray) -> ForecastSkill:
    """Of errors (starts, horizons) up to two periods of a second."""
    horizons_s = np.linspace(0.05, 2.0, N_HORIZONS)
    return ForecastSkill(horizons_s, 1.0, 0.05, apart_s, squared, 0.9, example=AHEAD, order=3)


def errors(size: float | np.ndarray, *, seed: int = 0, n: int = 40) -> np.ndarray:
    """Square errors that scatter by a tenth, independently."""
    rng = np.random.default_rng(seed)
    return size * (1.0 + 0.1 * rng.standard_normal((n, N_HORIZONS)))


def test_a_gain_at_all_horizons_is_reported() -> None:
    found = skill(model=errors(0.1), autoregression=errors(0.3, seed=1))
    assert found.text == "better than an autoregression up to 2 periods"
    assert found.better_periods == (0.0, 2.0)
    assert found.nearest_text == "Least error: the model up to 2 periods."
    seen = replace(found, seen=True)  # by the search
    assert seen.text == "better than an autoregression (in sample) up to 2 periods"


def test_a_gain_is_reported_from_the_horizon_where_it_begins_to_where_it_ends() -> None:
    grows = np.where(np.arange(N_HORIZONS) < 20, 0.1, 0.6)
    found = skill(model=errors(grows), autoregression=errors(0.3, seed=1))
    assert found.text == "better than an autoregression up to 1 period"
    later = skill(model=errors(grows[::-1]), autoregression=errors(0.3, seed=1))
    assert later.text == "better than an autoregression from 1 to 2 periods"
    expected = "Least error: the autoregression up to 1, the model up to 2 periods."
    assert later.nearest_text == expected


def test_a_gain_that_chance_may_make_is_neither_praised_nor_denied() -> None:
    """It is all in the errors of the autoregression from three starts of forty."""
    wild = np.where(np.arange(40) < 3, 3.0, 0.2)[:, None]
    found = skill(model=errors(0.2), autoregression=wild * errors(1.0, seed=1))
    assert found.text == "nearer than an autoregression up to 2 periods, within chance"


def test_errors_above_the_mean_s_are_no_forecast() -> None:
    still = {"persistence": errors(2.0, seed=2), "autoregression": errors(3.0, seed=1)}
    found = skill(model=errors(1.5), **still)
    assert found.text == "forecasts no better than an autoregression"
    assert found.veto == "the mean"
    assert found.nearest_text == "Least error: the mean up to 2 periods."
    assert skill(model=errors(2.5), **still).veto == "the last sample"
    assert not skill(model=errors(0.9), **still).veto


def test_one_start_or_equal_errors_tell_nothing() -> None:
    assert skill(model=errors(0.1, n=1), autoregression=errors(0.3, n=1)).better is None
    assert skill(model=errors(0.1), autoregression=errors(0.1)).better is None


@pytest.mark.parametrize("overlap", [1, 5, 10])
def test_correlated_starts_are_allowed_for(overlap) -> None:
    """Overlapping forecasts share what moves them. Without a gain, chance exceeds its standard
    error in one case of six, and is sure in one of twenty.
    """
    rng, n, n_cases = np.random.default_rng(overlap), 40, 1000
    found = skill(apart_s=2.0 / overlap, model=errors(0.1), autoregression=errors(0.1))
    gains = [
        np.convolve(rng.standard_normal(n + overlap - 1), np.ones(overlap), "valid")
        for _ in range(n_cases)
    ]
    for level in (EXCEEDS, SURE):
        fraction = np.mean([found._exceeds(gain, -1, level) for gain in gains])
        # Two standard deviations of such a fraction, and a quarter of it for what few waves miss.
        assert fraction == pytest.approx(1.0 - level, abs=0.025 + 0.25 * (1.0 - level))


def test_a_standard_error_is_that_of_the_mean() -> None:
    rng = np.random.default_rng(0)
    found = [standard_error(rng.standard_normal(400), 8) for _ in range(200)]
    assert np.sqrt(np.mean(np.square(found))) == pytest.approx(1.0 / 20.0, rel=0.1)
