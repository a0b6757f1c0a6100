"""Windows of the weak form under noise, and how fast and how long systems must be sampled."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import ep2sindy as ep
from ep2sindy.regression.rows import Formulation
from ep2sindy.runtime.parallel import Serial
from ep2sindy.studies import frontier as frontiers
from ep2sindy.studies import weak_windows
from ep2sindy.studies.weak_windows import coefficient_error, error_cells
from ep2sindy.systems.systems import System
from tests import programs, test_experiment_fits

EVERY_ROW = ep.regression.RandomSplit(test_fraction=0.0)
UNWEIGHTED = ep.Weak(split=EVERY_ROW, errors_in_variables=False)


def sampled(*, rate_Hz: float = 30.0, duration_s: float = 40.0) -> System:
    return replace(ep.lotka_volterra(), rate_Hz=rate_Hz, duration_s=duration_s)


def boxes(n_windows: int, n_points: int) -> ep.Weak:
    windows = ep.regression.Boxes(n_windows=n_windows, n_points=n_points)
    return replace(UNWEIGHTED, test_functions=windows, smooth_library=False)


def coefficient_errors(
    system: System,
    forms: Mapping[str, Formulation],
    *,
    noises: Sequence[float],
    n_realizations: int,
    seed: int = 0,
) -> pd.DataFrame:
    study = weak_windows.Study(
        system=system, rate_Hz=system.rate_Hz, formulation=ep.Differential(), fits={},
        noises=noises, n_realizations=n_realizations, parallel=Serial(),
    )  # fmt: skip
    return study.errors(forms, seed=seed)


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
    system, rng = sampled(), np.random.default_rng(0)
    for form in (UNWEIGHTED, ep.Weak(split=EVERY_ROW)):
        # The bump falls to 1e-10 at its edge; the integration has 1e-10.
        assert coefficient_error(system, system.trajectory(), form, rng=rng) < 1e-8


def test_more_and_longer_windows_bear_more_noise() -> None:
    forms = {f"{n}_{length}": boxes(n, length) for n in (100, 2000) for length in (10, 100)}
    errors = coefficient_errors(sampled(), forms, noises=[0.0, 0.05], n_realizations=4, seed=1)
    assert len(errors) == 4 * 2 * 4
    cells = error_cells(errors, forms)
    assert (cells["n"] == 4).all()
    noisy = cells[cells["noise"] == 0.05].set_index(["n_windows", "n_points"])["error_mean"]
    assert noisy[2000, 100] < noisy[2000, 10] < noisy[100, 10]
    assert noisy[2000, 100] < noisy[100, 100] < noisy[100, 10]


def test_leaving_a_form_out_changes_no_other() -> None:
    forms = {"boxes": boxes(100, 10), "automatic": UNWEIGHTED}
    both = coefficient_errors(sampled(), forms, noises=[0.1], n_realizations=2)
    del forms["automatic"]
    alone = coefficient_errors(sampled(), forms, noises=[0.1], n_realizations=2)
    kept = both[both["fit"] == "boxes"].reset_index(drop=True)
    pd.testing.assert_frame_equal(kept, alone)


def test_levels_of_noise_share_their_draws() -> None:
    forms = {"boxes": boxes(2000, 100)}
    errors = coefficient_errors(sampled(), forms, noises=[0.005, 0.01], n_realizations=1)
    # The first order in the noise doubles; the rest is noise^2 and the trapezoidal rule.
    small, large = errors["error"]
    assert large / small == pytest.approx(2.0, rel=0.05)


def test_weak_windows_runs_at_toy_size(tmp_path: Path) -> None:
    found = programs.computed(programs.composed(*test_experiment_fits.weak_windows(tmp_path)))
    cells = found.summary["cells"]
    assert len(cells) == 2 * (4 + 3)
    others = {cell["fit"] for cell in cells if cell["n_points"] is None}
    assert others == {"differential", "automatic", "automatic_weighted"}
    assert all(cell["n"] == 2 for cell in cells)
    assert found.report.headline["n_windows_100_n_points_10/error_10_percent"] > 0.0
    found.check_figures("errors")


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


def test_leaving_a_variant_out_changes_no_other() -> None:
    both, alone = frontier(), frontier(variants={"resampled": RESAMPLED})
    kept = both[both["variant"] == "resampled"].reset_index(drop=True)
    pd.testing.assert_frame_equal(kept, alone)
