"""How far signals can be foreseen, and what is searched and chosen in them therefore."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.discovery.foresight import Foresight, foresee
from ep2sindy.discovery.one_signal import Preparation, ToldFacts, judged_by, try_in_turn
from ep2sindy.selection.by_windows import WindowsLeftOut
from ep2sindy.signals.trace import Trace, prepare_signal

QUICK = ep.Regression(
    search=ep.BestSubset(max_terms=2, n_best=2),
    selection=ep.FreeRunScore(n_windows=40),
    depth=2,
)


def trace_of(x: np.ndarray, step_s: float = 1.0) -> Trace:
    return prepare_signal(ep.Trajectory(step_s * np.arange(len(x)), x[:, None], ("x",)))


def line_in_noise(n: int = 3000, period: float = 30.0, damping: float = 0.03) -> np.ndarray:
    """An AR(2): a line at one frequency that noise drives."""
    rng, x, r = np.random.default_rng(0), np.zeros(n), 1.0 - damping
    for k in range(2, n):
        x[k] = 2.0 * r * np.cos(2.0 * np.pi / period) * x[k - 1] - r**2 * x[k - 2]
        x[k] += rng.standard_normal()
    return x


def chaos(n: int = 2000) -> np.ndarray:
    return ep.lorenz().model.simulate(0.04 * np.arange(n + 100), [1.0, 2.0, 20.0]).states[100:, 0]


def test_a_line_that_noise_drives_is_linear_and_chaos_is_not() -> None:
    assert foresee(trace_of(line_in_noise())).is_linear
    found = foresee(trace_of(chaos(), 0.04))
    assert not found.is_linear
    assert found.ahead is not None
    assert found.ahead >= 5


def test_of_few_turns_nothing_is_said() -> None:
    short = trace_of(line_in_noise(300))
    assert foresee(short) == Foresight()


def test_a_periodic_signal_is_foreseen_without_an_end() -> None:
    signal = trace_of(np.sin(2.0 * np.pi * np.arange(1000) / 40.0))
    assert foresee(signal) == Foresight()


def test_of_a_linear_signal_linear_equations_alone_are_tried() -> None:
    tried = [Preparation("hidden", degree=2), Preparation("auto"), Preparation("auto", 3)]
    (attempt,) = try_in_turn(trace_of(line_in_noise()), tried, QUICK)
    assert attempt.preparation == Preparation("auto", degree=1)
    assert attempt.is_damped_line
    assert attempt.found.model.terms("v")["x"] == pytest.approx(-((2 * np.pi / 30.0) ** 2), rel=0.2)
    assert attempt.process_noise_std["v"] > 0.0


def test_models_are_judged_as_far_ahead_as_the_signal_is_foreseen() -> None:
    method = judged_by(QUICK, "x", 7)
    assert isinstance(method, ep.Regression)
    assert method.selection == replace(QUICK.selection, judged=("x",), ahead=7)
    assert judged_by(ep.TrajectorySearch(), "x", 7) == ep.TrajectorySearch()


def test_windows_that_are_run_through_tell_a_law_of_chaos_from_others() -> None:
    system = ep.lorenz()
    run = system.trajectory().window(0, 1200)
    measure = WindowsLeftOut([run], run.states.std(axis=0), run.state_names, 20, 2, ahead=12)
    assert measure.window == 13
    assert measure.window_on_all == 13
    wrong = replace(system.model, coef=1.1 * system.model.coef)
    off = measure._run_through([system.model, wrong], measure.folds[0].held)
    assert off.shape[:1] + off.shape[2:] == (2, 13, 3)
    np.testing.assert_array_equal(off[:, :, 0], 0.0)
    assert np.abs(off[0]).max() < 1e-3 < np.abs(off[1]).max()


def test_what_is_told_holds_in_the_library_of_every_preparation_that_has_it() -> None:
    states = ep.embed(trace_of(np.sin(np.arange(600) / 6.0)), "derivative")
    told = ToldFacts(
        exclude={"v": ["x^2", "x^5"], "g": ["x"]},
        relations=["v: x == -1 * v: v", "g: x == 1"],
        rests_at_zero=True,
    )
    library = told.add_to(states.library(2, ["cos(x)", "sin(x)"]), states)
    assert set(library.facts.excluded["v"]) == {"x^2", "1", "cos(x)"}
    assert set(library.facts.excluded) == {"v"}
    assert len(library.facts.relations) == len(states.relations) + 1
