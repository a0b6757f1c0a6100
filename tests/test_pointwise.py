import numpy as np
import pytest
import xarray as xr

import ep2sindy as ep
from ep2sindy.data.prepare import gradient
from ep2sindy.discovery.pointwise import STATUSES, PointSearch, blocks_of
from ep2sindy.runtime import parallel
from ep2sindy.runtime.parallel import Loky, Serial
from ep2sindy.signals.smoothers import NoSmoothing

T = np.linspace(0.0, 2.0, 201)
Z, R = np.array([0.01, 0.02, 0.03, 0.04]), np.array([0.035, 0.04, 0.05])
LIBRARY = ep.named_terms(["x", "u", "w"], ["1", "x", "u", "w", "u*w"])


def parabolas(z: np.ndarray = Z, r: np.ndarray = R) -> xr.Dataset:
    """x = a(z) t + b(r) t^2 / 2 with u = t, w = cos 5t: x' = a + b u, exact for differences."""
    a, b = 1.0 + 100.0 * z[:, None], -50.0 * r
    x = a * T[:, None, None] + b * T[:, None, None] ** 2 / 2.0 + 0.1
    axes = {"time": ("time", T, {"units": "s"}), "z": ("z", z), "r": ("r", r)}
    return xr.Dataset(
        {
            "x": (("time", "z", "r"), x, {"units": "m^-3"}),
            "u": (("time",), T, {"units": "m/s"}),
            "w": (("time", "z"), np.cos(5.0 * T)[:, None] + 0.0 * z, {"units": "1"}),
        },
        coords=axes,
    )


def noisy(seed: int = 0) -> xr.Dataset:
    field = parabolas()
    rng = np.random.default_rng(seed)
    return field.assign(x=field["x"] + 0.02 * rng.standard_normal(field["x"].shape))


def searching(**changes: object) -> PointSearch:
    settings = {
        "states": ["x"],
        "library": LIBRARY,
        "formulation": ep.Differential(),
        "search": ep.BestSubset(max_terms=4),
        "bootstraps": ep.Bootstraps(n=8, n_culled=0, block=10),
        "selection": ep.EBIC(),
    } | changes
    names = ("formulation", "search", "bootstraps", "selection")
    recipe = ep.Regression(**{name: settings.pop(name) for name in names})
    return PointSearch(method=recipe, **settings)


def bytes_of(result: xr.Dataset) -> dict[str, bytes]:
    return {str(name): values.values.tobytes() for name, values in result.variables.items()}


@pytest.fixture(scope="module")
def exact() -> xr.Dataset:
    """Without noise; looked at, never changed."""
    return ep.pointwise(parabolas(), searching(), workers=Serial())


@pytest.fixture(scope="module")
def noisy_bytes() -> dict[str, bytes]:
    """With noise, on one process, in blocks of a line."""
    return bytes_of(ep.pointwise(noisy(), searching(), workers=Serial(), block_points=4))


def test_every_point_gets_its_own_exact_equation(exact: xr.Dataset) -> None:
    assert (exact["status"] == 0).all()
    coef = exact["coef"].sel(equation="x")
    expected = {"1": (1.0 + 100.0 * Z)[:, None] + 0.0 * R, "u": -50.0 * R + 0.0 * Z[:, None]}
    for name in LIBRARY.names:
        np.testing.assert_allclose(
            coef.sel(term=name).transpose("z", "r"), expected.get(name, 0.0), rtol=1e-9
        )
    assert (exact["n_terms"] == 2).all()
    np.testing.assert_allclose(exact["r2_test"], 1.0, rtol=1e-12)
    np.testing.assert_array_equal(exact["inclusion"].sel(term=["1", "u"]), 1.0)
    np.testing.assert_array_equal(exact["inclusion"].sel(term=["x", "w", "u*w"]), 0.0)


def test_weights_are_shares_of_the_root_mean_square() -> None:
    found = searching(
        formulation=ep.Differential(split=ep.regression.RandomSplit(test_fraction=0.0))
    )
    result = ep.pointwise(parabolas(), found, workers=Serial()).isel(z=1, r=2, equation=0)
    one, u = 1.0 + 100.0 * Z[1], -50.0 * R[2] * np.sqrt(np.square(T).mean())
    weight = result["weight"].sel(term=["1", "u"]).values
    np.testing.assert_allclose(weight, np.array([one, u]) / (one - u), rtol=1e-9)
    np.testing.assert_allclose(np.abs(result["weight"]).sum(), 1.0)


