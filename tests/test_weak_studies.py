from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

import ep2sindy as ep
from ep2sindy.app.schema import Configured
from ep2sindy.runtime.parallel import Serial
from ep2sindy.studies import frontier as frontiers
from ep2sindy.studies import weak_windows
from ep2sindy.studies.weak import Setting, boxes_grid, fit_settings
from ep2sindy.studies.weak_windows import (
    coefficient_error,
    true_library,
    window_cells,
)
from ep2sindy.systems.systems import System

EVERY_ROW = ep.RandomSplit(test_fraction=0.0)
BOXES = ep.Weak(
    test_functions=ep.Boxes(),
    smooth_library=False,
    split=EVERY_ROW,
    errors_in_variables=False,
)
AUTOMATIC = ep.Weak(split=EVERY_ROW)


def sampled(*, rate_Hz: float = 30.0, duration_s: float = 40.0) -> System:
    return replace(ep.lotka_volterra(), rate_Hz=rate_Hz, duration_s=duration_s)


def boxes(n_windows: int, n_points: int) -> Setting:
    return Setting(replace(BOXES, test_functions=ep.Boxes(n_windows=n_windows, n_points=n_points)))


def coefficient_errors(
    system: System,
    settings: Mapping[str, Setting],
    *,
    noises: Sequence[float],
    n_realizations: int,
    seed: int = 0,
) -> pd.DataFrame:
    forms = {"formulation": ep.Differential(), "automatic": AUTOMATIC, "parallel": Serial()}
    form = Configured({"_target_": "ep2sindy.Weak"}, "boxes")
    study = weak_windows.Study(
        system=system, rate_Hz=system.rate_Hz, boxes=form, n_windows=[1], n_points=[2],
        noises=noises, n_realizations=n_realizations, **forms,
    )  # fmt: skip
    return study.errors(settings, seed=seed)


TERMS = {"x": ["x", "x*y"], "y": ["y", "x*y"]}


@pytest.mark.parametrize("n_points", [2, 10])
def test_without_noise_errors_are_those_of_the_trapezoidal_rule(n_points: int) -> None:
    rates_Hz = np.array([15.0, 30.0, 60.0])
    errors = [
        coefficient_error(
            system, system.trajectory(), boxes(2000, n_points), rng=np.random.default_rng(0)
        )
        for system in (sampled(rate_Hz=rate) for rate in rates_Hz)
    ]
    # A window's mean is off by dt^2 / 12 (f'(end) - f'(start)) / length, whatever its length.
    order = np.polyfit(np.log(1.0 / rates_Hz), np.log(errors), 1)[0]
    assert order == pytest.approx(2.0, abs=0.1)
    assert errors[1] < (1.0 / 30.0) ** 2 / 12.0


def test_without_noise_smooth_windows_find_the_coefficients() -> None:
    for weighted in (False, True):
        system = sampled()
        setting = Setting(AUTOMATIC, weighted=weighted)
        error = coefficient_error(
            system, system.trajectory(), setting, rng=np.random.default_rng(0)
        )
        assert error < 1e-8  # the bump falls to 1e-10 at its edge; the integration has 1e-10


def test_more_and_longer_windows_bear_more_noise() -> None:
    settings = boxes_grid(BOXES, n_windows=[100, 2000], n_points=[10, 100])
    errors = coefficient_errors(sampled(), settings, noises=[0.0, 0.05], n_realizations=4, seed=1)
    assert len(errors) == 4 * 2 * 4
    cells = window_cells(errors, settings)
    assert (cells["n"] == 4).all()
    noisy = cells[cells["noise"] == 0.05].set_index(["n_windows", "n_points"])["error_mean"]
    assert noisy[2000, 100] < noisy[2000, 10] < noisy[100, 10]
    assert noisy[2000, 100] < noisy[100, 100] < noisy[100, 10]


def test_leaving_a_setting_out_changes_no_other() -> None:
    settings = {"boxes": boxes(100, 10), "automatic": Setting(AUTOMATIC)}
    both = coefficient_errors(sampled(), settings, noises=[0.1], n_realizations=2)
    del settings["automatic"]
    alone = coefficient_errors(sampled(), settings, noises=[0.1], n_realizations=2)
    kept = both[both["setting"] == "boxes"].reset_index(drop=True)
    pd.testing.assert_frame_equal(kept, alone)


def test_levels_of_noise_share_their_draws() -> None:
    settings = {"boxes": boxes(2000, 100)}
    errors = coefficient_errors(sampled(), settings, noises=[0.005, 0.01], n_realizations=1)
    # The first order in the noise doubles; the rest is noise^2 and the trapezoidal rule.
    small, large = errors["error"]
    assert large / small == pytest.approx(2.0, rel=0.05)


def test_a_grid_is_named_by_what_varies() -> None:
    assert list(boxes_grid(BOXES, n_windows=[7], n_points=[5, 9])) == ["n_points_5", "n_points_9"]
    assert list(boxes_grid(BOXES, n_windows=[7], n_points=[5])) == ["n_points_5"]
    both = boxes_grid(BOXES, n_windows=[7, 8], n_points=[5, 9])
    assert both["n_windows_8_n_points_9"].boxes == ep.Boxes(n_windows=8, n_points=9)


