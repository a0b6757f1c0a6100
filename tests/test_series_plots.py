"""Figures of models next to the data: what every panel must hold."""

import numpy as np
import pytest

from ep2sindy.figures.style import frame_limits


def test_a_model_that_runs_away_does_not_shrink_the_rest() -> None:
    data = np.array([1.0, 3.0])
    assert frame_limits(data, np.array([1e9, -1e9])) == pytest.approx((-0.2, 4.2))
    assert frame_limits(data, np.array([2.0])) == pytest.approx((0.9, 3.1))
    assert frame_limits(data, np.empty(0)) == frame_limits(data, data)
