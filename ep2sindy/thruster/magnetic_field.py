"""The radial magnetic field on the channel axis: a Gaussian, or a table from a file.

The classes share two methods. `at(distance)` gives the field in T at a distance from the exit in
m, negative inside. `check_covers(first, last)` refuses an interval that the field does not cover.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ep2sindy.data.readers.source import file_named
from ep2sindy.thruster.checks import check_positive, set_profile
from ep2sindy.thruster.tables import read_columns

LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
FIELDS = {"T": 1.0, "mT": 1e-3, "G": 1e-4}
Points = Sequence[float] | Float[np.ndarray, " points"]
HIGHEST_T = 1.0  # above any Hall thruster: a larger number is in another unit


@dataclass(frozen=True)
class MagneticField:
    """A Gaussian field with its peak at the exit, wider in the plume.

    Parameters
    ----------
    peak : float, default 0.015
        Field at the exit in T.
    width_channel : float, default 0.011
        Standard deviation in the channel in m.
    width_plume : float, default 0.018
        Standard deviation in the plume in m.

    Raises
    ------
    ValueError
        If a number is not positive.
    """

    peak: float = 15e-3  # T
    width_channel: float = 11e-3  # m, standard deviation
    width_plume: float = 18e-3  # m

    def __post_init__(self) -> None:
        check_positive(self, "peak", "width_channel", "width_plume")

    def at(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Field in T at a distance from the exit in m, negative inside."""
        width = np.where(distance < 0.0, self.width_channel, self.width_plume)
        return self.peak * np.exp(-0.5 * (distance / width) ** 2)

    def check_covers(self, first: float, last: float) -> None:
        """Accept any interval, since the formula holds everywhere."""


@dataclass(frozen=True)
class MagneticFieldTable:
    """Field interpolated by a shape-preserving cubic (PCHIP), which does not overshoot.

    The table may end up to its widest step short of the domain; the end value is held there.

    Parameters
    ----------
    distance : sequence of float
        Distances from the exit in m, increasing, negative inside.
    B : sequence of float
        Field in T. Its sign is ignored.

    Raises
    ------
    ValueError
        If there are gaps, points out of order, or the field is zero everywhere or too large for T.
    """

    distance: Points
    B: Points

    def __post_init__(self) -> None:
        set_profile(self, "distance", "B", None)
        largest = max(map(abs, self.B))
        if not 0.0 < largest <= HIGHEST_T:
            raise ValueError(
                f"MagneticFieldTable.B must be in T and not zero everywhere, got up to {largest:g}"
            )

    def at(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Field in T at a distance from the exit in m."""
        from scipy.interpolate import PchipInterpolator

        curve = PchipInterpolator(self.distance, np.abs(self.B))
        return curve(np.clip(distance, self.distance[0], self.distance[-1]))

    def check_covers(self, first: float, last: float) -> None:
        """Raise ValueError if the points end short of [first, last], distances in m."""
        step = max(np.diff(self.distance))
        low, high = self.distance[0], self.distance[-1]
        if low - step > first or high + step < last:
            raise ValueError(
                f"the magnetic field must cover the domain, {first:g} to {last:g} m from the "
                f"exit: it is known from {low:g} to {high:g} m; measure on, or shorten the domain "
                "(is the exit where you say that it is?)"
            )


def read_magnetic_field(
    path: str | Path,
    *,
    exit_m: float,
    z_unit: str | None = None,
    B_unit: str | None = None,
    scale: float = 1.0,
) -> MagneticFieldTable:
    """Read a field from a CSV file of two columns, position and field.

    Lines that begin with # are ignored.

    Parameters
    ----------
    path : str or Path
        The file.
    exit_m : float
        Position of the channel's exit in m on the file's own axis: 0.025 if the axis begins at the
        anode of a channel of 25 mm, 0 if it begins at the exit.
    z_unit : str, optional
        Unit of the positions: m, cm or mm. None reads it in the header, as in `z_mm,B_mT` or
        `z (cm), Br [G]`; a file without units is taken as m, if its numbers are plausible.
    B_unit : str, optional
        Unit of the field: T, mT or G. None reads it in the header, and without one takes T.
    scale : float, default 1.0
        Factor on the field.

    Returns
    -------
    MagneticFieldTable
        The field along the axis.

    Raises
    ------
    ValueError
        If there is a gap, a unit is unknown, or the field exceeds 1 T.
    """
    header, (z, B) = read_columns(Path(path), "file of a magnetic field", 2)
    z_name, B_name = header or ("", "")
    lengths = _unit(LENGTHS, z_unit, z_name, f"{path}: position")
    fields = _unit(FIELDS, B_unit, B_name, f"{path}: field")
    largest = float(np.abs(B).max())
    if fields is None and largest > HIGHEST_T:
        raise ValueError(
            f"{path}: the field has no unit and reaches {largest:g}, too much for T; write it "
            "into the header, such as z_m,B_G, or give B_unit=G or mT"
        )
    if lengths is None and np.ptp(z) > 1.0:
        raise ValueError(
            f"{path}: the position has no unit and spans {np.ptp(z):g}, too much for "
            "m; write it into the header, such as z_mm,B_T, or give z_unit=mm or cm"
        )
    with file_named(Path(path)):
        return MagneticFieldTable((lengths or 1.0) * z - exit_m, scale * (fields or 1.0) * B)


def _unit(units: dict[str, float], given: str | None, header: str, place: str) -> float | None:
    """Factor to SI of the unit that is given, or of the last of several words in the header."""
    word = given
    if word is None and (words := re.findall(r"[A-Za-z]+", header))[1:]:
        word = words[-1]
    if word is None:
        return None
    if word not in units:
        raise ValueError(
            f"{place} must be in one of {list(units)}, got {word!r}; the unit stands last in the "
            "header, as in z_mm,B_mT, or is given"
        )
    return units[word]


Field = MagneticField | MagneticFieldTable
