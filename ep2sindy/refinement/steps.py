"""Step schemes of a refinement: ends of steps over one sample, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from torchdiffeq import odeint

from ep2sindy.library.library import Library
from ep2sindy.model.flow_kernels import advance, sums_of_products
from ep2sindy.model.runge_kutta import THREE_EIGHTHS
from ep2sindy.refinement.kernels import propagate
from ep2sindy.refinement.ode import ODE, Drive
from ep2sindy.runtime.values import set_counts

NEWTON_STEPS = 20  # Newton steps at most for two implicit half steps, started from a whole step


@runtime_checkable
class Step(Protocol):
    """Interface of the step schemes.

    ode: with its scalings set, and a drive of one segment over a batch of (windows * segments).
    nodes: (points, windows, samples, n_states).
    """

    def maps(self, ode: ODE, nodes: np.ndarray, *, by_scaling: bool = True) -> np.ndarray:
        """End of each step and its derivatives, in the layout of the kernels.

        by_scaling: False leaves out the derivatives by the scalings.
        """
        ...

    def finer(self, ode: ODE, nodes: np.ndarray) -> np.ndarray:
        """End of each step, taken as two half steps: (points, windows, segments, n_states)."""
        ...

    def halved(self) -> Step | None:
        """Scheme with twice as many steps; None if there is none."""
        ...


@dataclass(frozen=True)
class RungeKutta:
    """torchdiffeq's `rk4` (3/8 rule) on the module itself, `n_substeps` equal steps per sample.

    All steps of all windows are integrated in one call, the states together with their tangents.
    """

    n_substeps: int = 1

    def __post_init__(self) -> None:
        set_counts(self, {"n_substeps": 1})

    def maps(self, ode: ODE, nodes: np.ndarray, *, by_scaling: bool = True) -> np.ndarray:
        x = _batch(nodes[:, :, :-1], ode)
        z = x.new_zeros((len(x), _n_columns(ode, by_scaling=by_scaling), *x.shape[1:]))
        z[:, 0] = x
        for j in range(ode.n_states):
            z[:, 1 + j, j] = 1.0
        with torch.inference_mode():
            end = integrate(ode, z, n_substeps=self.n_substeps)[-1]
        return _as_maps(end, nodes)

    def finer(self, ode: ODE, nodes: np.ndarray) -> np.ndarray:
        x = _batch(nodes[:, :, :-1], ode)
        with torch.inference_mode():
            end = integrate(ode, x[:, None], n_substeps=2 * self.n_substeps)[-1, :, 0]
        return end.permute(0, 2, 1).cpu().numpy().reshape(nodes[:, :, 1:].shape)

    def halved(self) -> RungeKutta | None:
        return RungeKutta(2 * self.n_substeps) if self.n_substeps < 8 else None


ONE_RUNGE_KUTTA = RungeKutta()


def integrate(
    ode: ODE, start: torch.Tensor, *, n_segments: int = 1, n_substeps: int
) -> torch.Tensor:
    """States and tangents from their start through the segments of the drive, by torchdiffeq.

    start: (points, columns, n_states, batch). Returns (1 + n_segments, *start.shape).
    """
    # Times stay on the CPU. Inputs at a node are those of the segment that a step belongs to.
    t = torch.arange(n_segments + 1, dtype=torch.float64)
    grid = torch.linspace(0.0, n_segments, n_substeps * n_segments + 1, dtype=torch.float64)
    options = {"grid_constructor": lambda func, y0, t: grid, "perturb": n_segments > 1}
    path: torch.Tensor = odeint(ode, start, t, method="rk4", options=options)
    return path


@dataclass(frozen=True)
class FusedRungeKutta:
    """The steps of `RungeKutta` in a compiled kernel, for searches that refine many models.

    It takes equations of products on the CPU alone; `fastest_step` asks for it where it can.
    """

    n_substeps: int = 1

    def __post_init__(self) -> None:
        set_counts(self, {"n_substeps": 1})

    def maps(self, ode: ODE, nodes: np.ndarray, *, by_scaling: bool = True) -> np.ndarray:
        maps = np.zeros((*nodes[:, :, 1:].shape, _n_columns(ode, by_scaling=by_scaling)))
        slopes = maps.reshape(len(maps), -1, *maps.shape[3:])
        maps[..., -1] = self._ends(ode, nodes, self.n_substeps, slopes)
        return maps

    def finer(self, ode: ODE, nodes: np.ndarray) -> np.ndarray:
        none = np.empty((len(nodes), nodes[0, :, 1:, 0].size, ode.n_states, 0))
        return self._ends(ode, nodes, 2 * self.n_substeps, none)

    def halved(self) -> FusedRungeKutta | None:
        return FusedRungeKutta(2 * self.n_substeps) if self.n_substeps < 8 else None

    def _ends(self, ode: ODE, nodes: np.ndarray, n_substeps: int, slopes: np.ndarray) -> np.ndarray:
        """Ends of the steps, (points, windows, segments, n_states); derivatives go to `slopes`.

        slopes: (points, steps, n_states, columns), by the nodes, by the scalings, and a column that
        stays as it is; no columns if no derivatives are wanted.
        """
        points, n, n_columns = len(nodes), ode.n_states, max(1, slopes.shape[3])
        starts = np.ascontiguousarray(nodes[:, :, :-1]).reshape(points, -1, n)
        with torch.no_grad():
            weights = ode.weights(n_columns).numpy().reshape(points, n_columns, n, -1)
        steps = ode.drive.steps[0].numpy() / n_substeps
        elapsed = np.linspace(0.0, 1.0, 3 * n_substeps + 1)
        powers = np.stack([elapsed**3, elapsed**2, elapsed, np.ones_like(elapsed)], axis=1)
        inputs = np.einsum("uk,kpib->pubi", powers, ode.drive.inputs[0].numpy())
        ends = np.empty_like(starts)
        for k, start in enumerate(starts):
            sums = sums_of_products(ode.library.table, weights[k].transpose(1, 0, 2))
            at, length = np.ascontiguousarray(inputs[k]), np.ascontiguousarray(steps[k])
            advance(start, at, length, THREE_EIGHTHS, sums, ends[k], slopes[k])
        return ends.reshape(nodes[:, :, 1:].shape)


def fastest_step(library: Library) -> Step:
    """The scheme for many models of one library: the fused one, unless it has functions."""
    return RungeKutta() if library.functions else FusedRungeKutta()


@dataclass(frozen=True)
class HermiteSimpson:
    """Implicit collocation of order four over one sample, for stiff models.

    It is A-stable: a fast mode that has decayed does not limit the step. It is our own
    implementation, not part of torchdiffeq.
    Source: Hargraves & Paris 1987, doi:10.2514/3.20223.
    """

    def maps(self, ode: ODE, nodes: np.ndarray, *, by_scaling: bool = True) -> np.ndarray:
        left, right = _batch(nodes[:, :, :-1], ode), _batch(nodes[:, :, 1:], ode)
        with torch.inference_mode():
            end = _collocate(ode, left, right, _n_columns(ode, by_scaling=by_scaling))
        return _as_maps(end, nodes)

    def finer(self, ode: ODE, nodes: np.ndarray) -> np.ndarray:
        points, _, _, n = nodes.shape
        left, right = (nodes[:, :, cut].reshape(points, -1, n) for cut in (np.s_[:-1], np.s_[1:]))
        halves = np.stack([left, 0.5 * (left + right), right], axis=2)
        start, still = np.zeros_like(left), np.zeros((points, 0))
        whole, ode.drive = ode.drive, _half(ode.drive)
        for _ in range(NEWTON_STEPS):
            maps = self.maps(ode, halves, by_scaling=False)
            change = propagate(maps, halves, start, still)
            halves = halves + change
            if not np.abs(change).max() > 1e-12:
                break
        ode.drive = whole
        return halves[:, :, 2].reshape(nodes[:, :, 1:].shape)

    def halved(self) -> None:
        return None


def _n_columns(ode: ODE, *, by_scaling: bool) -> int:
    return ode.n_columns if by_scaling else 1 + ode.n_states


def _batch(nodes: np.ndarray, ode: ODE) -> torch.Tensor:
    """Reshape (points, windows, samples, n_states) to a tensor (points, n_states, batch)."""
    flat = nodes.reshape(len(nodes), -1, nodes.shape[-1]).transpose(0, 2, 1)
    return torch.tensor(np.ascontiguousarray(flat), device=ode.offset.device)


def _as_maps(end: torch.Tensor, nodes: np.ndarray) -> np.ndarray:
    """The layout of `Step.maps` for (points, columns, n_states, batch), the ends first."""
    columns = end.roll(-1, dims=1).permute(0, 3, 2, 1).contiguous()
    return columns.cpu().numpy().reshape(*nodes[:, :, 1:].shape, -1)


def _half(drive: Drive) -> Drive:
    """Drive with each step divided into two consecutive half steps."""
    steps = torch.repeat_interleave(0.5 * drive.steps, 2, dim=-1)
    powers = 0.5 ** torch.arange(3, -1, -1, dtype=torch.float64, device=steps.device)
    a, b, c, d = drive.inputs.unbind(1)
    # The same cubics, expanded about the middle of the step.
    about = [a, 1.5 * a + b, 0.75 * a + b + c, 0.125 * a + 0.25 * b + 0.5 * c + d]
    halves = torch.stack([drive.inputs, torch.stack(about, dim=1)], dim=-1)
    return Drive(steps, (halves * powers.view(1, 4, 1, 1, 1, 1)).flatten(-2))


def _collocate(ode: ODE, left: torch.Tensor, right: torch.Tensor, n_columns: int) -> torch.Tensor:
    """Ends of the implicit steps and their derivatives, by one Newton step from both nodes.

    The collocation residual is g = right - left - h/6 (f_left + 4 f_mid + f_right), where
    mid = (left + right)/2 + h/8 (f_left - f_right).
    """
    n, drive = ode.n_states, ode.drive

    def fields(t: float, x: torch.Tensor) -> torch.Tensor:
        """h * (rate, derivatives by state, by scaling), (points, batch, n_states, columns)."""
        steps, inputs = drive.at(t)
        out = ode.fields(x, inputs, n_columns)
        return (out if steps is None else out * steps[:, None]).permute(0, 3, 2, 1)

    at_left, at_right = fields(0.0, left), fields(1.0, right)
    x_left, x_right = left.transpose(1, 2), right.transpose(1, 2)
    middle = 0.5 * (x_left + x_right) + 0.125 * (at_left - at_right)[..., 0]
    at_middle = fields(0.5, middle.transpose(1, 2))
    by_middle = at_middle[..., 1 : 1 + n]
    one = torch.eye(n, dtype=left.dtype, device=left.device)
    g = (x_right - x_left) - (at_left + 4.0 * at_middle + at_right)[..., 0] / 6.0
    left_x, right_x = at_left[..., 1 : 1 + n], at_right[..., 1 : 1 + n]
    by_left = -one - (left_x + 4.0 * by_middle @ (0.5 * one + 0.125 * left_x)) / 6.0
    by_right = one - (4.0 * by_middle @ (0.5 * one - 0.125 * right_x) + right_x) / 6.0
    left_s, right_s = at_left[..., 1 + n :], at_right[..., 1 + n :]
    by_scaling = (
        -(left_s + 4.0 * (at_middle[..., 1 + n :] + by_middle @ (left_s - right_s) / 8.0) + right_s)
        / 6.0
    )
    whole = torch.cat([g[..., None], by_left, by_scaling], dim=-1)
    # Singular if two solutions of the implicit step merge; the end is then NaN, a valid result.
    solution, failed = torch.linalg.solve_ex(by_right, whole)
    end = torch.where(failed[..., None, None] == 0, -solution, torch.nan)
    end[..., 0] += x_right
    return end.permute(0, 3, 2, 1)
