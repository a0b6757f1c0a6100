"""A gap in a record: no room takes differences or steps across it, or takes it for a step."""

from __future__ import annotations

import numpy as np
import pytest

import ep2sindy as ep
from benchmarks.known_systems import noisy
from ep2sindy.data.gaps import between_gaps, describe_breaks, describe_gaps, mean_step
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation.problem import scale_problem
from ep2sindy.forecasting.baselines import spread_starts
from ep2sindy.forecasting.state_estimation import tune_estimator
from ep2sindy.refinement.windows import cut_windows, dominant_window

LV = ep.lotka_volterra().model
WHOLE = ep.lotka_volterra().trajectory(noise=0.05, rng=0)
FIRST, LAST = 500, 800  # the samples in between are missing
GAPPY = Trajectory(
    np.delete(WHOLE.t, slice(FIRST, LAST)),
    np.delete(WHOLE.states, slice(FIRST, LAST), axis=0),
    WHOLE.state_names,
)
HALVES = [GAPPY.window(0, FIRST), GAPPY.window(FIRST, GAPPY.n_samples)]


def test_a_gap_is_a_step_far_longer_than_those_next_to_it() -> None:
    assert between_gaps(GAPPY.t) == [(0, FIRST), (FIRST, GAPPY.n_samples)]
    t = np.concatenate([np.arange(50.0), [80.0], 120.0 + np.arange(50.0)])  # one sample alone
    assert between_gaps(t) == [(0, 50), (50, 51), (51, 101)]
    # Steps that grow by a factor are a way of sampling, however long the last ones are.
    assert between_gaps(np.logspace(-2.0, 3.0, 400)) == [(0, 400)]


def test_the_mean_step_does_not_count_gaps() -> None:
    assert pytest.approx(WHOLE.dt_s, rel=1e-12) == GAPPY.dt_s
    assert mean_step(GAPPY.t, WHOLE.t) == pytest.approx(WHOLE.dt_s, rel=1e-12)
    assert scale_problem([GAPPY], LV.library).step_s == pytest.approx(WHOLE.dt_s, rel=1e-12)


def test_records_of_an_estimate_are_the_stretches_between_gaps() -> None:
    problem, halves = (scale_problem(runs, LV.library) for runs in ([GAPPY], HALVES))
    for record, half in zip(problem.records, halves.records, strict=True):
        assert record.steps == pytest.approx(half.steps)
        np.testing.assert_array_equal(record.samples, half.samples)
    assert [record.run for record in problem.records] == [0, 0]


def test_the_default_search_of_a_run_with_a_gap_is_that_of_its_halves() -> None:
    found, apart = ep.discover(GAPPY), ep.discover(HALVES)
    np.testing.assert_allclose(found.model.coef, apart.model.coef, rtol=1e-9)
    assert found.estimate is not None
    (path,), (run,) = found.estimate.paths, found.estimate.runs
    assert run is GAPPY or run.n_samples == GAPPY.n_samples
    assert path.shape == GAPPY.states.shape


def test_samples_that_stand_alone_between_gaps_are_left_out_and_counted() -> None:
    lonely = np.r_[0:FIRST, 640, LAST : WHOLE.n_samples]
    run = Trajectory(WHOLE.t[lonely], WHOLE.states[lonely], WHOLE.state_names)
    found = ep.estimate(run, LV.library)
    words = "1 of 701 samples are left out: fewer than 5 stand together between gaps"
    assert words in found.data_warnings
    assert len(found.paths[0]) == found.runs[0].n_samples == 700


def test_a_record_of_nothing_but_bursts_is_taken_as_it_was_sampled() -> None:
    bursts = np.sort(np.concatenate([np.arange(0, 990, 30) + k for k in range(3)]))
    run = Trajectory(WHOLE.t[bursts], WHOLE.states[bursts], WHOLE.state_names)
    (record,) = scale_problem([run], LV.library).records
    assert len(record.samples) == run.n_samples


def test_a_hidden_state_is_found_next_to_a_gap() -> None:
    prey = Trajectory(GAPPY.t, GAPPY.columns(["x"]), ["x"])
    found = ep.discover(prey, hidden=["g"])
    assert list(found.model.terms("g")) == ["1", "x", "g", "x*g"]
    assert not found.lack_of_fit


def test_a_derivative_takes_no_samples_from_beyond_a_gap() -> None:
    form = ep.Differential()
    (rows,) = form.assemble([GAPPY], LV.library, rng=np.random.default_rng(0))
    (apart,) = form.assemble(HALVES, LV.library, rng=np.random.default_rng(0))
    np.testing.assert_allclose(rows.target, apart.target, rtol=1e-9)
    np.testing.assert_allclose(rows.theta, apart.theta, rtol=1e-9)
    by_half = [LV.score(half) for half in HALVES]
    assert min(by_half) <= LV.score(GAPPY) <= max(by_half)


