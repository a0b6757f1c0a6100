from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
import pytest
from numpy import nan

import ep2sindy as ep
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import Finding, Regression, TrajectorySearch
from ep2sindy.library.library import Library
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.formulations import Differential, RandomSplit, Weak
from ep2sindy.regression.searches import STLSQ, AdaptiveLasso, BestSubset
from ep2sindy.regression.windows import Boxes
from ep2sindy.runtime.parallel import Serial
from ep2sindy.runtime.progress import SILENT, Progress, as_progress
from ep2sindy.selection.criteria import Knee
from ep2sindy.studies.benchmark import (
    Study,
    Variant,
    cells,
    coefficient_error,
    merits,
)
from ep2sindy.systems.draws import realization
from ep2sindy.systems.systems import damped_oscillator
from tests.rules import BySize

TRUTH = {"x": frozenset({"v"}), "v": frozenset({"x", "v"})}  # of the oscillator
# Draws random bootstraps and a random split: its outcome hangs on its stream.
BALASSO = Regression(Differential(), AdaptiveLasso(), Knee(), Bootstraps(n=4))
STLSQ_ = Regression(Differential(), STLSQ(), Knee(), Bootstraps(n=0))
UNWEIGHTED = Weak(split=RandomSplit(test_fraction=0.0), errors_in_variables=False)
SAMPLED = {
    "systems": [ep.lotka_volterra()], "noises": [0.0], "n_realizations": None,
    "rates_Hz": [0.1, 2.0, 20.0], "durations_s": [2.0, 50.0],
}  # fmt: skip


def boxes(n_windows: int, n_points: int) -> Weak:
    windows = Boxes(n_windows=n_windows, n_points=n_points)
    return replace(UNWEIGHTED, test_functions=windows, smooth_library=False)


@dataclass
class Scripted:
    """Gives the findings it was told to give, and keeps the random numbers it was given."""

    findings: list[Finding]
    drawn: list[float] = field(default_factory=list)

    def find(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator
    ) -> Finding:
        self.drawn.append(rng.random())
        return self.findings.pop(0)


def benchmark(
    variants: Mapping[str, Variant],
    *,
    seed: int = 0,
    progress: Progress = SILENT,
    **settings,
) -> pd.DataFrame:
    study = Study(variants=list(variants), definitions={}, parallel=Serial(), **settings)
    return study.outcomes(variants, seed=seed, progress=progress)


def outcomes_of(**settings) -> pd.DataFrame:
    """Without the time, which no seed fixes."""
    defaults = {"systems": ["lotka_volterra"], "noises": [0.2], "n_realizations": 2}
    return benchmark(**(defaults | settings)).drop(columns="cpu_s")


@pytest.mark.parametrize(
    "name", ["oscillator", pytest.param("lotka_volterra", marks=pytest.mark.slow)]
)
def test_a_seed_fixes_every_realization(name: str) -> None:
    (first, (run,)), (again, (same,)) = (realization(name, 0.05, 3, seed=1) for _ in range(2))
    np.testing.assert_array_equal(run.states, same.states)
    np.testing.assert_array_equal(first.model.coef, again.model.coef)
    for number, seed in ((4, 1), (3, 2)):
        _, (other,) = realization(name, 0.05, number, seed=seed)
        assert not np.array_equal(run.states, other.states)


@pytest.mark.parametrize("name", ["oscillator", "van_der_pol"])
def test_noise_levels_share_the_draw_and_scale_the_same_noise(name: str) -> None:
    systems, runs = zip(*(realization(name, noise, 0) for noise in (0.0, 0.05, 0.2)), strict=True)
    for system in systems:
        np.testing.assert_array_equal(system.model.coef, systems[0].model.coef)
    clean, low, high = (run.states for (run,) in runs)
    np.testing.assert_allclose(high - clean, 4.0 * (low - clean), atol=1e-11)
    rms = np.sqrt(np.square(clean).mean(axis=0))
    # Standard deviation of n normal numbers: to 1 / sqrt(2 n), five times over.
    np.testing.assert_allclose((low - clean).std(axis=0), 0.05 * rms, rtol=5 / np.sqrt(2e3))


def test_further_trajectories_leave_the_first_as_it_was() -> None:
    _, (alone,) = realization("van_der_pol", 0.05, 0)
    _, (first, second) = realization("van_der_pol", 0.05, 0, n_trajectories=2)
    np.testing.assert_array_equal(first.states, alone.states)
    assert not np.allclose(first.states[0], second.states[0], atol=0.5)


