"""How a field becomes a trajectory: averages over a zone of its grid, several, or one point."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from ep2sindy.data.blocks import blocks_of
from ep2sindy.data.fields import (
    SPACE,
    cell_edges,
    cell_sizes,
    channel_length_m,
    check_field,
    check_samples,
    clock_of,
    grid_points,
    grid_values,
    mask_cells,
)
from ep2sindy.data.gaps import without_gaps
from ep2sindy.data.quantities import MADE_FROM
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.names import split_factors
from ep2sindy.library.units import unit_product
from ep2sindy.runtime.screen import near_words


def zone_average(
    field: xr.Dataset,
    zone: Zone | None,
    *,
    states: Sequence[str],
    inputs: Sequence[str] = (),
    products: Sequence[str] = (),
    axisymmetric: bool = True,
    label: str = "",
) -> Trajectory:
    """Average variables over the grid points inside a zone, at each time.

    The weight of a grid point is the size of its cell: its length in z and, if the field has r, the
    area of its annulus (its length if the field is not axisymmetric). All variables of one call are
    averaged over the same cells, those in which none of them is masked. Samples at which a variable
    of time only is missing (NaN) are left out for all variables.

    Parameters
    ----------
    field : Dataset
        Field over time and z, r or both.
    zone : Zone or None
        Part of the grid. None takes the whole field.
    states : sequence of str
        Names of the variables that become states.
    inputs : sequence of str, default ()
        Names of the variables that become inputs.
    products : sequence of str, default ()
        Each product, such as `"n_i*n_n*R_ion"`, adds an input named `<n_i*n_n*R_ion>` with the
        average of the product, which is not the product of averages. If a variable's attribute
        `average_of` names the product, that variable is used, since it is averaged in time as a
        simulation's samples are.
    axisymmetric : bool, default True
        True if r is the radius of a cylinder, False if it is a Cartesian coordinate.
    label : str, default ''
        Label of the trajectory.

    Returns
    -------
    Trajectory
        The averages over time, with the units of the field.

    Raises
    ------
    ValueError
        If a variable is unknown, the zone lies off the grid or holds no plasma, or a value is not
        finite in an unmasked cell.

    Notes
    -----
    The average of x at time t is

        <x>(t) = sum_c w_c x_c(t) / sum_c w_c,   w_c = dz dr or pi (r_outer^2 - r_inner^2) dz

    over the cells c of the zone. Sums are computed in float64, over parts of the field that fit
    into memory.

    Examples
    --------
    >>> field = ep.data.read_field("run.nc")
    >>> run = ep.zone_average(field, ep.Zone(z=(0.01, 0.02)), states=["n_i", "n_n"])
    >>> run.state_names, run.n_samples
    (('n_i', 'n_n'), 300)
    """
    check_field(field)
    columns = {name: [(name, 1)] for name in (*states, *inputs)}
    columns |= {f"<{p.replace(' ', '')}>": average_of(field, split_factors(p)) for p in products}
    used = list(dict.fromkeys(name for factors in columns.values() for name, _ in factors))
    _check_names(field, used, [*states, *inputs, *products])
    slices = zone_slices(field, resolve_zone(zone, field))
    part = field[used].assign_coords({axis: field[axis] for axis in field.dims}).isel(slices)
    part = without_gaps(part)
    masks = {name: mask_cells(part[name]) for name in used}
    weights = _zone_weights(field, slices, masks, axisymmetric=axisymmetric)
    means = _means(part, masks, weights, list(columns.values()))
    return Trajectory(
        t=grid_points(part, "time"),
        states=means[:, : len(states)],
        state_names=states,
        inputs=means[:, len(states) :],
        input_names=list(columns)[len(states) :],
        units={
            column: unit_product((field[name].attrs["units"], power) for name, power in factors)
            for column, factors in columns.items()
        },
        label=label,
        clock=clock_of(field),
    )


Factors = list[tuple[str, int]]
Masks = Mapping[str, Bool[np.ndarray, "1 _ _"]]  # variable -> cells without plasma

# Attribute: the product whose average over a cell's face, towards the anode, the variable holds.
FACES = "face_average_of"


def average_of(field: xr.Dataset, factors: Factors, *, faces: bool = False) -> Factors:
    """Factors of a product, or the variable that holds its time average if the field has one.

    faces: prefer the variable that holds it at the faces of the cells.
    """
    for attribute in (FACES, "average_of")[not faces :]:
        for name, variable in field.data_vars.items():
            kept = variable.attrs.get(attribute)
            if kept is not None and sorted(split_factors(kept)) == sorted(factors):
                return [(str(name), 1)]
    return factors


def _check_names(field: xr.Dataset, used: Sequence[str], columns: Sequence[str]) -> None:
    if unknown := [name for name in used if name not in field.data_vars]:
        hints = [
            f"; {name} is made from {source}: 'prepare=[{{_target_:{step}}}]'"
            for name, (source, step) in MADE_FROM.items()
            if name in unknown and source in field
        ]
        hints = hints or [near_words(unknown[0], map(str, field.data_vars))]
        raise ValueError(
            f"unknown variables {unknown}; this field has {list(field.data_vars)}{''.join(hints)}"
        )
    if len(set(columns)) < len(columns):
        raise ValueError(f"states, inputs and products must differ, got {list(columns)}")


def _zone_weights(
    field: xr.Dataset, slices: Mapping[str, slice], masks: Masks, *, axisymmetric: bool
) -> Float[np.ndarray, "z r"]:
    """Cell sizes inside the zone, normalised to sum one; zero where any variable is masked."""
    sizes = [
        cell_sizes(field, axis, axisymmetric=axisymmetric)[slices.get(axis, slice(None))]
        if axis in field.dims
        else np.ones(1)
        for axis in SPACE
    ]
    weights = np.multiply.outer(*sizes)
    for mask in masks.values():
        weights = np.where(mask[0], 0.0, weights)
    if not weights.any():
        raise ValueError(
            f"a zone must hold plasma: {list(masks)} share no unmasked cell "
            f"among its {weights.size} grid points; move the zone, mend the mask, or crop a first "
            "sample that is empty"
        )
    return weights / weights.sum()


def _means(
    part: xr.Dataset, masks: Masks, weights: Float[np.ndarray, "z r"], columns: Sequence[Factors]
) -> Float[np.ndarray, "samples columns"]:
    """Weighted means of products of variables over the cells at all times, block by block."""
    means = np.zeros((part.sizes["time"], len(columns)))
    for where in blocks_of(part):
        block, values = part.isel(where), {}
        cells = tuple(where.get(axis, slice(None)) for axis in SPACE)
        for name, masked in masks.items():
            raw, here = grid_values(block[name]), _of_cells(masked, cells)
            check_samples(block[name], raw, here)
            values[name] = np.where(here, 0.0, raw)
        fraction = _of_cells(weights, cells)
        for j, factors in enumerate(columns):
            product = math.prod(values[name] ** power for name, power in factors)
            spread = np.broadcast_to(product, (block.sizes["time"], *fraction.shape))
            means[where["time"], j] += np.einsum("tzr,zr->t", spread, fraction)
    return means


def _of_cells(grid: np.ndarray, cells: Sequence[slice]) -> np.ndarray:
    """Part of an array over z and r, its last axes; an axis of one point stands for all cells."""
    along_z, along_r = (
        part if n > 1 else slice(None) for part, n in zip(cells, grid.shape[-2:], strict=True)
    )
    return grid[..., along_z, along_r]


# Zones: part of a grid in z and r, given by its ends or as a part of a thruster's channel.


# Fractions of the channel's length up to its exit, by name. Through the ends of the whole channel
# pass a known inflow and what leaves the thruster; the thesis averages over the downstream part.
PARTS = {"channel": 1.0, "downstream": 0.4}


@dataclass(frozen=True)
class Zone:
    """Part of the grid of a field: a range or a place in z and in r.

    Parameters
    ----------
    z : (float, float), float or str, optional
        (from, to) in m, ends included. A number is a place: the grid point nearest to it. "channel"
        is the thruster's channel from the anode to the exit, "downstream" its last 40 %; its length
        is an attribute of the field, and a field without z needs none. None takes the whole axis.
    r : (float, float) or float, optional
        (from, to) in m, ends included, or a place. None takes the whole axis.

    Raises
    ------
    ValueError
        If a range is not a number or two increasing ones, or the name of a part is unknown.

    Examples
    --------
    >>> zone = ep.Zone(z=(0.01, 0.02))
    >>> zone.z, zone.r
    ((0.01, 0.02), None)
    """

    z: Sequence[float] | float | str | None = None
    r: Sequence[float] | float | None = None

    def __post_init__(self) -> None:
        for axis in SPACE:
            bounds = getattr(self, axis)
            if bounds is None or (axis == "z" and isinstance(bounds, str) and bounds in PARTS):
                continue
            if isinstance(bounds, int | float):
                object.__setattr__(self, axis, float(bounds))
                continue
            if isinstance(bounds, str) or len(bounds) != 2 or not bounds[0] < bounds[1]:
                names = f" or one of {', '.join(PARTS)}" if axis == "z" else ""
                raise ValueError(
                    f"a zone's {axis} must be a number or two increasing ones in m{names}, got "
                    f"{bounds!r}"
                )
            object.__setattr__(self, axis, (float(bounds[0]), float(bounds[1])))


def resolve_zone(zone: Zone | None, field: xr.Dataset) -> Zone:
    """Replace the name of a part by ends in m, and None by a zone that covers the whole field.

    Raises ValueError for a part of the channel if the field does not give the channel's length.
    """
    zone = zone or Zone()
    if not isinstance(zone.z, str):
        return zone
    if "z" not in field.dims:
        return replace(zone, z=None)
    length_m = channel_length_m(field.attrs)
    if length_m is None:
        points = grid_points(field, "z")
        raise ValueError(
            f"an average over {_part_text(zone.z)} needs the channel's length, which the file does "
            f"not say: give data.channel_m=LENGTH in m, or a zone of your own, "
            f"'trajectory.zone.z=[FROM,TO]' in m (null: all of it); its z runs from "
            f"{points[0]:.4g} to {points[-1]:.4g} m"
        )
    return replace(zone, z=((1.0 - PARTS[zone.z]) * length_m, length_m))


def _part_text(name: str) -> str:
    part = "" if PARTS[name] == 1.0 else f"last {100.0 * PARTS[name]:.0f} % of the "
    return f"the {part}channel"


def _nearest(points: Float[np.ndarray, " points"], place: float, axis: str) -> int:
    """Index of the grid point nearest to a place within the grid's cells."""
    ends = cell_edges(points)[[0, -1]] if len(points) > 1 else points[[0, 0]]
    if not ends[0] <= place <= ends[1]:
        raise ValueError(
            f"a point must lie on the grid, got {axis} = {place:g} m, the grid's cells reach "
            f"from {ends[0]:g} to {ends[1]:g} m"
        )
    return int(np.argmin(np.abs(points - place)))


