"""Figures of laws of the operating point, drawn from small tables."""

import warnings
from collections.abc import Sequence

import numpy as np
import pandas as pd
import pytest
from matplotlib.axes import Axes
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from ep2sindy.figures.operating import FADED, WRONG, cycle_figure, laws_figure
from ep2sindy.library.library import named_terms, polynomial
from ep2sindy.operating.law import OperatingLaw

POINTS = pd.DataFrame(
    {
        "a": [1.0, 2.0, 1.0, 2.0, 1.5, 2.0],
        "b": [0.0, 0.0, 1.0, 1.0, 0.5, 0.5],
        "branch": ["strong", "strong", "strong", "", "weak", ""],
        "f_kHz": [10.0, 11.0, 12.0, np.nan, 14.0, np.nan],
        "relative_amplitude": [0.9, 1.0, 1.1, np.nan, 0.3, np.nan],
    }
)
LONG = "n_i^2*n_n"


def drawn(figure: Figure) -> list[str]:
    """What its legends say; nothing may collapse in the layout."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        figure.draw_without_rendering()
    legends = [*figure.legends, *(ax.get_legend() for ax in figure.axes)]
    entries = [text for legend in legends if legend for text in legend.get_texts()]
    return [text.get_text() for text in entries]


def spots(ax: Axes) -> dict[tuple[float, ...], tuple[str, str]]:
    """Face and edge of every mark, by its place."""
    return {
        tuple(place): (to_hex(face), to_hex(edge))
        for marks in ax.collections
        if len(places := np.asarray(marks.get_offsets())) and marks.get_facecolor().size
        for place, face in zip(
            places, np.resize(marks.get_facecolor(), (len(places), 4)), strict=True
        )
        for edge in marks.get_edgecolor()[:1]
    }


def grid(n: int) -> pd.DataFrame:
    """A law over a in [1, 2] and b in [0, 1], fitted below their diagonal, at rest for large a."""
    a, b = (each.ravel() for each in np.meshgrid(np.linspace(1, 2, n), np.linspace(0, 1, n)))
    rows = pd.DataFrame({"a": a, "b": b}).sort_values(["a", "b"])
    alive = (rows["a"] < 1.9) | (rows["b"] > 0.7)
    return rows.assign(
        inside=rows["a"] - 1.0 + rows["b"] <= 1.0,
        status=np.where(alive, "sustained", "decays"),
        f_kHz=(10.0 + rows["a"]).where(alive),
        relative_amplitude=(0.9 + 0.1 * rows["b"]).where(alive),
        growth_per_s=np.where(alive, 1.0, -1.0),
    )


def cycles(rows: pd.DataFrame, *parameters: str) -> Figure:
    labels = {"a": "discharge voltage (V)", "b": "mass flow of the anode (mg/s)"}
    return cycle_figure(rows, POINTS, branch="strong", parameters=parameters, labels=labels)


def test_a_mark_on_a_map_has_its_own_colour_and_is_red_where_the_law_errs() -> None:
    figure = cycles(grid(11), "a", "b")
    drawn(figure)
    ax = figure.axes[0]
    of, map_ = spots(ax), ax.collections[0]
    for place, f in (((1.0, 0.0), 10.0), ((1.0, 1.0), 12.0), ((2.0, 0.0), 11.0)):
        assert of[place][0] == to_hex(map_.cmap(map_.norm(f)))
    assert [of[place][1] == WRONG for place in ((1.0, 0.0), (2.0, 0.0))] == [False, True]
    # the law oscillates at (2, 1) and rests at (2, 0.5); neither point does
    assert [of[place][0] for place in ((2.0, 1.0), (2.0, 0.5))] == [WRONG, "#222222"]
    assert of[1.5, 0.5][0] == "#ffffff"


def test_a_map_is_faded_beyond_the_fitted_points_and_white_without_a_cycle() -> None:
    rows = grid(11)
    map_ = cycles(rows, "a", "b").axes[0].collections[0]
    opacity = np.asarray(map_.get_alpha()).T.ravel()
    np.testing.assert_array_equal(opacity, np.where(rows["inside"], 1.0, FADED))
    shown = np.ma.masked_invalid(map_.get_array()).T.ravel()
    np.testing.assert_array_equal(shown.mask, rows["status"] == "decays")


def test_signals_around_zero_have_a_map_of_their_frequency_alone() -> None:
    points = POINTS.assign(relative_amplitude=np.nan)
    figure = cycle_figure(grid(5), points, branch="strong", parameters=["a", "b"], labels={})
    drawn(figure)
    assert [ax.get_ylabel() for ax in figure.axes] == ["$b$", "frequency (kHz)"]


def example_law(n: int, parameters: Sequence[str]) -> tuple[OperatingLaw, pd.DataFrame]:
    """A law of n coefficients, and its table with values of points alone a tenth higher."""
    names = ["x", "x^2", LONG, f"x*{LONG}", "x*n_i", "n_i*n_n"] * 2
    pairs = tuple((("n_i", "n_n")[k // 6], name) for k, name in enumerate(names[:n]))
    functions = polynomial(parameters, degree=1)
    values = [np.linspace(1.0, 5.0, 5), np.linspace(100.0, 300.0, 3)]
    points = np.array(np.meshgrid(*values[: len(parameters)])).reshape(len(parameters), -1).T
    law = OperatingLaw(
        functions=functions,
        library=named_terms(("x", "n_i", "n_n"), tuple(dict.fromkeys(names))),
        states=("n_i", "n_n"),
        coefficients=pairs,
        coef=np.random.default_rng(0).normal(size=(n, len(functions))) * 1e5,
        points=points,
        units={"x": "m^-3", "n_i": "m^-3", "n_n": "m^-3"},
    )
    of_law = functions.evaluate(points) @ law.coef.T
    rows = [
        {
            **dict(zip(parameters, point, strict=True)), "state": state, "term": term,
            "law": value, "law_low": value, "law_high": value,
            "alone": 1.1 * value, "alone_low": value, "alone_high": 1.2 * value,
        }
        for point, at in zip(points, of_law, strict=True)
        for (state, term), value in zip(pairs, at, strict=True)
    ]  # fmt: skip
    return law, pd.DataFrame(rows)


@pytest.mark.parametrize("parameters", [["m"], ["V", "m"]])
@pytest.mark.parametrize("n", [1, 3])
def test_filled_marks_lie_on_the_line_of_their_law(n: int, parameters: list[str]) -> None:
    law, rows = example_law(n, parameters)
    figure = laws_figure(rows, law, parameters=parameters, labels={"V": "$V_D$ (V)"})
    assert len(drawn(figure)) == 2 + 5 * (len(parameters) - 1)
    assert len(figure.axes) == n
    for ax, pair in zip(figure.axes, law.coefficients, strict=True):
        lines = [
            line for line in ax.lines if line.get_linestyle() == "-" and len(line.get_xdata()) > 6
        ]
        marks = [each.lines[0] for each in ax.containers]
        for line, filled, open_ in zip(lines, marks[::2], marks[1::2], strict=True):
            colour = line.get_color()
            assert (filled.get_mfc(), open_.get_mfc(), open_.get_color()) == (
                colour,
                "none",
                colour,
            )
            for mark in (filled, open_):
                assert set(mark.get_xdata()) <= set(rows["m"])
            on_line = np.interp(filled.get_xdata(orig=False), line.get_xdata(), line.get_ydata())
            np.testing.assert_allclose(filled.get_ydata(orig=False), on_line, rtol=1e-9)
        own = rows[(rows["state"] == pair[0]) & (rows["term"] == pair[1])]
        alone = np.concatenate([mark.get_ydata(orig=False) for mark in marks[1::2]])
        np.testing.assert_allclose(np.sort(alone), np.sort(own["alone"].to_numpy()))
