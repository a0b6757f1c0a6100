"""Figures of fronts: a logarithmic scale, and behind the front all that was fitted."""

import numpy as np
import pytest

from ep2sindy.data.coerce import Task
from ep2sindy.discovery.method import Regression
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.formulations import Differential
from ep2sindy.regression.front import ParetoFront, fit_supports
from ep2sindy.regression.searches import BestSubset
from ep2sindy.systems.systems import lotka_volterra

Searched = tuple[ParetoFront, np.ndarray]


@pytest.fixture(scope="module")
def searched() -> Searched:
    """A front of three candidates per size, and the supports that it was taken from."""
    system = lotka_volterra()
    run = system.trajectory(noise=0.05, rng=np.random.default_rng(0))
    recipe = Regression(
        Differential(), BestSubset(max_terms=4), bootstraps=Bootstraps(n=12), depth=3
    )
    equation = recipe.search_equations(Task([run], system.model.library), rng=0)[0]
    return equation.front, equation.supports.masks


def test_the_cloud_holds_the_error_of_every_support_that_was_proposed(searched: Searched) -> None:
    front, masks = searched
    assert front.ensemble is not None
    fits = fit_supports(front.problem, front.equation, masks)
    assert front.ensemble.sizes.tolist() == [fit.n_terms for fit in fits]
    # Gram matrices square the condition of the rows, some 1e3 here.
    expected = [1.0 - fit.r2_test for fit in fits]
    assert front.ensemble.errors == pytest.approx(expected, rel=0, abs=1e-9)
