"""Stages of long work: whoever watches them changes no result."""

import numpy as np

import ep2sindy as ep
from ep2sindy.runtime.progress import SILENT, Bars, as_progress

LIBRARY = ep.polynomial(["x", "y"], degree=2)
METHOD = ep.Regression(ep.Differential(), ep.BestSubset(max_terms=2), ep.EBIC(), ep.Bootstraps(n=4))


def test_a_result_does_not_depend_on_who_watches() -> None:
    prey = ep.lotka_volterra().trajectory(noise=0.01, rng=0)
    counted: list[int] = []
    alone = ep.discover(prey, LIBRARY, METHOD, seed=1)
    watched = ep.discover(prey, LIBRARY, METHOD, seed=1, progress=counted.append)
    assert sum(counted) > 0
    np.testing.assert_array_equal(watched.model.coef, alone.model.coef)
    np.testing.assert_array_equal(watched.model.covariance, alone.model.covariance)
    for state in ("x", "y"):
        np.testing.assert_array_equal(watched.scores[state], alone.scores[state])


def test_true_means_bars_and_false_silence() -> None:
    assert as_progress(True) == Bars()
    assert as_progress(False) is SILENT