@pytest.mark.parametrize(
    "formulation", [ep.Differential(), ep.Weak()], ids=["differential", "weak"]
)
def test_a_point_is_what_discover_finds_there(formulation: object) -> None:
    draws = ep.Bootstraps(n=8, n_culled=0)
    search = searching(formulation=formulation, search=ep.AdaptiveLasso(), bootstraps=draws)
    field = noisy()
    result = ep.pointwise(field, search, workers=Serial()).isel(z=2, r=1)
    place = ep.Zone(z=Z[2], r=R[1])
    run = ep.zone_average(field, place, states=["x"], inputs=["u", "w"])
    found = ep.discover([run], LIBRARY, search.method, seed=search.seed)
    np.testing.assert_allclose(result["coef"].sel(equation="x"), found.model.coef[:, 0], rtol=1e-12)
    chosen = found.chosen["x"]
    assert result["r2_test"].item() == pytest.approx(chosen.r2_test)
    inclusion = result["inclusion"].sel(equation="x", term=list(chosen.terms))
    np.testing.assert_allclose(inclusion, chosen.inclusion)


@pytest.mark.parametrize("axis", ["z", "r"])
def test_a_field_may_have_one_axis(axis: str, exact: xr.Dataset) -> None:
    other = "r" if axis == "z" else "z"
    line = parabolas().isel({other: 0}, drop=True)
    result = ep.pointwise(line, searching(), workers=Serial())
    assert result["status"].dims == (axis,)
    np.testing.assert_array_equal(result["coef"], exact["coef"].isel({other: 0}))


@pytest.mark.parametrize("block_points", [1, 5, 1000])
def test_blocks_do_not_show_in_the_result(block_points: int, noisy_bytes: dict[str, bytes]) -> None:
    result = ep.pointwise(noisy(), searching(), workers=Serial(), block_points=block_points)
    assert bytes_of(result) == noisy_bytes


