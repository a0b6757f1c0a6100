"""Ion velocities and probes: exact distributions, the fluid's mean, exact filters."""

import json

import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.thruster.axial.settings import to_json
from ep2sindy.thruster.constants import E_CHARGE, M_XENON
from ep2sindy.thruster.instruments import ion_velocities, probe

POINT = ep.thruster.OperatingPoint(300.0, 5.0, neutral_speed=300.0)
L, N = 0.04, 50


def record(E, S, n_samples=3, point=POINT):
    """A record with these profiles at the middle of N cells."""
    z = L * (np.arange(N) + 0.5) / N
    profile = {
        name: (("time", "z"), np.tile(f(z), (n_samples, 1)))
        for name, f in (("E_z", E), ("ionization", S))
    }
    parameters = {"thruster": ep.thruster.Thruster(), "operating_point": point}
    return xr.Dataset(
        {**profile, "dz": ("z", np.full(N, L / N))},
        {"time": 1.5e-6 * np.arange(n_samples), "z": z},
        {"parameters": to_json(parameters)},
    )


def speed(volts, start=300.0):
    return np.sqrt(start**2 + 2.0 * E_CHARGE * volts / M_XENON)


@pytest.mark.parametrize("place", [0.0101, 0.03])
def test_a_uniform_field_and_uniform_births_give_a_uniform_distribution(place):
    """f = 1/(u_max - u_n) between the two: the births over u cancel the time that ions take."""
    edges = np.linspace(0.0, 12_000.0, 121)
    field = record(lambda z: np.full_like(z, 2e3), np.ones_like)
    f = ion_velocities(field, place, speeds=edges).sel(z=place)
    top = speed(2e3 * place)
    inside = np.clip(edges, 300.0, top)
    expected = np.diff(inside) / np.diff(edges) / (top - 300.0)
    np.testing.assert_allclose(f, expected, atol=1e-9)
    assert float((f * np.diff(edges)).sum()) == pytest.approx(1.0)
    assert f.attrs["units"] == "s/m"


def test_births_in_one_cell_arrive_with_the_drop_since():
    """A field beyond the place of birth alone: one speed."""
    field = record(lambda z: np.where(z > 0.02, 1e4, 0.0), lambda z: (z < L / N).astype(float))
    f = ion_velocities(field, [0.01, 0.03])
    mean = (f * f["u"]).sum("u") / f.sum("u")
    width = float(f["u"][1] - f["u"][0])
    np.testing.assert_allclose(mean, [300.0, speed(1e4 * 0.01)], atol=0.6 * width)


def test_ions_that_cannot_climb_do_not_arrive():
    field = record(lambda z: np.where(z < 0.012, -1e4, 1e3), np.ones_like)
    f = ion_velocities(field, 0.02, speeds=np.linspace(0.0, 1e4, 201)).sel(z=0.02)
    top = speed(1e3 * 0.008)
    beyond = f.where(f["u"] > top + 50.0).sum()
    assert float(beyond) < 1e-12  # of 1 over the speed
    assert float(f.max()) > 0.0


def test_samples_count_by_their_density():
    field = record(lambda z: np.full_like(z, 2e3), np.ones_like, n_samples=2)
    field["E_z"][1] *= 4.0
    whole = ion_velocities(field, 0.03, speeds=np.linspace(0.0, 2e4, 101)).values[0]
    parts = [
        ion_velocities(field.isel(time=[k]), 0.03, speeds=np.linspace(0.0, 2e4, 101)).values[0]
        for k in (0, 1)
    ]
    # densities: S m/(e E) (u_max - u_n)
    weights = np.array([(speed(2e3 * 0.03) - 300.0), (speed(8e3 * 0.03) - 300.0) / 4.0])
    np.testing.assert_allclose(whole, weights @ parts / weights.sum(), rtol=1e-9, atol=1e-15)


def test_the_mean_is_the_fluids_where_ions_come_from_upstream():
    thruster = ep.thruster.Thruster(
        transport=ep.thruster.AnomalousTransport(1 / 160, 1 / 16),
        wall=ep.thruster.SheathWall(ion_scale=0.0),
    )
    field = ep.thruster.simulate(
        thruster, POINT, duration_s=3e-4, warm_up_s=4e-4, n_cells=60, progress=False
    )
    z = field["z"].values[[25, 45, 58]]
    f = ion_velocities(field, z)
    mean = (f * f["u"]).sum("u") / f.sum("u")
    flux = field["flux_i"].mean("time") / field["n_i"].mean("time")
    np.testing.assert_allclose(mean, flux.sel(z=z), rtol=0.06)


