"""Anomalous transport: an effective collision frequency nu = c(z) omega_ce, not given by theory.

The classes share one method: `at(distance)`, the coefficient c at a distance from the exit in m,
negative inside the channel; `PressureShift` moves any of them. Their numbers are tuned, as in every
1-D code; see docs/thruster.md.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from ep2sindy.thruster.checks import check_not_negative, check_positive, check_range, set_profile
from ep2sindy.thruster.walls import fraction
from ep2sindy.trust.user_code import identify, load_marked

Points = Sequence[float] | Float[np.ndarray, " points"]


@dataclass(frozen=True)
class AnomalousTransport:
    """Anomalous transport of two zones, with c linear across a layer around the exit.

    Parameters
    ----------
    c_channel : float, default 1 / 365
        Coefficient in the channel.
    c_plume : float, default 1 / 69
        Coefficient in the plume.
    transition : float, default 0.0035
        Thickness of the layer in m.

    Raises
    ------
    ValueError
        If a coefficient is not positive, or the layer is negative.
    """

    c_channel: float = 1 / 365
    c_plume: float = 1 / 69
    transition: float = 3.5e-3  # m

    def __post_init__(self) -> None:
        check_positive(self, "c_channel", "c_plume")
        check_not_negative(self, "transition")

    def at(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Coefficient c at a distance from the exit in m."""
        return fraction(distance, self.c_channel, self.c_plume, self.transition)


