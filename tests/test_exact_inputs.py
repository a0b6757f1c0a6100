from dataclasses import replace

import numpy as np
import pytest

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import reweight
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import Regression
from ep2sindy.library.library import polynomial
from ep2sindy.regression.formulations import RandomSplit, Weak, WeightedWeak, is_switched
from ep2sindy.regression.front import fit_support
from ep2sindy.regression.rows import NoisyRows
from ep2sindy.signals.smoothers import SavitzkyGolay

T = np.arange(2000) * 0.01
SWITCH = np.where(np.random.default_rng(3).random(20) < 0.5, 0.0, 30.0).repeat(100)
EVERY_ROW = Weak(split=RandomSplit(0.0))


def driven(u: np.ndarray, noise: float = 0.0) -> Trajectory:
    """x' = -x + 2 u, exact for an input that holds its value from sample to sample."""
    x, decay = np.zeros_like(T), np.exp(-0.01)
    for k in range(len(T) - 1):
        x[k + 1] = decay * x[k] + 2 * (1 - decay) * u[k]
    x += noise * x.std() * np.random.default_rng(0).standard_normal(len(T))
    return Trajectory(T, x[:, None], ["x"], u[:, None], ["u"])


def followed(run: Trajectory, form: Weak) -> NoisyRows:
    library = polynomial(run.names, degree=1)
    (problem,) = form.assemble([run], library, rng=np.random.default_rng(0))
    assert problem.noisy is not None
    return problem.noisy


@pytest.mark.parametrize(
    "u",
    [
        SWITCH,
        SWITCH + np.linspace(0.0, 9.0, 20).repeat(100),  # a level of its own every second
        np.where(np.random.default_rng(1).random(2000) < 0.5, 0.0, 30.0),  # at every sample
        np.sin(2 * T),
        np.full(2000, 3.0),
    ],
    ids=["switched", "held", "random", "smooth", "constant"],
)
def test_inputs_that_are_set_are_neither_smoothed_nor_noisy(u: np.ndarray) -> None:
    run = driven(u, noise=0.05)
    for form in (EVERY_ROW, replace(EVERY_ROW, smoother=SavitzkyGolay())):
        rows = followed(run, form)
        assert np.array_equal(rows.smoothed[:, 1], u)
        assert np.array_equal(rows.noise_std[:, 1], np.zeros(len(u)))
        assert rows.noise_std[:, 0].min() > 0.0
        library = polynomial(run.names, degree=1)
        (problem,) = form.assemble([run], library, rng=np.random.default_rng(0))
        np.testing.assert_allclose(problem.theta[:, 2], rows.windows.mean @ u, atol=1e-12)


def test_a_measured_input_keeps_its_noise_unless_it_is_declared_exact() -> None:
    u = np.sin(2 * T) + 0.05 * np.random.default_rng(2).standard_normal(len(T))
    run = driven(u)
    assert followed(run, EVERY_ROW).noise_std[0, 1] == pytest.approx(0.05, rel=0.1)
    assert followed(run, replace(EVERY_ROW, exact_inputs=["u"])).noise_std[0, 1] == 0.0
    nothing = followed(driven(SWITCH), replace(EVERY_ROW, exact_inputs=[]))
    assert nothing.noise_std[0, 1] > 0.0


def test_noise_in_whole_digits_is_no_switch() -> None:
    noise = np.random.default_rng(0).standard_normal(2000)
    assert not is_switched(np.round(5.0 * noise))
    assert is_switched(np.round(0.1 * noise))


def test_only_inputs_can_be_exact() -> None:
    with pytest.raises(ValueError, match=r"must name inputs, got \['x'\]; .* inputs \['u'\]"):
        followed(driven(SWITCH), replace(EVERY_ROW, exact_inputs=["x"]))
    with pytest.raises(ValueError, match=r"a list, got 'u'; write \['u'\]"):
        Weak(exact_inputs="u")


@pytest.mark.parametrize("degree", [2, 3])
def test_a_switched_input_is_found_in_noise_and_what_repeats_it_named(degree: int) -> None:
    run = driven(SWITCH, noise=0.05)
    found = discover(run, polynomial(run.names, degree=degree), Regression(WeightedWeak()))
    assert set(found.model.terms("x")) == {"x", "u"}
    for term, truth in (("x", -1.0), ("u", 2.0)):
        # The trapezoidal rule takes a jump for half a step late or early: 5 ms in some 1 s.
        assert found.model.terms("x")[term] == pytest.approx(truth, rel=0.02)
    messages = [a.message for a in found.ambiguities]
    assert "'u^2' is a multiple of 'u' on every row and is left out" in messages


def test_corrections_of_nearly_equal_terms_do_not_run_away() -> None:
    """A smoothed switch tells u^2 from 30 u by its corners alone; whole steps end at 5000 u."""
    run = driven(SWITCH, noise=0.2)
    form = replace(EVERY_ROW, exact_inputs=[])
    library = polynomial(run.names, degree=2)
    (problem,) = form.assemble([run], library, rng=np.random.default_rng(0))
    x, u, square = reweight(problem, fit_support(problem, "x", ["u", "u^2", "x"])).coef
    assert abs(u) < 20.0
    assert u + 30.0 * square == pytest.approx(2.0, rel=0.02)
    assert x == pytest.approx(-1.0, rel=0.02)
