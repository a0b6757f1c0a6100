"""Frequency and amplitude between the points of records, and the band of a forecast there."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.operating.interpolation import Interpolation
from tests.test_operating_law import by_rows, model_at, recorded

LINE = ep.polynomial(["p"], degree=1)


def drawn(seed: int, n_points: int = 6) -> Interpolation:
    rng, p = np.random.default_rng(seed), np.linspace(1.0, 3.0, n_points)
    cycles = np.column_stack([20.0 + 3.0 * p, 5.0 - p, 0.1 * p])
    cycles += rng.normal(size=cycles.shape) * [0.2, 0.05, 0.001]
    return Interpolation(LINE, p[:, None], ("x", "y"), cycles)


def test_an_interpolation_is_the_least_squares_fit_of_its_functions() -> None:
    found, at = drawn(0), 1.7
    values = LINE.evaluate(found.points)
    fit = np.linalg.lstsq(values, found.cycles)[0]
    cycle = found.at(p=at)
    middle = [cycle.frequency_Hz[0], *(own[0] for own in cycle.amplitude.values())]
    assert middle == pytest.approx([1.0, at] @ fit, rel=1e-12)
    assert list(cycle.amplitude) == ["x", "y"]


def test_half_widths_hold_the_truth() -> None:
    held = []
    for seed in range(300):
        cycle = drawn(seed).at(p=2.2)
        own = (cycle.frequency_Hz, *cycle.amplitude.values())
        held += [abs(y - t) < reach for (y, reach), t in zip(own, (26.6, 2.8, 0.22), strict=True)]
    # Points left out at the ends are extrapolated to, so that intervals are somewhat wide.
    assert 0.95 <= np.mean(held) < 1.0


def test_an_interpolation_does_not_extrapolate() -> None:
    with pytest.raises(ValueError, match=r"p=3.5 lies outside the points .* p 1 to 3: record"):
        drawn(0).at(p=3.5)
    with pytest.raises(ValueError, match="an operating point must"):
        drawn(0).at(q=2.0)
    with pytest.raises(ValueError, match="needs 3 points or more"):
        drawn(0, n_points=2)


def test_a_forecast_at_a_point_that_was_not_measured_carries_a_band() -> None:
    """Coefficients leave the law by 0.3 % at every point: so far is the law uncertain."""
    places, straight = np.linspace(0.5, 1.5, 8).tolist(), ep.polynomial(["a"], degree=1)
    exact = by_rows([replace(recorded(a, 0.0).run, parameters={"a": a}) for a in places])
    t, held = np.arange(0.0, 12.0, 0.1), []
    true = model_at(0.9, 0.0).simulate(t, [1.0, 0.0]).states
    for seed in range(20):
        rng = np.random.default_rng(seed)
        models = [replace(m, coef=m.coef * rng.normal(1.0, 3e-3, m.coef.shape), covariance=None)
                  for m in exact.models]  # fmt: skip
        model = replace(exact, models=models).law(straight).at(a=0.9)
        low, high = model.simulate(t, [1.0, 0.0], draws=200).band()
        held.append(((low <= true) & (true <= high))[1:].mean())
    assert 0.85 <= np.mean(held) <= 0.99
    past = recorded(0.9, 0.0).run.window(0, 300)
    sharp, wide = (
        np.ptp(ep.forecast(m, past, 12.0).band(), axis=0).max()
        for m in (replace(model, covariance=None), model)
    )
    assert wide > 1.5 * sharp
