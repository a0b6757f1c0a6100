"""A simulation that diverges or does not oscillate says so, whatever is done to it."""

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.studies.source import DivergedError, Step, amiss, is_simulation, open_prepared


def simulation(status: str, n_samples: int = 2000) -> xr.Dataset:
    attrs = {"status": status, "I_d_mean": 1.0, "I_d_std": 0.0, "parameters": "{}", "f_kHz": 80.0}
    time_s, z = 1e-6 * np.arange(n_samples), np.array([0.01, 0.02])
    n_i = 1e17 + 1e16 * np.random.default_rng(0).random((n_samples, 2))
    data = {"n_i": (("time", "z"), n_i, {"units": "m^-3"})}
    return xr.Dataset(data, coords={"time": time_s, "z": z}, attrs=attrs)


def prepared(field: xr.Dataset, *steps: Step) -> xr.Dataset:
    """As a study has it of what its config names."""
    return open_prepared(SimpleNamespace(settings={}, build=lambda: field), steps)


STEPS: list[Step] = [
    lambda field: field.drop_attrs(),
    lambda field: ep.data.decimate(field, factor=2),
    lambda field: ep.data.derive(field, name="twice", expression="2*n_i", units="m^-3"),
    lambda field: xr.Dataset({"n_i": field["n_i"]}),
]


@pytest.mark.parametrize("status", ["diverged", "transit"])
@pytest.mark.parametrize("k", range(len(STEPS)))
def test_no_step_makes_a_simulation_silent(status: str, k: int) -> None:
    field = prepared(simulation(status), STEPS[k])
    assert is_simulation(field.attrs)
    assert amiss(field.attrs)


def test_a_run_that_broke_at_once_is_no_data() -> None:
    with pytest.raises(DivergedError, match="it diverged after 3; try shorter steps"):
        prepared(simulation("diverged", 3))