def test_every_variant_has_a_stream_of_its_own() -> None:
    nothing = Finding(kept={"x": [], "y": []}, selected=None)
    alone, beside = Scripted([nothing] * 2), Scripted([nothing] * 2)
    outcomes_of(variants={"scripted": alone})
    outcomes_of(variants={"STLSQ": STLSQ_, "scripted": beside})
    assert alone.drawn == beside.drawn
    assert len(set(alone.drawn)) == 2


@pytest.mark.parametrize(
    ("variants", "settings"),
    [
        ({"STLSQ": STLSQ_, "BALASSO": BALASSO}, {}),
        ({"STLSQ": STLSQ_, "BALASSO": BALASSO}, SAMPLED),
        ({"automatic": UNWEIGHTED, "boxes": boxes(100, 10)}, {"systems": [ep.lotka_volterra()]}),
    ],
)
def test_leaving_a_variant_out_changes_no_other(variants: dict, settings: dict) -> None:
    both, last = outcomes_of(variants=variants, **settings), list(variants)[-1]
    kept = both[both["variant"] == last].reset_index(drop=True)
    pd.testing.assert_frame_equal(kept, outcomes_of(variants={last: variants[last]}, **settings))


def test_known_findings_give_exact_counts() -> None:
    wrong = {"x": frozenset({"x"}), "v": frozenset({"v"})}
    half = TRUTH | {"v": frozenset({"v"})}
    whole = {state: [frozenset(), terms] for state, terms in TRUTH.items()}
    off_front = whole | {"v": [frozenset({"x"})]}
    pairs = (whole, TRUTH), (whole, half), (off_front, wrong), (whole, wrong)
    variants = {"scripted": Scripted([Finding(*pair) for pair in pairs])}
    n_done: list[int] = []
    settings = {"systems": ["oscillator"], "noises": [0.0], "n_realizations": 4}
    outcomes = benchmark(variants, **settings, progress=as_progress(n_done.append))
    assert sum(n_done) == 4
    assert outcomes["number"].tolist() == [0, 1, 2, 3]
    assert outcomes["on_front"].tolist() == [1, 1, 0, 1]
    assert outcomes["selected"].tolist() == [1, 0, 0, 0]  # half of the system is not right
    assert outcomes["correct_terms"].tolist() == [3, 2, 1, 1]
    (cell,) = cells(outcomes).to_dict("records")
    assert (cell["on_front"], cell["selected"], cell["n"]) == (3, 1, 4)
    assert cell["mean_correct_terms"] == 7 / 4


def test_a_variant_that_selects_nothing_has_no_number_there() -> None:
    found = merits(Finding({s: [t] for s, t in TRUTH.items()}, None), damped_oscillator())
    assert found["on_front"] == 1.0
    assert np.isnan([found["selected"], found["correct_terms"]]).all()
    finding = Finding({s: [t] for s, t in TRUTH.items()}, None)
    settings = {"systems": ["oscillator"], "noises": [0.0], "n_realizations": 2}
    table = cells(benchmark({"free": Scripted([finding] * 2)}, **settings))
    assert table["on_front"].item() == 2
    assert table[["selected", "mean_correct_terms"]].isna().to_numpy().all()


def test_this_packages_path_is_a_variant_and_keeps_the_empty_support() -> None:
    assert isinstance(BALASSO, Variant)
    system, runs = realization("lotka_volterra", 0.0, 0)
    found = BALASSO.find(runs, system.model.library, rng=np.random.default_rng(0))
    assert merits(found, system) == {"on_front": 1.0, "selected": 1.0, "correct_terms": 4.0}
    assert all(kept[0] == frozenset() for kept in found.kept.values())


def test_a_search_of_trajectories_finds_what_its_rule_selects() -> None:
    system, runs = realization("lotka_volterra", 0.05, 0, n_trajectories=1, seed=0)
    library = system.model.library
    plain = TrajectorySearch(max_terms=3)
    by_size = replace(plain, selection=BySize())
    found, largest = (method.find(runs, library, rng=0) for method in (plain, by_size))
    assert largest.kept == found.kept
    assert found.selected == {s: frozenset(system.model.terms(s)) for s in ("x", "y")}
    assert {len(terms) for terms in found.selected.values()} == {2}
    model = discover(runs, library, by_size).model
    assert largest.selected == {s: frozenset(model.terms(s)) for s in ("x", "y")}
    assert {len(terms) for terms in largest.selected.values()} == {3}