def test_the_noise_that_a_tracker_finds_does_not_know_of_a_gap() -> None:
    whole, gappy = (tune_estimator(LV, run).noise for run in (WHOLE, GAPPY))
    assert gappy.samples == pytest.approx(whole.samples, rel=0.15)
    # A step across the gap would need process noise as large as the states.
    assert (gappy.process < 0.02 * WHOLE.states.std(axis=0)).all()


def test_states_that_nobody_measured_follow_the_model_on_both_sides_of_a_gap() -> None:
    found = ep.model.estimate_states(LV, Trajectory(GAPPY.t, GAPPY.columns(["x"]), ["x"]))
    assert found.n_samples == GAPPY.n_samples
    off = found.columns(["y"]) - GAPPY.columns(["y"])
    assert off.std() < 0.15 * WHOLE.columns(["y"]).std()


@pytest.mark.slow
@pytest.mark.parametrize("since", [1, 40])
def test_a_forecast_starts_from_the_samples_since_the_last_gap(since: int) -> None:
    past = GAPPY.window(0, FIRST + since)
    begin, end = WHOLE.t[LAST + since - 1], LAST + since + 20
    ahead = ep.forecast(LV, past, WHOLE.t[LAST + since : end], fitted_to=WHOLE)
    truth = ep.lotka_volterra().trajectory().states[LAST + since : end]
    low, high = ahead.band(0.99)
    assert ahead.t[0] > begin
    assert ((low <= truth) & (truth <= high)).mean() > 0.9


def test_forecasts_that_are_counted_do_not_lead_across_a_gap() -> None:
    starts = spread_starts(GAPPY.t, 100, 50, 40)
    assert len(starts) == 40
    assert not ((starts > FIRST - 50) & (starts <= FIRST)).any()
    # Where every forecast would, they are counted all the same.
    assert len(spread_starts(GAPPY.t, FIRST - 10, 200, 5)) == 5


def test_a_delayed_value_is_not_taken_from_within_a_gap() -> None:
    t = np.delete(np.arange(3000) * 0.01, slice(1000, 1530))
    run = Trajectory(t, np.sin(2.0 * np.pi * t)[:, None], ["x"])
    found = ep.embed(run, "delays", decimate=None).run
    assert found.columns(["x_before"])[:, 0] == pytest.approx(
        np.sin(2.0 * np.pi * (found.t - 0.25)), abs=2e-3
    )


def test_means_of_samples_do_not_reach_across_a_gap() -> None:
    t = np.delete(np.arange(6000) * 0.002, slice(2005, 3000))
    signal = ep.signals.prepare_signal(
        Trajectory(t, np.sin(2.0 * np.pi * t)[:, None], ["x"]), decimate=10
    )
    assert signal.x == pytest.approx(np.sin(2.0 * np.pi * signal.t), abs=0.01)
    assert signal.per_period == pytest.approx(50.0, rel=0.01)


def test_refinement_takes_windows_between_gaps_alone() -> None:
    assert dominant_window([GAPPY], ["x", "y"]) <= FIRST // 2
    with pytest.raises(ValueError, match="between its gaps: 600 samples were asked of at most 500"):
        cut_windows([GAPPY], ep.lotka_volterra().model, n_windows=2, window=600, rng=0)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["gap5x1", "gap5x3", "gap10x1", "gap20x3", "gap30x1", "gap30x3"])
@pytest.mark.parametrize("name", ["lorenz", "lotka_volterra", "van_der_pol", "fitzhugh_nagumo"])
def test_equations_are_found_next_to_gaps_as_without(name: str, kind: str) -> None:
    for number in range(3):
        system, run = noisy(name, 0.05, number, kind)
        found = ep.estimate(run, system.model.library)
        np.testing.assert_array_equal(found.model.coef != 0.0, system.model.coef != 0.0)


@pytest.mark.parametrize(
    ("unit", "gap"), [("day", "9 days"), ("step", "7.776e+05 steps"), ("s", "777.6 ks")]
)
def test_gaps_are_told_in_the_unit_of_the_times(unit: str, gap: str) -> None:
    clock, t = ep.library.Clock.of(unit), 86400.0 * np.delete(np.arange(40.0), np.arange(20, 28))
    assert f"the longest gap is {gap}, 9 times the usual step" in describe_gaps(t, 40, clock)
    broken = np.append(t, t[-1] + 20.0 * 86400.0)
    twenty = clock.duration_text(20.0 * 86400.0, digits=4)
    assert f"the record has 1 gap: {twenty} pass after sample 32" in describe_breaks(broken, clock)
