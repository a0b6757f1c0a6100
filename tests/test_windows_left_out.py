from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.refinement.ode import unconstrained
from ep2sindy.refinement.windows import WindowBatch, cut_windows
from ep2sindy.regression.front import Candidate, ParetoFront
from ep2sindy.runtime.progress import SILENT
from ep2sindy.selection import by_windows, systems
from ep2sindy.selection.by_windows import WindowsLeftOut
from ep2sindy.selection.criteria import MAX_ERROR
from ep2sindy.selection.systems import BatchRefinement, Fold, TrialSystem, refine_systems
from ep2sindy.systems.draws import realization
from ep2sindy.systems.systems import System, damped_oscillator
from tests.models import plain_rows

PREY = ep.lotka_volterra()
RULE = ep.FreeRunScore(bounds=None)
Terms = dict[str, float]


def fronts_of(
    runs: list[ep.Trajectory], library: ep.Library, choices: dict[str, list[Terms]]
) -> list[ParetoFront]:
    """One front per equation, of given candidates after the empty one."""
    values = np.concatenate([run.columns(library.variables) for run in runs])
    target = np.concatenate([run.states for run in runs])
    rows = plain_rows(library.evaluate(values), target, library, runs[0].state_names)
    rows = replace(rows, trajectories=tuple(runs))
    fronts = []
    for equation, given in choices.items():
        candidates = [
            Candidate(
                equation,
                tuple(coef),
                np.array(list(coef.values())),
                1.0 - 0.1**k,
                np.nan,
                1.0,
                np.ones(len(coef)),
            )
            for k, coef in enumerate([{}, *sorted(given, key=len)])
        ]
        fronts.append(ParetoFront(equation, candidates, rows))
    return fronts


def scores_by(rule: ep.FreeRunScore, fronts: list[ParetoFront]) -> list[np.ndarray]:
    rows = fronts[0].rows
    return list(rule.decide(fronts, DiscoveryProblem(rows.trajectories, rows.library)).scores)


def picked(rule: ep.FreeRunScore, fronts: list[ParetoFront]) -> list[set[str]]:
    scores = scores_by(rule, fronts)
    return [set(f.with_scores(s).best.terms) for f, s in zip(fronts, scores, strict=True)]


def supports(system: System) -> list[set[str]]:
    return [set(system.model.terms(s)) for s in system.model.states]


def next_to_truth(system: System, wrong: dict[str, list[Terms]]) -> dict[str, list[Terms]]:
    return {s: [system.model.terms(s), *wrong[s]] for s in system.model.states}


WRONG = {
    # One term short, another wrong, one too many.
    "Lotka-Volterra": {
        "x": [{"x*y": -0.5}, {"x": 0.66, "x*y": -1.0, "x^2": 0.003}],
        "y": [{"x*y": 0.4}, {"y": -0.3, "x*y": 1.0, "y^2": 0.01}],
    },
    "Lorenz": {
        "x": [],
        "y": [{"x": 26.5, "x*z": -0.97}, {"x": 28.0, "y": -1.0, "x*z": -1.0, "z": 1e-3}],
        "z": [],
    },
}


@pytest.mark.parametrize(
    "system", [PREY, pytest.param(ep.lorenz(), marks=pytest.mark.slow)], ids=lambda s: s.name
)
def test_the_truth_is_selected_from_exact_samples(system: System) -> None:
    run = system.trajectory().window(0, 600)
    fronts = fronts_of([run], system.model.library, next_to_truth(system, WRONG[system.name]))
    found = scores_by(RULE, fronts)
    chosen = [f.with_scores(scores).best for f, scores in zip(fronts, found, strict=True)]
    assert [set(c.terms) for c in chosen] == supports(system)
    assert max(scores.min() for scores in found) < 1.0


@pytest.mark.parametrize("noise", [pytest.param(0.0, marks=pytest.mark.slow), 0.05])
def test_biased_coefficients_of_the_truth_are_mended(noise: float) -> None:
    # A needless term next to good coefficients competes with the truth and poor ones.
    run = PREY.trajectory(noise=noise, rng=np.random.default_rng(0))
    poor = {
        s: {name: c * (1.0 + 0.2 * (-1) ** k) for k, (name, c) in enumerate(terms.items())}
        for s, terms in ((s, PREY.model.terms(s)) for s in PREY.model.states)
    }
    good = {s: PREY.model.terms(s) | {"1": 1e-4} for s in PREY.model.states}
    fronts = fronts_of([run], PREY.model.library, {s: [poor[s], good[s]] for s in poor})
    assert picked(RULE, fronts) == supports(PREY)


