"""Figures of models beside the data: what every panel must hold."""

import numpy as np
import pytest

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.series import (
    derivative_figure,
    phase_figure,
    spectrum_figure,
    trajectory_figure,
)
from ep2sindy.figures.style import framing
from ep2sindy.library.library import named_terms
from ep2sindy.model.integrated import Integrated
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import Rollout
from ep2sindy.signals.smoothers import NoSmoothing
from ep2sindy.studies.shown import Shown, run_figures


@pytest.fixture(scope="module")
def oscillation() -> Trajectory:
    """Eight periods of x'' = -x, in SI units."""
    t = np.linspace(0.0, 16 * np.pi, 801)
    states = np.column_stack([np.cos(t), -np.sin(t)])
    return Trajectory(t, states, ("x", "v"), units={"x": "m", "v": "m/s"})


def rolled(t: np.ndarray, states: np.ndarray, *, diverged: bool = False) -> Rollout:
    names = ("x", "v")[: states.shape[1]]
    return Rollout(t, states, diverged, "", names, np.empty((len(t), 0)), (), {})


def rollouts(run: Trajectory, n: int) -> dict[str, Rollout]:
    """The data again, each a little larger; the last runs away."""
    grown = {f"model {k}": rolled(run.t, (1 + 0.1 * k) * run.states) for k in range(n)}
    away = run.states[:200] * np.exp(run.t[:200, None])
    return grown | {f"model {n - 1}": rolled(run.t[:200], away, diverged=True)}


@pytest.mark.parametrize("n_models", [1, 3, 8])
def test_every_model_has_a_row_and_every_state_a_column(
    oscillation: Trajectory, n_models: int
) -> None:
    models = rollouts(oscillation, n_models)
    for figure in (
        trajectory_figure(oscillation, models, duration_s=20.0),
        spectrum_figure(oscillation, models, f_max_Hz=1.0),
    ):
        assert len(figure.axes) == 2 * n_models
        names = [ax.get_ylabel() for ax in figure.axes[::2]]
        assert names[-1] == f"model {n_models - 1} (diverged)"
        assert all("m" in ax.get_title() for ax in figure.axes[:2])  # units


@pytest.mark.parametrize(("n_models", "n_columns"), [(1, 1), (3, 3), (5, 3), (8, 4)])
def test_phase_portraits_leave_no_empty_panel(
    oscillation: Trajectory, n_models: int, n_columns: int
) -> None:
    models = rollouts(oscillation, n_models)
    figure = phase_figure(oscillation, models, plane=("x", "v"), duration_s=20.0)
    assert [ax.get_title().removesuffix(" (diverged)") for ax in figure.axes] == list(models)
    labelled = [ax for ax in figure.axes if ax.get_xlabel()]
    assert len(labelled) == n_columns  # the lowest of every column


def test_lines_end_with_the_duration(oscillation: Trajectory) -> None:
    figure = trajectory_figure(oscillation, rollouts(oscillation, 3), duration_s=5.0)
    ends = [line.get_xdata()[-1] for ax in figure.axes for line in ax.lines]  # type: ignore[index]
    assert max(ends) <= 5.0
    assert min(ends) > 5.0 - 2 * oscillation.dt_s


def test_right_hand_sides_stand_in_the_order_of_the_data(oscillation: Trajectory) -> None:
    swapped = SparseModel(
        named_terms(("x", "v"), ("x", "v")), ("v", "x"), np.array([[-1.0, 0.0], [0.0, 1.0]])
    )
    figure = derivative_figure(
        oscillation, {"swapped": swapped}, smoother=NoSmoothing(), duration_s=20.0
    )
    for ax in figure.axes:
        data, model = (np.asarray(line.get_ydata())[5:-5] for line in ax.lines)
        # Central differences: dt**2 / 6 of the third derivative, which is 1 at most.
        assert np.abs(model - data).max() < oscillation.dt_s**2 / 6 * 1.01


def test_a_model_that_runs_away_does_not_shrink_the_rest() -> None:
    data = np.array([1.0, 3.0])
    assert framing(data, np.array([1e9, -1e9])) == pytest.approx((-0.2, 4.2))
    assert framing(data, np.array([2.0])) == pytest.approx((0.9, 3.1))
    assert framing(data, np.empty(0)) == framing(data, data)


def test_one_state_has_no_phase_portrait(oscillation: Trajectory) -> None:
    one = Trajectory(oscillation.t, oscillation.states[:, :1], ("x",))
    model = SparseModel(named_terms(("x",), ("x",)), ("x",), np.array([[-1.0]]))
    integrated = {"model": Integrated(model, rolled(one.t, one.states), {}, 0.0)}
    figures = run_figures(("phase", "spectra"), one, integrated, Shown(20.0, None))
    assert list(figures) == ["spectra"]
