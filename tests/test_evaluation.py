"""What is said of a model: by samples, by its cycle and rest points, and by forecasts."""

import re
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.known_systems import noisy
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.evaluation import evaluate
from ep2sindy.library.library import polynomial
from ep2sindy.model.comparison import FreeRunBounds, Status
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.model.stability import basin_stability, multiplier_error
from ep2sindy.systems.systems import lorenz, lotka_volterra
from tests.models import model_of

LIBRARY = polynomial(["x", "y"], degree=3)


def hopf(*, growth: float = 1.0, turn: float = 1.0, radius: float = 1.0) -> SparseModel:
    """r' = growth r (1 - r^2/radius^2), angle' = turn."""
    pull = growth / radius**2
    terms = [
        {"x": growth, "y": -turn, "x^3": -pull, "x*y^2": -pull},
        {"x": turn, "y": growth, "x^2*y": -pull, "y^3": -pull},
    ]
    return SparseModel(LIBRARY, ["x", "y"], coef_matrix(LIBRARY, terms))


def record(n_periods: float = 40.0) -> Trajectory:
    t = np.linspace(0.0, 2.0 * np.pi * n_periods, round(50 * n_periods) + 1)
    return Trajectory(t, np.column_stack([np.cos(t), np.sin(t)]), ("x", "y"))


def test_the_truth_is_sustained_and_every_figure_is_exact() -> None:
    found = evaluate(hopf(), record())
    assert found.status is Status.FOLLOWS
    assert found.text == "follows the samples for 251 s"
    assert max(found.distance.values()) < 0.1
    assert found.f_error == pytest.approx(0.0, abs=1e-5)
    assert dict(found.amplitude_ratio) == pytest.approx({"x": 1.0, "y": 1.0}, abs=1e-3)
    assert max(found.waveform_error.values()) < 1e-3
    assert found.periods == pytest.approx(40.0, rel=1e-3)
    assert found.nrmse < 1e-4


@pytest.mark.parametrize(
    ("model", "verdict", "f_error", "amplitude"),
    [
        (hopf(turn=1.005), Status.SUSTAINED, 0.005, 1.0),
        (hopf(turn=1.03), Status.WRONG_FREQUENCY, 0.03, 1.0),
        (hopf(radius=1.05), Status.SUSTAINED, 0.0, 1.05),
        (hopf(radius=1.3), Status.WRONG_CYCLE, 0.0, 1.3),
        (hopf(growth=-0.2, radius=1e9), Status.DECAYS, np.nan, 0.0),
        (hopf(growth=0.3, radius=1e9), Status.DIVERGES, np.nan, np.nan),
    ],
)
def test_verdicts(model, verdict, f_error, amplitude) -> None:
    found = evaluate(model, record())
    assert found.status is verdict
    assert found.f_error == pytest.approx(f_error, abs=1e-4, nan_ok=True)
    assert found.amplitude_ratio["x"] == pytest.approx(amplitude, abs=2e-3, nan_ok=True)


def test_the_phase_slips_by_a_quarter_when_it_should() -> None:
    found = evaluate(hopf(turn=1.01), record(60.0))  # a quarter after 25 periods
    assert found.phase_end == pytest.approx(0.01 * (60.0 - 4.0), abs=1e-3)  # mean of the last eight
    assert found.periods == pytest.approx(25.0, abs=1.0)


def test_a_transient_does_not_count() -> None:
    found = evaluate(hopf(growth=0.3), record(), initial=np.array([0.2, 0.0]))
    assert found.status is Status.SUSTAINED
    assert found.nrmse > 0.05


def test_bounds_are_settings() -> None:
    model = hopf(radius=1.05)
    assert (
        evaluate(model, record(), bounds=FreeRunBounds(amplitude=0.03)).status is Status.WRONG_CYCLE
    )
    with pytest.raises(ValueError, match="the bound waveform must be positive, got 0.0"):
        FreeRunBounds(waveform=0.0)


def test_units_change_nothing() -> None:
    run, model = record(), hopf(turn=1.005)
    plain = evaluate(model, run)
    scaled_run = Trajectory(1e-6 * run.t, 1e18 * run.states, run.state_names)
    degrees = LIBRARY.degrees
    scaled = replace(model, coef=model.coef * 1e6 * 1e18 / 1e18 ** degrees[:, None])
    found = evaluate(scaled, scaled_run)
    assert found.f_error == pytest.approx(plain.f_error, abs=1e-6)
    assert found.waveform_error["y"] == pytest.approx(plain.waveform_error["y"], abs=1e-5)


