"""Figures of fronts: a logarithmic scale, and behind the front all that was fitted."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.discovery.method import Regression
from ep2sindy.figures.fronts import FLOOR, TOP, front_figure
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
    equation = recipe.search_equations(DiscoveryProblem([run], system.model.library), rng=0)[0]
    return equation.front, equation.supports.masks


def drawn(front: ParetoFront) -> Axes:
    scores = np.where(np.arange(len(front.candidates)) == 1, 0.25, 1.0)
    figure = front_figure({front.equation: front.with_scores(scores)}, label="d_pareto")
    return figure.axes[0]


def line(ax: Axes, label: str) -> Line2D:
    (found,) = [each for each in ax.lines if each.get_label() == label]
    return found


def test_the_cloud_holds_the_error_of_every_support_that_was_proposed(searched: Searched) -> None:
    front, masks = searched
    assert front.ensemble is not None
    fits = fit_supports(front.problem, front.equation, masks)
    assert front.ensemble.sizes.tolist() == [fit.n_terms for fit in fits]
    # Gram matrices square the condition of the rows, some 1e3 here.
    expected = [1.0 - fit.r2_test for fit in fits]
    assert front.ensemble.errors == pytest.approx(expected, rel=0, abs=1e-9)


def test_errors_are_drawn_on_a_logarithmic_scale_with_all_supports_behind(
    searched: Searched,
) -> None:
    front, masks = searched
    ax = drawn(front)
    assert ax.get_yscale() == "log"
    every = line(ax, "all supports fitted")
    assert front.ensemble is not None
    assert np.sum(front.ensemble.errors > TOP) == 0
    assert len(np.asarray(every.get_xdata())) == len(masks) > len(front.candidates)
    best, others = line(ax, "best of size"), line(ax, "runners-up")
    assert every.get_zorder() < others.get_zorder() < best.get_zorder()
    star = np.asarray(line(ax, "selected").get_xydata()).ravel()
    assert star.tolist() == [front.sizes[1], front.errors[1]]
    low, high = ax.get_ylim()
    assert low < front.errors.min()
    assert high > front.errors.max()


def test_errors_of_exact_fits_stand_on_a_line_that_says_so(searched: Searched) -> None:
    front, _ = searched
    exact = [
        replace(each, r2_test=1.0 + 1e-15) if each.n_terms == 2 else each
        for each in front.candidates
    ]
    ax = drawn(replace(front, candidates=exact, ensemble=None))
    heights = np.asarray(line(ax, "best of size").get_ydata())
    assert heights.min() == FLOOR > ax.get_ylim()[0]
    assert [text.get_text() for text in ax.texts] == ["$10^{-12}$ or less"]
    assert not drawn(front).texts


def test_supports_far_worse_than_none_are_marked_at_the_edge(searched: Searched) -> None:
    front, _ = searched
    assert front.ensemble is not None
    errors = np.append(front.ensemble.errors[:-1], 1e6)
    ax = drawn(replace(front, ensemble=replace(front.ensemble, errors=errors)))
    (carets,) = [each for each in ax.lines if np.asarray(each.get_ydata()).tolist() == [TOP]]
    assert np.asarray(carets.get_xdata()).tolist() == [front.ensemble.sizes[-1]]