def describe_zone(zone: Zone | None, field: xr.Dataset) -> str:
    """Describe a zone as `z 15 to 25 mm (20 of 100 points), ...`; "" for a field without a grid."""
    ends = resolve_zone(zone, field)
    slices = zone_slices(field, ends)
    texts = []
    for axis in SPACE:
        if axis in field.dims:
            points = grid_points(field, axis)
            bounds = getattr(ends, axis)
            inside = points[slices.get(axis, slice(None))]
            if isinstance(bounds, float):
                texts.append(f"{axis} = {1e3 * inside[0]:.4g} mm (one grid point)")
                continue
            first, last = points[[0, -1]] if bounds is None else bounds
            of_all = "all" if len(inside) == len(points) else f"{len(inside)} of"
            texts.append(
                f"{axis} {1e3 * first:.4g} to {1e3 * last:.4g} mm ({of_all} {len(points)} points)"
            )
    if texts and zone is not None and isinstance(zone.z, str) and "z" in field.dims:
        length_mm = 1e3 * float(channel_length_m(field.attrs) or np.nan)
        texts[0] += f", {_part_text(zone.z)}, {length_mm:.4g} mm"
    return "; ".join(texts)


def zone_slices(field: xr.Dataset, zone: Zone) -> dict[str, slice]:
    """Slice of the grid points inside the zone, for each axis that the zone bounds.

    Raises ValueError if the zone bounds an axis the field lacks, holds no grid point, or
    reaches beyond the grid by more than one cell (a sign of cm taken for m).
    """
    slices = {}
    for axis in SPACE:
        bounds = getattr(zone, axis)
        if bounds is None:
            continue
        if axis not in field.dims:
            raise ValueError(
                f"a zone may bound only the axes of its field, got {axis}, the field has "
                f"{list(field.dims)}; leave {axis} out of the zone"
            )
        points = grid_points(field, axis)
        if isinstance(bounds, float):
            nearest = _nearest(points, bounds, axis)
            slices[axis] = slice(nearest, nearest + 1)
            continue
        rounding = 1e-6 * np.ptp(points)  # a grid stored as float32 must not lose its end points
        start = int(np.searchsorted(points, bounds[0] - rounding, side="left"))
        stop = int(np.searchsorted(points, bounds[1] + rounding, side="right"))
        steps = np.diff(points) if len(points) > 1 else np.array([np.inf])
        beyond = max(points[0] - bounds[0] - steps[0], bounds[1] - points[-1] - steps[-1])
        if start >= stop or beyond > rounding:
            raise ValueError(
                f"a zone must hold grid points and stay on the grid, got {axis} from {bounds[0]:g} "
                f"to {bounds[1]:g} m, the grid has {len(points)} points from {points[0]:g} to "
                f"{points[-1]:g} m; take a zone on the grid ('trajectory.zone.{axis}=[FROM,TO]')"
            )
        slices[axis] = slice(start, stop)
    return slices