def test_chaos_is_assessed_by_means_and_amplitudes() -> None:
    system = replace(lorenz(), duration_s=60.0, rate_Hz=100.0)
    run = system.trajectory()
    truth = evaluate(system.model, run)
    assert truth.comparison.status is Status.NO_CYCLE
    assert truth.comparison.is_similar
    assert truth.run_text == "no cycle to compare"
    assert (
        truth.text == "follows the samples for 690 ms at a time"
    )  # runs of chaos leave each other
    assert np.isnan(truth.f_error)
    still = replace(system.model, coef=system.model.coef.copy())
    coef = still.coef.copy()
    coef[list(still.library.names).index("x"), 1] = 12.0  # rho = 12: two fixed points
    assert evaluate(replace(still, coef=coef), run).status is Status.DECAYS
    wide = system.model.coef.copy()
    wide[list(still.library.names).index("x"), 1] = 60.0
    other = evaluate(replace(still, coef=wide), run)
    assert (other.status, other.comparison.is_similar) == (Status.DEPARTS, False)
    assert sorted([other, truth], key=lambda found: found.rank)[0] is truth


def test_a_run_that_needs_ever_smaller_steps_stops() -> None:
    library = polynomial(["x", "y"], degree=1)
    coef = coef_matrix(library, [{"y": 1e6}, {"x": -1e6}])
    rollout = SparseModel(library, ["x", "y"], coef).simulate(np.linspace(0, 1e4, 50), [1.0, 0.0])
    assert rollout.diverged
    assert "its steps became too small for the samples" in rollout.message


SLOW = pytest.mark.slow


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=SLOW), pytest.param(3, marks=SLOW)])
def test_the_true_model_of_a_chaotic_record_is_alike_and_a_wrong_one_is_not(number: int) -> None:
    """Rossler's frequency and waveform wander: no run lies closer than the data's own parts."""
    system, run = noisy("rossler", 0.05, number)
    truth = evaluate(system.model, run)
    assert (truth.status, truth.comparison.is_similar) == (Status.FOLLOWS, True)
    assert truth.comparison.status is Status.NO_CYCLE
    coef = system.model.coef
    periodic = replace(system.model, coef=np.where(coef == -5.7, -3.0, coef))
    other = evaluate(periodic, run)
    assert other.status is Status.WRONG_CYCLE
    assert truth.rank < other.rank


@pytest.mark.parametrize(
    ("radius", "unit", "verdict"),
    [
        (1.0, "m^-3", Status.FOLLOWS),
        (1.3, "m^-3", Status.NEGATIVE),
        (1.3, "V", Status.WRONG_CYCLE),  # other states may be negative
    ],
)
def test_a_density_below_zero_is_a_verdict_of_its_own(radius, unit, verdict) -> None:
    """On circles about (1.2, 1.2): they pass below zero where their radius is larger."""
    t, units = np.linspace(0.0, 80.0 * np.pi, 2001), dict.fromkeys(("x", "y"), unit)
    run = Trajectory(t, 1.2 + np.column_stack([np.cos(t), np.sin(t)]), ("x", "y"), units=units)
    circles = model_of({"x": {"1": 1.2, "y": -1.0}, "y": {"1": -1.2, "x": 1.0}})
    start = np.array([1.2 + radius, 1.2])
    found = evaluate(replace(circles, units=units), run, initial=start)
    assert found.status is verdict
    if verdict is Status.NEGATIVE:
        assert found.text == "turns negative"


def test_of_several_records_the_worst_run_counts() -> None:
    good, longer = record(), record(50.0)
    apart = replace(longer, states=1.3 * longer.states)
    found = evaluate(hopf(), [good, apart, good])
    assert [each.status for each in found.each] == [
        Status.FOLLOWS, Status.WRONG_CYCLE, Status.FOLLOWS,
    ]  # fmt: skip
    assert found.status is Status.WRONG_CYCLE
    np.testing.assert_array_equal(found.record.states, apart.states)
    assert found.one_step is not None
    assert found.one_step.n_ahead == 1
    assert len(found.one_step.error) == 3 * 200  # starts


def test_a_neutral_cycle_is_reported_and_every_start_has_its_own() -> None:
    prey = lotka_volterra()
    found = evaluate(prey.model, prey.trajectory())
    assert found.cycle is not None
    assert (found.status, found.cycle.stability) == (Status.FOLLOWS, "neutral")
    assert found.multiplier == pytest.approx(1.0, abs=1e-6)
    assert basin_stability(prey.model, found.cycle) < 0.2
    rest = found.rest_points[0]
    np.testing.assert_allclose(rest.state, [1 / 3, 2 / 3], rtol=1e-9)
    assert rest.frequency_Hz == pytest.approx(np.sqrt(2.0) / 3.0 / (2.0 * np.pi))
    off = replace(prey.model, coef=1.004 * prey.model.coef)  # by its clock, over 0.4 periods
    near = evaluate(off, prey.trajectory())
    assert near.status is Status.NEUTRAL
    assert near.heading == "on a neutral cycle"
    assert "does not show what sets the amplitude" in near.missing


