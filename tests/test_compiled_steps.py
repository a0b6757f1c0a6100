"""Kernels of refinement and free runs against plain forms, which serve functions and GPUs."""

import numpy as np
import pytest
import torch

import ep2sindy as ep
from ep2sindy.model import stability
from ep2sindy.model.stability import LimitCycle, basin_stability
from ep2sindy.model.vector_field import VectorField
from ep2sindy.refinement.kernels import condense, propagate, starts
from ep2sindy.refinement.ode import ODE, Drive, ScaledEquations
from ep2sindy.refinement.steps import FusedRungeKutta, RungeKutta, fastest_step
from tests.models import model_of

CASES = {
    "two states": {"x": {"x": 0.5, "x*y": -0.3}, "y": {"y": -0.7, "x*y": 0.2, "1": 0.1}},
    "an input": {"x": {"y*u": 1.2}, "y": {"x": -1.0, "u^2": 0.4, "x^2*y": -0.1}},
}


@pytest.mark.parametrize("n_substeps", [1, 2])
@pytest.mark.parametrize("case", CASES)
def test_fused_steps_are_those_of_torchdiffeq(case: str, n_substeps: int) -> None:
    rng, variables = np.random.default_rng(0), sorted({*"xy", *("u" if case == "an input" else "")})
    library = ep.polynomial(variables, degree=3)
    coef = ep.model.coef_matrix(library, [*CASES[case].values()])
    scale, n_inputs = np.array([2.0, 0.5, 3.0])[: len(variables)], len(variables) - 2
    model = ep.SparseModel(library, ["x", "y"], coef)
    ode = ODE.of([ScaledEquations.of(model, scale=scale, step_s=0.2)] * 3)
    drive = Drive(
        torch.tensor(rng.uniform(0.5, 1.5, size=(1, 3, 20))),
        torch.tensor(0.3 * rng.normal(size=(1, 4, 3, n_inputs, 20))),
    )
    nodes = rng.normal(size=(3, 4, 6, 2))
    ode.set(rng.uniform(0.5, 1.5, (3, ode.n_free)), drive)
    fused, steps = FusedRungeKutta(n_substeps), RungeKutta(n_substeps)
    for ours, torchs in (
        (fused.maps(ode, nodes), steps.maps(ode, nodes)),
        (fused.finer(ode, nodes), steps.finer(ode, nodes)),
        (fused.maps(ode, nodes, by_scaling=False), steps.maps(ode, nodes)[..., [0, 1, -1]]),
        (steps.maps(ode, nodes, by_scaling=False), steps.maps(ode, nodes)[..., [0, 1, -1]]),
    ):
        assert ours.shape == torchs.shape
        np.testing.assert_allclose(ours, torchs, rtol=1e-11, atol=1e-13)


def test_only_products_are_fused() -> None:
    assert isinstance(fastest_step(ep.polynomial(["x"])), FusedRungeKutta)
    assert isinstance(fastest_step(ep.polynomial(["x"], functions=["sin"])), RungeKutta)


def test_starts_that_a_kernel_brings_near_the_end_reach_what_a_loop_reaches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """van der Pol with a second, repelling cycle far out: some starts leave."""
    model = model_of({"x": {"y": 1.0}, "y": {"x": -1.0, "y": 1.0, "x^2*y": -1.0, "x^4*y": 0.05}})
    t = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    states = 2.0 * np.stack([np.sin(t), np.cos(t)], axis=1)
    cycle = LimitCycle(6.6, states, np.array([1.0, 0.001]), model)
    found = basin_stability(model, cycle, n_starts=32, n_periods=8.0)

    def as_they_are(field: VectorField, y: np.ndarray, *_: object) -> tuple:
        return y, np.zeros(len(y)), np.full(len(y), 100_000)

    monkeypatch.setattr(stability, "_approach", as_they_are)
    assert basin_stability(model, cycle, n_starts=32, n_periods=8.0) == found
    assert 0.0 <= found < 1.0


def test_each_start_takes_no_more_steps_than_allowed() -> None:
    """A circle, whose steps are a 64th of the time unit, since its Jacobian is small."""
    field = model_of({"x": {"y": 1.0}, "y": {"x": -1.0}}).field
    y, t, left = stability._approach(field, np.ones((3, 2)), np.zeros(2), 5.0, 1.0, 4)
    np.testing.assert_array_equal(left, 0)
    np.testing.assert_allclose(t, 4.0 / 64.0)
    np.testing.assert_allclose(y[:, 0], np.cos(1.0 / 16.0) + np.sin(1.0 / 16.0), rtol=1e-9)
    y, *_ = stability._approach(field, np.ones((3, 2)), np.zeros(2), 1.2, 1.0, 40)
    assert y.shape == (0, 2)


@pytest.mark.parametrize("free_start", [True, False])
def test_condensed_windows_are_the_least_squares_of_their_linearised_paths(
    free_start: bool,
) -> None:
    """Rows of W (dx_k + x_k - data_k), dx_(k+1) = F_x dx_k + F_s ds + F - x_(k+1), written out."""
    rng, n, p, n_samples = np.random.default_rng(0), 2, 3, 7
    maps = rng.normal(size=(1, 1, n_samples - 1, n, n + p + 1))
    nodes, data = rng.normal(size=(2, 1, 1, n_samples, n))
    weights, change = np.array([[1.5, 0.5]]), rng.normal(size=(1, p))
    n_start = n if free_start else 0
    triangles = condense(maps, nodes, data, weights, n_start)
    held = np.ascontiguousarray((data - nodes)[:, :, 0])
    first = starts(triangles, change, n) if free_start else held
    columns = np.zeros((n, n_start + p + 1))  # dx by the start, ds and one
    columns[:, :n_start] = np.eye(n, n_start)
    columns[:, -1] = 0.0 if free_start else held[0, 0]
    rows, paths = [], []
    for k in range(n_samples):
        left = columns.copy()
        left[:, -1] += (nodes - data)[0, 0, k]
        rows.append(weights[0][:, None] * left)
        paths.append(columns)
        if k + 1 < n_samples:
            step, ahead = maps[0, 0, k], np.zeros_like(columns)
            ahead[:, n_start:] = step[:, n:]
            ahead[:, -1] -= nodes[0, 0, k + 1]
            columns = ahead + step[:, :n] @ columns
    dense, triangle = np.concatenate(rows), triangles[0, 0]
    np.testing.assert_allclose(triangle.T @ triangle, dense.T @ dense, atol=1e-10)
    unknowns = np.append(change[0], 1.0)
    if free_start:
        target = -dense[:, n:] @ unknowns
        best = np.linalg.lstsq(dense[:, :n], target, rcond=None)[0]
        np.testing.assert_allclose(first[0, 0], best, rtol=1e-9)
        unknowns = np.append(best, unknowns)
    moved = propagate(maps, nodes, first, change)[0, 0]
    np.testing.assert_allclose(moved, [x @ unknowns for x in paths], atol=1e-9)
