"""Many models integrated together: truths stay on their samples, and what diverges is marked."""

import numpy as np
import pytest

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import polynomial
from ep2sindy.model.inputs import curve_through
from ep2sindy.model.many import WindowSteps, run_many
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.model.vector_field import VectorField
from ep2sindy.systems.systems import System, damped_oscillator, lorenz, lotka_volterra, van_der_pol

SYSTEMS = [damped_oscillator(), lotka_volterra(), van_der_pol(), lorenz()]


def paths_from(
    model: SparseModel, run: Trajectory, coefs: np.ndarray, starts: np.ndarray, n_samples: int
) -> np.ndarray:
    curve = curve_through(run.t, run.inputs, [None]) if model.inputs else None
    steps = WindowSteps.along(run.t, curve, starts, n_samples, n_substeps=2)
    centre, reach = run.states.mean(axis=0), 20.0 * run.states.std(axis=0)
    field = VectorField.of(model.library, [*model.states, *model.inputs], coefs)
    return run_many(field, run.states[starts], steps, centre=centre, reach=reach)


@pytest.mark.parametrize("system", SYSTEMS, ids=lambda s: s.name)
def test_the_truth_follows_noise_free_samples(system: System) -> None:
    run = system.trajectory()
    n_steps = run.n_samples // 10
    starts = np.arange(0, run.n_samples - n_steps, n_steps)
    spread = run.states.std(axis=0)
    paths = paths_from(system.model, run, system.model.coef[None], starts, n_steps + 1)
    samples = run.states[starts[:, None] + np.arange(n_steps + 1)]
    np.testing.assert_array_equal(paths[0, :, 0], samples[:, 0])
    # A mean square of 1e-9 variances over each window.
    assert np.square((paths[0] - samples) / spread).mean(axis=(1, 2)).max() < 1e-9


def test_inputs_drive_the_integration() -> None:
    # x' = u - x with u = 2 cos t: x = cos t + sin t; samples at unequal steps.
    t = np.sort(np.random.default_rng(0).uniform(0.0, 30.0, 600))
    u = 2.0 * np.cos(t)
    run = Trajectory(t, (np.cos(t) + np.sin(t))[:, None], ["x"], u[:, None], ["u"])
    library = polynomial(["u", "x"], degree=1)  # the library's order is its own
    coefs = np.stack(
        [coef_matrix(library, [terms]) for terms in ({"u": 1.0}, {"u": 1.0, "x": -1.0})]
    )
    starts = np.array([0, 100, 400])
    paths = paths_from(SparseModel(library, ["x"], coefs[1]), run, coefs, starts, 151)
    misses = np.abs(paths[..., 0] - run.states[starts[:, None] + np.arange(151), 0]).max(
        axis=(1, 2)
    )
    assert misses[0] > 1.0
    assert misses[1] < 1e-3  # of the cubics between samples up to 0.4 apart


def test_a_model_that_diverges_leaves_the_others_alone() -> None:
    system = damped_oscillator()
    run = system.trajectory()
    library = polynomial(["x", "v"], degree=3)
    given = [[{"v": 1.0}, {"x": -9.0, "v": -0.6}], [{"1": 1e3, "x^3": 1e6}, {"x": -9.0, "v": -0.6}]]
    coefs = np.stack([coef_matrix(library, terms) for terms in given])
    model = SparseModel(library, ["x", "v"], coefs[0])
    paths = paths_from(model, run, coefs, np.array([0, 50]), 101)
    assert np.isfinite(paths[0]).all()
    assert np.isfinite(paths[1, :, 0]).all()
    assert np.isnan(paths[1, :, -1]).all()
