"""Process noise: the law is found, and what a library lacks is none."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation.likelihood import TrajectoryFit
from ep2sindy.estimation.problem import scale_problem
from ep2sindy.estimation.process_noise import likely_errors, solve_with_process_noise
from ep2sindy.systems.systems import System

VAN_DER_POL = replace(ep.systems.van_der_pol(), duration_s=12.0)
N_SUBSTEPS = 10  # of the Euler-Maruyama scheme, around exact steps of the law


def moved(system: System, fraction: float, seed: int, *, noise: float = 0.01) -> Trajectory:
    """A record whose states process noise moves by a fraction of their RMS in ten samples."""
    rng, clean = np.random.default_rng(seed), system.trajectory()
    rms = np.sqrt(np.square(clean.states).mean(axis=0))
    size = fraction * rms / np.sqrt(10 * N_SUBSTEPS)
    h, none = clean.dt_s / N_SUBSTEPS, np.empty(0)
    x, states = clean.states[0].copy(), [clean.states[0].copy()]
    for _ in range(clean.n_samples - 1):
        for _ in range(N_SUBSTEPS):
            half = x + 0.5 * h * system.model.derivative(x, none)
            x = x + h * system.model.derivative(half, none) + size * rng.standard_normal(len(x))
        states.append(x.copy())
    samples = np.array(states) + noise * rms * rng.standard_normal((len(states), len(x)))
    return Trajectory(clean.t, samples, clean.state_names)


def counted(system: System, degree: int, seeds: range) -> tuple[int, int, int]:
    """Right supports without a lack of fit, and intervals of them that hold, of how many."""
    right = held = n = 0
    for seed in seeds:
        run = moved(system, 0.02, seed)
        found = ep.discover(run, ep.polynomial(run.state_names, degree=degree))
        truth = system.model
        if found.lack_of_fit or any(
            set(found.model.terms(s)) != set(truth.terms(s)) for s in truth.states
        ):
            continue
        assert "process noise moves the states" in found.data_warnings[0]
        right += 1
        for state in truth.states:
            for term, (low, high) in found.model.intervals(state).items():
                held += low <= truth.terms(state)[term] <= high
                n += 1
    return right, held, n


def test_a_law_is_found_under_process_noise_with_intervals_that_hold() -> None:
    right, held, n = counted(VAN_DER_POL, 3, range(1))
    assert right == 1
    assert held >= n - 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "degree"),
    [(ep.systems.van_der_pol(), 3), (ep.lorenz(), 2)],
    ids=lambda x: str(x)[:6],
)
def test_the_law_is_found_in_most_draws(system: System, degree: int) -> None:
    right, held, n = counted(system, degree, range(10))
    assert right >= 9
    assert held >= 0.8 * n  # nine in ten or so, less two standard errors


def test_the_sizes_of_process_noise_and_noise_are_found() -> None:
    run = moved(VAN_DER_POL, 0.02, 0)
    rms = np.sqrt(np.square(run.states).mean(axis=0))
    found = ep.estimate(run, ep.polynomial(run.state_names, degree=3))
    assert found.process_noise_std / rms == pytest.approx(0.02 / np.sqrt(10), rel=0.25)
    assert found.noise_std / rms == pytest.approx(0.01, rel=0.25)
    exact = ep.estimate(
        VAN_DER_POL.trajectory(noise=0.05, rng=0), ep.polynomial(["x", "y"], degree=3)
    )
    assert exact.process_noise_std.tolist() == [0.0, 0.0]


@pytest.mark.parametrize("noise", [0.01, 0.05])
def test_what_a_library_lacks_is_no_process_noise(noise: float) -> None:
    """x' lacks x^3."""
    run = ep.systems.van_der_pol().trajectory(noise=noise, rng=0)
    found = solve_with_process_noise(scale_problem([run], ep.polynomial(run.state_names, degree=2)))
    assert found.tests[2].statistic.max() > 6.0
    assert not found.fits


@pytest.mark.slow  # an equation without one of its states is told so in the fast suite
def test_an_equation_that_lacks_no_term_is_told_from_one_that_does() -> None:
    """x' lacks x^3, and the linear y' is right."""
    run = VAN_DER_POL.trajectory(noise=0.05, rng=0)
    found = ep.estimate(run, ep.polynomial(run.state_names, degree=2))
    assert found.explained_states == ("y",)
    assert "this library lacks terms: with products up to degree 3" in found.lack_of_fit
    assert found.model.terms("y") == pytest.approx({"x": 0.5}, rel=0.03)


def test_the_likeliest_errors_of_a_random_walk_are_exact() -> None:
    """Of x' = 0: differences have the variance 2 r^2 + q^2, and the covariance -r^2."""
    rng, n = np.random.default_rng(1), 20_000
    walk = np.cumsum(0.3 * rng.standard_normal(n))
    samples = walk + 0.5 * rng.standard_normal(n)
    run = Trajectory(np.arange(float(n)), samples[:, None], ["x"])
    problem = scale_problem([run], ep.polynomial(["x"], degree=1))
    none, guess = np.zeros(2), np.array([0.1])
    path = problem.records[0].samples
    fit = TrajectoryFit(problem, np.ones((n, 1)), 1.0, path, none, none > 0.0)
    noise, process, _ = likely_errors(fit.with_errors(guess, guess))
    assert noise * problem.scale == pytest.approx([0.5], rel=0.05)
    assert process * problem.scale == pytest.approx([0.3], rel=0.05)