@pytest.mark.slow  # two processes import the package
def test_processes_give_the_same_bits(
    noisy_bytes: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(parallel, "START_S", -1.0)  # as if they were started already
    result = ep.pointwise(noisy(), searching(), workers=Loky(n_jobs=2), block_points=2)
    assert bytes_of(result) == noisy_bytes


def test_what_cannot_be_fitted_is_flagged_and_never_zero() -> None:
    field = parabolas()
    x = field["x"].values.copy()
    x[:, 0, 0] = np.nan
    x[7, 0, 1] = np.nan
    x[:, 0, 2] = 3.0 + 1e-4 * np.sin(T)
    x[:, 1, 0] = 0.0
    x[:, 1, 1] = 1e60 * np.sin(T)  # finite, but not to the sixth
    field = field.assign(x=(field["x"].dims, x, field["x"].attrs))
    library = ep.named_terms(["x", "u", "w"], ["1", "x^6", "u"])
    result = ep.pointwise(field, searching(library=library), workers=Serial())
    named = [[STATUSES[k] for k in row] for row in result["status"].values]
    assert named[0] == ["no_plasma", "missing_samples", "too_little_variation"]
    assert named[1] == ["too_little_variation", "no_fit", "fitted"]
    assert "every term must be finite on every row: 'x^6'" in result.attrs["no_fit"]
    for name in ("coef", "inclusion", "weight", "coef_draws", "r2_test", "n_terms"):
        lost = np.isnan(result[name]).transpose(..., "z", "r").values
        assert (lost == (result["status"].values != 0)).all()


def test_masked_inputs_mask_the_point() -> None:
    field = parabolas()
    field = field.assign(w=field["w"].where(field["z"] > 0.015).assign_attrs(units="1"))
    status = ep.pointwise(field, searching(), workers=Serial())["status"]
    assert (status.isel(z=0) == STATUSES.index("no_plasma")).all()
    assert (status.isel(z=slice(1, None)) == 0).all()


def test_units_of_coefficients_follow_the_field(exact: xr.Dataset) -> None:
    assert exact["coef_units"].sel(equation="x", term="u").item() == "m^-4"
    assert exact["coef_units"].sel(equation="x", term="x").item() == "s^-1"


def test_blocks_cover_the_grid_once() -> None:
    field = parabolas()
    for n_points in range(1, 14):
        seen = np.zeros((len(Z), len(R)), dtype=np.int64)
        for block in blocks_of(field, n_points):
            seen[block["z"], block["r"]] += 1
            assert seen[block["z"], block["r"]].size <= n_points
        assert (seen == 1).all()


def test_what_makes_no_sense_is_refused() -> None:
    field = parabolas()
    with pytest.raises(ValueError, match=r"unknown variables \['w'\]; this field has"):
        ep.pointwise(field.drop_vars("w"), searching(), workers=Serial())
    with pytest.raises(ValueError, match="needs bootstraps for its spread, got n=0"):
        searching(bootstraps=ep.Bootstraps(n=0))


def test_rules_that_refine_all_equations_serve_every_point() -> None:
    field = parabolas(Z[:1], R[:1])
    result = ep.pointwise(
        field, searching(selection=ep.FreeRunScore(bounds=None)), workers=Serial()
    )
    assert result["n_terms"].item() == 2


EXACT = [
    ep.Differential(smoother=NoSmoothing()),
    ep.Weak(
        ep.regression.Bumps(half_width_s=0.1),
        NoSmoothing(),
        smooth_library=False,
        errors_in_variables=False,
    ),
]


@pytest.mark.parametrize("formulation", EXACT, ids=["differential", "weak"])
def test_a_travelling_wave_has_its_speed_at_every_point(formulation: object) -> None:
    z, speed = np.array([0.0, 0.1, 0.3, 0.35]), 0.7
    wave = (z - speed * T[:, None] + 2.0) ** 2  # whose differences are exact
    axes = {"time": ("time", T, {"units": "s"}), "z": ("z", z)}
    field = xr.Dataset({"x": (("time", "z"), wave, {"units": "m^-3"})}, coords=axes)
    field = gradient(field, of="x", name="dx_dz")
    library = ep.named_terms(["x", "dx_dz"], ["1", "x", "dx_dz"])
    found = searching(
        library=library, formulation=formulation, bootstraps=ep.Bootstraps(n_culled=0)
    )
    result = ep.pointwise(field, found, workers=Serial()).sel(equation="x")
    np.testing.assert_allclose(result["coef"].sel(term="dx_dz"), -speed, rtol=1e-8)
    assert (result["coef"].sel(term=["1", "x"]) == 0.0).all()
    assert result["coef_units"].sel(term="dx_dz").item() == "m s^-1"


SHARED = "x: u == -1 * y: u"


def exchanging(noise: float) -> xr.Dataset:
    """x' = 2 u - w and y' = -2 u + 3 w at every point, for u = 1 + t and w = 1 - t^2."""
    x, y = 2.0 * T + T**2 - (T - T**3 / 3.0), -2.0 * T - T**2 + 3.0 * (T - T**3 / 3.0)
    rng = np.random.default_rng(0)
    arrays = {
        "x": x[:, None] + noise * rng.standard_normal((len(T), 2)),
        "y": y[:, None] + noise * rng.standard_normal((len(T), 2)),
        "u": 1.0 + T[:, None] + np.zeros(2),
        "w": 1.0 - T[:, None] ** 2 + np.zeros(2),
    }
    data = {name: (("time", "z"), a, {"units": "1"}) for name, a in arrays.items()}
    return xr.Dataset(data, coords={"time": ("time", T, {"units": "s"}), "z": ("z", Z[:2])})


def sharing(*relations: str, **changes: object) -> PointSearch:
    settings = {"states": ["x", "y"], "formulation": EXACT[1]} | changes
    library = ep.named_terms(["x", "y", "u", "w"], ["u", "w"]).relate(*relations)
    draws = ep.Bootstraps(n=4, n_culled=0)
    return searching(**{"library": library, "bootstraps": draws, **settings})


def test_relations_tie_equations_at_every_point_and_in_every_draw() -> None:
    exact = ep.pointwise(exchanging(0.0), sharing(SHARED), workers=Serial())
    expected = np.array([[2.0, -1.0], [-2.0, 3.0]])[:, :, None] + np.zeros(2)
    for name in ("coef", "coef_draws"):
        np.testing.assert_allclose(*np.broadcast_arrays(exact[name], expected), rtol=1e-6)
    np.testing.assert_allclose(exact["r2_test"], 1.0, rtol=1e-9)
    noisy, free = (
        ep.pointwise(exchanging(0.05), sharing(*coupled), workers=Serial())
        for coupled in ([SHARED], [])
    )
    for name in ("coef", "coef_draws"):
        x, y = (noisy[name].sel(term="u", equation=e) for e in ("x", "y"))
        np.testing.assert_allclose(x, -y, rtol=1e-12)
        assert not np.allclose(*(free[name].sel(term="u", equation=e) for e in ("x", "y")))
    weights = np.abs(noisy["weight_draws"]).sum("term")
    np.testing.assert_allclose(weights, 1.0, rtol=1e-12)
    assert (noisy["r2_train"] < free["r2_train"]).all()


def test_a_draw_of_all_rows_is_the_fit_of_all_rows() -> None:
    """Blocks as long as the rows draw each of them once."""
    whole = ep.Bootstraps(n=2, n_culled=0, smallest=1.0, largest=1.0, block=len(T))
    form = ep.Differential(
        smoother=NoSmoothing(), split=ep.regression.RandomSplit(test_fraction=0.0)
    )
    search = sharing(SHARED, formulation=form, bootstraps=whole)
    result = ep.pointwise(exchanging(0.05), search, workers=Serial())
    same = np.broadcast_arrays(result["coef_draws"], result["coef"])
    np.testing.assert_allclose(*same, rtol=1e-9)


def test_relations_that_cannot_hold_are_refused_at_once() -> None:
    with pytest.raises(ValueError, match="n_culled must be 0, got 1"):
        sharing(SHARED, bootstraps=ep.Bootstraps(n=4, n_culled=1))
    with pytest.raises(ValueError, match="'v'"):
        sharing("x: v == -1 * y: v")
