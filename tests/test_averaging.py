"""Long records in means: what a search of them finds, and which are left as they are."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.discovery.method import of_means
from ep2sindy.signals.signal import average_alike, average_long

PER_PERIOD = 1450


def damped(n: int = 30_000, *, held: int = 0) -> ep.Trajectory:
    """x' = v, v' = -x - 0.2 v + 2 u along an exact solution, with u held over some samples."""
    from scipy.linalg import expm

    rng, dt = np.random.default_rng(0), 2.0 * np.pi / PER_PERIOD
    drive = rng.choice([-1.0, 0.0, 1.0], size=n // held + 1) if held else np.zeros(n)
    u = np.repeat(drive, held or 1)[:n]
    step = expm(dt * np.array([[0.0, 1.0, 0.0], [-1.0, -0.2 if held else 0.0, 2.0], [0, 0, 0]]))
    x = np.empty((n, 2))
    x[0] = 1.0, 0.0
    for k in range(n - 1):
        x[k + 1] = (step @ [*x[k], u[k]])[:2]
    noisy = x + 0.01 * rng.standard_normal(x.shape)
    inputs = u[:, None] if held else np.empty((n, 0))
    return ep.Trajectory(dt * np.arange(n), noisy, ("x", "v"), inputs, ("u",) * bool(held))


def test_the_law_of_a_long_record_is_found_in_its_means() -> None:
    run = damped()
    found = ep.discover(run)
    (words,) = (text for text in found.data_warnings if "means" in text)
    assert words == "means over 14 samples: 2142 are left; decimate=None takes all samples"
    assert found.model.terms("x") == pytest.approx({"v": 1.0}, abs=2e-3)
    assert found.model.terms("v") == pytest.approx({"x": -1.0}, abs=2e-3)
    assert not found.lack_of_fit


@pytest.mark.slow
def test_an_input_that_is_held_is_averaged_with_the_states() -> None:
    """A lag of half a step between means of states and input would show as a delayed channel."""
    run = damped(held=400)
    library = ep.polynomial(["x", "v", "u"], degree=1)
    method = ep.TrajectorySearch(courses={"u": "held"})
    found = ep.discover(run, library, method)
    assert found.model.terms("v") == pytest.approx({"x": -1.0, "v": -0.2, "u": 2.0}, abs=3e-3)
    assert not found.lack_of_fit
    assert found.model.courses == {"u": "linear"}
    assert of_means(ep.TrajectorySearch()) == ep.TrajectorySearch()


def test_means_of_several_records_are_alike_and_cross_no_gap() -> None:
    run = damped()
    gap = replace(run, t=np.where(np.arange(run.n_samples) < 10_007, run.t, run.t + 1.0))
    fewer, _ = average_alike([gap, run], "auto")
    assert [each.n_samples for each in fewer] == [10_007 // 14 + 19_993 // 14, 2142]
    np.testing.assert_allclose(fewer[1].states[0], run.states[:14].mean(axis=0))
    steps = np.diff(fewer[0].t)
    assert (steps > 1.5 * np.median(steps)).sum() == 1


def test_records_stay_as_they_are_that_are_short_or_lack_samples_or_are_told_to() -> None:
    run = damped()
    missing = np.zeros((run.n_samples, 2), dtype=np.bool_)
    missing[5, 0] = True
    for kept, decimate in (
        (run.window(0, 15_000), "auto"),
        (replace(run, missing=missing), "auto"),
        (run, None),
    ):
        (same,), words = average_long([kept], decimate)
        assert same is kept
        assert words == ()
    with pytest.raises(ValueError, match="decimate must be auto, null or a whole number"):
        average_alike([run], 0)


def test_what_is_fast_next_to_the_period_is_kept() -> None:
    run = damped()
    fast = 0.5 * np.sin(40.0 * run.t)  # 36 samples to one of its periods
    found, _ = average_long([replace(run, states=run.states + fast[:, None])], "auto")
    assert found[0].n_samples == run.n_samples
