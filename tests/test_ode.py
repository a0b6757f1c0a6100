import numpy as np
import pytest
import torch
from torch import nn
from torchdiffeq import odeint

import ep2sindy as ep
from ep2sindy.refinement.ode import ODE, Drive, ScaledEquations
from ep2sindy.refinement.steps import FusedRungeKutta, RungeKutta, Step

SCALE = np.array([2.0, 3.0])


def driven_model() -> ep.SparseModel:
    """x' = -x u + 3, y' = x^2 y - y: powers, a constant and an input."""
    library = ep.named_terms(["u", "x", "y"], ["1", "y", "u*x", "x^2*y"])
    equations = [{"1": 3.0, "u*x": -1.0}, {"y": -1.0, "x^2*y": 0.4}]
    return ep.SparseModel(library, ["x", "y"], ep.model.coef_matrix(library, equations))


def module(model: ep.SparseModel, scale: np.ndarray, step_s: float) -> ODE:
    return ODE.of([ScaledEquations.of(model, scale=scale, step_s=step_s)])


def constant_drive(value: float, n_batch: int, *, step: float = 1.0) -> Drive:
    inputs = torch.zeros((1, 4, 1, 1, n_batch), dtype=torch.float64)
    inputs[:, 3] = value
    return Drive(torch.full((1, 1, n_batch), step, dtype=torch.float64), inputs)


def test_rate_is_the_models_in_scaled_states_and_time() -> None:
    model = driven_model()
    ode = module(model, np.array([2.0, 3.0, 5.0]), 0.1)
    ode.drive = constant_drive(0.7, 4, step=2.0)
    x = np.random.default_rng(0).standard_normal((4, 2))
    rate = ode(torch.tensor(0.3), torch.tensor(x.T[None, None].copy())).detach().numpy()[0, 0].T
    inputs = np.full((4, 1), 0.7 * 5.0)
    expected = model.derivative(x * SCALE, inputs) / SCALE * 0.1 * 2.0
    np.testing.assert_allclose(rate, expected, rtol=1e-13)


def test_relations_hold_to_rounding_for_any_scaling() -> None:
    model = ep.lotka_volterra().model
    relations = ep.library.constraint(
        model.library,
        {s: tuple(model.terms(s)) for s in model.states},
        ["x: x*y == -1 * y: x*y", "y: y == -0.5"],
    )
    equations = ScaledEquations.of(model, scale=SCALE, step_s=0.1, constraint=relations)
    assert equations.n_free == 2
    values = equations.coef(np.array([0.3, -7.0]))
    coef = dict(zip(relations.coefficients, values.tolist(), strict=True))
    assert coef["x", "x*y"] == -coef["y", "x*y"]
    assert coef["y", "y"] == -0.5


def test_tangents_agree_with_autograd() -> None:
    ode = module(driven_model(), np.array([2.0, 3.0, 5.0]), 0.1)
    x = torch.randn((3, 2), dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    scaling = torch.tensor([[1.1, 0.8, -0.5, 2.0]], dtype=torch.float64)
    ode.set(scaling.numpy(), constant_drive(0.7, 3))
    z = torch.randn((1, 7, 2, 3), dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    z[0, 0] = x.T
    with torch.inference_mode():
        out = ode(torch.tensor(0.0), z)[0].permute(2, 1, 0)

    def rate(state: torch.Tensor, factors: torch.Tensor) -> torch.Tensor:
        at, column = {"scaling": factors}, state.T[None, None]
        return torch.func.functional_call(ode, at, (torch.tensor(0.0), column))[0, 0].T

    by_state, by_scaling = torch.autograd.functional.jacobian(rate, (x, scaling))
    tangents = torch.einsum("bibj,cjb->bic", by_state, z[0, 1:])
    tangents[:, :, 2:] += by_scaling[:, :, 0]
    torch.testing.assert_close(out[:, :, 0], rate(x, scaling).detach())
    torch.testing.assert_close(out[:, :, 1:], tangents)


@pytest.mark.parametrize("step", [RungeKutta(), RungeKutta(2), FusedRungeKutta()])
def test_steps_are_of_order_four(step: Step) -> None:
    """x' = -x from one: the end of a step against exp(-h)."""
    library = ep.named_terms(["x"], ["x"])
    model = ep.SparseModel(library, ["x"], np.array([[-1.0]]))
    errors = []
    for h in (0.2, 0.1):
        ode = module(model, np.ones(1), h)
        drive = Drive(torch.ones((1, 1, 1), dtype=torch.float64), torch.zeros((1, 4, 1, 0, 1)))
        nodes = np.array([1.0, np.exp(-h)]).reshape(1, 1, 2, 1)
        ode.set(np.ones((1, 1)), drive)
        maps = step.maps(ode, nodes)
        errors.append(abs(maps[0, 0, 0, 0, -1] - np.exp(-h)))
        np.testing.assert_allclose(maps[0, 0, 0, 0, :-1], [np.exp(-h), -h * np.exp(-h)], rtol=2e-4)
    # One step's error falls with the fifth power.
    assert np.log2(errors[0] / errors[1]) == pytest.approx(5.0, abs=0.2)


def test_cubic_inputs_drive_torchdiffeq_exactly() -> None:
    """x' = u with u a cubic: rk4 integrates it exactly, over two segments."""
    library = ep.named_terms(["x", "u"], ["u"])
    ode = module(ep.SparseModel(library, ["x"], np.array([[1.0]])), np.ones(2), 1.0)
    shifted = [[1.0, -2.0, 0.5, 3.0], [1.0, 1.0, -0.5, 2.5]]  # t^3 - 2 t^2 + t/2 + 3, about 0 and 1
    inputs = torch.tensor(shifted, dtype=torch.float64).view(2, 4, 1, 1, 1)
    ode.drive = Drive(torch.ones((2, 1, 1), dtype=torch.float64), inputs)
    t = torch.arange(3, dtype=torch.float64)
    path = odeint(ode, torch.zeros((1, 1, 1, 1), dtype=torch.float64), t, method="rk4")
    exact = t**4 / 4 - 2 * t**3 / 3 + t**2 / 4 + 3 * t
    torch.testing.assert_close(path[:, 0, 0, 0, 0].detach(), exact)


class Constant(nn.Module):
    def forward(self, values: torch.Tensor) -> torch.Tensor:
        return torch.ones_like(values)


def test_correction_adds_to_the_rate() -> None:
    equations = ScaledEquations.of(ep.lotka_volterra().model, scale=SCALE, step_s=0.1)
    plain, extended = ODE.of([equations]), ODE.of([equations], Constant())
    for ode in (plain, extended):
        ode.drive = Drive(torch.ones((1, 1, 1)), torch.zeros((1, 4, 1, 0, 1)))
    x, t = torch.ones((1, 1, 2, 1), dtype=torch.float64), torch.tensor(0.0)
    torch.testing.assert_close(extended(t, x), plain(t, x) + 1.0)


def test_bad_models_are_refused() -> None:
    model = ep.lotka_volterra().model
    narrow = ep.library.constraint(model.library, {"x": ("x",), "y": ("y", "x*y")})
    with pytest.raises(ValueError, match=r"must cover every term .*\('x', 'x\*y'\)"):
        ScaledEquations.of(model, scale=SCALE, step_s=0.1, constraint=narrow)
    wide = ep.library.constraint(model.library, {"x": ("x", "x^2", "x*y"), "y": ("y", "x*y")})
    with pytest.raises(ValueError, match=r"free coefficient must start away from zero.*x\^2"):
        ScaledEquations.of(model, scale=SCALE, step_s=0.1, constraint=wide)
