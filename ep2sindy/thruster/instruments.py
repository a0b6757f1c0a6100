"""What instruments would see of a simulated thruster: ion velocities by LIF, signals of probes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.signal import lfilter

from ep2sindy.runtime.files import read_json
from ep2sindy.thruster.constants import E_CHARGE, M_XENON
from ep2sindy.thruster.recording import notes

N_SPEEDS = 200  # bins of a distribution
NEEDED = ("ionization", "E_z", "dz")

Values = Sequence[float] | Float[np.ndarray, " values"]


def ion_velocities(
    field: xr.Dataset, z: Values | float, *, speeds: Values | None = None
) -> xr.DataArray:
    """Distribution f(u) of the axial velocity of singly charged ions, as LIF averages it.

    Ions born in a place at the rate `ionization`, with the neutrals' speed u_n (or at rest), have
    u^2 = u_n^2 + 2 e (drop of the potential since)/m and the density (rate dz)/u. Each sample is
    taken as steady, since ions cross the thruster in a few samples; its densities are added up over
    the record. Left out: losses to walls, collisions, ions that move towards the anode, and that
    some are born with two charges. The fluid has one velocity in a place: its
    u_iz agrees with the mean of f where ions come from upstream, and is above it where they are
    born.

    field: record of `simulate` with averages. z: places in m from the anode. speeds: edges of bins
    in m/s, increasing; None takes 200 up to the fastest ion. Returns f in s/m on (z, u), with u at
    the middle of each bin; its integral over all u is 1.
    Raises ValueError for a record without averages, places outside of it, or edges out of order.
    """
    if lacking := [name for name in NEEDED if name not in field]:
        raise ValueError(
            f"ion_velocities needs the averages of an axial run: {lacking} are not there; simulate "
            "with averaged=True"
        )
    mass, born_m_s, per_volt = _ions(field)
    faces = np.concatenate([[0.0], np.cumsum(field["dz"].values.astype(float))])
    places = np.atleast_1d(np.asarray(z, dtype=float))
    if not np.all((places > 0.0) & (places <= faces[-1])):
        raise ValueError(f"places must lie in the record, 0 to {faces[-1]:g} m: {places} came")
    E, rate = (field[name].values.astype(float) for name in ("E_z", "ionization"))
    if "area" in field:  # in a wider cell more ions are born; where they are seen, all spread alike
        rate = rate * field["area"].values
    groups = [_births(faces, E, rate, place, born_m_s, per_volt) for place in places]
    edges = _edges(speeds, max(float(fast.max(initial=0.0)) for _, fast, _ in groups))
    f = np.array([_histogram(edges, *group) for group in groups])
    coords = {
        "z": ("z", places, notes("m", "axial distance from the anode")),
        "u": ("u", 0.5 * (edges[1:] + edges[:-1]), notes("m/s", "axial ion velocity")),
    }
    attrs = notes("s/m", "distribution of the axial ion velocity") | {"ion_mass_kg": mass}
    return xr.DataArray(f, dims=("z", "u"), coords=coords, attrs=attrs, name="f")


def _ions(field: xr.Dataset) -> tuple[float, float, float]:
    """Mass in kg, speed at birth in m/s, and 2 e/m, from the parameters of a run."""
    parameters = read_json(field.attrs["parameters"])
    thruster, speed = parameters["thruster"], parameters["operating_point"]["neutral_speed"]
    mass = float(thruster["propellant"].get("mass", M_XENON))  # formulas are of xenon
    if isinstance(speed, dict):  # a NeutralSpeed: its mean, for it hardly counts
        speed = float(np.mean(speed["speed"]))
    return mass, 0.0 if thruster["ions_born_at_rest"] else float(speed), 2.0 * E_CHARGE / mass


def _births(
    faces: Float[np.ndarray, " faces"],
    E: Float[np.ndarray, "samples cells"],
    rate: Float[np.ndarray, "samples cells"],
    place: float,
    born_m_s: float,
    per_volt: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lowest and highest speed at a place and density of the ions of every sample and cell.

    With a constant field in a cell, f is constant between the two speeds.
    """
    last = int(np.searchsorted(faces, place)) - 1  # the cell with the place
    dz = np.diff(np.append(faces[: last + 1], place))
    drops = E[:, : last + 1] * dz
    left = np.cumsum(drops[:, ::-1], axis=1)[:, ::-1]  # from the left face of each cell, V
    right = left - drops
    highest = np.maximum.accumulate(right[:, ::-1], axis=1)[:, ::-1]  # potential ahead, V
    passes = born_m_s**2 + per_volt * (left - highest) >= 0.0
    squares = [born_m_s**2 + per_volt * drop for drop in (left, right)]
    one, other = (np.sqrt(np.maximum(square, 0.0)) for square in squares)
    mean = np.maximum(0.5 * (one + other), 1e-3)
    density = np.where(passes, rate[:, : last + 1] * dz / mean, 0.0)
    return np.minimum(one, other), np.maximum(one, other), density


