"""Figures of identified systems: which panels there are, and what each holds."""

from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest

from ep2sindy.discovery.method import Regression
from ep2sindy.figures.identified import Identified
from ep2sindy.regression.formulations import WeightedWeak
from ep2sindy.studies.benchmark import first_realizations
from ep2sindy.systems.draws import realization

PAIRS = [*product(["lorenz", "oscillator"], [0.0, 0.05])]


@pytest.fixture(scope="module")
def first() -> Sequence[Identified]:
    return first_realizations(Regression(WeightedWeak()), PAIRS, realization, seed=[0])


def test_first_realizations_are_those_that_the_benchmark_searches(
    first: Sequence[Identified],
) -> None:
    assert [(each.system, each.noise) for each in first] == PAIRS
    for each in first:
        _, (run,) = realization(each.system, each.noise, 0)
        assert np.array_equal(each.samples.states, run.states)
        assert np.array_equal(each.truth.t, run.t)
        noise = each.samples.states - each.truth.states
        rms = np.sqrt(np.square(each.truth.states).mean(axis=0))
        assert noise.std(axis=0) == pytest.approx(each.noise * rms, rel=0.1)
        assert each.right
        assert np.array_equal(each.rollout.states[0], each.truth.states[0])
    lorenz = first[0]
    early = lorenz.truth.t < 1.0
    assert lorenz.rollout.states[early] == pytest.approx(lorenz.truth.states[early], abs=0.05)
