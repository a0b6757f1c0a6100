from functools import cache

import numpy as np
import pytest
import xarray as xr
from sklearn.metrics import adjusted_rand_score

import ep2sindy as ep
from benchmarks.regions import REGIONS, STATES, RegionField, three_regions
from ep2sindy.discovery.pointwise import PointSearch
from ep2sindy.discovery.regimes import Regimes, find_regimes, group_points
from ep2sindy.runtime.parallel import Serial
from tests.models import point_study

SIZES = {"fast": (8, 7, 600), "full": (20, 15, 1500)}
ONE_EQUATION = dict.fromkeys(REGIONS, REGIONS["exit"])
# The points that are invalid on purpose in the results below.
HOLES = ((0, 0), (2, 1))


@cache
def made(size: str, *, one_equation: bool = False) -> RegionField:
    n_z, n_r, n_samples = SIZES[size]
    regions = ONE_EQUATION if one_equation else REGIONS
    return three_regions(regions, n_z=n_z, n_r=n_r, n_samples=n_samples)


@cache
def studied(size: str, noise: float, *, seed: int = 0, one_equation: bool = False) -> xr.Dataset:
    truth = made(size, one_equation=one_equation)
    search = PointSearch(
        states=STATES,
        library=truth.library,
        method=ep.Regression(
            ep.Differential(), ep.BestSubset(max_terms=5), bootstraps=ep.Bootstraps(n=8, n_culled=0)
        ),
        seed=seed,
    )
    noisy = truth.noisy(noise, rng=np.random.default_rng(seed))
    return ep.pointwise(noisy.field, search, workers=Serial())


@cache
def grouped(size: str, noise: float, *, seed: int = 0, one_equation: bool = False) -> Regimes:
    result = studied(size, noise, seed=seed, one_equation=one_equation)
    return find_regimes(result, rng=np.random.default_rng(seed))


def agreement(found: Regimes, truth: RegionField) -> float:
    """Adjusted Rand index away from the transitions."""
    inside = truth.inside.values
    return adjusted_rand_score(truth.labels.values[inside], found.labels.values[inside])


@pytest.mark.parametrize(
    ("noise", "floor"), [pytest.param(0.0, 0.95, marks=pytest.mark.slow), (0.05, 0.9)]
)
def test_regimes_are_the_regions_away_from_transitions(noise: float, floor: float) -> None:
    assert agreement(grouped("fast", noise), made("fast")) >= floor


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise", "floor", "seed"), [(0.0, 0.95, 0), (0.05, 0.9, 0), (0.05, 0.9, 1), (0.05, 0.9, 2)]
)
def test_regimes_of_a_larger_field_are_the_regions(noise: float, floor: float, seed: int) -> None:
    found = grouped("full", noise, seed=seed)
    assert agreement(found, made("full")) >= floor
    assert found.n_regimes == len(REGIONS)


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_regimes_have_the_equations_of_their_regions(noise: float) -> None:
    found, truth = grouped("fast", noise), made("fast")
    inside = truth.inside.values
    for k, region in enumerate(REGIONS.values()):
        labels = found.labels.values[(truth.labels.values == k) & inside]
        equations = found.equations(int(np.bincount(labels).argmax()))
        for state, terms in region.items():
            assert set(equations[state]) == set(terms)
            # Smoothing over 11 samples, 16 us, flattens peaks of 1/14 kHz; and the regime's rim
            # has coefficients on their way to those of the next region.
            assert equations[state] == pytest.approx(terms, rel=0.12)


@pytest.mark.parametrize("noise", [pytest.param(0.0, marks=pytest.mark.slow), 0.05])
def test_a_field_of_one_equation_is_one_regime(noise: float) -> None:
    found = grouped("fast", noise, one_equation=True)
    assert found.n_regimes == 1
    assert (found.labels.values == 0).all()


@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_confidence_falls_in_the_transitions(noise: float) -> None:
    confidence = grouped("fast", noise).confidence.values
    inside = made("fast").inside.values
    assert confidence[inside].mean() > 0.95
    assert confidence[~inside].mean() < confidence[inside].mean() - 0.005


