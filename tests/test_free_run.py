"""Free runs: what becomes of a model that starts from one sample."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from benchmarks.known_systems import noisy
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.library.library import polynomial
from ep2sindy.model.comparison import FreeRunBounds, Status, samples_in
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.studies.views import found_model, worst_run
from ep2sindy.systems.systems import lorenz
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


def test_the_truth_lives_and_every_figure_is_exact() -> None:
    found = evaluate(hopf(), record())
    assert found.status is Status.SUSTAINED
    assert found.text == "sustained"
    assert found.f_error == pytest.approx(0.0, abs=1e-5)
    assert dict(found.amplitude_ratio) == pytest.approx({"x": 1.0, "y": 1.0}, abs=1e-3)
    assert max(found.waveform_error.values()) < 1e-3
    assert found.periods == pytest.approx(40.0, rel=1e-3)
    assert found.excursion == pytest.approx(np.sqrt(2.0), rel=1e-2)
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
    with pytest.raises(ValueError, match="the bound waveform must be positive: 0.0 came"):
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


def test_chaos_is_judged_by_its_distribution() -> None:
    system = replace(lorenz(), duration_s=60.0, rate_Hz=100.0)
    run = system.trajectory()
    truth = evaluate(system.model, run)
    assert truth.status is Status.NO_CYCLE
    assert truth.is_similar
    assert truth.text == "no cycle to compare; its statistics are the record's"
    assert np.isnan(truth.f_error)
    still = replace(system.model, coef=system.model.coef.copy())
    coef = still.coef.copy()
    coef[list(still.library.names).index("x"), 1] = 12.0  # rho = 12: two fixed points
    assert evaluate(replace(still, coef=coef), run).status is Status.DECAYS
    wide = system.model.coef.copy()
    wide[list(still.library.names).index("x"), 1] = 60.0
    other = evaluate(replace(still, coef=wide), run)
    assert other.status is Status.NO_CYCLE
    assert other.text == "no cycle to compare; its statistics are not the record's"
    assert sorted([other, truth], key=lambda found: found.rank)[0] is truth


def test_a_run_that_needs_ever_smaller_steps_stops() -> None:
    library = polynomial(["x", "y"], degree=1)
    coef = coef_matrix(library, [{"y": 1e6}, {"x": -1e6}])
    rollout = SparseModel(library, ["x", "y"], coef).simulate(np.linspace(0, 1e4, 50), [1.0, 0.0])
    assert rollout.diverged
    assert "its steps became too small for the samples" in rollout.message


def test_samples_of_a_duration() -> None:
    run = record()
    assert samples_in(run, float(run.t[10])) == 11
    with pytest.raises(ValueError, match="a window must hold two samples"):
        samples_in(run, 1e-9)


SLOW = pytest.mark.slow


@pytest.mark.parametrize("number", [0, pytest.param(1, marks=SLOW), pytest.param(3, marks=SLOW)])
def test_the_true_model_of_a_chaotic_record_is_alike_and_a_wrong_one_is_not(number: int) -> None:
    """Rossler's frequency and waveform wander: no run lies closer than the data's own parts."""
    system, run = noisy("rossler", 0.05, number)
    truth = evaluate(system.model, run)
    assert (truth.status, truth.is_similar) == (Status.NO_CYCLE, True)
    coef = system.model.coef
    periodic = replace(system.model, coef=np.where(coef == -5.7, -3.0, coef))
    other = evaluate(periodic, run)
    assert other.status is Status.WRONG_CYCLE
    assert truth.rank < other.rank


@pytest.mark.parametrize(
    ("radius", "unit", "verdict"),
    [
        (1.0, "m^-3", Status.SUSTAINED),
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


def test_the_title_of_a_result_says_where_a_model_was_fitted_and_what_it_does_not_explain() -> None:
    run = evaluate(hopf(), record())

    def title(run: Evaluation, **how: Any) -> str:
        return found_model("Found", run, file="a", picture="", where="it", **how).title

    assert title(run) == "Found: a model that is sustained"
    assert title(run, seen=True) == "Found: a model that is sustained where it was fitted"
    similar = replace(run, status=Status.NO_CYCLE)
    assert title(similar) == "Found: a model that has the statistics of the data"
    assert title(similar, misfit="no law") == "Found: a model that does not explain the data"


def test_of_several_records_the_worst_run_counts() -> None:
    run = evaluate(hopf(), record())
    apart = replace(run, is_similar=False, status=Status.DIVERGES)
    assert worst_run([run, apart, run]) is apart


def test_a_neutral_cycle_is_told_and_an_attracting_one_is_not() -> None:
    neutral, attracting = hopf(growth=0.0), hopf()
    cautions = [evaluate(each, record()).caution for each in (neutral, attracting)]
    assert "neither attracts nor repels" in cautions[0]
    assert not cautions[1]
