"""Synthetic (time, z, r) field of three regions with known equations, to test regime detection.

Densities at every grid point follow equations whose coefficients change smoothly from one region
to the next; velocities and the ionization rate are given. Supports and magnitudes are those that
the thesis reports for a Hall thruster's channel (VI-VII): the neutral source is constant near
the anode and proportional to the neutral density downstream, and radial convection acts only
near the walls.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.special import expit

from ep2sindy.library.library import Library, named_terms
from ep2sindy.model.model import coef_matrix
from ep2sindy.model.runge_kutta import step
from ep2sindy.thruster.parameters import Thruster

Equations = Mapping[str, Mapping[str, float]]

UNITS = {"n_i": "m^-3", "n_n": "m^-3", "u_iz": "m/s", "u_ir": "m/s", "R_ion": "m^3/s"}

STATES = ("n_i", "n_n")

INPUTS = ("u_iz", "u_ir", "R_ion")

TERMS = ("1", "n_n", "n_i*u_iz", "n_i*u_ir", "n_i*n_n*R_ion")

# Axial convection and ionization as in the thesis's Eq. 25 at 300 V, 5 mg/s (Table IV).
IONS = {"n_i*u_iz": -41.0, "n_i*n_n*R_ion": 0.82}

REGIONS: Mapping[str, Equations] = {
    "anode": {"n_i": IONS, "n_n": {"1": 8e22, "n_i*n_n*R_ion": -0.77}},
    "exit": {"n_i": {"1": 3e22, **IONS}, "n_n": {"n_n": 3.0e4, "n_i*n_n*R_ion": -0.77}},
    "walls": {
        "n_i": {**IONS, "n_i*u_ir": 45.0},
        "n_n": {"1": 8e22, "n_i*n_n*R_ion": -0.77},
    },
}

# A point where one region's weight in the coefficients exceeds this counts as inside the region.
INSIDE = 0.95


@dataclass(frozen=True, eq=False)
class RegionField:
    """A field and the equations that made it.

    field: n_i, n_n, u_iz, u_ir, R_ion over (time, z, r), in SI. fraction: (region, z, r), weight of
    each region's coefficients at a point; weights sum to 1. library: the terms of the equations.
    """

    field: xr.Dataset
    fraction: xr.DataArray
    library: Library

    @property
    def labels(self) -> xr.DataArray:
        """Number of the region with the greatest fraction at each point, (z, r)."""
        return self.fraction.argmax("region")

    @property
    def inside(self) -> xr.DataArray:
        """True at points away from the transitions, (z, r)."""
        return self.fraction.max("region") > INSIDE

    def noisy(self, noise: float, *, rng: np.random.Generator | int) -> RegionField:
        """Copy with white noise of `noise` times the RMS of each variable at each point."""
        rng = np.random.default_rng(rng)
        if noise < 0.0:
            raise ValueError(f"noise must be zero or more, got {noise}")
        field = self.field.map(_with_noise, keep_attrs=True, args=(noise, rng))
        return replace(self, field=field)


def _with_noise(array: xr.DataArray, noise: float, rng: np.random.Generator) -> xr.DataArray:
    rms = np.sqrt((array**2).mean("time"))
    return array + noise * rms * array.copy(data=rng.standard_normal(array.shape))


def three_regions(
    regions: Mapping[str, Equations] = REGIONS,
    *,
    thruster: Thruster | None = None,
    n_z: int = 20,
    n_r: int = 15,
    n_samples: int = 1500,
    dt_s: float = 1.5e-6,
    transition: float = 0.02,
) -> RegionField:
    """Integrate the blended equations at every point of a thruster's channel.

    regions: equations by region, in the order near the anode, downstream, near the walls. Three
    identical sets make a field of one regime. transition: width of the transition between regions
    (the scale of a logistic function), as a fraction of the channel's length and gap.
    Integrated by fourth-order Runge-Kutta, one step per sample, inputs exact at half steps.
    Raises ValueError unless there are three regions and two points or more along every axis.
    """
    if len(regions) != 3 or min(n_z, n_r, n_samples) < 2 or not min(dt_s, transition) > 0.0:
        raise ValueError(
            "a field of three regions needs three sets of equations, two points or more along "
            f"every axis, and dt_s and transition above 0, got {list(regions)}, n_z={n_z}, "
            f"n_r={n_r}, n_samples={n_samples}, dt_s={dt_s}, transition={transition}"
        )
    channel = thruster or Thruster()
    # Cell centres, as fractions of the channel's length and gap.
    z, r = ((np.arange(n) + 0.5) / n for n in (n_z, n_r))
    z_points, r_points = np.repeat(z, n_r), np.tile(r, n_z)
    fraction = _fractions(z_points, r_points, transition)
    library = named_terms([*STATES, *INPUTS], TERMS)
    coef = np.array([coef_matrix(library, [e[s] for s in STATES]) for e in regions.values()])
    half_t = 0.5 * dt_s * np.arange(2 * n_samples - 1)
    inputs = _inputs(half_t, z_points, r_points)
    states = _integrate(library, np.einsum("kp,kte->pte", fraction, coef), inputs, dt_s)
    values = np.concatenate([states, inputs[::2]], axis=2).reshape(n_samples, n_z, n_r, -1)
    variables = {
        name: (("time", "z", "r"), values[..., k], {"units": UNITS[name]})
        for k, name in enumerate([*STATES, *INPUTS])
    }
    places = {
        "z": ("z", channel.channel_length * z, {"units": "m"}),
        "r": ("r", channel.inner_radius + channel.gap * r, {"units": "m"}),
    }
    fractions = fraction.reshape(3, n_z, n_r), {"region": list(regions), **places}
    return RegionField(
        field=xr.Dataset(variables, {"time": ("time", half_t[::2], {"units": "s"}), **places}),
        fraction=xr.DataArray(*fractions, ("region", "z", "r")),
        library=library,
    )


def _fractions(
    z: Float[np.ndarray, " points"], r: Float[np.ndarray, " points"], transition: float
) -> Float[np.ndarray, "3 points"]:
    """Weights of the anode's, the exit's and the walls' equations; z, r from 0 to 1."""
    downstream = expit((z - 0.45) / transition)
    wall = expit((np.abs(r - 0.5) - 0.3) / transition)
    return np.stack([(1.0 - wall) * (1.0 - downstream), (1.0 - wall) * downstream, wall])