def patched(**changes: np.ndarray) -> xr.Dataset:
    """A (z, r) study of 4 x 3 points: x' = a y at z = 0, 1 and x' = -a y at z = 2, 3; y' = b x.

    Points in HOLES are NaN; two bootstraps agree with the whole.
    """
    shape = (2, 2, 4, 3)  # equations x, y; terms x, y
    coef, weight = np.zeros(shape), np.zeros(shape)
    sign = np.array([1.0, 1.0, -1.0, -1.0])[:, None]
    size = 1.0 + np.arange(12.0).reshape(4, 3) / 10.0
    coef[0, 1], weight[0, 1] = sign * size, sign
    coef[1, 0], weight[1, 0] = 2.0 * size, 1.0
    lost = np.zeros((4, 3), dtype=bool)
    lost[*np.transpose(HOLES)] = True
    units = {"x": "s^-1", "y": "m s^-1"}
    result = point_study(coef, weight, lost, terms=units, equations=("x", "y"))
    dims = ("draw", *result["weight"].dims)
    given = {name: (dims[-v.ndim :], v) for name, v in changes.items()}
    return result.drop_vars(given).assign(given)


def found_in(result: xr.Dataset) -> Regimes:
    return find_regimes(result, rng=np.random.default_rng(0))


def test_a_term_that_turns_from_source_to_sink_parts_two_regimes() -> None:
    labels = found_in(patched()).labels
    # Five valid points either side: sizes tie, and the weights decide the order.
    assert labels.dims == ("z", "r")
    assert set(labels.values[:2].ravel()) | set(labels.values[2:].ravel()) == {-1, 0, 1}
    assert not set(labels.values[:2].ravel()) & set(labels.values[2:].ravel()) - {-1}


def test_labels_are_missing_at_invalid_points_and_nowhere_else() -> None:
    found = found_in(patched())
    holes = np.zeros((4, 3), dtype=bool)
    holes[*np.transpose(HOLES)] = True
    assert ((found.labels.values == -1) == holes).all()
    assert (np.isnan(found.confidence.values) == holes).all()


def test_the_table_holds_medians_and_spread_of_each_regime() -> None:
    found = found_in(patched())
    first = found.labels.values[3, 0]
    table = found.table.set_index(["regime", "equation", "term"])
    row = table.loc[(first, "x", "y")]
    held = -np.array([1.6, 1.8, 1.9, 2.0, 2.1])
    assert bool(row["acts"])
    assert (row["in_support"], row["weight"], row["n_points"]) == (1.0, -1.0, 5)
    assert row["coef_units"] == "m s^-1"
    ends = np.percentile(held, [16, 50, 84])
    assert row[["coef_low", "coef", "coef_high"]].tolist() == pytest.approx(ends.tolist())
    absent = table.loc[(first, "x", "x")]
    assert not absent["acts"]
    assert absent["in_support"] == 0.0
    assert np.isnan(absent["coef"])
    assert found.equations(int(first)) == {
        "x": {"y": pytest.approx(-1.9)},
        "y": {"x": pytest.approx(3.8)},
    }


@pytest.mark.parametrize("has_one_sign", [True, False])
def test_a_term_of_little_weight_that_all_points_hold_is_in_the_equation(
    has_one_sign: bool,
) -> None:
    coef, weight = (np.array(patched()[name].values) for name in ("coef", "weight"))
    coef[0, 0], weight[0, 0] = 0.1, 0.05
    if not has_one_sign:
        coef[0, 0] *= (-1.0) ** np.indices((4, 3)).sum(axis=0)
    found = found_in(patched(coef=coef, weight=weight, weight_draws=np.stack([weight] * 2)))
    expected = {"x", "y"} if has_one_sign else {"y"}
    assert [set(found.equations(k)["x"]) for k in range(found.n_regimes)] == [expected] * 2


def test_the_largest_regime_comes_first() -> None:
    weight = np.array(patched()["weight"].values)
    weight[0, 1, 1] = -1.0
    labels = found_in(patched(weight=weight, weight_draws=np.stack([weight]))).labels.values
    assert (labels[1:] != 1).all()
    assert set(labels[0]) == {-1, 1}


