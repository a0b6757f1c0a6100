"""Figures of models next to the data: what every panel must hold."""

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.figures.series import (
    derivative_figure,
    phase_figure,
    trajectory_figure,
)
from ep2sindy.figures.style import frame_limits
from ep2sindy.model.rollout import Rollout
from ep2sindy.report.report import Report
from ep2sindy.studies.views import PlotRange, add_figures


@pytest.fixture(scope="module")
def oscillation() -> ep.Trajectory:
    """Eight periods of x'' = -x, in SI units."""
    t = np.linspace(0.0, 16 * np.pi, 801)
    states = np.column_stack([np.cos(t), -np.sin(t)])
    return ep.Trajectory(t, states, ("x", "v"), units={"x": "m", "v": "m/s"})


def rolled(t: np.ndarray, states: np.ndarray, *, diverged: bool = False) -> Rollout:
    names = ("x", "v")[: states.shape[1]]
    return Rollout(t, states, diverged, "", names, np.empty((len(t), 0)), (), {})


def rollouts(run: ep.Trajectory, n: int) -> dict[str, Rollout]:
    """The data again, each a little larger; the last runs away."""
    grown = {f"model {k}": rolled(run.t, (1 + 0.1 * k) * run.states) for k in range(n)}
    away = run.states[:200] * np.exp(run.t[:200, None])
    return grown | {f"model {n - 1}": rolled(run.t[:200], away, diverged=True)}


@pytest.mark.parametrize("n_models", [1, 3, 8])
def test_every_model_has_a_row_and_every_state_a_column(
    oscillation: ep.Trajectory, n_models: int
) -> None:
    models = rollouts(oscillation, n_models)
    figure = trajectory_figure(oscillation, models, duration_s=20.0)
    assert len(figure.axes) == 2 * n_models
    names = [ax.get_ylabel() for ax in figure.axes[::2]]
    assert names[-1] == f"model {n_models - 1}\n(diverges at 12.5 s)"
    assert all("m" in ax.get_title() for ax in figure.axes[:2])  # units


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


def test_runs_are_named_by_what_becomes_of_them(
    oscillation: ep.Trajectory,
) -> None:
    runs = rollouts(oscillation, 2)
    words = {"model 0": "follows the data", "model 1": "which ended badly"}
    rows = trajectory_figure(oscillation, runs, duration_s=20.0, statuses=words)
    plane = phase_figure(oscillation, runs, duration_s=20.0, statuses=words)
    names = ["model 0\n(follows the data)", "model 1\n(diverges at 12.5 s)"]
    assert [ax.get_ylabel() for ax in rows.axes[::2]] == names
    assert [ax.get_title() for ax in plane.axes] == names


def test_times_of_a_run_count_from_its_start(oscillation: ep.Trajectory) -> None:
    late = ep.Trajectory(1e-6 * oscillation.t + 7e-3, oscillation.states, ("x", "v"))
    runs = {"model": rolled(late.t[:100], 1.2 * late.states[:100], diverged=True)}
    since = "time since noon"
    figure = trajectory_figure(late, runs, duration_s=2e-5, since=since)
    assert figure.axes[0].get_ylabel() == "model\n(diverges at 6.22 µs)"
    assert {ax.get_xlabel() for ax in figure.axes} == {"time since noon (µs)"}
    data = figure.axes[0].lines[0].get_xdata()
    assert data == pytest.approx(oscillation.t[oscillation.t <= 20.0])  # type: ignore[comparison-overlap]


def test_one_state_has_no_phase_portrait(oscillation: ep.Trajectory) -> None:
    one = ep.Trajectory(oscillation.t, oscillation.states[:, :1], ("x",))
    model = ep.SparseModel(ep.named_terms(("x",), ("x",)), ("x",), np.array([[-1.0]]))
    integrated = {"model": ep.evaluate(model, one)}
    report = Mock(Report)
    add_figures(report, ("phase", "trajectories"), one, integrated, PlotRange(20.0))
    assert [call.args[0] for call in report.figure.mock_calls] == ["trajectories"]
