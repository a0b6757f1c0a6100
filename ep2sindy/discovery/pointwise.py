"""Discovery at every grid point of a field: the active terms and their coefficients by place.

The grid is cut into blocks of points, which are read and searched one after the other.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import product
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.data.fields import SPACE, check_field, clock_of, grid_points, grid_values
from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.method import Regression, SearchedEquation
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, constraint
from ep2sindy.library.units import unit_product
from ep2sindy.model.scores import r2
from ep2sindy.regression.constrained import fit_draws
from ep2sindy.regression.front import Candidate
from ep2sindy.runtime.parallel import SURROUNDING, Workers, refuse_part
from ep2sindy.runtime.progress import Advance, Progress, as_progress
from ep2sindy.runtime.values import check_count, check_kind, check_list

NO_FIT = "no_fit"

STATUSES = ("fitted", "no_plasma", "missing_samples", "too_little_variation", NO_FIT)

# Dimensions of every result, followed by those of space.
LAYOUT: Mapping[str, tuple[str, ...]] = {
    "coef": ("equation", "term"),
    "inclusion": ("equation", "term"),
    "weight": ("equation", "term"),
    "coef_draws": ("draw", "equation", "term"),
    "weight_draws": ("draw", "equation", "term"),
    "r2_train": ("equation",),
    "r2_test": ("equation",),
    "n_terms": ("equation",),
}


@dataclass(frozen=True, eq=False)
class PointSearch:
    """Settings of the search at every point, whose spread is taken over the bootstraps.

    Parameters
    ----------
    states : sequence of str
        Names of the field's variables that become states.
    library : Library
        Terms, with relations between coefficients if there are some, such as
        "n_i: S == -1 * n_n: S" for ionization S, which turns a neutral into an ion. They are the
        same at every point.
    method : Regression
        The regression, with bootstraps.
    least_variation : float, default 0.001
        Standard deviation of every state, as a fraction of its root mean square, below which a
        point counts as having no dynamics.
    seed : int, default 0
        Every point has the same split and the same draws, so that results differ only by place.

    Raises
    ------
    ValueError
        If a setting is of the wrong kind or out of range, the method has no bootstraps, relations
        contradict each other or meet bootstraps that leave out terms, or the library has roles.
    """

    states: Sequence[str]
    library: Library
    method: Regression
    least_variation: float = 1e-3
    seed: int = 0

    def __post_init__(self) -> None:
        check_list("states", self.states)
        check_kind("library", self.library, Library, "ep.polynomial(['x', 'y'], degree=2)")
        object.__setattr__(self, "states", tuple(self.states))
        if not 0.0 <= self.least_variation < 1.0:
            raise ValueError(
                f"least_variation must lie in [0, 1), got {self.least_variation}; it is a fraction"
            )
        check_kind("method", self.method, Regression, "ep.Regression(bootstraps=ep.Bootstraps())")
        if not (n := self.method.bootstraps.n):
            raise ValueError(f"a pointwise study needs bootstraps for its spread, got n={n}")
        facts, every_term = self.library.facts, dict.fromkeys(self.states, self.library.names)
        constraint(self.library, every_term, facts.relations)  # refuses those that cannot hold
        if facts.roles is not None:
            raise ValueError(
                "roles tie all equations together, and a pointwise study searches one at a time, "
                f"got {facts.roles}; give relations"
            )
        if facts.relations and (n_culled := self.method.bootstraps.n_culled):
            raise ValueError(
                "relations need all their terms in every bootstrap: n_culled must be 0, got "
                f"{n_culled}"
            )

    @cached_property
    def variables(self) -> tuple[str, ...]:
        """States, then the other variables that the library needs."""
        others = (v for v in self.library.variables if v not in self.states)
        return (*self.states, *others)

    @property
    def sizes(self) -> dict[str, int]:
        """Lengths of the dimensions in `LAYOUT`."""
        n_draws, n_terms = self.method.bootstraps.n, len(self.library)
        return {"draw": n_draws, "equation": len(self.states), "term": n_terms}


def pointwise(
    field: xr.Dataset,
    search: PointSearch,
    *,
    workers: Workers | None = None,
    block_points: int = 256,
    progress: Progress | Advance | bool = False,
) -> xr.Dataset:
    """Search at every point of a field over (time, z, r), (time, z) or (time, r), block by block.

    If the field is opened lazily, only the current block is in memory.

    Parameters
    ----------
    field : Dataset
        Field over time and z, r or both, in SI.
    search : PointSearch
        States, library and method, the same at every point.
    workers : Workers, optional
        How the blocks are computed, such as `ep.parallel.Loky()`. By default as a surrounding
        `joblib.parallel_config` says, and one after the other without it.
    block_points : int, default 256
        Number of points in a block.
    progress : Progress, callable or bool, default False
        True shows a bar. A function is called with the number of points of every finished block.

    Returns
    -------
    Dataset
        A dataset over `equation`, `term`, `draw` and the axes of the field: `coef`, in SI, zero for
        a term outside the selected support; `inclusion`, the fraction of bootstraps whose support
        of that size held the term; `weight`, coef times the root mean square of its term, with its
        sign, as a fraction of all terms of the equation; `coef_draws` and `weight_draws`, the same
        in every bootstrap; `r2_train`, `r2_test` and `n_terms` per equation; and `status` per
        point. Where the status is not 0, all others are NaN. If a fit failed, the attribute
        `no_fit` holds a reason.

    Raises
    ------
    ValueError
        If the field has no axis in space or lacks a variable, or no point could be fitted; the
        error then states the first reason.

    Examples
    --------
    >>> field = ep.open_field("run.nc")
    >>> method = ep.Regression(ep.Differential(), bootstraps=ep.Bootstraps(4, n_culled=0))
    >>> library = ep.polynomial(["n_i", "n_n"], degree=1)
    >>> search = ep.discovery.PointSearch(["n_i", "n_n"], library, method)
    >>> found = ep.pointwise(field.isel(z=[2], r=[2]), search)
    >>> found["coef"].sizes["term"], found["status"].values.tolist()
    (3, [[0]])
    """
    _check(field, search)
    part = field[list(search.variables)]
    blocks, search_block = blocks_of(part, block_points), partial(_search_block, search)
    result = _empty(part, search)
    pieces = (part.isel(block) for block in blocks)  # once read, none is held
    workers = workers or SURROUNDING
    refuse_part(workers.part)
    with as_progress(progress).stage(result["status"].size, "point") as advance:
        for k, found in workers.run(search_block, pieces, n_alike=len(blocks)):
            _place(result, blocks[k], found)
            advance(found["status"].size)
    if not (result["status"] == 0).any():
        raise ValueError(f"no point could be fitted: {_why_none(result)}")
    return result


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
    term_units, time = search.library.units(units), clock_of(field).of_values
    coef_units = [
        [unit_product([(units[state], 1), (time, -1), (unit, -1)]) for unit in term_units]
        for state in search.states
    ]
    values = {
        name: ((*dims, *axes), np.full((*(search.sizes[d] for d in dims), *shape), np.nan))
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


def _place(result: xr.Dataset, block: Mapping[str, slice], done: xr.Dataset) -> None:
    reasons = {str(result.attrs[NO_FIT]), str(done.attrs[NO_FIT])} - {""}
    result.attrs[NO_FIT] = min(reasons, default="")  # independent of the division into blocks
    for name in (*LAYOUT, "status"):
        result[name].isel(block).values[...] = done[name].values


def _search_block(search: PointSearch, block: xr.Dataset) -> xr.Dataset:
    """Results at every point of a block; a reason if a fit failed."""
    block = block.load(scheduler="synchronous")  # chunks, if any, are read on this thread
    result, t, reasons = _empty(block, search), grid_points(block, "time"), []
    shape = result["status"].shape
    grids = [grid_values(block[name]) for name in search.variables]
    whole = np.broadcast_shapes(*(grid.shape for grid in grids))
    grids = [np.broadcast_to(grid, whole).reshape(len(t), *shape) for grid in grids]
    for place in np.ndindex(shape):
        values = np.stack([grid[(..., *place)] for grid in grids])
        status = _assess_samples(values, search)
        if status == 0:
            try:
                point = search_point(_trajectory(t, values, block, search), search)
                for name, value in point.items():
                    result[name].values[(..., *place)] = value
            except ValueError as error:
                status = STATUSES.index(NO_FIT)
                reasons.append(str(error))
        result["status"].values[place] = status
    return result.assign_attrs({NO_FIT: min(reasons, default="")})


def _assess_samples(values: Float[np.ndarray, "variables samples"], search: PointSearch) -> int:
    """Status that can be reported before a fit; 0 if a fit is worth trying."""
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


def blocks_of(field: xr.Dataset, n_points: int) -> list[dict[str, slice]]:
    """Rectangles of at most `n_points` points, made of whole lines along the last axis if one fits.

    Points that are neighbours in a file are then read together. Each is a slice for every axis.
    Raises ValueError for n_points below one.
    """
    room, parts = check_count("block_points", n_points), {}
    for axis in reversed([axis for axis in SPACE if axis in field.dims]):
        n, step = field.sizes[axis], min(field.sizes[axis], room)
        parts[axis] = [slice(k, min(k + step, n)) for k in range(0, n, step)]
        room = max(1, room // step)
    axes = list(reversed(parts))
    return [dict(zip(axes, block, strict=True)) for block in product(*(parts[a] for a in axes))]


# The search at one point.


def search_point(run: Trajectory, search: PointSearch) -> dict[str, np.ndarray]:
    """Search, select and fit at one point, and the spread over the bootstraps."""
    task = DiscoveryProblem([run], search.library)
    equations = search.method.search_equations(task, rng=np.random.default_rng(search.seed))
    choice = search.method.choose([equation.front for equation in equations], task)
    parts = zip(equations, choice.chosen.values(), choice.model.coef.T, strict=True)
    found = [_describe_equation(*part) for part in parts]
    point = {
        name: np.stack([row[name] for row in found], axis=dims.index("equation"))
        for name, dims in LAYOUT.items()
    }
    return point if choice.constraint is None else _constrained(point, equations, choice.constraint)


def _describe_equation(
    equation: SearchedEquation, chosen: Candidate, coef: Float[np.ndarray, " terms"]
) -> dict[str, Any]:
    """Results of one equation at a point, by the names of `LAYOUT`."""
    problem = equation.front.rows
    mask: Bool[np.ndarray, " terms"] = np.isin(problem.library.names, chosen.terms)
    fits = equation.draws.fits(equation.number, equation.found, mask)
    return {
        "coef": coef,
        "inclusion": equation.supports.inclusion[chosen.n_terms],
        "weight": weigh_terms(coef * problem.theta_scale),
        "coef_draws": fits * problem.coef_scale(equation.number),
        "weight_draws": weigh_terms(fits),
        "r2_train": chosen.r2_train,
        "r2_test": chosen.r2_test,
        "n_terms": chosen.n_terms,
    }


def _constrained(
    point: Mapping[str, np.ndarray], equations: Sequence[SearchedEquation], held: Constraint
) -> dict[str, np.ndarray]:
    """A point's results with draws and R2 of coefficients that obey the constraint."""
    problems = list(dict.fromkeys(equation.front.rows for equation in equations))
    draws = {equation.front.equation: equation.draws for equation in equations}
    found = fit_draws(problems, draws, held)
    drawn, weights = np.zeros((2, *point["coef_draws"].shape))
    scores = np.full((2, len(equations)), np.nan)
    for row, equation in enumerate(equations):
        problem, target = equation.front.rows, equation.front.rows.target[:, equation.number]
        for k, (state, term) in enumerate(held.coefficients):
            if state == equation.front.equation:
                drawn[:, row, problem.library.index(term)] = found[:, k]
        weights[:, row] = weigh_terms(drawn[:, row] * problem.theta_scale)
        for held_out in sorted({False, bool(problem.test.any())}):
            at = problem.test == held_out
            fitted = problem.theta[at] @ point["coef"][row]
            scores[int(held_out), row] = r2(truth=target[at], prediction=fitted[None])[0]
    return {
        **point, "coef_draws": drawn, "weight_draws": weights,
        "r2_train": scores[0], "r2_test": scores[1],
    }  # fmt: skip


def weigh_terms(parts: Float[np.ndarray, "*draws terms"]) -> Float[np.ndarray, "*draws terms"]:
    """Each term's part in the sum of absolute values, with its sign; zeros if all are zero."""
    total = np.abs(parts).sum(axis=-1, keepdims=True)
    return parts / np.where(total > 0.0, total, 1.0)