def test_equations_without_terms_take_part_and_can_win() -> None:
    t = np.linspace(0.0, 6.0, 300)
    rng = np.random.default_rng(0)
    states = np.stack([np.ones(300), np.exp(-t)], axis=1) + 0.02 * rng.standard_normal((300, 2))
    run = ep.Trajectory(t, states, ["x", "y"])
    choices = {"x": [{"x": 0.01}], "y": [{"y": -0.8}]}
    fronts = fronts_of([run], ep.polynomial(["x", "y"], degree=1), choices)
    assert picked(RULE, fronts) == [set(), {"y"}]


def test_inputs_drive_the_refinement() -> None:
    # x' = u - x with u = 2 cos t: x = cos t + sin t; samples at unequal steps.
    t = np.sort(np.random.default_rng(0).uniform(0.0, 30.0, 600))
    run = ep.Trajectory(t, (np.cos(t) + np.sin(t))[:, None], ["x"], 2.0 * np.cos(t)[:, None], ["u"])
    choices = {"x": [{"u": 1.0}, {"u": 0.7, "x": -1.2}]}
    library = ep.polynomial(["u", "x"], degree=1)  # the library's order is its own
    assert picked(RULE, fronts_of([run], library, choices)) == [{"u", "x"}]


def test_units_do_not_matter_to_windows() -> None:
    run = PREY.trajectory(noise=0.05, rng=np.random.default_rng(1)).window(0, 500)
    library, choices = PREY.model.library, next_to_truth(PREY, WRONG["Lotka-Volterra"])
    degree = dict(zip(library.names, library.exponents.sum(axis=1), strict=True))
    dense = ep.Trajectory(run.t * 1e-6, run.states * 1e18, run.state_names)
    converted = {
        s: [{n: c * 1e6 * 1e18 ** (1.0 - degree[n]) for n, c in terms.items()} for terms in given]
        for s, given in choices.items()
    }
    plain = scores_by(RULE, fronts_of([run], library, choices))
    scaled = scores_by(RULE, fronts_of([dense], library, converted))
    for a, b in zip(plain, scaled, strict=True):
        assert b == pytest.approx(a, rel=1e-4)


def test_a_combination_that_diverges_gets_the_largest_error() -> None:
    system = damped_oscillator()
    library = ep.polynomial(["x", "v"], degree=3)
    choices = {"x": [{"v": 1.0}, {"1": 1e200, "x^3": 1e200}], "v": [{"x": -9.0, "v": -0.6}]}
    run = system.trajectory().window(0, 600)
    scores = scores_by(RULE, fronts_of([run], library, choices))
    assert scores[0][2] == MAX_ERROR
    assert scores[0][1] < 1.0


def test_what_refines_does_not_assess(monkeypatch: pytest.MonkeyPatch) -> None:
    fitted: list[np.ndarray] = []
    held: list[np.ndarray] = []

    def seen(runs: list[ep.Trajectory], model: ep.SparseModel, **settings: object) -> WindowBatch:
        batch = cut_windows(runs, model, **settings)
        places, n = zip(batch.trajectory, batch.start, strict=True), batch.data.shape[1]
        fitted.append(np.concatenate([runs[j].t[k : k + n] for j, k in places]))
        return batch

    def assess(
        measure: WindowsLeftOut, trials: list, refined: object, fold: Fold, *rest: object
    ) -> np.ndarray:
        times = [measure.runs[w.run].t[w.start : w.stop] for w in fold.held]
        held.append(np.concatenate(times))
        return assess_held(measure, trials, refined, fold, *rest)

    assess_held = WindowsLeftOut.assess
    monkeypatch.setattr(systems, "cut_windows", seen)
    monkeypatch.setattr(WindowsLeftOut, "assess", assess)
    run = PREY.trajectory()
    parts = [run.window(0, 450), run.window(600, 990)]
    choices = {s: [PREY.model.terms(s)] for s in PREY.model.states}
    fronts = fronts_of(parts, PREY.model.library, choices)
    assert picked(replace(RULE, n_windows=10), fronts) == supports(PREY)
    assert len(fitted) == len(held) == 3
    for own, others in zip(held, fitted, strict=True):
        assert not set(own) & set(others)
        assert len(set(own)) == len(own)


def test_two_windows_refine_and_assess_by_turns() -> None:
    run = PREY.trajectory(noise=0.05, rng=np.random.default_rng(1)).window(0, 400)
    fronts = fronts_of([run], PREY.model.library, next_to_truth(PREY, WRONG["Lotka-Volterra"]))
    assert picked(replace(RULE, n_windows=2), fronts) == supports(PREY)


