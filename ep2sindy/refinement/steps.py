"""Step schemes of a refinement: ends of steps over one sample, and their derivatives."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torchdiffeq import odeint

from ep2sindy.model.flow_kernels import SumsOfProducts, Tableau, advance, reach_of
from ep2sindy.refinement.kernels import propagate
from ep2sindy.refinement.ode import Augmented, Drive

NEWTON_STEPS = 20  # Newton steps at most for two implicit half steps, started from a whole step


@runtime_checkable
class Step(Protocol):
    """Interface of the step schemes.

    nodes: (points, windows, samples, n_states); scaling: (points, free); drive: one segment, with
    a batch of (windows * segments).
    """

    def maps(
        self, system: Augmented, drive: Drive, scaling: np.ndarray, nodes: np.ndarray
    ) -> np.ndarray:
        """End of each step and its derivatives, in the layout of the kernels."""
        ...

    def finer(
        self, system: Augmented, drive: Drive, scaling: np.ndarray, nodes: np.ndarray
    ) -> np.ndarray:
        """End of each step, taken as two half steps: (points, windows, segments, n_states)."""
        ...

    def halved(self) -> Step | None:
        """Scheme with twice as many steps; None if there is none."""
        ...


@dataclass(frozen=True)
class RungeKutta:
    """Explicit scheme: torchdiffeq's `rk4` (3/8 rule), with `n_substeps` equal steps per sample.

    Products of variables on a CPU go through the same steps in a compiled kernel.
    """

    n_substeps: int = 1

    def __post_init__(self) -> None:
        if self.n_substeps < 1:
            raise ValueError(f"n_substeps must be one or more: {self.n_substeps} came")

    def maps(
        self, system: Augmented, drive: Drive, scaling: np.ndarray, nodes: np.ndarray
    ) -> np.ndarray:
        if system.compiled:
            shape = (*nodes[:, :, 1:].shape, system.n_columns)
            maps = np.zeros(shape)
            columns = maps.reshape(len(maps), -1, *shape[3:])
            ends = _compiled_ends(system, drive, scaling, nodes, self.n_substeps, columns)
            maps[..., -1] = ends.reshape(shape[:-1])
            return maps
        x = _batch(nodes[:, :, :-1], system)
        n = system.n_states
        z = x.new_zeros((len(x), n, system.n_columns, x.shape[-1]))
        z[:, :, 0] = x
        for j in range(n):
            z[:, j, 1 + j] = 1.0
        with torch.inference_mode():
            end = _end(system.rhs(_tensor(scaling, system), drive), z, self.n_substeps)
        return _as_maps(end, nodes)

    def finer(
        self, system: Augmented, drive: Drive, scaling: np.ndarray, nodes: np.ndarray
    ) -> np.ndarray:
        if system.compiled:
            none = np.empty((len(nodes), nodes[0, :, 1:, 0].size, system.n_states, 0))
            ends = _compiled_ends(system, drive, scaling, nodes, 2 * self.n_substeps, none)
            return ends.reshape(nodes[:, :, 1:].shape)
        x = _batch(nodes[:, :, :-1], system)
        with torch.inference_mode():
            rhs = system.value_rhs(_tensor(scaling, system), drive)
            end = _end(rhs, x, 2 * self.n_substeps)
        return end.permute(0, 2, 1).cpu().numpy().reshape(nodes[:, :, 1:].shape)

    def halved(self) -> RungeKutta | None:
        return RungeKutta(2 * self.n_substeps) if self.n_substeps < 8 else None


ONE_RUNGE_KUTTA = RungeKutta()

THREE_EIGHTHS = Tableau(
    leads=np.array([[0, 0, 0, 0], [1 / 3, 0, 0, 0], [-1 / 3, 1, 0, 0], [1.0, -1, 1, 0]]),
    weights=np.array([0.125, 0.375, 0.375, 0.125]),
    places=np.arange(4),
    stride=3,
)


def _compiled_ends(
    system: Augmented,
    drive: Drive,
    scaling: np.ndarray,
    nodes: np.ndarray,
    n_substeps: int,
    slopes: np.ndarray,
) -> np.ndarray:
    """Ends of the steps by the kernel, (points, steps, n_states); derivatives go to `slopes`.

    slopes: (points, steps, n_states, columns), by the nodes, by the scalings, and a column that
    stays as it is; no columns if no derivatives are wanted.
    """
    points, n = len(nodes), nodes.shape[-1]
    starts = np.ascontiguousarray(nodes[:, :, :-1]).reshape(points, -1, n)
    n_columns = max(1, slopes.shape[3])
    weights = system.weights(_tensor(scaling, system)).numpy()
    weights = weights.reshape(points, n, system.n_columns, -1)[:, :, :n_columns]
    steps = drive.steps[0].numpy() / n_substeps
    elapsed = np.linspace(0.0, 1.0, 3 * n_substeps + 1)
    powers = np.stack([elapsed**3, elapsed**2, elapsed, np.ones_like(elapsed)], axis=1)
    inputs = np.einsum("uk,kpib->pubi", powers, drive.inputs[0].numpy())
    ends = np.empty_like(starts)
    for k, start in enumerate(starts):
        equations = _equations(system.library.table, weights[k])
        at, length = np.ascontiguousarray(inputs[k]), np.ascontiguousarray(steps[k])
        advance(start, at, length, THREE_EIGHTHS, equations, ends[k], slopes[k])
    return ends


def _equations(
    table: np.ndarray, weights: Float[np.ndarray, "n_states columns products"]
) -> SumsOfProducts:
    """Weights of the products for rates and derivatives, as the kernel takes them."""
    there = weights != 0.0
    product, target, *where = _order_of_sums(there.shape, there.tobytes())
    return SumsOfProducts(table, product, target, weights[there], *where)


@lru_cache(maxsize=256)  # the same weights stay zero through all iterations
def _order_of_sums(shape: tuple[int, int, int], there: bytes) -> tuple[np.ndarray, ...]:
    """Fields of `SumsOfProducts` after `table`, but for `weight`, for weights that are not zero.

    There is a sum of products for every rate, then for every derivative that is not zero.
    """
    n, width = shape[:2]
    state, column, product = np.nonzero(np.frombuffer(there, dtype=np.bool_).reshape(shape))
    by_state, by_scaling = (column > 0) & (column <= n), column > n
    code = state * width + column
    pairs, pair = np.unique(code[by_state], return_inverse=True)
    sources, source = np.unique(code[by_scaling], return_inverse=True)
    target = state.copy()
    target[by_state] = n + pair
    target[by_scaling] = n + len(pairs) + source
    row, factor = pairs // width, pairs % width - 1
    reach = reach_of(n, row, factor)
    # Columns of `nonzero` are strided, and the kernel would be compiled once more for them.
    product = np.ascontiguousarray(product)
    return product, target, row, factor, sources // width, sources % width - 1 - n, reach


@dataclass(frozen=True)
class HermiteSimpson:
    """Implicit collocation of order four over one sample, for stiff models.

    It is A-stable: a fast mode that has decayed does not limit the step. It is our own
    implementation, not part of torchdiffeq.
    Source: Hargraves & Paris 1987, doi:10.2514/3.20223.
    """

    def maps(
        self, system: Augmented, drive: Drive, scaling: np.ndarray, nodes: np.ndarray
    ) -> np.ndarray:
        with torch.inference_mode():
            left = _batch(nodes[:, :, :-1], system)
            right = _batch(nodes[:, :, 1:], system)
            end = _collocate(system, drive, _tensor(scaling, system), left, right)
        return _as_maps(end, nodes)

    def finer(
        self, system: Augmented, drive: Drive, scaling: np.ndarray, nodes: np.ndarray
    ) -> np.ndarray:
        points, _, _, n = nodes.shape
        left, right = (nodes[:, :, cut].reshape(points, -1, n) for cut in (np.s_[:-1], np.s_[1:]))
        halves = np.stack([left, 0.5 * (left + right), right], axis=2)
        half_drive = _half(drive)
        for _ in range(NEWTON_STEPS):
            maps = self.maps(system, half_drive, scaling, halves)
            start, still = np.zeros((points, left.shape[1], 1, n)), np.zeros_like(scaling)
            change = propagate(maps, halves, start, still, 3)
            halves = halves + change
            if not np.abs(change).max() > 1e-12:
                break
        return halves[:, :, 2].reshape(nodes[:, :, 1:].shape)

    def halved(self) -> None:
        return None


def _tensor(values: np.ndarray, system: Augmented) -> torch.Tensor:
    return torch.tensor(values, dtype=torch.float64, device=system.offset.device)


def _batch(nodes: np.ndarray, system: Augmented) -> torch.Tensor:
    """Reshape (points, windows, samples, n_states) to a tensor (points, n_states, batch)."""
    flat = nodes.reshape(len(nodes), -1, nodes.shape[-1]).transpose(0, 2, 1)
    return _tensor(np.ascontiguousarray(flat), system)


def _as_maps(end: torch.Tensor, nodes: np.ndarray) -> np.ndarray:
    """The layout of `Step.maps` for (points, n_states, columns, batch), the ends first."""
    columns = end.roll(-1, dims=2).permute(0, 3, 1, 2).contiguous()
    return columns.cpu().numpy().reshape(*nodes[:, :, 1:].shape, -1)


def _end(
    rhs: Callable[[torch.Tensor, torch.Tensor], torch.Tensor], start: torch.Tensor, n_steps: int
) -> torch.Tensor:
    """Integrate over one unit of time by torchdiffeq; the time grid stays on the CPU."""
    grid = torch.linspace(0.0, 1.0, n_steps + 1, dtype=torch.float64)
    options = {"grid_constructor": lambda func, y0, t: grid}
    return odeint(rhs, start, grid[[0, -1]], method="rk4", options=options)[-1]


def _half(drive: Drive) -> Drive:
    """Drive with each step divided into two consecutive half steps."""
    steps = torch.repeat_interleave(0.5 * drive.steps, 2, dim=-1)
    powers = 0.5 ** torch.arange(3, -1, -1, dtype=torch.float64, device=steps.device)
    a, b, c, d = drive.inputs.unbind(1)
    # The same cubics, expanded about the middle of the step.
    about = [a, 1.5 * a + b, 0.75 * a + b + c, 0.125 * a + 0.25 * b + 0.5 * c + d]
    halves = torch.stack([drive.inputs, torch.stack(about, dim=1)], dim=-1)
    return Drive(steps, (halves * powers.view(1, 4, 1, 1, 1, 1)).flatten(-2))


def _collocate(
    system: Augmented,
    drive: Drive,
    scaling: torch.Tensor,
    left: torch.Tensor,
    right: torch.Tensor,
) -> torch.Tensor:
    """Ends of the implicit steps and their derivatives, by one Newton step from both nodes.

    The collocation residual is g = right - left - h/6 (f_left + 4 f_mid + f_right), where
    mid = (left + right)/2 + h/8 (f_left - f_right).
    """
    n, weights = system.n_states, system.weights(scaling)

    def fields(t: float, x: torch.Tensor) -> torch.Tensor:
        """h * (rate, derivatives by state, by scaling), (points, batch, n_states, columns)."""
        steps, inputs = drive.at(t)
        out = system.fields(weights, x, inputs)
        return (out if steps is None else out * steps[:, None]).permute(0, 3, 1, 2)

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
    return end.permute(0, 2, 3, 1)
