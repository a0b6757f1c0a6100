"""The figures of `plot` methods: what stands on their axes, and what their curves are."""

import warnings
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from matplotlib.figure import Figure

import ep2sindy as ep
from ep2sindy.signals.spectrum import dominant_frequency
from tests.models import model_of

UNITS = {"x": "A", "y": "m"}


def labels(figure: Figure) -> list[str]:
    """Labels of the ordinates from left to right and down; nothing may collapse in the layout."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.draw_without_rendering()
    return [ax.get_ylabel() for ax in figure.axes if ax.get_ylabel()]


def oscillator(w: float, mu: float = 0.0) -> ep.SparseModel:
    equations = {"x": {"y": 1.0}, "y": {"x": -w * w, "y": mu, "x^2*y": -mu}}
    return replace(model_of(equations), units=UNITS)


@cache
def record(w: float = 3.0, mu: float = 0.4, *, n: int = 1500) -> ep.Trajectory:
    t = np.linspace(0.0, 0.02 * n, n + 1)
    return oscillator(w, mu).simulate(t, [2.0, 0.0]).trajectory()


def test_a_record_is_drawn_with_its_units_and_its_frequency() -> None:
    run = record()
    figure = ep.plot(run)
    assert labels(figure)[0] == "$x$ (A)"
    assert figure.axes[2].get_xlabel() == "time (s)"
    shown = figure.axes[0].lines[0]
    assert np.array_equal(shown.get_ydata(), run.states[: len(shown.get_xdata()), 0])
    frequency = dominant_frequency(run.t, run.states[:, 0])
    assert shown.get_xdata()[-1] == pytest.approx(min(20.0 / frequency, run.t[-1]), rel=0.01)
    assert figure.axes[3].get_xlabel() == "frequency (Hz)"
    assert figure.axes[1].lines[1].get_xdata()[0] == pytest.approx(frequency)
    part = ep.plot(run, duration_s=1.0, f_max_Hz=2.0)
    assert part.axes[0].lines[0].get_xdata()[-1] == pytest.approx(1.0)


def test_a_discovery_is_drawn_with_its_selected_candidates() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    found = ep.discover(run, method=ep.Regression())
    for each in (found, ep.Discovery.from_json(found.to_json())):
        assert len(labels(ep.plot(each))) == 2
    (ax,) = ep.plot(found.fronts["x"]).axes
    (star,) = (line for line in ax.lines if line.get_label() == "selected")
    assert star.get_xdata() == found.chosen["x"].n_terms


def test_a_free_run_is_drawn_over_its_record_whatever_their_order() -> None:
    run = record()
    turned = replace(run, states=run.states[:, ::-1], state_names=["y", "x"])
    figure = ep.plot(ep.evaluate(oscillator(3.0, 0.4), turned))
    assert labels(figure) == ["$x$ (A)", "$y$ (m)"]
    data, model = figure.axes[0].lines
    n = len(data.get_ydata())
    assert np.array_equal(data.get_ydata(), run.states[:n, 0])
    assert model.get_ydata() == pytest.approx(data.get_ydata(), abs=1e-5)


def test_a_cycle_is_drawn_closed_with_runs_that_reach_it() -> None:
    cycle = ep.model.limit_cycle(oscillator(3.0, 0.4), np.array([2.0, 0.0]), period_s=2.1)
    assert cycle is not None
    (ax,) = ep.plot(cycle, record()).axes
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("$x$ (A)", "$y$ (m)")
    curve = ax.lines[-1].get_xydata()
    assert np.array_equal(curve[0], curve[-1])
    assert np.array_equal(curve[:-1], cycle.states)
    assert len(ep.plot(cycle).axes[0].lines) == len(ax.lines) - 1  # without the data
    runs = [line.get_xydata() for line in ax.lines[1:-1] if len(line.get_xdata()) > 1]
    assert len(runs) == 5
    for run in runs:  # none stops before it has come near
        assert np.linalg.norm(cycle.states - run[-1], axis=1).min() < 0.2


def law(names: list[str], points: list[list[float]]) -> ep.operating.OperatingLaw:
    """x'' = -w^2 x + mu (1 - x^2) x', w the first parameter."""
    known = oscillator(1.0, 0.4)
    terms = [("x", "y"), ("y", "x"), ("y", "y"), ("y", "x^2*y")]
    coef = np.array([[1.0, 0.0], [0.0, -1.0], [0.4, 0.0], [-0.4, 0.0]])
    functions = ep.named_terms(names, ["1", f"{names[0]}^2"])
    return ep.operating.OperatingLaw(
        functions, known.library, ("x", "y"), tuple(terms), coef, np.array(points), units=UNITS
    )


def point(*values: float) -> ep.Trajectory:
    at = dict(zip(("w", "b", "c"), values, strict=False))
    return replace(record(values[0], n=2000), parameters=at)


def test_a_law_of_one_parameter_is_drawn_as_a_line_of_its_frequency() -> None:
    records = [point(3.0), point(3.5)]
    figure = ep.plot(law(["w"], [[3.0], [3.5]]), records, n_points=3, labels={"w": "w (rad/s)"})
    assert labels(figure)[0].startswith("frequency (")
    assert figure.axes[0].get_xlabel() == "w (rad/s)"
    line, dots = figure.axes[0].lines[0], figure.axes[0].collections[0].get_offsets()
    assert line.get_ydata()[[0, -1]] == pytest.approx(np.asarray(dots)[:, 1], rel=1e-3)
