"""The plume's cross-section: exact cones, an integral, and angles that are refused."""

import math
from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.thruster.constants import E_CHARGE, M_XENON

DISTANCE = np.array([-0.02, -0.01, -1e-3, 2e-3, 5e-3, 0.02, 0.05])
SPEED = np.linspace(-2e3, 2e4, DISTANCE.size)
PLASMA = {"exit_T_e_eV": 25.0, "ion_mass": M_XENON}


@pytest.mark.parametrize("degrees", [0.0, 10.0, 40.0])
def test_a_cone_grows_as_its_radii(degrees: float) -> None:
    thruster = ep.thruster.Thruster()
    plume = ep.thruster.ConicalPlume(degrees)
    tangents = plume.tangents(SPEED, **PLASMA)
    growth = math.tan(math.radians(degrees)) * np.maximum(DISTANCE, 0.0)
    outer, inner = 0.05 + growth, np.maximum(0.035 - growth, 0.0)
    expected = np.pi * (outer**2 - inner**2) / thruster.area
    np.testing.assert_allclose(thruster.relative_area(DISTANCE, tangents), expected, rtol=1e-13)


def test_a_tangent_that_varies_is_integrated() -> None:
    """tan = x/L beyond the exit, linear: h = x^2/(2 L), from the first place on."""
    thruster, L = ep.thruster.Thruster(), 0.1
    z = np.concatenate([[-0.01, 0.0], np.linspace(0.0, 0.05, 300)[1:]])
    growth = np.maximum(z, 0.0) ** 2 / (2.0 * L)
    expected = ((0.05 + growth) ** 2 - (0.035 - growth) ** 2) / (0.05**2 - 0.035**2)
    found = thruster.relative_area(z, np.maximum(z, 0.0) / L)
    np.testing.assert_allclose(found, expected, atol=2e-5)  # of dz^2/(2 L) in h


def test_a_thermal_plume_spreads_by_sound_over_speed() -> None:
    sound = math.sqrt(5.0 * E_CHARGE * 25.0 / (3.0 * M_XENON))
    speed = np.array([-500.0, 0.0, sound, 2.0 * sound, 17_000.0])
    found = ep.thruster.ThermalPlume().tangents(speed, **PLASMA)
    np.testing.assert_allclose(found, [1.0, 1.0, 1.0, 0.5, sound / 17_000.0])


@pytest.mark.parametrize("degrees", [-1.0, 46.0, math.nan, math.inf])
def test_an_angle_out_of_range_is_refused(degrees: float) -> None:
    with pytest.raises(ValueError, match=r"half_angle_deg must be from 0 to 45: .* came; give"):
        ep.thruster.ConicalPlume(degrees)


def test_the_z_r_model_refuses_a_plume() -> None:
    spread = replace(ep.thruster.THRUSTER_2D, plume=ep.thruster.ThermalPlume())
    with pytest.raises(ValueError, match=r"\(z, r\) model does not solve a plume that spreads"):
        ep.thruster.simulate_2d(spread, progress=False)