# Several zones next to each other.


def zone_averages(
    field: xr.Dataset,
    zones: Mapping[str, Zone | Sequence[float]],
    *,
    states: Sequence[str],
    inputs: Sequence[str] = (),
    products: Sequence[str] = (),
    axisymmetric: bool = True,
    label: str = "",
) -> Trajectory:
    """One trajectory of the averages over several zones, named `n_i@exit` and so on.

    Each zone is averaged as `zone_average` does.

    Parameters
    ----------
    field : Dataset
        Field over time and z, r or both.
    zones : mapping of str to Zone or (from, to)
        A `Zone`, or its (from, to) in z in m, by name, in the order in which the zones lie. A grid
        point on an edge that two zones share belongs to the first.
    states : sequence of str
        Names of the variables that become states in every zone.
    inputs : sequence of str, default ()
        Names of the variables that become inputs in every zone.
    products : sequence of str, default ()
        Products whose averages become inputs, as for `zone_average`.
    axisymmetric : bool, default True
        True if r is the radius of a cylinder, False if it is a Cartesian coordinate.
    label : str, default ''
        Label of the trajectory.

    Returns
    -------
    Trajectory
        The averages over time. The states of the first zone stand first.

    Raises
    ------
    ValueError
        As `zone_average`, and if a zone's name is not a word, or zones overlap or are out of order.

    Examples
    --------
    >>> field = ep.data.read_field("run.nc")
    >>> zones = {"anode": (0.0, 0.0125), "exit": (0.0125, 0.025)}
    >>> ep.zone_averages(field, zones, states=["n_i", "n_n"]).state_names
    ('n_i@anode', 'n_n@anode', 'n_i@exit', 'n_n@exit')
    """
    average = ZoneAverage(states, None, products, axisymmetric, zones)
    return average.trajectory(field, inputs=inputs, label=label)