@pytest.mark.parametrize("number", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_windows_without_a_jump_do_not_decide_alone(number: int) -> None:
    # Half of the windows of a slow relaxation oscillator hold none of its two or three jumps, and
    # any multiple of the fast equation follows them.
    system, (run,) = realization("van_der_pol", 0.05, number, seed=7)
    terms = {s: system.model.terms(s) for s in system.model.states}
    choices = {"x": [terms["x"]], "y": [terms["y"], {"x^3": 0.5 * terms["y"]["x"]}]}
    assert picked(RULE, fronts_of([run], system.model.library, choices)) == supports(system)


def test_a_refinement_that_fails_leaves_the_model_and_the_others_as_they_were() -> None:
    library = ep.polynomial(["x", "y"], degree=4)
    truth = {s: PREY.model.terms(s) for s in ("x", "y")}
    wild = ep.SparseModel(
        library, ["x", "y"], ep.model.coef_matrix(library, [{"x^2*y^2": 1e200}, {"y": 1e3}])
    )
    sound = ep.SparseModel(library, ["x", "y"], ep.model.coef_matrix(library, list(truth.values())))
    batch = cut_windows([PREY.trajectory()], PREY.model, n_windows=3, window=50, rng=1)
    trials = [TrialSystem(each, unconstrained(each)) for each in (wild, sound)]
    found = refine_systems(trials, batch)
    kept, good = found.models
    assert found.loss[0] == np.inf
    assert found.loss[1] < 1e-8
    np.testing.assert_array_equal(kept.coef, wild.coef)
    np.testing.assert_allclose(good.coef, sound.coef, rtol=1e-5, atol=1e-12)


def test_windows_left_out_are_followed_from_fitted_starts() -> None:
    """Of the right model the noise alone is left; one that blows up is nowhere."""
    run = PREY.trajectory(noise=0.05, rng=np.random.default_rng(0))
    wild = ep.SparseModel(PREY.model.library, ["x", "y"], 1e9 * PREY.model.coef)
    measure = WindowsLeftOut([run], np.ones(2), ["x", "y"], 8, 2)
    models, (fold, _) = [PREY.model, wild], measure.folds
    held = BatchRefinement(models, np.ones(2))
    trials = [TrialSystem(each, unconstrained(each)) for each in models]
    followed, lost = measure.assess(trials, held, fold, SILENT)
    assert followed.shape == (len(fold.held), measure.window, 2)
    half = replace(measure, spread=2.0 * measure.spread)
    np.testing.assert_array_equal(half.assess(trials, held, fold, SILENT)[0], 0.5 * followed)
    noise = (run.states - PREY.trajectory().states).std(axis=0)
    assert np.square(followed / noise).mean() == pytest.approx(1.0, rel=0.2)
    assert not np.isfinite(lost[:, -1]).any()


def pieces_of(*lengths: int) -> list[ep.Trajectory]:
    run = PREY.trajectory()
    return [run.window(0, length) for length in lengths]


@pytest.mark.parametrize(
    ("lengths", "window"),
    [
        ([240, 100], 40),  # as wanted
        ([100, 30], 21),  # three pairs of 130 samples
        ([9, 10], 5),  # the fewest samples of a window
        ([20] * 20, 10),  # half of the longest record
    ],
)
def test_a_window_leaves_room_for_another(
    monkeypatch: pytest.MonkeyPatch, lengths: list[int], window: int
) -> None:
    monkeypatch.setattr(by_windows, "dominant_window", lambda runs, states: 40)
    runs = pieces_of(*lengths)
    assert WindowsLeftOut(runs, np.ones(2), ["x", "y"], 20, 3).window == window
    short = WindowsLeftOut([runs[0].window(0, 9), runs[0].window(0, 8)], *[None] * 4)
    with pytest.raises(ValueError, match="of 5 samples or more, got at most 9; use longer records"):
        _ = short.window


def test_a_window_is_no_longer_than_the_longest_segment() -> None:
    parts = [systems.Segment(0, 0, 60), systems.Segment(1, 20, 100)]
    cut = systems.cut_segments(pieces_of(60, 100), parts, PREY.model, window=500, n_windows=2)
    assert cut.data.shape[1] == 80


def test_pairs_of_windows_are_spread_over_every_record_by_its_length() -> None:
    measure = WindowsLeftOut(pieces_of(600, 300, 40), np.ones(2), ["x", "y"], 12, 3)
    measure.__dict__["window"] = 30
    starts = [(0, 0), (0, 180), (0, 360), (0, 540), (1, 0), (1, 240)]  # the last has no room
    pairs = [systems.Segment(run, k, k + 30) for run, at in starts for k in (at, at + 30)]
    assert [fold.held for fold in measure.folds] == [pairs[k::3] for k in range(3)]


def test_residuals_alike_from_sample_to_sample_count_as_fewer() -> None:
    same, turning = np.ones((3, 8, 1)), (-1.0) ** np.arange(24).reshape(3, 8, 1)
    # rho = 7/8, and below zero, which adds nothing.
    assert by_windows._independent(same) == pytest.approx(24 / 15, rel=1e-14)
    assert by_windows._independent(np.dstack([same, turning])) == pytest.approx(24 / 15 + 24)
