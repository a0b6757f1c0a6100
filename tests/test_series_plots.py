"""Figures of models next to the data: what every panel must hold."""

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.figures.series import (
    derivative_figure,
)
from ep2sindy.figures.style import find_exits, frame_limits


@pytest.fixture(scope="module")
def oscillation() -> ep.Trajectory:
    """Eight periods of x'' = -x, in SI units."""
    t = np.linspace(0.0, 16 * np.pi, 801)
    states = np.column_stack([np.cos(t), -np.sin(t)])
    return ep.Trajectory(t, states, ("x", "v"), units={"x": "m", "v": "m/s"})


def test_right_hand_sides_stand_in_the_order_of_the_data(oscillation: ep.Trajectory) -> None:
    swapped = ep.SparseModel(
        ep.named_terms(("x", "v"), ("x", "v")), ("v", "x"), np.array([[-1.0, 0.0], [0.0, 1.0]])
    )
    figure = derivative_figure(
        oscillation, {"swapped": swapped}, smoother=ep.signals.NoSmoothing(), duration_s=20.0
    )
    for ax in figure.axes:
        data, model = (np.asarray(line.get_ydata())[5:-5] for line in ax.lines)
        # Central differences: dt**2 / 6 of the third derivative, which is 1 at most.
        assert np.abs(model - data).max() < oscillation.dt_s**2 / 6 * 1.01


def test_a_model_that_runs_away_does_not_shrink_the_rest() -> None:
    data = np.array([1.0, 3.0])
    assert frame_limits(data, np.array([1e9, -1e9])) == pytest.approx((-0.2, 4.2))
    assert frame_limits(data, np.array([2.0])) == pytest.approx((0.9, 3.1))
    assert frame_limits(data, np.empty(0)) == frame_limits(data, data)


def test_rare_values_at_the_ends_of_a_derivative_set_no_scale() -> None:
    data = np.sin(np.linspace(0.0, 20.0, 300))
    spiked = np.concatenate([[40.0], data, [-70.0]])
    assert frame_limits(spiked, data) == pytest.approx((-73.35 - 2.15, 45.5), rel=0.03)
    low, high = frame_limits(spiked, data, rare=0.01)
    assert -2.2 < low < -1.0 < 1.0 < high < 2.2
    assert frame_limits(data, data, rare=0.01) == frame_limits(data, data)  # what is not rare stays
    step = np.append(np.zeros(200), 1.0)  # all but a rare value alike: nothing else to go by
    assert frame_limits(step, step, rare=0.01) == pytest.approx((-0.05, 1.05))


def test_a_curve_leaves_a_panel_where_it_crosses_the_edge() -> None:
    x, y = np.array([0.0, 1.0, 2.0, 3.0, 4.0]), np.array([0.0, 4.0, 0.0, -4.0, np.inf])
    assert find_exits(x, y, (0.0, 4.0), (-1.0, 2.0)) == [(0.5, 2.0, 6), (2.25, -1.0, 7)]
    assert find_exits(y, x, (-1.0, 2.0), (0.0, 4.0)) == [(2.0, 0.5, 5), (-1.0, 2.25, 4)]
    assert find_exits(x, x, (0.0, 4.0), (0.0, 4.0)) == []
    assert find_exits(x[:0], y[:0], (0.0, 4.0), (-1.0, 2.0)) == []
    assert find_exits(np.array([0.0, 1.0]), np.array([9.0, 0.0]), (0.0, 1.0), (0.0, 2.0)) == [
        (0.0, 2.0, 6)  # it begins outside
    ]
