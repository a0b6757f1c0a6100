"""Channel walls: emission, named materials, and where they act."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.thruster.constants import E_CHARGE, M_ELECTRON, M_XENON
from ep2sindy.thruster.plane.simulate import THRUSTER_2D

T = np.array([5.0, 10.0, 20.0])
DISTANCE = np.array([-2e-3, -1e-3, 0.0, 1e-3, 2e-3])


def test_wall_emission_stops_at_the_space_charge_limit():
    emission = ep.thruster.SheathWall().emission(np.array([1.0, 10.0, 100.0]), M_XENON)
    assert emission[0] < emission[1] < emission[2] == pytest.approx(0.983, abs=1e-3)


def test_emission_without_limit_reaches_one_at_the_crossover():
    wall = ep.thruster.SheathWall(yield_0=0.5, crossover_eV=30.0)
    heavy = 1e6 * M_XENON  # moves the limit to one
    assert wall.emission(np.array(20.0), heavy) == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize(
    ("name", "published"),  # mean energy of yield one in eV, yield at zero: HallThruster.jl v0.22
    [("BN-SiO2", (40.0, 0.54)), ("BN", (45.0, 0.24)), ("alumina", (22.0, 0.57)),
     ("SiC", (43.0, 0.69)), ("SiO2", (18.0, 0.5))],
)  # fmt: skip
def test_materials_have_their_published_yields(name, published):
    wall = ep.thruster.wall_material(name)
    assert (wall.crossover_eV, wall.yield_0) == published


def test_the_default_wall_is_a_named_one():
    assert ep.thruster.wall_material("BN-SiO2") == ep.thruster.SheathWall()


def test_losses_go_with_the_bohm_speed():
    """At the same emission, krypton's ions are faster by the root of the masses."""
    wall = ep.thruster.SheathWall(yield_0=0.0, crossover_eV=1e9)
    krypton = ep.thruster.propellant("krypton").mass
    ratio = np.sqrt(M_XENON / krypton)
    for loss in (wall.ion_loss, wall.collision):
        np.testing.assert_allclose(loss(T, 0.015, krypton) / loss(T, 0.015, M_XENON), ratio)


def test_power_is_what_electrons_carry_through_the_sheath():
    """Without emission: nu (2 T + phi), phi = T ln sqrt(m / (2 pi m_e))."""
    wall = ep.thruster.SheathWall(yield_0=0.0, crossover_eV=1e12, electron_scale=1.0)
    nu = 0.4965 * np.sqrt(E_CHARGE * T / M_XENON) / 0.015
    phi = T * np.log(np.sqrt(M_XENON / (2.0 * np.pi * M_ELECTRON)))
    np.testing.assert_allclose(wall.power(T, 0.015, M_XENON), nu * (2.0 * T + phi))


def test_shares_change_at_the_exit_or_across_a_layer():
    sharp = ep.thruster.SheathWall(plume_collisions=0.0, plume_power=0.5)
    np.testing.assert_array_equal(sharp.ion_weight(DISTANCE), [1, 1, 0, 0, 0])
    np.testing.assert_array_equal(sharp.power_weight(DISTANCE), [1, 1, 0.5, 0.5, 0.5])
    soft = ep.thruster.SheathWall(plume_collisions=0.0, transition=4e-3)
    np.testing.assert_allclose(soft.collision_weight(DISTANCE), [1.0, 0.75, 0.5, 0.25, 0.0])


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: ep.thruster.SheathWall(yield_0=1.0), r"SheathWall\.yield_0 must be below 1"),
    ],
)
def test_bad_walls_say_what_must_hold(build, message):
    with pytest.raises(ValueError, match=message):
        build()


def test_a_shielded_wall_meets_the_electrons_of_its_own_temperature():
    """Whatever T_e is, the losses are those of an unshielded wall at that temperature."""
    open_wall, gap = ep.thruster.SheathWall(), 0.015
    shielded = ep.thruster.wall_material("BN-SiO2", shielded_T_e_eV=3.0)
    T = np.array([1.0, 3.0, 40.0])
    for name in ("ion_loss", "collision", "power"):
        cold = getattr(open_wall, name)(np.array(3.0), gap, M_XENON)
        np.testing.assert_allclose(getattr(shielded, name)(T, gap, M_XENON), cold)
    with pytest.raises(ValueError, match=r"shielded_T_e_eV must be finite and positive, got 0\.0"):
        ep.thruster.SheathWall(shielded_T_e_eV=0.0)
    thruster = replace(THRUSTER_2D, wall=shielded)
    with pytest.raises(ValueError, match=r"does not solve a shielded wall"):
        ep.thruster.simulate_2d(thruster, progress=False)