def fitted(run: ep.Trajectory, settings: dict[str, Setting]) -> dict:
    return fit_settings(
        run,
        true_library(ep.lotka_volterra()),
        TERMS,
        settings,
        rollout_s=None,
        rng=np.random.default_rng(0),
    )


def test_every_form_follows_exact_data() -> None:
    run = sampled().trajectory()
    settings = {
        "differential": Setting(ep.Differential(split=EVERY_ROW)),
        "boxes": boxes(1000, 50),
        "automatic": Setting(AUTOMATIC),
        "automatic_weighted": Setting(AUTOMATIC, weighted=True),
    }
    for name, found in fitted(run, settings).items():
        assert found.integrated.is_similar  # fewer than three periods: no cycle
        assert found.r2 == pytest.approx({"x": 1.0, "y": 1.0}, abs=1e-5)
        # 40 s hold less than three periods: a spectral line of that width, and no cycle to compare
        assert found.integrated.frequency_Hz["x"] == pytest.approx(1.0 / 15.0, rel=0.2)
        assert np.isnan(found.integrated.f_error)
        assert (found.integrated.model.covariance is not None) == (name == "automatic_weighted")
    bumps = fitted(run, {"automatic": Setting(AUTOMATIC)})["automatic"]
    for state, x in zip(run.state_names, run.states.T, strict=True):
        windows = ep.Bumps().windows(run.t, x, rng=np.random.default_rng(0))
        assert 2 * bumps.half_width[state] + 1 == windows.mean.indptr[1]


def test_a_weighted_fit_needs_rows_that_know_their_noise() -> None:
    with pytest.raises(ValueError, match="a weighted fit needs the formulation Weak with"):
        Setting(ep.Differential(), weighted=True)


def test_windows_longer_than_the_data_are_refused() -> None:
    system = sampled(duration_s=2.0)
    settings = {"automatic": Setting(AUTOMATIC), "boxes": boxes(100, 61)}
    message = "windows must fit the data: n_points=61 was asked of 60 samples"
    with pytest.raises(ValueError, match=message):
        fitted(system.trajectory(), settings)
    with pytest.raises(ValueError, match=message):
        coefficient_errors(system, settings, noises=[0.0], n_realizations=1)


@pytest.mark.parametrize(
    "settings", [{"n_realizations": 0}, {"noises": []}, {"settings": {}}], ids=str
)
def test_errors_of_nothing_are_refused(settings: dict) -> None:
    defaults = {"settings": {"boxes": boxes(10, 2)}, "noises": [0.0], "n_realizations": 1}
    with pytest.raises(ValueError, match="there must be something to run"):
        coefficient_errors(sampled(), **(defaults | settings))


VARIANT = ep.Regression(
    formulation=ep.Differential(smooth_library=False),
    search=ep.BestSubset(max_terms=3),
    selection=ep.Knee(),
    bootstraps=ep.Bootstraps(n=0),
)
RESAMPLED = replace(VARIANT, bootstraps=ep.Bootstraps(n=4))


def frontier(**settings: object) -> pd.DataFrame:
    defaults: dict = {
        "variants": {"plain": VARIANT, "resampled": RESAMPLED},
        "rates_Hz": [0.1, 2.0, 20.0],
        "durations_s": [2.0, 50.0],
    }
    arguments = defaults | settings
    variants = arguments.pop("variants")
    study = frontiers.Study(
        ep.lotka_volterra(), **arguments, variants=list(variants), definitions={}, parallel=Serial()
    )
    return study.points(variants)


def test_long_and_fast_samples_identify_and_few_do_not() -> None:
    points = frontier().set_index(["variant", "rate_Hz", "duration_s"])
    for variant in ("plain", "resampled"):
        assert points.loc[(variant, 20.0, 50.0), "identified"]
        assert not points.loc[(variant, 0.1, 2.0), "identified"]
        for rate_Hz in (0.1, 2.0, 20.0):  # never less identified for being longer
            short, long = (points.loc[(variant, rate_Hz, d), "identified"] for d in (2.0, 50.0))
            assert long >= short


def test_too_few_samples_count_as_not_identified_and_say_why() -> None:
    points = frontier()
    assert not points.loc[points["reason"] != "", "identified"].any()
    reasons = points.set_index(["variant", "rate_Hz", "duration_s"])["reason"]
    assert reasons["plain", 0.1, 2.0] == "a trajectory needs two samples: 0 fit in"
    assert "smoothing needs at least 11 samples" in reasons["plain", 2.0, 2.0]
    assert reasons["plain", 20.0, 50.0] == ""


def test_a_variant_that_cannot_run_at_all_is_an_error() -> None:
    broken = replace(VARIANT, bootstraps=ep.Bootstraps(n=1, n_culled=6))
    with pytest.raises(ValueError, match="n_culled must leave a term"):
        frontier(variants={"broken": broken})


def test_leaving_a_variant_out_changes_no_other() -> None:
    both, alone = frontier(), frontier(variants={"resampled": RESAMPLED})
    kept = both[both["variant"] == "resampled"].reset_index(drop=True)
    pd.testing.assert_frame_equal(kept, alone)


def test_a_frontier_of_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="there must be something to run"):
        frontier(rates_Hz=[])
