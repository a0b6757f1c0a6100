"""Figures of identified systems: which panels there are, and what each holds."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from ep2sindy.discovery.method import Regression
from ep2sindy.figures.identified import Identified, attractor_figure
from ep2sindy.figures.style import OFF_SCALE
from ep2sindy.model.rollout import Rollout
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


@pytest.mark.parametrize("over_time", [False, True])
def test_every_system_has_a_column_and_every_noise_level_a_row(
    first: Sequence[Identified], over_time: bool
) -> None:
    figure = attractor_figure(first, over_time=over_time)
    panels = np.array(figure.axes).reshape(2, 2)
    for ax, name in zip(panels[0], ("Lorenz", "damped oscillator"), strict=True):
        assert ax.get_title() == f"{name}\ntrue terms"
    assert panels[1, 0].get_xlabel() == ("time (s)" if over_time else "$x$")
    assert panels[0, 0].get_ylabel() == ("noise 0 %\n\n$x$" if over_time else "noise 0 %\n\n$z$")
    for ax, each in zip(panels.T.ravel(), first, strict=True):
        lengths = [len(line.get_xdata()) for line in ax.lines[1:3]]
        assert lengths == [each.truth.n_samples, len(each.rollout.t)]


def test_a_model_that_diverges_neither_sets_the_scale_nor_goes_unsaid(
    first: Sequence[Identified],
) -> None:
    each = first[2]
    away = each.truth.states[:400] * np.exp(each.truth.t[:400, None])
    ended = Rollout(each.truth.t[:400], away, True, "", ("x", "v"), np.empty((400, 0)), (), {})
    figure = attractor_figure([replace(each, rollout=ended, right=False)], over_time=True)
    (ax,) = figure.axes
    assert ax.get_title().endswith("other terms, diverges at 3.99 s")
    assert np.abs(ax.get_ylim()).max() < 2.0 * np.abs(each.samples.states[:, 0]).max()
    assert f"_{OFF_SCALE}" in [line.get_label() for line in ax.lines]