@pytest.mark.parametrize(
    ("change", "arguments", "message"),
    [
        (
            lambda f: f.drop_vars("ionization"),
            {"z": 0.01},
            r"\['ionization'\] are not there; si",
        ),
        (lambda f: f, {"z": 0.05}, r"places must lie in the record, 0 to 0\.04 m"),
        (lambda f: f, {"z": 0.01, "speeds": [1.0, 1.0]}, r"two or more increasing edges in m/s"),
    ],
)
def test_what_cannot_be_seen_is_refused(change, arguments, message):
    field = change(record(lambda z: np.full_like(z, 2e3), np.ones_like))
    with pytest.raises(ValueError, match=message):
        ion_velocities(field, **arguments)


def series(values, step=1e-6):
    attrs = {"units": "A", "long_name": "current"}
    time = step * np.arange(len(values))
    return xr.Dataset({"I_d": ("time", np.asarray(values), attrs)}, {"time": time})


def test_a_probe_answers_a_ramp_exactly():
    """y' = (x - y)/tau with x = a t from rest: a (t - tau (1 - exp(-t/tau)))."""
    field, tau = series(3e6 * 1e-6 * np.arange(50)), 1.0 / (2.0 * np.pi * 4e4)
    seen = probe(field, "I_d", bandwidth_Hz=4e4)
    t = field["time"].values
    np.testing.assert_allclose(seen, 3e6 * (t - tau * (1.0 - np.exp(-t / tau))), atol=1e-12)
    assert (seen.attrs["units"], seen.dims) == ("A", ("time",))
    assert seen.attrs["long_name"] == "current, by a probe of 40000 Hz"


def test_a_probe_weakens_and_delays_a_sine_at_its_corner():
    t = 1e-7 * np.arange(20_000)
    seen = probe(series(np.sin(2.0 * np.pi * 2e4 * t), 1e-7), "I_d", bandwidth_Hz=2e4)
    late = 2.0 * np.pi * 2e4 * t - np.pi / 4.0
    np.testing.assert_allclose(seen[10_000:], np.sqrt(0.5) * np.sin(late)[10_000:], atol=1e-4)


def test_a_probe_stands_between_two_cells_and_its_noise_is_drawn_by_a_seed():
    z = np.array([0.01, 0.02])
    values = np.tile([1.0, 3.0], (4000, 1))
    attrs = {"units": "m^-3", "long_name": "density"}
    field = xr.Dataset({"n_i": (("time", "z"), values, attrs)}, {"time": np.arange(4000.0), "z": z})
    still = probe(field, "n_i", 0.0125, bandwidth_Hz=1.0)
    np.testing.assert_allclose(still, 1.5)
    noisy = [probe(field, "n_i", 0.0125, bandwidth_Hz=1.0, noise=0.2, seed=k) for k in (1, 1, 2)]
    assert float(noisy[0].std()) == pytest.approx(0.2, rel=0.05)
    np.testing.assert_array_equal(noisy[0], noisy[1])
    assert float(abs(noisy[0] - noisy[2]).max()) > 0.1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("I_x",), r"there is no 'I_x' to record: the run has \['I_d'\]"),
        (("I_d", 0.01), r"z must be given for what varies along z, and only then: I_d, z = 0\.01"),
    ],
)
def test_a_probe_says_what_it_lacks(arguments, message):
    with pytest.raises(ValueError, match=message):
        probe(series(np.ones(5)), *arguments, bandwidth_Hz=1e4)
    with pytest.raises(ValueError, match=r"bandwidth_Hz must be positive .*: 0\.0 and 0\.0 came"):
        probe(series(np.ones(5)), "I_d", bandwidth_Hz=0.0)


def test_the_mass_is_that_of_the_gas():
    krypton = ep.thruster.propellant("krypton")
    field = record(lambda z: np.full_like(z, 2e3), np.ones_like)
    parameters = json.loads(field.attrs["parameters"])
    made = json.loads(to_json({"thruster": ep.thruster.Thruster(propellant=krypton)}))
    field.attrs["parameters"] = json.dumps(parameters | made)
    assert ion_velocities(field, 0.01).attrs["ion_mass_kg"] == krypton.mass