def test_an_attracting_cycle_has_its_multiplier_and_rests_inside() -> None:
    found = evaluate(hopf(growth=0.05), record())
    assert found.multiplier == pytest.approx(np.exp(-0.2 * np.pi), rel=1e-6)
    assert found.cycle is not None
    assert basin_stability(found.model, found.cycle) == 1.0
    (rest,) = found.rest_points
    np.testing.assert_array_equal(rest.state, [0.0, 0.0])
    assert rest.growth_per_s == pytest.approx(0.05)
    assert rest.frequency_Hz == pytest.approx(0.5 / np.pi)


def test_rest_points_are_those_near_the_record() -> None:
    system = replace(lorenz(), duration_s=20.0)
    found = evaluate(system.model, system.trajectory())
    places = sorted(tuple(point.state.round(9)) for point in found.rest_points)
    side = round(np.sqrt(8 / 3 * 27), 9)
    assert places == [(-side, -side, 27.0), (0.0, 0.0, 0.0), (side, side, 27.0)]
    assert all(point.growth_per_s > 0.0 for point in found.rest_points)


def test_a_run_without_a_cycle_has_none_of_its_numbers() -> None:
    decays, diverges = (evaluate(hopf(growth=g, radius=1e9), record()) for g in (-0.2, 0.3))
    for found in (decays, diverges):
        assert np.isnan(found.multiplier)
        assert (found.cycle, found.cycle_text, found.missing) == (None, "", "")
        assert [rest.growth_per_s > 0.0 for rest in found.rest_points] == [found is diverges]
    assert np.isnan(diverges.phase_end)
    assert re.fullmatch(r"diverges after [0-9.]+ s", diverges.text)


def test_of_a_line_of_rest_points_one_is_reported() -> None:
    run = record()
    beside = evaluate(model_of({"x": {"y": 1.0}, "y": {"y": -1.0}}), run, n_samples=200)
    (rest,) = beside.rest_points
    assert "neutral: a perturbation neither grows nor decays" in replace(rest, is_seen=True).text(
        beside.model, run.clock
    )
    far = evaluate(model_of({"x": {"1": 1e3, "x": -1.0}, "y": {"y": -1.0}}), run, n_samples=200)
    assert far.rest_points == ()


def test_forecasts_need_held_out_samples() -> None:
    assert evaluate(hopf(), record()).forecast is None
    with pytest.raises(ValueError, match="got n_fitted=1999 for 2001 samples"):
        evaluate(hopf(), record(), n_fitted=1999)


def cart(u: float = 1.5) -> SparseModel:
    """x' = v, v' = -4 x - 0.3 v - 0.8 x^3 + u times an input."""
    library = polynomial(["x", "v", "u"], degree=3)
    terms = [{"v": 1.0}, {"x": -4.0, "v": -0.3, "x^3": -0.8, **({"u": u} if u else {})}]
    return SparseModel(library, ["x", "v"], coef_matrix(library, terms))


def driven(noise: float, *, seed: int = 0, missing: float = 0.0) -> Trajectory:
    """The cart under two tones, at unequal steps."""
    rng = np.random.default_rng(seed)
    t = np.sort(np.append(0.0, rng.uniform(0.0, 40.0, 499)))
    u = np.sin(0.9 * t + seed) + 0.6 * np.cos(2.3 * t)
    states = cart().simulate(t, [1.0, 0.0], u[:, None]).states
    noisy = states + noise * states.std(axis=0) * rng.standard_normal(states.shape)
    lacks = rng.random(states.shape) < missing
    return Trajectory(t, noisy, ["x", "v"], u[:, None], ["u"], missing=lacks)


def test_an_exact_law_under_inputs_follows_the_samples_to_within_their_noise() -> None:
    """At unequal steps, with noise and samples missing: no cycle overrules the samples."""
    runs = [driven(0.02, seed=seed, missing=0.05) for seed in range(3)]
    found = evaluate(cart(), runs)
    assert [each.status for each in found.each] == [Status.FOLLOWS] * 3
    for each in found.each:
        assert max(each.distance.values()) == pytest.approx(1.0, abs=0.15)
    assert found.heading.startswith("follows the samples for 39.")
    assert found.one_step is not None
    limit = float(found.one_step.limit.mean())
    assert found.one_step.score == pytest.approx(limit, abs=0.005)
    assert f"; the noise allows {limit:.3f}" in found.one_step.text
    assert cart().score([driven(0.0, seed=seed) for seed in range(3)]) == pytest.approx(1.0)


