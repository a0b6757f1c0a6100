"""Step schemes of a refinement: ends of steps over one sample, and their derivatives."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torchdiffeq import odeint

from ep2sindy.library.library import Library
from ep2sindy.model.flow_kernels import advance, sums_of_products
from ep2sindy.model.runge_kutta import THREE_EIGHTHS
from ep2sindy.refinement.ode import ODE
from ep2sindy.runtime.values import set_counts


@dataclass(frozen=True)
class RungeKutta:
    """Steps of torchdiffeq's `rk4` (3/8 rule) on the torch module itself.

    All steps of all windows are integrated in one call, the states together with their tangents.

    Parameters
    ----------
    n_substeps : int, default 1
        Number of equal steps per sample.

    Raises
    ------
    ValueError
        If there is no step.
    """

    n_substeps: int = 1

    def __post_init__(self) -> None:
        set_counts(self, {"n_substeps": 1})

    def maps(self, ode: ODE, nodes: np.ndarray, *, by_scaling: bool = True) -> np.ndarray:
        """End of each step and its derivatives, in the layout of the kernels.

        ode: with its scalings set, and a drive of one segment over a batch of (windows * segments).
        nodes: (points, windows, samples, n_states). by_scaling: False leaves out the derivatives by
        the scalings.
        """
        x = _batch(nodes[:, :, :-1], ode)
        z = x.new_zeros((len(x), _n_columns(ode, by_scaling=by_scaling), *x.shape[1:]))
        z[:, 0] = x
        for j in range(ode.n_states):
            z[:, 1 + j, j] = 1.0
        with torch.inference_mode():
            end = integrate(ode, z, n_substeps=self.n_substeps)[-1]
        return _as_maps(end, nodes)

    def finer(self, ode: ODE, nodes: np.ndarray) -> np.ndarray:
        """End of each step, taken as two half steps: (points, windows, segments, n_states)."""
        x = _batch(nodes[:, :, :-1], ode)
        with torch.inference_mode():
            end = integrate(ode, x[:, None], n_substeps=2 * self.n_substeps)[-1, :, 0]
        return end.permute(0, 2, 1).cpu().numpy().reshape(nodes[:, :, 1:].shape)


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

    It takes equations of products, on the CPU only; `fastest_step` selects it where it can.

    Parameters
    ----------
    n_substeps : int, default 1
        Number of equal steps per sample.

    Raises
    ------
    ValueError
        If there is no step.
    """

    n_substeps: int = 1

    def __post_init__(self) -> None:
        set_counts(self, {"n_substeps": 1})

    def maps(self, ode: ODE, nodes: np.ndarray, *, by_scaling: bool = True) -> np.ndarray:
        """As `RungeKutta.maps`."""
        maps = np.zeros((*nodes[:, :, 1:].shape, _n_columns(ode, by_scaling=by_scaling)))
        slopes = maps.reshape(len(maps), -1, *maps.shape[3:])
        maps[..., -1] = self._ends(ode, nodes, self.n_substeps, slopes)
        return maps

    def finer(self, ode: ODE, nodes: np.ndarray) -> np.ndarray:
        """As `RungeKutta.finer`."""
        none = np.empty((len(nodes), nodes[0, :, 1:, 0].size, ode.n_states, 0))
        return self._ends(ode, nodes, 2 * self.n_substeps, none)

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


Step = RungeKutta | FusedRungeKutta


def halved(step: Step) -> Step | None:
    """The scheme with twice as many steps; None if there is none."""
    return replace(step, n_substeps=2 * step.n_substeps) if step.n_substeps < 8 else None


def fastest_step(library: Library) -> Step:
    """The scheme for many models of one library: the fused one, unless it has functions."""
    return RungeKutta() if library.functions else FusedRungeKutta()


def _n_columns(ode: ODE, *, by_scaling: bool) -> int:
    return ode.n_columns if by_scaling else 1 + ode.n_states


def _batch(nodes: np.ndarray, ode: ODE) -> torch.Tensor:
    """Reshape (points, windows, samples, n_states) to a tensor (points, n_states, batch)."""
    flat = nodes.reshape(len(nodes), -1, nodes.shape[-1]).transpose(0, 2, 1)
    return torch.tensor(np.ascontiguousarray(flat), device=ode.offset.device)


def _as_maps(end: torch.Tensor, nodes: np.ndarray) -> np.ndarray:
    """The layout of `RungeKutta.maps` for (points, columns, n_states, batch), the ends first."""
    columns = end.roll(-1, dims=1).permute(0, 3, 2, 1).contiguous()
    return columns.cpu().numpy().reshape(*nodes[:, :, 1:].shape, -1)