def in_zones(zones: Iterable[str], names: Sequence[str]) -> list[str]:
    """Names of the averages of variables over several zones, zone by zone."""
    return [_in_zone(name, zone) for zone in zones for name in names]


def _in_zone(name: str, zone: str) -> str:
    return f"{name}@{zone}" if zone else name


def side_by_side(zones: Mapping[str, Zone | Sequence[float]], field: xr.Dataset) -> dict[str, Zone]:
    """Zones with ends in m that share no grid point; see `zone_averages`."""
    found: dict[str, Zone] = {}
    taken, reached_m = 0, -math.inf
    for name, given in zones.items():
        if not re.fullmatch(r"\w{1,100}", str(name)):
            raise ValueError(f"a zone's name must be a word, such as 'exit', got {name!r}")
        zone = resolve_zone(given if isinstance(given, Zone) else Zone(z=given), field)
        begin_m, end_m = zone.z if isinstance(zone.z, tuple) else (math.nan, math.nan)
        if not begin_m >= reached_m:
            raise ValueError(
                "zones must follow each other in z without overlap, each with its ends in m: "
                f"{name} is {zone.z}"
                + (f", after one that ends at {reached_m:g} m" if found else "")
            )
        inside = zone_slices(field, zone)["z"]
        if inside.stop <= taken:
            raise ValueError(
                f"each zone must hold grid points of its own: {name}, {zone.z} m, has "
                "only one that belongs to the zone before; give wider zones"
            )
        if inside.start < taken:
            zone = replace(zone, z=(float(grid_points(field, "z")[taken]), end_m))
        found[str(name)] = zone
        taken, reached_m = inside.stop, end_m
    return found


