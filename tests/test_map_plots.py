import numpy as np
import pytest
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from ep2sindy.discovery.regimes import Regimes, find_regimes
from ep2sindy.figures.maps import (
    ABSENT,
    GAP,
    HALF,
    coefficient_maps,
    quality_maps,
    regime_map,
)
from ep2sindy.thruster.parameters import Thruster
from tests.models import point_study

TERMS = {"1": "m^-3 s^-1", "n_n": "s^-1", "n_i*u_iz": "m^-1"}


def study() -> xr.Dataset:
    """5 x 4 points of z and r, the last row of z without plasma.

    n_i' = -40 n_i u_iz; n_n' = 10^22..10^24 at z < 1 cm, 3e4 n_n beyond.
    """
    coef, weight = np.zeros((2, 2, 3, 5, 4))
    fraction = np.ones((2, 3, 5, 4))
    fraction[0, 2, :, 0] = 0.25  # of the bootstraps have n_i*u_iz at the inner wall
    coef[0, 2], weight[0, 2] = -40.0, -1.0
    coef[1, 0, :2], weight[1, 0, :2] = np.logspace(22, 24, 8).reshape(2, 4), 1.0
    coef[1, 1, 2:], weight[1, 1, 2:] = 3e4, 1.0
    lost = np.zeros((5, 4), dtype=bool)
    lost[-1] = True
    result = point_study(coef, weight, lost, terms=TERMS, fraction=fraction)
    one = 0.0 * result["n_terms"] + 1.0
    r2 = xr.DataArray([0.8, -3.0], dims="equation")
    return result.assign(r2_train=0.9 * one, r2_test=r2 * one)


def grouped(result: xr.Dataset) -> Regimes:
    return find_regimes(result, rng=np.random.default_rng(0))


@pytest.fixture(scope="module")
def coefficients() -> Figure:
    """Drawn once for all tests that look at it, as the two below."""
    return coefficient_maps(study())


@pytest.fixture(scope="module")
def quality() -> Figure:
    return quality_maps(study())


def maps(figure: Figure) -> list[tuple[Axes, np.ma.MaskedArray]]:
    """Panels with a map, and its values over (r, z), colour bars left out."""
    found = []
    for ax in figure.axes:
        meshes = [c for c in ax.collections if isinstance(c, QuadMesh)]
        if meshes and ax.get_label() != "<colorbar>":
            found.append((ax, np.ma.masked_invalid(np.ma.asarray(meshes[0].get_array()))))
    return found


def places(ax: Axes, values: np.ndarray) -> np.ndarray:
    """Where values stand on the colour bar of their map, from -1 to 1."""
    return np.asarray(2.0 * ax.collections[0].norm(values) - 1.0)


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_a_coefficient_shows_its_sign_and_its_exponent(coefficients: Figure) -> None:
    drawn = [(ax, values.filled(np.nan)) for ax, values in maps(coefficients)]
    assert len(drawn) == 2 * len(TERMS)
    by_panel = dict(zip([(e, t) for e in ("n_i", "n_n") for t in TERMS], drawn, strict=True))
    ax, values = by_panel["n_n", "1"]
    constant = places(ax, values[:, :2].T.ravel())
    # From 10^22 at the rim of the middle to 10^24 at the end, even in the logarithm.
    assert constant == pytest.approx(np.linspace(GAP, 1.0, 8), abs=1e-12)
    # -40 is log10(40) = 1.6 of the way from 10 to 100.
    ax, values = by_panel["n_i", "n_i*u_iz"]
    assert places(ax, values[:, :4]) == pytest.approx(-(GAP + (1.0 - GAP) * (np.log10(40.0) - 1.0)))


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_coefficient_below_the_scale_is_not_drawn_as_absent(sign: float) -> None:
    result = study()
    result["coef"][1, 0, 0, 0] = sign * 1e3
    result = result.isel(z=slice(0, 4))
    ax, values = maps(coefficient_maps(result))[3]
    (mesh,) = ax.collections
    least, none = values[0, 0], values[0, -1]
    assert places(ax, np.array([sign * least, none])) == pytest.approx([GAP, 0.0])
    assert np.allclose(mesh.to_rgba(none), to_rgba(ABSENT))
    assert not np.allclose(mesh.to_rgba(least), to_rgba(ABSENT), atol=0.01)


def test_coefficients_fade_to_grey_with_r2_and_the_share_of_bootstraps(
    coefficients: Figure,
) -> None:
    """R2 is 0.8 for n_i' and -3 for n_n' in all fitted cells: the latter shows nothing but grey."""
    r2 = [0.8] * 3 + [0.0] * 3
    for k, (ax, values) in enumerate(maps(coefficients)):
        (mesh,) = ax.collections
        alpha = np.asarray(mesh.get_alpha())
        masked = np.ma.getmaskarray(values)
        assert np.all(alpha[masked] == 1.0)  # white, over the grey
        assert alpha[1:][~masked[1:]] == pytest.approx(r2[k])
        inner_wall = (0.25 if k == 2 else 1.0) * r2[k]
        assert alpha[0][~masked[0]] == pytest.approx(inner_wall)
        assert to_rgba(ax.get_facecolor()) == to_rgba(ABSENT)
        assert np.allclose(mesh.cmap(np.nan), to_rgba("white"))
    assert HALF in legend(coefficients)


def test_r2_below_zero_is_drawn_as_zero(quality: Figure) -> None:
    drawn = {ax.get_title(): values for ax, values in maps(quality)}
    assert (drawn[r"$\dot{n}_{i}$: $R^2$, held-out"].compressed() == 0.8).all()
    assert (drawn[r"$\dot{n}_{n}$: $R^2$, held-out"].compressed() == 0.0).all()


@pytest.mark.parametrize("cut", [{"r": 1}, {"z": [1], "r": [1]}], ids=str)
def test_every_figure_is_drawn_over_any_axes(cut: dict[str, int | list[int]]) -> None:
    result = study().isel(cut, drop=True)
    for figure in (
        coefficient_maps(result, outline=Thruster()),
        regime_map(grouped(result), outline=Thruster()),
        quality_maps(result, outline=Thruster()),
    ):
        figure.canvas.draw()
        assert all(ax.has_data() for ax in figure.axes)
