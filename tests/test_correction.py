from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.library.relations import constraint
from ep2sindy.model.model import SparseModel, coef_matrix
from ep2sindy.refinement.correction import Corrected, refine_with_correction
from ep2sindy.refinement.methods.gradient_descent import GradientDescent
from ep2sindy.regression.bootstraps import Bootstraps, pool_supports
from ep2sindy.regression.front import Candidate, pareto_front
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import BestSubset
from ep2sindy.selection.criteria import Knee
from ep2sindy.systems.systems import lotka_volterra

PREY = lotka_volterra()
DENSITY = 1e18


@cache
def data() -> Trajectory:
    return PREY.trajectory()


def known_part() -> SparseModel:
    """Growth and decay without the interaction."""
    library = named_terms(["x", "y"], ["x", "y"])
    equations = [{"x": PREY.model.terms("x")["x"]}, {"y": PREY.model.terms("y")["y"]}]
    return SparseModel(library, ["x", "y"], coef_matrix(library, equations))


def network(n_in: int, n_out: int, *, hidden: int = 8) -> nn.Module:
    """Zero at first, so that training starts from the known part."""
    torch.manual_seed(0)
    last = nn.Linear(hidden, n_out)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(nn.Linear(n_in, hidden), nn.Tanh(), last)


def refined(model: SparseModel, run: Trajectory, module: nn.Module, **settings: Any) -> Corrected:
    """From the same windows at each call."""
    rng = np.random.default_rng(0)
    return refine_with_correction(model, [run], module, seed=rng, **settings)


class Fixed(nn.Module):
    """The first variable times the last, in units of their scales, into every state."""

    def __init__(self, n_states: int) -> None:
        super().__init__()
        self.n_states = n_states

    def forward(self, values: torch.Tensor) -> torch.Tensor:
        return (values[:, :1] * values[:, -1:]).expand(-1, self.n_states)


def named(found: Corrected, library: Library) -> list[Candidate]:
    """What the learned term is, equation by equation, at the fitted states."""
    states = found.trajectories.reshape(-1, len(found.model.states))
    rows = RegressionRows(
        theta=library.evaluate(states),
        target=found.learned(states),
        library=library,
        equations=found.model.states,
        groups=np.arange(len(states)),
        test=np.zeros(len(states), dtype=np.bool_),
    )
    supports = pool_supports(
        rows, BestSubset(max_terms=4), Bootstraps(n=0), rng=np.random.default_rng(0)
    )
    fronts = [pareto_front(rows, each) for each in supports]
    return [
        front.with_scores(score).best
        for front, score in zip(fronts, Knee(scale="log").decide(fronts).scores, strict=True)
    ]


@pytest.mark.slow  # torch.optim imports torch's compiler
def test_missing_interaction_is_learned_and_named() -> None:
    model = known_part()
    held = constraint(
        model.library,
        {"x": ("x",), "y": ("y",)},
        [f"x: x == {model.terms('x')['x']!r}", f"y: y == {model.terms('y')['y']!r}"],
    )
    found = refined(model, data(), network(2, 2), window=25, n_windows=10, constraint=held)
    assert found.status == "converged"
    assert found.loss < 1e-5 * found.loss_before
    assert found.loss == pytest.approx(found.window_loss.mean())
    np.testing.assert_array_equal(found.model.coef, model.coef)
    assert found.model.covariance is None
    prey, predator = named(found, polynomial(["x", "y"], degree=2))
    # Eight neurons leave a learned term 0.3 % off; its projection on one term is closer.
    for candidate, truth in ((prey, -1.0), (predator, 1.0)):
        assert candidate.terms == ("x*y",)
        assert candidate.coef[0] == pytest.approx(truth, rel=3e-3)


@pytest.mark.slow
def test_rescaled_units_change_the_learned_term_and_nothing_else() -> None:
    model = known_part()
    big = replace(data(), states=data().states * DENSITY, t=data().t * 1e-6)
    rescaled = replace(model, coef=model.coef * 1e6)
    small, large = (
        refined(m, d, network(2, 2), window=10, n_windows=3, method=GradientDescent(max_iter=1))
        for m, d in ((model, data()), (rescaled, big))
    )
    states = data().states[::100]
    assert large.loss == pytest.approx(small.loss, rel=1e-6)
    np.testing.assert_allclose(
        large.learned(states * DENSITY) / (DENSITY * 1e6), small.learned(states), rtol=1e-5
    )


@pytest.mark.slow
def test_learned_term_is_in_si_and_knows_the_inputs() -> None:
    """x' = -x + c x u: with c x u for a correction, its SI value is what integrates exactly."""
    t = np.linspace(0.0, 3.0, 200)
    u = 3.0 * np.cos(t)
    x = 5.0 * np.exp(-t + 0.2 * 3.0 * np.sin(t))
    run = Trajectory(t, x[:, None], ["x"], u[:, None], ["u"])
    library = named_terms(["x", "u"], ["x"])
    model = SparseModel(library, ["x"], np.array([[-1.0]]))
    once = GradientDescent(max_iter=1)
    trial = refined(model, run, Fixed(1), window=50, n_windows=3, method=once)
    # Fixed returns x u / scale, so this factor of it is 0.2 x u in SI.
    factor = 0.2 * trial.scale.prod() / trial.rate[0]
    layer = nn.Linear(1, 1, bias=False)
    nn.init.constant_(layer.weight, float(np.float32(factor)))
    found = refined(model, run, nn.Sequential(Fixed(1), layer), window=50, n_windows=3)
    assert found.loss < 1e-10
    np.testing.assert_allclose(
        found.learned(x[:, None], u[:, None]), (0.2 * x * u)[:, None], rtol=1e-3, atol=1e-3
    )
    assert found.model.terms("x")["x"] == pytest.approx(-1.0, rel=1e-3)
    with pytest.raises(ValueError, match=r"takes \['x'\] and inputs \['u'\], got 1 columns"):
        found.learned(x[:, None])


@pytest.mark.slow
def test_callers_module_is_left_alone_and_seeding_decides_the_rest() -> None:
    given = network(2, 2)
    before = [p.detach().clone() for p in given.parameters()]
    first, second = (
        refined(
            known_part(), data(), given, window=10, n_windows=3, method=GradientDescent(max_iter=2)
        )
        for _ in range(2)
    )
    assert first.status == "max_iter"
    assert len(first.history) == 2
    for old, now in zip(before, given.parameters(), strict=True):
        assert torch.equal(old, now)
    states = data().states[::50]
    np.testing.assert_array_equal(first.learned(states), second.learned(states))
    assert np.abs(first.learned(states)).max() > 0.0


@pytest.mark.slow
def test_blow_up_hands_back_what_came() -> None:
    model = replace(known_part(), coef=known_part().coef * 1e4)
    found = refined(model, data(), network(2, 2), window=50, n_windows=2)
    assert found.status == "non_finite"
    assert found.loss == found.loss_before == float("inf")
    np.testing.assert_allclose(found.model.coef, model.coef, rtol=1e-15)
    np.testing.assert_array_equal(found.learned(data().states), 0.0)


def test_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"one column per state \['x', 'y'\], got \(3, 1\)"):
        refined(known_part(), data(), network(2, 1), window=10)