def test_bootstraps_that_disagree_lower_the_confidence_of_their_point() -> None:
    draws = np.array(patched()["weight_draws"].values)
    draws[0, 0, 1, 3, 2] = 1.0  # one of the two says source
    confidence = found_in(patched(weight_draws=draws)).confidence.values
    assert confidence[3, 2] == pytest.approx(0.5, abs=0.01)
    assert np.sort(confidence[np.isfinite(confidence)])[1] > 0.95


def test_a_bootstrap_without_a_fit_supports_no_regime() -> None:
    draws = np.array(patched()["weight_draws"].values)
    draws[1, :, :, 3, 2] = np.nan
    confidence = found_in(patched(weight_draws=draws)).confidence.values
    assert confidence[3, 2] == pytest.approx(0.5, abs=0.01)


@pytest.mark.parametrize(("gone", "left"), [("z", "r"), ("r", "z")])
def test_a_field_of_one_axis_has_regimes_along_it(gone: str, left: str) -> None:
    whole = patched()
    found = found_in(whole.isel({gone: 2}, drop=True))
    assert found.labels.dims == (left,)
    assert found.labels.size == whole.sizes[left]


def test_axes_may_come_in_any_order() -> None:
    turned = patched().transpose("r", "term", "z", "draw", "equation")
    assert found_in(turned).labels.equals(found_in(patched()).labels)


def test_the_table_counts_the_points_that_are_unsure() -> None:
    draws = np.array(patched()["weight_draws"].values)
    draws[:, 0, 1, 3, 2] = 1.0  # all say source, where the whole says sink
    found = found_in(patched(weight_draws=draws))
    assert (found.confidence.values < 0.5).sum() == 1
    unsure = found.table.groupby("regime")["unsure"].first()
    assert unsure[found.labels.values[3, 2]] == pytest.approx(1 / 5)
    assert unsure.sum() == pytest.approx(1 / 5)


def points(n: int = 60) -> tuple[np.ndarray, np.ndarray]:
    """Weights of three terms, in three groups by which two of them act, and their draws."""
    rng = np.random.default_rng(3)
    group, part = np.arange(n) % 3, rng.uniform(0.3, 0.7, n)
    weights = np.zeros((n, 3))
    weights[np.arange(n), group] = part
    weights[np.arange(n), (group + 1) % 3] = part - 1.0
    return weights, weights + 0.02 * rng.standard_normal((8, n, 3)) * (weights != 0.0)


def test_the_order_of_the_points_does_not_matter() -> None:
    # No groups at all, so that the mixture's random starts decide where regimes end.
    rng = np.random.default_rng(3)
    weights = rng.uniform(-1.0, 1.0, (40, 4))
    draws = weights + 0.02 * rng.standard_normal((8, 40, 4))
    labels, confidence = group_points(weights, draws, rng=np.random.default_rng(0))
    assert labels.max() > 0
    order = rng.permutation(len(weights))
    moved = group_points(weights[order], draws[:, order], rng=np.random.default_rng(0))
    assert (moved[0] == labels[order]).all()
    assert moved[1] == pytest.approx(confidence[order], abs=1e-12)


def test_weights_that_vary_do_not_part_points_where_the_same_terms_act() -> None:
    weights, draws = points()
    labels, _ = group_points(weights, draws, rng=np.random.default_rng(0))
    assert adjusted_rand_score(np.arange(len(weights)) % 3, labels) == 1.0


@pytest.mark.parametrize("n", [1, 2])
def test_fewer_points_than_regimes_are_grouped(n: int) -> None:
    weights, draws = points()
    labels, confidence = group_points(weights[:n], draws[:, :n], rng=np.random.default_rng(0))
    assert labels.max() < n
    assert (confidence > 0.0).all()


def test_points_that_are_all_alike_are_one_regime_beyond_doubt() -> None:
    weights = np.tile([0.6, -0.4], (10, 1))
    draws = np.stack([weights] * 4)
    labels, confidence = group_points(weights, draws, rng=np.random.default_rng(0))
    assert (labels == 0).all()
    assert (confidence == 1.0).all()


def test_a_study_without_any_equation_has_no_regimes() -> None:
    nothing = np.full((2, 2, 4, 3), np.nan)
    with pytest.raises(ValueError, match="none of the 12 points of the study has any"):
        found_in(patched(weight=nothing))
