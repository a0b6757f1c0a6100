"""The search for a self-sustained model in noise, from a mean cycle where it reports so."""

from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.studies.sustained import SustainedSearch

SETTINGS = SustainedSearch(
    ep.BestSubset(max_terms=3, n_best=2), 2, ep.FreeRunScore(), degree=3, noise_limit=0.3
)
ROWS = ep.Regression(ep.Differential(), bootstraps=ep.Bootstraps(n=0))


def record(noise: float) -> ep.Trajectory:
    """A Van der Pol oscillator over twelve periods; noise in fractions of each state's RMS."""
    van_der_pol = replace(ep.systems.van_der_pol(), duration_s=120.0, rate_Hz=10.0)
    run = van_der_pol.trajectory(noise=noise, rng=1)
    return run.window(200, run.n_samples)


def searched(run: ep.Trajectory, settings: SustainedSearch) -> ep.Discovery:
    library = ep.polynomial(run.state_names, degree=3)
    return settings.found(run, library, ROWS, rng=np.random.default_rng(0))


@pytest.mark.slow
def test_in_noise_the_mean_cycle_is_searched_and_reported() -> None:
    run = record(0.5)
    found = searched(run, SETTINGS)
    assert found.note.startswith(
        "found in the mean cycle, without intervals, since the white noise of "
    )
    assert found.model.covariance is None
    assert ep.evaluate(found.model, record(0.0)).status is ep.model.Status.SUSTAINED


@pytest.mark.parametrize(("noise", "limit"), [(0.5, None), (0.02, 0.3)])
def test_below_the_limit_the_samples_are_searched(noise: float, limit: float | None) -> None:
    quick = replace(SETTINGS, selection=ep.FreeRunScore(bounds=None), depth=1, noise_limit=limit)
    assert "mean cycle" not in searched(record(noise), quick).note
