"""What the benchmark of waiting makes of the times at which output came."""

import pytest

from benchmarks.startup import longest_gap


@pytest.mark.parametrize(
    ("times", "gap"), [([], 0.0), ([3.0], 0.0), ([0.0, 1.0, 4.5, 5.0], 3.5), ([1.0, 1.0], 0.0)]
)
def test_the_longest_silence_is_between_two_outputs_that_follow_each_other(
    times: list[float], gap: float
) -> None:
    assert longest_gap(times) == gap