def _inputs(
    t: Float[np.ndarray, " times"], z: Float[np.ndarray, " points"], r: Float[np.ndarray, " points"]
) -> Float[np.ndarray, "times points inputs"]:
    """Inputs u_iz, u_ir in m/s and R_ion in m^3/s: the 14 kHz mode plus one tone for each input.

    The tones have no common period, so no input is a function of another. The radial velocity
    changes sign between the walls; in the middle only its tone is left.
    """

    def tone(f_Hz: float, phase: float) -> Float[np.ndarray, "times points"]:
        return np.sin(2.0 * np.pi * (f_Hz * t[:, None] - 0.2 * z - 0.1 * r) + phase)

    outward = 2.0 * (r - 0.5)
    u_iz = (3.2e3 + 1.6e3 * z) * (1.0 + 0.2 * tone(14.0e3, 1.0) + 0.2 * tone(23.1e3, 0.3))
    u_ir = 1.5e3 * outward * (1.0 + 0.2 * tone(14.0e3, 2.2)) + 6e2 * tone(20.9e3, 0.9)
    R_ion = 7e-14 * (1.0 + 0.2 * tone(14.0e3, 0.0) + 0.2 * tone(17.3e3, 1.7))
    return np.stack([u_iz, u_ir, R_ion], axis=2)


def _integrate(
    library: Library,
    coef: Float[np.ndarray, "points terms equations"],
    inputs: Float[np.ndarray, "half_times points inputs"],
    dt_s: float,
) -> Float[np.ndarray, "samples points states"]:
    """Densities at every sample, integrated at all points together; inputs are at half steps."""
    n_samples, n_points = (len(inputs) + 1) // 2, len(coef)

    def slope(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        theta = library.evaluate(np.concatenate([x, u], axis=1))
        return (theta[:, None, :] @ coef)[:, 0]

    states = np.empty((n_samples, n_points, len(STATES)))
    states[0] = [4e17, 2.6e18]
    for k in range(n_samples - 1):
        start, middle, end = inputs[2 * k : 2 * k + 3]
        states[k + 1] = step(slope, states[k], (start, middle, end), dt_s)
    return states