def test_an_input_that_no_term_holds_is_named() -> None:
    found = evaluate(cart(u=0.0), driven(0.02))
    assert found.status is Status.DEPARTS
    assert found.missing == "No term of the model holds the input u."
    assert found.heading == "departs from the samples"


def test_a_repelling_cycle_is_not_sustained_and_a_slow_one_is_not_told() -> None:
    """Rates that turn about the same circle: from it at 1 %, and to it within 300 periods."""
    repels = evaluate(hopf(growth=-0.01 / (4.0 * np.pi), turn=1.005), record())
    assert repels.comparison.stays
    assert repels.multiplier > 1.003
    assert repels.status is Status.REPELLING
    slow = evaluate(hopf(growth=1.0 / (4.0 * np.pi * 300.0), turn=1.005), record())
    assert slow.cycle is not None
    assert slow.cycle.relaxation_s == pytest.approx(300.0 * 2.0 * np.pi, rel=0.02)
    assert slow.status is Status.SUSTAINED  # LSODA stays on it for 900 periods
    away = evaluate(hopf(growth=1.0 / (4.0 * np.pi * 300.0), turn=1.005, radius=1.2), record())
    assert away.comparison.stays  # it leaves the record's circle later than the record ends
    assert away.status is Status.NOT_TOLD
    assert "lasts 302 periods: a longer record" in away.missing


def test_a_multiplier_is_as_uncertain_as_the_coefficients_make_it() -> None:
    cycle = evaluate(hopf(growth=0.02, turn=1.005), record()).cycle
    assert cycle is not None
    size = np.square(cycle.model.coef.T[cycle.model.coef.T != 0.0])
    errors = [
        multiplier_error(replace(cycle, model=replace(cycle.model, covariance=np.diag(v * size))))
        for v in (0.0, 1e-6, 4e-6)
    ]
    assert multiplier_error(cycle) == errors[0] == 1e-6
    assert errors[2] == pytest.approx(2.0 * errors[1], rel=1e-2)
    # By the growth rate alone: the multiplier is exp(-4 pi growth / turn).
    assert errors[1] > 1e-3 * 4.0 * np.pi * 0.02 / 1.005 * cycle.largest_multiplier / np.sqrt(2.0)


def test_the_last_sample_or_the_mean_vetoes_a_model_that_forecasts_worse() -> None:
    """Wild rates, fitted to a table of few rows: a candidate, not an equation."""
    rng = np.random.default_rng(0)
    table = Trajectory(np.arange(24.0), rng.standard_normal((24, 2)), ("x", "y"))
    found = evaluate(hopf(growth=-3.0, radius=3.0, turn=2.0), table)
    assert found.rival
    assert found.heading == f"no equations found: {found.rival} forecasts better"
    assert not evaluate(hopf(), record()).rival


@pytest.mark.parametrize("n", [40, 600])
def test_a_model_at_rest_does_not_follow_what_is_all_noise(n: int) -> None:
    noise = np.random.default_rng(0).standard_normal((n, 2))
    rest = model_of({"x": {"x": -1.0}, "y": {"y": -1.0}})
    found = evaluate(rest, Trajectory(np.arange(float(n)), noise, ("x", "y")))
    assert found.status is not Status.FOLLOWS
    coarse = record().window(0, 2001)
    every = coarse._at(slice(0, 2001, 70))  # less than a sample in a turn
    assert evaluate(rest, every).status is not Status.FOLLOWS


def test_states_need_not_be_measured_at_the_same_samples() -> None:
    run = record()
    turns = np.arange(run.n_samples)[:, None] % 2 == [0, 1]
    found = evaluate(hopf(), replace(run, missing=turns))
    assert found.status is Status.FOLLOWS
    assert found.one_step is None
    assert not evaluate(hopf(growth=-0.2, radius=1e9), replace(run, missing=turns)).rival
    first = np.zeros_like(turns)
    first[0, 0] = True  # a run from the interpolated sample would be off
    moved = replace(run, states=run.states + [[0.3, 0.0]] * (turns[:, :1] & first[:, :1]))
    assert evaluate(hopf(growth=0.001), replace(moved, missing=first)).status is Status.FOLLOWS


def test_a_long_run_begins_where_a_state_is_zero() -> None:
    """Slow enough for another solver to be asked."""
    t = np.linspace(0.0, 100.0, 1501)
    states = 1.02 * np.column_stack([np.cos(1.004 * t), np.sin(1.004 * t)])
    found = evaluate(hopf(growth=0.005), Trajectory(t, states, ("x", "y")))
    assert found.status is Status.SUSTAINED
    assert found.cycle is not None
    assert 3.0 * found.cycle.relaxation_s > t[-1]
