"""How far signals can be foreseen, and what is searched and chosen in them therefore."""

from typing import NoReturn

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.data.coerce import FailedTryError
from ep2sindy.discovery.foresight import is_linear
from ep2sindy.discovery.one_signal import Preparation, StatedFacts, try_in_turn
from ep2sindy.signals.signal import Signal, prepare_signal

QUICK = ep.Regression(
    search=ep.BestSubset(max_terms=2, n_best=2),
    selection=ep.FreeRunScore(n_windows=40),
    depth=2,
)


def trace_of(x: np.ndarray, step_s: float = 1.0) -> Signal:
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
    assert is_linear(trace_of(line_in_noise()))
    assert not is_linear(trace_of(chaos(), 0.04))


def test_of_few_turns_and_of_a_period_nothing_is_reported() -> None:
    assert not is_linear(trace_of(line_in_noise(300)))
    assert not is_linear(trace_of(np.sin(2.0 * np.pi * np.arange(1000) / 40.0)))


def test_of_a_linear_signal_linear_equations_alone_are_tried() -> None:
    tried = [Preparation("hidden", degree=2), Preparation("auto"), Preparation("auto", 3)]
    (attempt,) = try_in_turn(trace_of(line_in_noise()), tried, QUICK)
    assert attempt.preparation == Preparation("auto", degree=1)
    assert attempt.is_damped_line
    assert attempt.found.model.terms("v")["x"] == pytest.approx(-((2 * np.pi / 30.0) ** 2), rel=0.2)
    assert attempt.process_noise_std["v"] > 0.0


def test_a_positive_signal_that_is_linear_has_a_derivative_and_no_rate() -> None:
    x = line_in_noise()
    positive = trace_of(x + 1.5 * np.abs(x).max())
    (attempt,) = try_in_turn(positive, [Preparation("auto")], QUICK)
    assert attempt.preparation == Preparation("derivative", degree=1)
    assert attempt.is_damped_line


class Failing(Preparation):
    def search(self, *args: object, **settings: object) -> NoReturn:
        raise FailedTryError("no states fit the data")


def test_a_try_that_fails_leaves_the_others() -> None:
    signal, failing = trace_of(line_in_noise()), Failing("hidden")
    tried = [failing, Preparation("derivative", degree=1)]
    (attempt,) = try_in_turn(signal, tried, QUICK, linear=False)
    assert attempt.preparation == tried[1]
    with pytest.raises(FailedTryError, match="no states fit the data"):
        try_in_turn(signal, [failing], QUICK, linear=False)


def test_what_is_stated_holds_in_the_library_of_every_preparation_that_has_it() -> None:
    states = ep.embed(trace_of(np.sin(np.arange(600) / 6.0)), "derivative")
    facts = StatedFacts(
        exclude={"v": ["x^2", "x^5"], "g": ["x"]},
        relations=["v: x == -1 * v: v", "g: x == 1"],
        rests_at_zero=True,
    )
    library = facts.add_to(states.library(2, ["cos(x)", "sin(x)"]), states)
    assert set(library.facts.excluded["v"]) == {"x^2", "1", "cos(x)"}
    assert set(library.facts.excluded) == {"v"}
    assert len(library.facts.relations) == len(states.relations) + 1
