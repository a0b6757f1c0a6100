from itertools import pairwise

import numpy as np
import pytest
import xarray as xr

from benchmarks.regions import INPUTS, REGIONS, STATES, RegionField, three_regions
from ep2sindy.data.fields import check_field
from ep2sindy.model.model import coef_matrix
from ep2sindy.thruster.parameters import Thruster

DT_S = 1.5e-6


def small(**settings: float) -> RegionField:
    return three_regions(n_z=8, n_r=7, **{"n_samples": 300, **settings})  # type: ignore[arg-type]


def values(field: xr.Dataset) -> np.ndarray:
    """(time, z, r, variables), states first."""
    return np.stack([field[name].values for name in (*STATES, *INPUTS)], axis=-1)


def residuals(made: RegionField, region: str) -> np.ndarray:
    """(z, r): RMS of each state's derivative less a region's right-hand side, as a share."""
    samples = values(made.field)
    coef = coef_matrix(made.library, [REGIONS[region][s] for s in STATES])
    slope = np.gradient(samples[..., :2], DT_S, axis=0, edge_order=2)
    left = slope - made.library.evaluate(samples) @ coef
    return np.sqrt(np.square(left).mean(axis=0) / np.square(slope).mean(axis=0)).max(axis=-1)


def test_a_field_of_regions_is_a_field_inside_the_channel() -> None:
    made, thruster = small(), Thruster()
    check_field(made.field)
    z, r = made.field["z"].values, made.field["r"].values
    assert 0.0 < z.min() < z.max() < thruster.channel_length
    assert thruster.inner_radius < r.min() < r.max() < thruster.outer_radius
    for name, low, high in (("n_i", 1e16, 1e19), ("n_n", 5e17, 1e19)):
        assert low < float(made.field[name].min()) < float(made.field[name].max()) < high


@pytest.mark.parametrize("region", list(REGIONS))
def test_points_inside_a_region_follow_its_equations_and_no_others(region: str) -> None:
    made = small(transition=1e-3)
    own = (made.labels == list(REGIONS).index(region)).values
    assert own.any()
    # Differences leave (omega dt)^2 / 6: up to 3 % at the sharpest peaks, four times 14 kHz.
    assert residuals(made, region)[own].max() < 0.03
    for other in set(REGIONS) - {region}:
        assert residuals(made, other)[own].min() > 0.15


def test_integration_is_of_order_four() -> None:
    steps = np.array([1, 2, 4])
    ends = [
        values(
            three_regions(
                n_z=3, n_r=4, n_samples=1 + 60 * int(k), dt_s=3e-6 / k, transition=0.05
            ).field
        )[-1, ..., :2]
        for k in (*steps, 32)
    ]
    errors = [np.abs(end / ends[-1] - 1.0).max() for end in ends[:-1]]
    order = -np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order == pytest.approx(4.0, abs=0.3)


def test_equations_pass_smoothly_from_one_region_to_the_next() -> None:
    made = small()
    assert made.share.sum("region").values == pytest.approx(1.0)
    inside = [float(small(transition=width).inside.mean()) for width in (1e-3, 0.02, 0.1)]
    assert all(wide < narrow for narrow, wide in pairwise(inside))
    assert set(np.unique(made.labels.values[made.inside.values])) == {0, 1, 2}


def test_noise_is_a_share_of_the_rms_of_every_point() -> None:
    made = small(n_samples=2000)
    noisy = made.noisy(0.05, rng=np.random.default_rng(0))
    rms = np.sqrt(np.square(values(made.field)).mean(axis=0))
    share = (values(noisy.field) - values(made.field)).std(axis=0) / rms
    # 2000 samples: the spread of a standard deviation is 1/sqrt(2 n) = 1.6 %; 280 of them.
    assert share == pytest.approx(np.full(share.shape, 0.05), rel=5 * 0.016)
    assert noisy.field["n_i"].attrs == made.field["n_i"].attrs
    check_field(noisy.field)