@dataclass(frozen=True)
class ZoneAverage:
    """Settings of `zone_average` without the field, for use in a config.

    Parameters
    ----------
    states : sequence of str
        Names of the variables that become states.
    zone : Zone, optional
        Part of the grid. None takes the whole field.
    products : sequence of str, default ()
        Products whose averages become inputs.
    axisymmetric : bool, default True
        True if r is the radius of a cylinder.
    zones : mapping of str to Zone or (from, to), or int, optional
        The zones of `zone_averages`, in place of the one zone; or a number of parts of `zone`, of
        equal length in z, called z1, z2 and so on.

    Raises
    ------
    ValueError
        If zones are neither names with places nor a number of one or more.
    """

    states: Sequence[str]
    zone: Zone | None = None
    products: Sequence[str] = ()
    axisymmetric: bool = True
    zones: Mapping[str, Zone | Sequence[float]] | int | None = None

    def __post_init__(self) -> None:
        zones = self.zones
        is_number = type(zones) is int and zones >= 1
        if not (zones is None or is_number or (isinstance(zones, Mapping) and zones)):
            raise ValueError(
                "zones must be a whole number of parts, one or more, or zones by name, such as "
                f"{{anode: [0, 0.01], exit: [0.01, 0.025]}} in m, got {zones!r}"
            )

    def parts(self, field: xr.Dataset) -> dict[str, Zone]:
        """The zones by name; a single one is called ""."""
        if isinstance(self.zones, Mapping):
            return side_by_side(self.zones, field)
        whole = resolve_zone(self.zone, field)
        if self.zones is None:
            return {"": whole}
        points = grid_points(field, "z")
        ends = whole.z if isinstance(whole.z, tuple) else cell_edges(points)[[0, -1]]
        begin_m, end_m = map(float, ends)
        edges_m = np.linspace(begin_m, end_m, self.zones + 1)
        cut = {n: replace(whole, z=z) for n, z in zip(self._names, pairwise(edges_m), strict=True)}
        return side_by_side(cut, field)

    @property
    def _names(self) -> list[str]:
        """Of the zones; a single one is called ""."""
        if isinstance(self.zones, int):
            return [f"z{k + 1}" for k in range(self.zones)]
        return list(self.zones or [""])

    def trajectory(self, field: xr.Dataset, *, inputs: Sequence[str], label: str) -> Trajectory:
        average = partial(
            zone_average, field, states=self.states, inputs=inputs, products=self.products,
            axisymmetric=self.axisymmetric, label=label,
        )  # fmt: skip
        runs = {name: average(zone) for name, zone in self.parts(field).items()}
        first = next(iter(runs.values()))
        return replace(
            first,
            states=np.column_stack([run.states for run in runs.values()]),
            state_names=in_zones(runs, first.state_names),
            inputs=np.column_stack([run.inputs for run in runs.values()]),
            input_names=in_zones(runs, first.input_names),
            units={
                _in_zone(name, zone): unit
                for zone, run in runs.items()
                for name, unit in run.units.items()
            },
        )

    def columns(self, names: Sequence[str]) -> list[str]:
        """What the averages of variables are called in the trajectory."""
        return in_zones(self._names, names)

    def sizes(self, field: xr.Dataset) -> dict[str, float]:
        """Length in m of each of several zones; empty for a single one.

        Raises ValueError for zones that do not adjoin: nothing is known of what lies between.
        """
        if self.zones is None:
            return {}
        parts = self.parts(field)
        inside = [zone_slices(field, zone)["z"] for zone in parts.values()]
        if any(there.start != here.stop for here, there in pairwise(inside)):
            raise ValueError(
                "zones that exchange something must adjoin, each beginning where the one before "
                f"ends, got {self.zones}"
            )
        lengths = cell_sizes(field, "z", axisymmetric=self.axisymmetric)
        return {n: float(lengths[part].sum()) for n, part in zip(parts, inside, strict=True)}

    def place(self, field: xr.Dataset) -> str:
        """Description of the part of the field's grid that is averaged over."""
        if self.zones is None:
            words = describe_zone(self.zone, field)
            return f"average over {words}" if words else ""
        parts = self.parts(field).items()
        return "; ".join(f"{name}: average over {describe_zone(z, field)}" for name, z in parts)
