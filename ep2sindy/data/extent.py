"""Part of a grid: a zone in z and r, by its ends or as the downstream part of a channel."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr

from ep2sindy.data.fields import SPACE, channel_length_m, grid_points

DOWNSTREAM, SHARE = "downstream", 0.4  # of the channel, where the thesis averages


@dataclass(frozen=True)
class Zone:
    """Part of the grid: (from, to) in z and r, in m, ends included; None is the whole axis.

    z: "downstream" is the last 40 % of the thruster's channel, whose length the field's attributes
    say; a field without z needs none.
    """

    z: Sequence[float] | str | None = None
    r: Sequence[float] | None = None

    def __post_init__(self) -> None:
        for axis in SPACE:
            bounds = getattr(self, axis)
            if bounds is None or (axis == "z" and bounds == DOWNSTREAM):
                continue
            if isinstance(bounds, str) or len(bounds) != 2 or not bounds[0] < bounds[1]:
                raise ValueError(
                    f"a zone's {axis} must be two increasing numbers in m: {list(bounds)} came"
                )
            object.__setattr__(self, axis, (float(bounds[0]), float(bounds[1])))


def in_numbers(zone: Zone | None, field: xr.Dataset) -> Zone:
    """The zone with its ends in m.

    Raises ValueError for a downstream part of a channel whose length the field does not say.
    """
    zone = zone or Zone()
    if zone.z != DOWNSTREAM:
        return zone
    if "z" not in field.dims:
        return replace(zone, z=None)
    length_m = channel_length_m(field.attrs)
    if length_m is None:
        points = grid_points(field, "z")
        raise ValueError(
            f"an average over the last {SHARE:.0%} of the channel needs its length, which the file "
            f"does not say: give data.channel_m=LENGTH in m, or a zone of your own, "
            f"'trajectory.zone.z=[FROM,TO]' in m (null: all of it); its z runs from "
            f"{points[0]:.4g} to {points[-1]:.4g} m"
        )
    return replace(zone, z=((1.0 - SHARE) * length_m, length_m))


def zone_words(zone: Zone | None, field: xr.Dataset) -> str:
    """What of the grid a zone takes: `z 15 to 25 mm (20 of 100 points), ...`; "" without a grid."""
    ends = in_numbers(zone, field)
    slices = zone_slices(field, ends)
    texts = []
    for axis in SPACE:
        if axis in field.dims:
            points = grid_points(field, axis)
            bounds = getattr(ends, axis) or points[[0, -1]]
            n_points = len(points[slices.get(axis, slice(None))])
            of_all = "all" if n_points == len(points) else f"{n_points} of"
            texts.append(
                f"{axis} {1e3 * bounds[0]:.4g} to {1e3 * bounds[1]:.4g} mm "
                f"({of_all} {len(points)} points)"
            )
    if texts and zone is not None and zone.z == DOWNSTREAM:
        length_mm = 1e3 * float(channel_length_m(field.attrs) or np.nan)
        texts[0] += f", the last {SHARE:.0%} of the channel's {length_mm:.4g} mm"
    return "; ".join(texts)


def zone_slices(field: xr.Dataset, zone: Zone) -> dict[str, slice]:
    """Grid points inside the zone, per axis of the field.

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
                f"a zone may bound only the axes of its field: {axis} came, the field has "
                f"{list(field.dims)}; leave {axis} out of the zone"
            )
        points = grid_points(field, axis)
        rounding = 1e-6 * np.ptp(points)  # a grid stored as float32 must not lose its end points
        start = int(np.searchsorted(points, bounds[0] - rounding, side="left"))
        stop = int(np.searchsorted(points, bounds[1] + rounding, side="right"))
        steps = np.diff(points) if len(points) > 1 else np.array([np.inf])
        beyond = max(points[0] - bounds[0] - steps[0], bounds[1] - points[-1] - steps[-1])
        if start >= stop or beyond > rounding:
            raise ValueError(
                f"a zone must hold grid points and stay on the grid: {axis} from {bounds[0]:g} to "
                f"{bounds[1]:g} m came, the grid has {len(points)} points from {points[0]:g} to "
                f"{points[-1]:g} m"
            )
        slices[axis] = slice(start, stop)
    return slices
