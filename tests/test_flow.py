"""The compiled flow against array expressions, which serve libraries with functions."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from benchmarks.collection import collected_draw
from ep2sindy.estimation.likelihood import TrajectoryFit, divergence_rate
from ep2sindy.estimation.problem import scale_problem
from ep2sindy.estimation.solver import from_smooth
from ep2sindy.model.flow import Steps, _in_arrays, ends, flow
from ep2sindy.model.flow_kernels import _advance
from ep2sindy.model.vector_field import VectorField

N = 37  # no multiple of the lanes


def steps(n_substeps: int, n_inputs: int, rng: np.random.Generator) -> Steps:
    return Steps(rng.uniform(0.05, 0.1, N), rng.normal(size=(2 * n_substeps + 1, N, n_inputs)))


@pytest.mark.parametrize("n_substeps", [1, 3])
@pytest.mark.parametrize("names", ["x", "xu", "xyzu", "xyzwab"])
def test_the_compiled_flow_is_that_of_array_expressions(names: str, n_substeps: int) -> None:
    rng, inputs = np.random.default_rng(0), names.count("u")
    d = len(names) - inputs
    library = ep.polynomial(list(names), degree=3)
    there = rng.random((len(library), d)) < 0.3
    field = VectorField(library, 0.2 * there * rng.normal(size=(len(library), d)))
    by = rng.integers(0, d, 9), rng.integers(0, len(library), 9)
    states, divided = rng.normal(size=(N, d)), steps(n_substeps, inputs, rng)
    plain = np.zeros((N, d, d + 9))
    expected = _in_arrays(field, states, divided, by, plain)
    found = flow(field, states, divided, by, n_more=2)
    np.testing.assert_allclose(found.ends, expected, rtol=1e-12)
    np.testing.assert_allclose(ends(field, states, divided), expected, rtol=1e-12)
    off = np.abs(found.slopes[:, :, :-2] - plain).max()
    assert off < 1e-12 * np.abs(plain).max()
    assert not found.slopes[:, :, -2:].any()


def test_a_chain_carries_a_change_as_far_as_its_stages_reach() -> None:
    """In x_k' = x_(k-1)^2 a step carries a change four states on, and no further."""
    names = [f"x{k}" for k in range(8)]
    library = ep.named_terms(names, [f"{name}^2" for name in names])
    field, rng = VectorField(library, np.eye(8, k=1)), np.random.default_rng(0)
    slopes = flow(field, rng.uniform(1, 2, (N, 8)), steps(1, 0, rng)).slopes
    far = np.subtract.outer(np.arange(8), np.arange(8))
    assert np.array_equal((slopes != 0.0).all(axis=0), (far >= 0) & (far <= 4))


def test_a_sample_that_runs_away_leaves_the_others_alone() -> None:
    library, rng = ep.polynomial(["x"], degree=3), np.random.default_rng(0)
    field = VectorField(library, np.array([[0.0], [0.0], [0.0], [1.0]]))
    states, divided = rng.normal(size=(N, 1)), steps(2, 0, rng)
    with np.errstate(over="ignore", invalid="ignore"):
        away = np.where(np.arange(N)[:, None] == 5, 1e200, states)
        found = flow(field, away, divided)
    assert not np.isfinite(found.ends[5])
    others = np.arange(N) != 5
    np.testing.assert_array_equal(found.ends[others], ends(field, states, divided)[others])
    assert np.isfinite(found.slopes[others]).all()


@pytest.mark.parametrize(("rate", "expected"), [(0.2, 0.2 * 2), (-0.2, 0.0), (0.0, 0.0)])
def test_paths_part_by_twice_the_positive_exponents(rate: float, expected: float) -> None:
    """x' = a x: a difference grows by exp(a) per step, its variance by exp(2 a)."""
    run = ep.Trajectory(np.arange(400.0), np.exp(np.arange(400.0)[:, None] / 400.0), ["x"])
    problem = scale_problem([run], ep.polynomial(["x"], degree=1))
    free = np.array([0.0, rate])
    noise, path = np.full((400, 1), 0.1), np.zeros((400, 1))
    fit = TrajectoryFit(problem, noise, 1e-4, path, free, free != 0.0, n_substeps=4)
    assert divergence_rate(fit) == pytest.approx(expected, abs=0.05)


def test_a_model_that_could_follow_any_samples_is_a_lack_of_fit() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.05, rng=0).window(0, 400)
    problem = scale_problem([run], ep.polynomial(run.state_names, degree=2))
    found = from_smooth(problem, None)
    assert found.fits
    (apart,) = [test for test in found.tests if "paths next to" in test.words]
    assert (apart.statistic < np.exp(0.05 / 2.0)).all()
    diverging = replace(found, tests=(replace(apart, statistic=np.full(2, np.exp(4.0 / 2.0))),))
    assert not diverging.fits
    (sign,) = diverging.signs
    assert "part by a factor of 7.4 per sample, so it could follow any samples" in sign


# The first is a long curved way off, where ten straight steps end far from the minimum. The second
# is a wrong optimum of seventeen terms, which only states that are relaxed again show to be one.
@pytest.mark.slow
@pytest.mark.parametrize("draw", [("AtmosphericRegime", 0.2, 1), ("HyperRossler", 0.01, 1)])
def test_supports_that_exchanges_between_exact_flows_do_not_reach(
    draw: tuple[str, float, int],
) -> None:
    pytest.importorskip("dysts")
    system, runs = collected_draw(*draw)
    found = ep.estimate(runs, system.model.library)
    assert np.array_equal(found.model.coef != 0.0, system.model.coef != 0.0)
    assert not found.lack_of_fit


def test_the_flow_is_compiled_once_for_search_and_refinement() -> None:
    """An array that is strided in one of them would be another type, which costs seconds."""
    before = len(_advance.signatures)
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    model = ep.discover(run).model
    ep.refine(model, run, n_windows=3, window=30)
    assert len(_advance.signatures) == max(before, 1)
