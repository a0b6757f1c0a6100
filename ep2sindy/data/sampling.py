"""How a field becomes a trajectory: averages over several zones, one, or a single grid point."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
import xarray as xr

from ep2sindy.data.fields import cell_edges, cell_sizes, grid_points
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.data.zones import Zone, describe_zone, resolve_zone, zone_average, zone_slices


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
    return [f"{name}@{zone}" for zone in zones for name in names]


def side_by_side(zones: Mapping[str, Zone | Sequence[float]], field: xr.Dataset) -> dict[str, Zone]:
    """Zones with ends in m that share no grid point; see `zone_averages`."""
    found: dict[str, Zone] = {}
    taken, reached_m = 0, -math.inf
    for name, given in zones.items():
        if not re.fullmatch(r"\w{1,100}", str(name)):
            raise ValueError(f"a zone's name must be a word, such as 'exit', got {name!r}")
        zone = resolve_zone(given if isinstance(given, Zone) else Zone(z=given), field)
        is_part = isinstance(zone.z, tuple)
        begin_m, end_m = zone.z if isinstance(zone.z, tuple) else (-math.inf, math.inf)
        if begin_m < reached_m or not is_part:
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
        ends = (
            whole.z if isinstance(whole.z, tuple) else cell_edges(grid_points(field, "z"))[[0, -1]]
        )
        begin_m, end_m = map(float, ends)
        edges_m = np.linspace(begin_m, end_m, self.zones + 1)
        cut = {n: replace(whole, z=z) for n, z in zip(self._names, pairwise(edges_m), strict=True)}
        return side_by_side(cut, field)

    @property
    def _names(self) -> list[str]:
        """Of several zones."""
        if isinstance(self.zones, int):
            return [f"z{k + 1}" for k in range(self.zones)]
        return list(self.zones or {})

    def trajectory(self, field: xr.Dataset, *, inputs: Sequence[str], label: str) -> Trajectory:
        average = partial(
            zone_average, field, states=self.states, inputs=inputs, products=self.products,
            axisymmetric=self.axisymmetric, label=label,
        )  # fmt: skip
        if self.zones is None:
            return average(self.zone)
        runs = {name: average(zone) for name, zone in self.parts(field).items()}
        first = next(iter(runs.values()))
        return replace(
            first,
            states=np.column_stack([run.states for run in runs.values()]),
            state_names=in_zones(runs, first.state_names),
            inputs=np.column_stack([run.inputs for run in runs.values()]),
            input_names=in_zones(runs, first.input_names),
            units={
                f"{n}@{zone}": unit for zone, run in runs.items() for n, unit in run.units.items()
            },
        )

    def columns(self, names: Sequence[str]) -> list[str]:
        """What the averages of variables are called in the trajectory."""
        return list(names) if self.zones is None else in_zones(self._names, names)

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
