"""Discovery at every grid point of a field: the active terms and their coefficients by place.

The grid is cut into blocks of points, which are read and searched one after the other.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import xarray as xr
from jaxtyping import Float

from ep2sindy.data.fields import SPACE, check_field, grid_points, grid_values
from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.point_search import (
    LAYOUT,
    PointSearch,
    nothing,
    search_point,
)
from ep2sindy.library.units import unit_product
from ep2sindy.runtime.parallel import Workers, run_alike
from ep2sindy.runtime.progress import Advance, Progress, as_progress

NO_FIT = "no_fit"

STATUSES = ("fitted", "no_plasma", "missing_samples", "too_little_variation", NO_FIT)


def pointwise(
    field: xr.Dataset,
    search: PointSearch,
    *,
    workers: Workers,
    block_points: int = 256,
    progress: Progress | Advance | bool = False,
) -> xr.Dataset:
    """Search at every point of a (time, z, r), (time, z) or (time, r) field, block by block.

    Returns, over `equation`, `term`, `draw` and the axes of the field:
    coef, in SI, zero for a term outside the selected support; inclusion, share of bootstraps whose
    support of that size held the term; weight, coef times the root mean square of its term, with
    its sign, as a share of all terms of the equation (not the variance: the constant has none);
    coef_draws and weight_draws, the same in every bootstrap; r2_train, r2_test, n_terms per
    equation; status per point. If the status is not 0, the others are NaN. The attribute no_fit
    holds a reason why a fit failed, if one did.
    If the field is opened lazily, only the current block is in memory.
    progress: True shows a bar; a function is called with the number of points of every finished
    block; see `Progress`.
    Raises ValueError for a field without space, a variable it lacks, or, with the first reason, if
    no point could be fitted.
    """
    _check(field, search)
    part = field[list(search.variables)]
    blocks = blocks_of(part, block_points)
    result = _empty(part, search)
    n_points = sum(block.n_points for block in blocks)
    with as_progress(progress).stage(n_points, "point") as advance:
        for block, done in _search_blocks(part, search, blocks, workers):
            _place(result, block, done)
            advance(block.n_points)
    if not (result["status"] == 0).any():
        raise ValueError(f"no point could be fitted: {_why_none(result)}")
    return result


def _search_blocks(
    part: xr.Dataset,
    search: PointSearch,
    blocks: Sequence[Block],
    workers: Workers,
) -> Iterator[tuple[Block, Mapping[str, np.ndarray]]]:
    """Every block with its results, as they come."""
    function = partial(_search_block, search)
    pieces = (part.isel(block.slices) for block in blocks)  # once read, none is held
    for number, done in run_alike(workers, function, pieces, len(blocks)):
        yield blocks[number], done


def _why_none(result: xr.Dataset) -> str:
    if result.attrs[NO_FIT]:
        return str(result.attrs[NO_FIT])
    counts = {name: int((result["status"] == k).sum()) for k, name in enumerate(STATUSES)}
    found = ", ".join(f"{n} with {name.replace('_', ' ')}" for name, n in counts.items() if n)
    return f"of {result['status'].size} points {found}; see to the mask and to least_variation"


def _check(field: xr.Dataset, search: PointSearch) -> None:
    check_field(field)
    if not [axis for axis in SPACE if axis in field.dims]:
        raise ValueError(
            "a pointwise study needs a grid: this field has time alone; search it with discover"
        )
    missing = [name for name in search.variables if name not in field.data_vars]
    if missing:
        raise ValueError(f"unknown variables {missing}; this field has {list(field.data_vars)}")
    timeless = [name for name in search.variables if "time" not in field[name].dims]
    if set(timeless) & set(search.states):
        raise ValueError(f"states must depend on time: {timeless} do not")


def _empty(field: xr.Dataset, search: PointSearch) -> xr.Dataset:
    """The result before any point is done: units, coordinates, and NaN."""
    axes = [axis for axis in SPACE if axis in field.dims]
    shape = tuple(field.sizes[axis] for axis in axes)
    units = {name: str(field[name].attrs["units"]) for name in search.variables}
    term_units = search.library.units(units)
    coef_units = [
        [unit_product([(units[state], 1), ("s", -1), (unit, -1)]) for unit in term_units]
        for state in search.states
    ]
    sizes = {
        "draw": search.method.bootstraps.n,
        "equation": len(search.states),
        "term": len(search.library),
    }
    values = {
        name: ((*dims, *axes), np.full((*(sizes[d] for d in dims), *shape), np.nan))
        for name, dims in LAYOUT.items()
    }
    flags = {"flag_values": list(range(len(STATUSES))), "flag_meanings": " ".join(STATUSES)}
    return xr.Dataset(
        values | {"status": (axes, np.full(shape, -1, dtype=np.int8), flags)},
        coords={
            "equation": list(search.states),
            "term": list(search.library.names),
            "coef_units": (("equation", "term"), coef_units),
            **{axis: (axis, grid_points(field, axis), {"units": "m"}) for axis in axes},
        },
        attrs={NO_FIT: ""},
    )


def _place(result: xr.Dataset, block: Block, done: Mapping[str, np.ndarray]) -> None:
    reasons = {str(result.attrs[NO_FIT]), str(done[NO_FIT])} - {""}
    result.attrs[NO_FIT] = min(reasons, default="")  # independent of the division into blocks
    for name in (*LAYOUT, "status"):
        values, target = done[name], result[name].isel(block.slices)
        target.values[...] = values.reshape(target.shape)


def _search_block(search: PointSearch, block: xr.Dataset) -> dict[str, np.ndarray]:
    """Results at every point of a block, points along the last axis; a reason if a fit failed."""
    block = block.load(scheduler="synchronous")  # chunks, if any, are read on this thread
    t = grid_points(block, "time")
    found: dict[str, list[np.ndarray]] = {name: [] for name in LAYOUT}
    status, reasons = [], []
    no_result = nothing(search)
    for values in _columns(block, search.variables):
        point = no_result
        status.append(_status(values, search))
        if status[-1] == 0:
            try:
                point = search_point(_trajectory(t, values, block, search), search)
            except ValueError as error:
                status[-1] = STATUSES.index(NO_FIT)
                reasons.append(str(error))
        for name, value in point.items():
            found[name].append(value)
    stacked = {name: np.stack(each, axis=-1) for name, each in found.items()}
    flags = np.array(status, dtype=np.int8)
    return stacked | {"status": flags, NO_FIT: np.array(min(reasons, default=""))}


def _columns(
    block: xr.Dataset, names: Sequence[str]
) -> Iterator[Float[np.ndarray, "variables samples"]]:
    """All variables at one point after another, the samples of each contiguous in memory."""
    shape = (block.sizes["time"], *(block.sizes.get(axis, 1) for axis in SPACE))
    grids = [np.broadcast_to(grid_values(block[n]), shape).reshape(shape[0], -1) for n in names]
    for point in range(grids[0].shape[1]):
        yield np.stack([grid[:, point] for grid in grids])


def _status(values: Float[np.ndarray, "variables samples"], search: PointSearch) -> int:
    """Status that can be told before a fit; 0 if a fit is worth trying."""
    lost = ~np.isfinite(values)
    if lost.all(axis=1).any():
        return STATUSES.index("no_plasma")
    if lost.any():
        return STATUSES.index("missing_samples")
    states = values[: len(search.states)]
    largest = np.abs(states).max(axis=1, keepdims=True)
    scaled = states / zero_to_one(largest)
    still = scaled.std(axis=1) <= search.least_variation * np.sqrt(np.square(scaled).mean(axis=1))
    return STATUSES.index("too_little_variation") if still.any() else 0


def _trajectory(
    t: np.ndarray, values: np.ndarray, block: xr.Dataset, search: PointSearch
) -> Trajectory:
    n = len(search.states)
    return Trajectory(
        t=t,
        states=values[:n].T,
        state_names=search.states,
        inputs=values[n:].T,
        input_names=search.variables[n:],
        units={name: str(block[name].attrs["units"]) for name in search.variables},
    )


@dataclass(frozen=True)
class Block:
    """A rectangle of grid points: slices by axis of the field."""

    slices: Mapping[str, slice]

    @property
    def n_points(self) -> int:
        return int(np.prod([part.stop - part.start for part in self.slices.values()]))


def blocks_of(field: xr.Dataset, n_points: int) -> list[Block]:
    """Rectangles of at most `n_points` points, made of whole lines along the last axis if one fits.

    Points that are neighbours in a file are then read together.
    Raises ValueError for n_points below one.
    """
    if n_points < 1:
        raise ValueError(f"a block needs a point: block_points={n_points} came")
    steps, room = {}, n_points
    for axis in reversed([axis for axis in SPACE if axis in field.dims]):
        steps[axis] = min(field.sizes[axis], room)
        room = max(1, room // steps[axis])
    blocks = [Block({})]
    for axis in reversed(steps):
        n = field.sizes[axis]
        parts = [slice(k, min(k + steps[axis], n)) for k in range(0, n, steps[axis])]
        blocks = [Block({**block.slices, axis: part}) for block in blocks for part in parts]
    return blocks