def test_a_wider_library_holds_the_same_model() -> None:
    system, (run,) = realization("lorenz", 0.0, 0)
    wider, (same,) = realization("lorenz", 0.0, 0, degree=3)
    assert len(wider.model.library) == 20
    assert np.array_equal(run.states, same.states)
    for state in system.model.states:
        assert wider.model.terms(state) == system.model.terms(state)
    with pytest.raises(ValueError, match=r"terms of Lorenz, of degree 2 or more, got degree=1"):
        realization("lorenz", 0.0, 0, degree=1)


def test_long_and_fast_samples_identify_and_few_do_not() -> None:
    plain = Regression(Differential(smooth_library=False), BestSubset(max_terms=3), Knee())
    points = outcomes_of(variants={"plain": plain}, **SAMPLED).set_index(["rate_Hz", "duration_s"])
    # Never less identified for being longer; and what could not run, was not.
    assert points["on_front"].to_dict() == pytest.approx(
        {(20, 50): 1, (20, 2): 1, (2, 50): 1, (2, 2): nan, (0.1, 50): nan, (0.1, 2): nan},
        nan_ok=True,
    )
    assert points.loc[(0.1, 2.0), "reason"] == "a trajectory needs two samples: 0 fit in"
    assert "smoothing needs at least 11 samples" in points.loc[(2.0, 2.0), "reason"]
    assert points.loc[(20.0, 50.0), "reason"] == ""
    with pytest.raises(ValueError, match="smoothing needs at least 11 samples"):
        outcomes_of(variants={"plain": plain}, **SAMPLED | {"rates_Hz": [1], "durations_s": [5]})


@pytest.mark.parametrize("n_points", [2, 10])
def test_without_noise_errors_are_those_of_the_trapezoidal_rule(n_points: int) -> None:
    rates_Hz = np.array([15.0, 30.0, 60.0])
    errors = [error_of(boxes(2000, n_points), rate_Hz) for rate_Hz in rates_Hz]
    # A window's mean is off by dt^2 / 12 (f'(end) - f'(start)) / length, whatever its length.
    order = np.polyfit(np.log(1.0 / rates_Hz), np.log(errors), 1)[0]
    assert order == pytest.approx(2.0, abs=0.1)
    assert errors[1] < (1.0 / 30.0) ** 2 / 12.0


def error_of(form: Weak, rate_Hz: float) -> float:
    system, runs = realization(ep.lotka_volterra(), rate_Hz=rate_Hz, duration_s=40.0)
    return coefficient_error(form, system, runs, rng=np.random.default_rng(0))


def test_without_noise_smooth_windows_find_the_coefficients() -> None:
    for form in (UNWEIGHTED, replace(UNWEIGHTED, errors_in_variables=True)):
        # The bump falls to 1e-10 at its edge; the integration has 1e-10.
        assert error_of(form, 30.0) < 1e-8


def errors_of(forms: Mapping[str, Weak], noises: Sequence[float], **settings) -> pd.DataFrame:
    shared = {"systems": [ep.lotka_volterra()], "rates_Hz": [30.0], "durations_s": [40.0]}
    return benchmark(forms, noises=noises, **shared, **settings)


def test_more_and_longer_windows_bear_more_noise() -> None:
    forms = {f"{n}_{length}": boxes(n, length) for n in (100, 2000) for length in (10, 100)}
    means = cells(errors_of(forms, [0.0, 0.05], n_realizations=4, seed=1))
    assert means["n"].tolist() == [4] * 2 * 4
    noisy = means[means["noise"] == 0.05].set_index("variant")["error_mean"]
    assert noisy["2000_100"] < noisy["2000_10"] < noisy["100_10"]
    assert noisy["2000_100"] < noisy["100_100"] < noisy["100_10"]


def test_levels_of_noise_share_their_draws() -> None:
    errors = errors_of({"boxes": boxes(2000, 100)}, [0.005, 0.01], n_realizations=1)
    # The first order in the noise doubles; the rest is noise^2 and the trapezoidal rule.
    small, large = errors["error"]
    assert large / small == pytest.approx(2.0, rel=0.05)
