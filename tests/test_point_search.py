"""The compiled search at a point against the general one, its oracle, and against plain forms."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.discovery import pointwise as module
from ep2sindy.discovery.point_kernels import (
    add_steps,
    alike,
    differentiate,
    fill_running_sums,
    smooth,
)
from ep2sindy.discovery.point_search import PointSearch, _filter, compiled_points
from ep2sindy.discovery.pointwise import pointwise
from ep2sindy.library.library import named_terms
from ep2sindy.regression.gram_kernels import all_usable
from ep2sindy.regression.row_kernels import fill_products
from ep2sindy.runtime.parallel import Serial
from ep2sindy.signals.smoothers import difference

T = np.arange(601) * 2e-3
TERMS = ["1", "x", "y", "u", "x*y", "x^2"]
SEARCH = PointSearch(
    states=["x", "y"],
    library=named_terms(["x", "y", "u"], TERMS),
    method=ep.Regression(
        ep.Differential(), ep.BestSubset(), ep.Knee(), ep.Bootstraps(n=8, n_culled=0)
    ),
)


def field(n_points: int = 6, t: np.ndarray = T) -> xr.Dataset:
    """Two states in different units and one input, with noise, different at every point."""
    rng = np.random.default_rng(3)
    phase, strength = rng.uniform(0.5, 1.5, (2, 3, n_points))
    turns = np.array([3.0, 7.0, 11.0])[:, None, None] * t[:, None] + phase[:, None]
    waves = np.sin(2 * np.pi * turns) * strength[:, None]
    values = 2.0 + waves + 0.05 * rng.standard_normal(waves.shape)
    scales = {"x": 1e17, "y": 1e18, "u": 4e3}
    return xr.Dataset(
        {
            name: (("time", "z"), scale * each, {"units": "1"})
            for (name, scale), each in zip(scales.items(), values, strict=True)
        },
        coords={"time": ("time", t, {"units": "s"}), "z": np.linspace(0.0, 0.01, n_points)},
    )


def both(
    search: PointSearch, data: xr.Dataset, monkeypatch: pytest.MonkeyPatch
) -> tuple[xr.Dataset, xr.Dataset]:
    """Results by the compiled path and by `Regression`."""
    compiled = pointwise(data, search, workers=Serial())
    monkeypatch.setattr(module, "compiled_points", lambda search, t: None)
    return compiled, pointwise(data, search, workers=Serial())


def changed(**settings: object) -> PointSearch:
    return replace(SEARCH, method=replace(SEARCH.method, **settings))


@pytest.mark.parametrize(
    "search",
    [
        changed(),
        changed(bootstraps=ep.Bootstraps(n=8, n_culled=2)),
        changed(bootstraps=ep.Bootstraps(n=8, n_culled=0, block=40)),
        changed(selection=ep.Knee(scale="log", n_norm="max_terms")),
        changed(selection=ep.EBIC(), bootstraps=ep.Bootstraps(n=8, block=40)),
        changed(selection=ep.EBIC(gamma=0.0, coarsening=None)),
        changed(search=ep.BestSubset(max_terms=2)),
        changed(formulation=ep.Differential(smooth_library=False)),
        changed(formulation=ep.Differential(smoother=ep.signals.NoSmoothing())),
        changed(formulation=ep.Differential(split=ep.RandomSplit(0.0))),
        changed(formulation=ep.Differential(split=ep.BlockSplit())),
    ],
    ids=lambda search: repr(search.method)[11:],
)
def test_compiled_points_are_those_of_the_general_path(
    search: PointSearch, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = field()
    made = compiled_points(search, T)
    assert made is not None
    columns = np.array([data[name].values[:, 0] for name in search.variables])
    assert made.at(columns) is not None
    ours, plain = both(search, data, monkeypatch)
    for name in ("status", "n_terms", "inclusion"):
        np.testing.assert_array_equal(ours[name], plain[name])
    for name in ("coef", "weight", "coef_draws", "weight_draws"):
        largest = np.abs(plain[name]).max(dim=[d for d in plain[name].dims if d != "term"])
        off = np.abs(ours[name] - plain[name]) / largest.where(largest > 0.0, 1.0)
        assert float(off.max()) < 1e-11, name  # a draw's Gram matrix squares its condition
    for name in ("r2_train", "r2_test"):
        np.testing.assert_allclose(ours[name], plain[name], atol=1e-12)


def test_exact_laws_are_found_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    t = np.linspace(0.0, 2.0, 201)
    data = xr.Dataset(
        {
            "x": (("time", "z"), 0.1 + t[:, None] + t[:, None] ** 2 * [1.0, 2.0], {"units": "1"}),
            "u": ("time", t, {"units": "1"}),
        },
        coords={"time": ("time", t, {"units": "s"}), "z": [0.0, 0.1]},
    )
    library = named_terms(["x", "u"], ["1", "x", "u", "u^3"])
    search = replace(changed(selection=ep.EBIC()), states=["x"], library=library)
    ours, plain = both(search, data, monkeypatch)
    truth = [[1.0, 0.0, 2.0, 0.0], [1.0, 0.0, 4.0, 0.0]]
    for result in (ours, plain):
        np.testing.assert_allclose(result["coef"].values[0].T, truth, atol=1e-9)


@pytest.mark.parametrize(
    "special", ["states alike", "a term repeated", "a term of others", "overflow", "underflow"]
)
def test_special_points_go_the_general_way(special: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data, search = field(2), SEARCH
    x, y = data["x"].values.copy(), data["y"].values.copy()
    if special == "states alike":
        y[:, 0] = 2.0 * x[:, 0] + 1e17
    elif special == "a term repeated":
        x[:, 0] = y[:, 0] * data["u"].values[:, 0]
        raw = changed(formulation=ep.Differential(smoother=ep.signals.NoSmoothing()))
        search = replace(raw, library=named_terms(["x", "y", "u"], ["1", "x", "y*u"]))
    elif special == "a term of others":
        x[:, 0] = y[:, 0] + 1e14 * data["u"].values[:, 0]
        search = replace(SEARCH, library=named_terms(["x", "y", "u"], ["y", "u", "x"]))
    elif special == "overflow":
        x[:, 0] *= 1e110
        search = replace(SEARCH, library=named_terms(["x", "y", "u"], ["1", "y", "x^3"]))
    else:
        x[:, 0] *= 1e-70
    data = data.assign(x=(("time", "z"), x, {"units": "1"}), y=(("time", "z"), y, {"units": "1"}))
    made = compiled_points(search, T)
    assert made is not None
    first, second = (
        np.array([data[name].values[:, k] for name in search.variables]) for k in (0, 1)
    )
    assert made.at(first) is None
    assert made.at(second) is not None
    ours, plain = both(search, data, monkeypatch)
    for name, values in plain.data_vars.items():
        np.testing.assert_array_equal(ours[name].isel(z=0), values.isel(z=0))
    assert ours.attrs == plain.attrs


@pytest.mark.parametrize(
    "search",
    [
        changed(search=ep.AdaptiveLasso()),
        changed(search=ep.BestSubset(n_best=2)),
        changed(depth=2),
        changed(selection=ep.RefinedScore()),
        changed(formulation=ep.WeightedWeak()),
        changed(formulation=ep.Differential(smoother=ep.signals.KalmanSmoother())),
        replace(SEARCH, library=named_terms(["x", "y", "u"], ["1", "x", "log(y)"])),
    ],
    ids=lambda search: repr(search.method)[11:],
)
def test_settings_that_are_not_compiled_go_the_general_way(search: PointSearch) -> None:
    assert compiled_points(search, T) is None


def test_uneven_and_short_records_go_the_general_way() -> None:
    rng = np.random.default_rng(0)
    assert compiled_points(SEARCH, np.sort(rng.uniform(size=100))) is None
    assert compiled_points(SEARCH, T[:9]) is None
    assert compiled_points(SEARCH, T[:1]) is None


@pytest.mark.parametrize("smoother", [ep.signals.SavitzkyGolay(9, 2), ep.signals.NoSmoothing()])
def test_weights_act_as_the_smoother_does(smoother: ep.signals.SavitzkyGolay) -> None:
    values = np.random.default_rng(1).normal(size=(3, 50))
    t = np.arange(50) * 1.5e-6
    weights = _filter(smoother, t)
    assert weights is not None
    smoothed, rates = np.empty_like(values), np.empty_like(values)
    smooth(values, *weights.smoothing, smoothed)
    np.testing.assert_allclose(smoothed, smoother.smooth(t, values.T).T, atol=1e-14)
    differentiate(smoothed, weights.difference, rates)
    plain = difference(t, smoothed.T).T
    np.testing.assert_allclose(rates, plain, atol=1e-13 * np.abs(plain).max())


def test_running_sums_give_the_sums_of_weighted_products() -> None:
    rng = np.random.default_rng(2)
    rows, n_rows = rng.normal(1.0, 0.1, size=(4, 300)), 300
    counts, _ = ep.Bootstraps(n=5, block=30).draw_groups(n_rows, np.ones(3, dtype=bool), rng)
    first, second = np.triu_indices(4)
    plain = counts @ (rows[first] * rows[second]).T
    products = np.empty((10, n_rows))
    fill_products(rows, 0, n_rows, products)
    np.testing.assert_allclose(counts @ products.T, plain, rtol=1e-14)
    padded = np.pad(counts, ((0, 0), (1, 1)))
    draw, place = np.nonzero(padded[:, :-1] - padded[:, 1:])
    steps = (padded[:, :-1] - padded[:, 1:])[draw, place]
    starts = np.searchsorted(draw, np.arange(6))
    running, sums = np.empty((n_rows + 1, 10)), np.empty((5, 10))
    means = products.mean(axis=1)
    fill_running_sums(rows, means, running)
    add_steps(starts, place, steps, running, means, counts.sum(axis=1), sums)
    np.testing.assert_allclose(sums, plain, rtol=1e-14)


def test_likeness_and_dependence_are_told() -> None:
    x, y, z = np.random.default_rng(0).normal(size=(3, 500))
    assert alike(np.array([x, y, 3.0 - 2.0 * x]), 0.99)
    assert not alike(np.array([x, y, z]), 0.99)
    order = np.arange(3)
    for columns, usable in (
        ([x, y, z], True),
        ([x, y, -2.0 * x], False),
        ([x, y, x + y], False),
        ([x, y, 0.0 * z], False),
    ):
        unit = np.array(columns) / 30.0
        assert all_usable(unit @ unit.T, order, 1e-10) == usable
    square = unit[:2] @ unit[:2].T
    square[0, 0] = np.inf
    assert not all_usable(square, order[:2], 1e-10)