@dataclass(frozen=True)
class GaussianTransport:
    """Anomalous transport of one level, with a trough near the exit.

    Parameters
    ----------
    c_far : float, default 1 / 16
        Coefficient far from the trough.
    trough : float, default 0.1
        Coefficient at the middle of the trough, as a fraction of c_far.
    center : float, default 0.0
        Distance of the trough from the exit in m.
    width : float, default 0.005
        Standard deviation of the trough in m.

    Raises
    ------
    ValueError
        If a coefficient or the width is not positive, the trough is above 1, or the center is not
        finite.

    Notes
    -----
    At the distance d from the exit,

        c = c_far (1 - (1 - trough) exp(-((d - center) / width)^2 / 2))

    Source: GaussianBohm of HallThruster.jl, Marks et al., JOSS 8 (2023) 4672.
    """

    c_far: float = 1 / 16
    trough: float = 0.1
    center: float = 0.0  # m
    width: float = 5e-3  # m

    def __post_init__(self) -> None:
        check_positive(self, "c_far", "trough", "width")
        check_range(self, "at most 1", lambda value: value <= 1.0, "trough")
        check_range(self, "finite", lambda _: True, "center")

    def at(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Coefficient c at a distance from the exit in m."""
        bell = np.exp(-0.5 * ((distance - self.center) / self.width) ** 2)
        return self.c_far * (1.0 - (1.0 - self.trough) * bell)


@dataclass(frozen=True)
class MultiLogTransport:
    """Anomalous transport at given points: log c is linear between them, constant beyond the ends.

    Parameters
    ----------
    distance : sequence of float
        Distances of the points from the exit in m, increasing, negative inside.
    c : sequence of float
        Coefficients at the points.

    Raises
    ------
    ValueError
        If there are gaps, points out of order, or a coefficient that is not positive.

    Notes
    -----
    Hall2De and HallThruster.jl (MultiLogBohm) use the same form.
    """

    distance: Points
    c: Points

    def __post_init__(self) -> None:
        set_profile(self, "distance", "c", "")

    def at(self, distance: Float[np.ndarray, " z"]) -> Float[np.ndarray, " z"]:
        """Coefficient c at a distance from the exit in m."""
        return np.exp(np.interp(distance, self.distance, np.log(self.c)))


BohmTransport = AnomalousTransport | GaussianTransport | MultiLogTransport


@dataclass(frozen=True)
class PressureShift:
    """A transport that the facility's pressure moves along the axis.

    With alpha above 2 and dz positive it moves from z0 + dz (1 - 1/alpha) in vacuum towards the
    anode, by half of that distance at half of pressure_Pa. The magnetic field stays.

    Parameters
    ----------
    transport : BohmTransport
        The transport that is moved.
    z0, dz : float
        Position and shift in channel lengths, towards the plume.
    pressure_Pa : float
        Scale of the pressure in Pa.
    alpha : float
        Steepness, above 1.

    Raises
    ------
    ValueError
        If alpha is not above 1, the pressure is not positive, or a shift is not finite.

    Notes
    -----
    At the pressure p the transport stands at

        z = z0 + dz / (1 + (alpha - 1)^(2 p / pressure_Pa - 1))

    Source: LogisticPressureShift of HallThruster.jl, Marks et al., JOSS 8 (2023) 4672.
    """

    transport: BohmTransport
    z0: float
    dz: float
    pressure_Pa: float
    alpha: float

    def __post_init__(self) -> None:
        check_positive(self, "pressure_Pa")
        check_range(self, "above 1", lambda value: value > 1.0, "alpha")
        check_range(self, "finite, in channel lengths", lambda _: True, "z0", "dz")

    def shift(self, pressure_Pa: float) -> float:
        """Where the transport stands at a pressure, in channel lengths from its own place."""
        power = 2.0 * pressure_Pa / self.pressure_Pa - 1.0
        return self.z0 + self.dz * float(
            np.exp(-np.logaddexp(0.0, power * np.log(self.alpha - 1.0)))
        )


@dataclass(frozen=True)
class Plasma:
    """What a transport may depend on, in the cells between anode and cathode plane, in SI.

    n_e, n_n: m^-3. T_e_eV: eV. E: axial field in V/m. u_i: speed of the ions in m/s, a mean over
    the charges. B: T.
    """

    n_e: Float[np.ndarray, " z"]
    T_e_eV: Float[np.ndarray, " z"]
    E: Float[np.ndarray, " z"]
    n_n: Float[np.ndarray, " z"]
    u_i: Float[np.ndarray, " z"]
    B: Float[np.ndarray, " z"]


Coefficients = Callable[[Float[np.ndarray, " z"], float, Plasma], Any]


@dataclass(frozen=True)
class FunctionTransport:
    """Anomalous transport by a function of your own, called once for every sample.

    At the very first call the field may be zero, since none is known yet.

    Parameters
    ----------
    function : callable or str
        Takes the distances from the exit in m, the time in s (negative in the warm-up) and a
        `Plasma`, and returns c at each distance or one number. In a config it is the dotted name of
        a function marked with `@ep.for_configs`, such as `my_module.c`. Put numbers that vary into
        a frozen dataclass with `__call__`.

    Attributes
    ----------
    identity : str
        Module, name and hash of the source, by which cached simulations are distinguished.

    Raises
    ------
    ValueError
        If the function is missing, or cannot be identified by its source.
    """

    function: Coefficients | str
    identity: str = field(init=False)

    def __post_init__(self) -> None:
        if not callable(self.function) and not isinstance(self.function, str):
            raise ValueError(
                "FunctionTransport.function must be a function c(z, t, plasma), or the dotted name "
                f"of one, got {self.function!r}"
            )
        try:
            identity = identify(self.called)
        except (ModuleNotFoundError, AttributeError) as error:
            raise ValueError(
                "FunctionTransport.function must be a function of yours, as my_module.c, below the "
                f"folder that you start in, got {self.function!r}, and {error}"
            ) from error
        object.__setattr__(self, "identity", identity)

    @property
    def called(self) -> Coefficients:
        """The function itself."""
        return load_marked(self.function) if isinstance(self.function, str) else self.function

    def at(
        self, distance: Float[np.ndarray, " z"], t: float, plasma: Plasma
    ) -> Float[np.ndarray, " z"]:
        """Coefficient c at distances from the exit in m.

        Raises ValueError for another number of values, or one that is negative or not finite.
        """
        found = np.asarray(self.called(distance, t, plasma), dtype=float)
        if found.shape not in ((), distance.shape):
            raise ValueError(
                f"a transport must give one coefficient for each of {distance.size} distances, or "
                f"one for all: {self.identity} gave the shape {found.shape}"
            )
        c = np.broadcast_to(found, distance.shape)
        good = np.isfinite(c) & (c >= 0.0)
        if not good.all():
            k = int(np.argmin(good))
            raise ValueError(
                f"a transport must be finite and zero or more everywhere: {self.identity} gave "
                f"{c[k]:g} at {1e3 * distance[k]:.3g} mm from the exit, t = {t:g} s"
            )
        return c


Transport = BohmTransport | PressureShift | FunctionTransport
