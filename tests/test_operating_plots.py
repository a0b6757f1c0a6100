"""Figures of laws of the operating point, drawn from small tables."""

import warnings

import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from ep2sindy.figures.operating import (
    cycle_figure,
    frequency_scale,
    laws_figure,
    left_out_figure,
)
from ep2sindy.library.library import named_terms, polynomial
from ep2sindy.operating.law import OperatingLaw

POINTS = pd.DataFrame(
    {
        "a": [1.0, 2.0, 1.0, 2.0, 1.5],
        "b": [0.0, 0.0, 1.0, 1.0, 0.5],
        "branch": ["strong", "strong", "strong", "", "weak"],
        "f_kHz": [10.0, 11.0, 12.0, np.nan, 14.0],
        "relative_amplitude": [0.9, 1.0, 1.1, np.nan, 0.3],
    }
)
GRID = pd.DataFrame(
    {
        "a": [1.0, 1.0, 2.0, 2.0],
        "b": [0.0, 1.0, 0.0, 1.0],
        "fate": ["oscillates", "oscillates", "oscillates", "rests"],
        "f_kHz": [10.0, 12.0, 11.0, np.nan],
        "relative_amplitude": [0.9, 1.1, 1.0, np.nan],
        "growth_per_s": [1.0, 1.0, 1.0, -1.0],
    }
)
FITTED = np.array([[1.0, 0.0], [2.0, 0.0], [1.0, 1.0]])


def drawn(figure: Figure) -> list[str]:
    """What its legends say; nothing may collapse."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.draw_without_rendering()
    legends = [*figure.legends, *(ax.get_legend() for ax in figure.axes)]
    return [text.get_text() for legend in legends if legend for text in legend.get_texts()]


def left_out(scale: float) -> pd.DataFrame:
    f = scale * np.array([10.0, 11.0, 12.0])
    return pd.DataFrame(
        {
            "branch": "all", "enclosed": [False, True, False], "f_kHz": f, "f_model_kHz": 1.01 * f,
            "amplitude_x": [1.0, 1.1, 9.0], "waveform_x": [0.1, 0.2, 3.0],
        }
    )  # fmt: skip


@pytest.mark.parametrize(("scale", "unit"), [(1.0, "kHz"), (1e-5, "mHz"), (1e5, "GHz")])
def test_points_left_out_are_drawn_at_any_frequency(scale: float, unit: str) -> None:
    figure = left_out_figure(left_out(scale))
    assert "enclosed by the others" in drawn(figure)
    left = figure.axes[0]
    assert left.get_xlabel() == f"frequency of the record ({unit})"
    assert frequency_scale(left_out(scale)["f_kHz"])[1] == unit
    assert 1.0 <= left.get_xlim()[1] < 2e3
    boxes = [ax.get_window_extent() for ax in figure.axes]
    assert min(box.width for box in boxes) > 200


def test_a_map_shows_every_point_and_the_cycle_that_it_is_not_of() -> None:
    figure = cycle_figure(GRID, POINTS, FITTED, branch="strong", parameters=["a", "b"], labels={})
    assert {"record", "not oscillating", "record of another cycle"} <= set(drawn(figure))
    outline = figure.axes[0].lines[0].get_xydata()
    assert len(outline) == 4  # closed
    assert {tuple(corner) for corner in outline} == {tuple(corner) for corner in FITTED}


def test_points_on_a_line_have_no_area() -> None:
    flat = np.array([[1.0, 0.0], [1.5, 0.5], [2.0, 1.0]])
    figure = cycle_figure(GRID, POINTS, flat, branch="strong", parameters=["a", "b"], labels={})
    outline = np.unique(figure.axes[0].lines[0].get_xydata(), axis=0)
    np.testing.assert_array_equal(outline, flat[[0, 2]])


def test_one_parameter_has_a_line_that_ends_with_the_cycle() -> None:
    rows = GRID[GRID["b"] == 1.0]
    figure = cycle_figure(rows, POINTS, FITTED[:, :1], branch="strong", parameters=["a"], labels={})
    assert {"the model's cycle", "record", "not oscillating"} <= set(drawn(figure))
    line = figure.axes[0].lines[0]
    assert line.get_xdata().tolist() == [1.0, 2.0]
    np.testing.assert_array_equal(line.get_ydata(), [12.0, np.nan])


def test_a_coefficient_that_is_constant_looks_constant_and_has_its_unit() -> None:
    law = OperatingLaw(
        functions=polynomial(["a"], degree=1),
        library=named_terms(("x",), ("x", "x^2")),
        states=("x",),
        coefficients=(("x", "x"), ("x", "x^2")),
        coef=np.array([[1.0, 1e-6], [-1e5, 2e5]]),
        points=np.array([[1.0], [2.0]]),
        units={"x": "m^-3"},
    )
    a = np.array([1.0, 2.0])
    values = {"x": 1.0 + 1e-6 * a, "x^2": -1e5 + 2e5 * a}
    rows = pd.concat(
        pd.DataFrame({"a": a, "state": "x", "term": term, "alone": v, "law": v})
        for term, v in values.items()
    )
    figure = laws_figure(rows, law, parameters=["a"], labels={})
    drawn(figure)
    low, high = figure.axes[0].get_ylim()
    assert high - low >= 0.1
    assert [ax.get_title().rpartition("  ")[2] for ax in figure.axes] == [
        "(s$^{-1}$)", "(m$^{3}$ s$^{-1}$)",
    ]  # fmt: skip