def _edges(speeds: Values | None, fastest: float) -> Float[np.ndarray, " edges"]:
    if speeds is None:
        return np.linspace(0.0, 1.01 * fastest, N_SPEEDS + 1)
    edges = np.asarray(speeds, dtype=float)
    if edges.ndim != 1 or edges.size < 2 or not np.all(np.diff(edges) > 0.0):
        raise ValueError(f"speeds must be two or more increasing edges in m/s, got {speeds!r}")
    return edges


def _histogram(
    edges: Float[np.ndarray, " edges"],
    slow: Float[np.ndarray, "samples cells"],
    fast: Float[np.ndarray, "samples cells"],
    density: Float[np.ndarray, "samples cells"],
) -> Float[np.ndarray, " bins"]:
    """Density in each bin over its width and the whole density: exact for uniform groups."""
    fast = np.maximum(fast, slow + 1e-3)  # sharper groups would divide by zero
    rate = density / (fast - slow)

    def ramps(start: Float[np.ndarray, "samples cells"]) -> Float[np.ndarray, " edges"]:
        """Sum of rate (edge - start) over all starts below each edge."""
        place = np.searchsorted(edges, start.ravel())
        sums = [
            np.cumsum(np.bincount(place, weights.ravel(), edges.size + 1))[:-1]
            for weights in (rate, rate * start)
        ]
        return edges * sums[0] - sums[1]

    held = np.maximum(np.diff(ramps(slow) - ramps(fast)), 0.0)  # rounding may go below
    return held / np.diff(edges) / density.sum()


def probe(
    field: xr.Dataset,
    name: str,
    z: float | None = None,
    *,
    bandwidth_Hz: float,
    noise: float = 0.0,
    seed: int = 0,
) -> xr.DataArray:
    """A quantity as a probe of a limited bandwidth records it.

    The probe is a first-order low-pass with the corner frequency bandwidth_Hz, at rest before the
    first sample; between samples the quantity is linear, for which the result is exact. It lags, as
    a probe does. name: of a variable. z: place in m from the anode for one on (time, z), linear
    between cells. noise: standard deviation of white noise of the recorder, in the variable's unit,
    drawn by `seed`. Returns a series on time, with the variable's unit.
    Raises ValueError for a name or place that is not there, or a bandwidth that is not positive.
    """
    if name not in field:
        raise ValueError(f"there is no {name!r} to record: the run has {list(field.data_vars)}")
    if not (np.isfinite(bandwidth_Hz) and bandwidth_Hz > 0.0 and 0.0 <= noise < np.inf):
        raise ValueError(
            f"bandwidth_Hz must be positive and noise zero or more: {bandwidth_Hz!r} and {noise!r} "
            "came"
        )
    signal = field[name]
    if ("z" in signal.dims) != (z is not None):
        raise ValueError(f"z must be given for what varies along z, and only then: {name}, z = {z}")
    if z is not None:
        low, high = float(field["z"][0]), float(field["z"][-1])
        if not low <= z <= high:
            raise ValueError(
                f"z must be between the outermost cells, {low:g} and {high:g} m: {z!r}"
            )
        signal = signal.interp(z=z)
    values = signal.values.astype(float)
    steps = 2.0 * np.pi * bandwidth_Hz * float(field["time"][1] - field["time"][0])
    kept = np.exp(-steps)
    mean = -np.expm1(-steps) / steps
    weights = [1.0 - mean, mean - kept]  # of the present sample and the one before
    start = [values[0] - weights[0] * values[0]]
    seen, _ = lfilter(weights, [1.0, -kept], values, zi=start)
    seen += noise * np.random.default_rng(seed).standard_normal(seen.size)
    text = f"{signal.attrs['long_name']}, by a probe of {bandwidth_Hz:g} Hz"
    attrs = notes(signal.attrs["units"], text)
    return xr.DataArray(
        seen, dims=("time",), coords={"time": field["time"]}, attrs=attrs, name=name
    )
