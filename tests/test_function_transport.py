"""Transport by a user's function: what it gets, what it may give, and how it is distinguished."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.thruster.axial.settings import to_json
from ep2sindy.thruster.transport import Plasma
from tests.thrusters import brief

BRIEF = {"duration_s": 9e-5, "warm_up_s": 3e-5, "n_cells": 30}


def default_c(z, t, plasma):
    return ep.thruster.AnomalousTransport().at(z)


def by_shear(z, t, plasma):
    return 0.01 / (1.0 + np.abs(np.gradient(plasma.E / plasma.B, z)) / 1e9)


def gives_nan(z, t, plasma):
    return np.where((z > 0.0) & (t > 2e-5), np.nan, 0.01)


def gives_too_few(z, t, plasma):
    return np.full(3, 0.01)


@dataclass(frozen=True)
class Level:
    c: float

    def __call__(self, z, t, plasma):
        return self.c


def run(function, **settings):
    transport = ep.thruster.FunctionTransport(function)
    return brief(ep.thruster.Thruster(transport=transport), **(BRIEF | settings))


def test_the_default_as_a_function_changes_nothing():
    plain = brief(**BRIEF)
    np.testing.assert_allclose(run(default_c)["I_d"], plain["I_d"], rtol=1e-12)


def test_a_function_sees_the_plasma_and_the_time():
    seen = []

    @dataclass(frozen=True)
    class Spy:
        def __call__(self, z, t, plasma):
            seen.append((z, t, plasma))
            return 0.01

    field = run(Spy(), averaged=False)
    steps = len(field["time"]) + 20 + 1  # and the warm-up, and before the first field
    assert len(seen) == steps
    times = np.array([t for _, t, _ in seen])
    np.testing.assert_allclose(times[1:], 1.5e-6 * np.arange(-20, len(field["time"])), atol=1e-12)
    z, _, plasma = seen[-1]  # the state at the end of the sample before
    np.testing.assert_allclose(z, field["z"] - 0.025)
    before = field.isel(time=-2)
    for name, theirs in (("n_n", "n_n"), ("n_e", "n_i"), ("T_e_eV", "T_e_eV"), ("u_i", "u_iz")):
        np.testing.assert_allclose(getattr(plasma, name), before[theirs], rtol=1e-5)
    np.testing.assert_allclose(plasma.E, before["E_z"], rtol=1e-5, atol=1e-3)
    np.testing.assert_allclose(plasma.B, ep.thruster.Thruster().magnetic_field.at(z))


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (gives_nan, r"everywhere: .*gives_nan \w+ gave nan at 0\.833 mm .* t = 2\.1e-05"),
        (gives_too_few, r"one coefficient for each of 30 distances, .* gave the shape \(3,\)"),
        (
            partial(default_c),
            r"must be known by its source, .*, got functools\.partial.* frozen data",
        ),
    ],
)
def test_what_is_no_transport_is_refused(function, message):
    with pytest.raises(ValueError, match=message):
        run(function)


def test_a_function_that_holds_values_is_refused():
    level = 0.01
    with pytest.raises(ValueError, match=r"must hold no values of its own"):
        ep.thruster.FunctionTransport(lambda z, t, plasma: level)


def test_two_functions_are_two_simulations(tmp_path: Path):
    def text(function):
        transport = ep.thruster.FunctionTransport(function)
        return to_json({"thruster": ep.thruster.Thruster(transport=transport)})

    texts = [text(f) for f in (default_c, by_shear, Level(0.01), Level(0.02))]
    assert len(set(texts)) == 4
    assert text(Level(0.02)) == texts[3]
    first = run(Level(0.01), cache=tmp_path)
    assert float(run(Level(0.02), cache=tmp_path)["I_d"][-1]) != float(first["I_d"][-1])
    again = run(Level(0.01), cache=tmp_path)
    np.testing.assert_array_equal(again["I_d"], first["I_d"])
    assert len(list(tmp_path.glob("*.nc"))) == 2


@pytest.mark.usefixtures("here")
def test_a_config_names_a_marked_function():
    text = "import ep2sindy as ep\n\n\n@ep.for_configs\ndef c(z, t, plasma):\n    return {}\n\n\n"
    text += "def bare(z, t, plasma):\n    return 1.0\n"
    Path("bohm_of_mine.py").write_text(text.format(0.02))
    made = ep.thruster.FunctionTransport("bohm_of_mine.c")
    plasma = Plasma(*np.zeros((6, 2)))
    np.testing.assert_array_equal(made.at(np.zeros(2), 0.0, plasma), [0.02, 0.02])
    assert made.identity.startswith("bohm_of_mine.c ")
    with pytest.raises(ValueError, match=r"bohm_of_mine\.bare must be for configs: mark it with"):
        ep.thruster.FunctionTransport("bohm_of_mine.bare")
    Path("bohm_of_mine.py").write_text(text.format(0.03))
    assert ep.thruster.FunctionTransport("bohm_of_mine.c").identity != made.identity
