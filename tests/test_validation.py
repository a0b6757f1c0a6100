from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.recipe import Recipe
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.model.many import MAX_ERROR, DrivenWindows, Ensemble
from ep2sindy.regression.rows import Regression
from ep2sindy.regression.weak import Weak
from ep2sindy.search.bootstraps import Bootstraps, pooled_supports
from ep2sindy.search.front import Candidate, ParetoFront, fit_support, pareto_front
from ep2sindy.search.searches import BestSubset
from ep2sindy.selection.integral import IntegralScore
from ep2sindy.selection.resampled import CrossValidation, Stability, blocked_folds
from ep2sindy.selection.rule import FLOOR, Selection, selected
from ep2sindy.systems.systems import (
    System,
    damped_oscillator,
    lorenz,
    lotka_volterra,
    van_der_pol,
)

SYSTEMS = [damped_oscillator(), lotka_volterra(), van_der_pol(), lorenz()]
NO_BOOTSTRAPS = Bootstraps(n=0)


def candidate(
    equation: str, coef: dict[str, float], *, error: float, inclusion: Sequence[float] = ()
) -> Candidate:
    return Candidate(
        equation=equation,
        terms=tuple(coef),
        coef=np.array(list(coef.values())),
        r2_train=1.0 - error,
        r2_test=float("nan"),
        share=0.5,
        inclusion=np.array(inclusion if len(inclusion) else np.ones(len(coef))),
    )


def rows_of(runs: Sequence[Trajectory], library: Library) -> Regression:
    """A regression that only its trajectories matter of."""
    values = np.concatenate([run.columns(library.variables) for run in runs])
    return Regression(
        theta=library.evaluate(values),
        target=np.concatenate([run.states for run in runs]),
        library=library,
        equations=runs[0].state_names,
        groups=np.arange(len(values)),
        test=np.zeros(len(values), dtype=np.bool_),
        trajectories=tuple(runs),
    )


def fronts_of(
    runs: Sequence[Trajectory], library: Library, choices: dict[str, list[dict[str, float]]]
) -> list[ParetoFront]:
    """One front per equation, of given candidates below one another, the empty one first."""
    problem = rows_of(runs, library)
    return [
        ParetoFront(
            equation,
            [
                candidate(equation, coef, error=1.0 / 10**k)
                for k, coef in enumerate([{}, *candidates])
            ],
            problem,
        )
        for equation, candidates in choices.items()
    ]


def picked(rule: Selection, fronts: Sequence[ParetoFront]) -> list[dict[str, float]]:
    scores = rule.scores(fronts)
    return [selected(f, s).coef_by_term for f, s in zip(fronts, scores, strict=True)]


# Stability


def stability_front(*inclusions: list[float]) -> ParetoFront:
    run = damped_oscillator().trajectory()
    names = ["1", "x", "v"]
    library = named_terms(["x", "v"], names)
    candidates = [
        candidate("x", dict.fromkeys(names[: len(i)], 1.0), error=0.1**k, inclusion=i)
        for k, i in enumerate([[], *inclusions])
    ]
    return ParetoFront("x", candidates, rows_of([run], library))


@pytest.mark.parametrize(
    ("inclusions", "n_terms"),
    [
        (([0.9], [0.8, 0.7], [0.9, 0.9, 0.6]), 2),
        (([0.6], [0.8, 0.7], [0.9, 0.9, 0.69]), 2),  # a smaller one need not be stable
        (([0.6], [0.8, 0.6], [0.9, 0.9, 0.6]), 0),  # the empty model always is
    ],
)
def test_the_largest_candidate_of_stable_terms_is_selected(
    inclusions: tuple[list[float], ...], n_terms: int
) -> None:
    front = stability_front(*inclusions)
    (scores,) = Stability(threshold=0.7).scores([front])
    assert selected(front, scores).n_terms == n_terms
    expected = [-len(i) if min(i, default=1.0) >= 0.7 else 1.0 - min(i) for i in ([], *inclusions)]
    assert scores == pytest.approx(expected)


def test_stability_of_one_search_is_refused() -> None:
    system = lotka_volterra()
    with pytest.raises(ValueError, match="none stands behind a candidate; search with"):
        found_by(Stability(), system, NO_BOOTSTRAPS)
    problem = rows_of([system.trajectory()], system.model.library)
    front = ParetoFront(
        "x", [fit_support(problem, "x", []), fit_support(problem, "x", ["x"])], problem
    )
    with pytest.raises(ValueError, match="none stands behind a candidate"):
        Stability().scores([front])


def test_a_stability_threshold_of_a_half_or_less_is_refused() -> None:
    with pytest.raises(ValueError, match="threshold must lie in"):
        Stability(threshold=0.5)


# Cross-validation


def independent_rows(*, noise: float, n_rows: int = 300, scale: float = 1.0) -> ParetoFront:
    """Target 2 a - b + noise, over a library of a, b, c and d; independent normal rows."""
    rng = np.random.default_rng(3)
    library = named_terms(list("abcd"), list("abcd"))
    theta = rng.standard_normal((n_rows, 4))
    target = theta @ [2.0, -1.0, 0.0, 0.0] + noise * rng.standard_normal(n_rows)
    problem = Regression(
        theta=theta * scale,
        target=target[:, None],
        library=library,
        equations=["y"],
        groups=np.arange(n_rows),
        test=np.zeros(n_rows, dtype=np.bool_),
    )
    (supports,) = pooled_supports(
        problem, BestSubset(), NO_BOOTSTRAPS, rng=np.random.default_rng(0)
    )
    return pareto_front(problem, supports)


@pytest.mark.parametrize("noise", [0.0, 0.1, 1.0])
def test_cross_validation_finds_the_terms_of_independent_rows(noise: float) -> None:
    front = independent_rows(noise=noise)
    (scores,) = CrossValidation().scores([front])
    assert selected(front, scores).terms == ("a", "b")
    # The target's variance is 5 + noise^2; over 300 rows both scatter by some 8 %.
    assert scores.min() == pytest.approx(max(noise**2 / (5.0 + noise**2), FLOOR), rel=0.25)


def test_cross_validation_is_least_squares_without_each_block() -> None:
    front = independent_rows(noise=1.0)
    theta, target = front.problem.theta, front.problem.target[:, 0]
    first, second = np.arange(300) < 150, np.arange(300) >= 150
    expected = np.zeros(len(front.candidates))
    for k, c in enumerate(front.candidates):
        columns = theta[:, [front.problem.library.index(n) for n in c.terms]]
        for fit, judge in ((first, second), (second, first)):
            away = fit & (np.abs(np.arange(300) - 149.5) > 1.0)  # not the neighbouring row
            coef = np.linalg.lstsq(columns[away], target[away])[0]
            expected[k] += np.square(target - columns @ coef)[judge].mean() / target.var() / 2.0
    (scores,) = CrossValidation(n_folds=2).scores([front])
    limit = scores.min()
    assert limit > expected.min()
    assert scores == pytest.approx(np.maximum(expected, limit), rel=1e-10)


def test_cross_validation_does_not_depend_on_units() -> None:
    plain = CrossValidation().scores([independent_rows(noise=0.1)])
    scaled = CrossValidation().scores([independent_rows(noise=0.1, scale=1e18)])
    assert scaled[0] == pytest.approx(plain[0], rel=1e-9)


def test_no_fold_is_fitted_to_its_block_or_the_groups_beside_it() -> None:
    groups = np.repeat([0, 1, 3, 4, 5, 6, 8, 9], 3)  # 2 and 7 are held out for testing
    fitted, judged = blocked_folds(groups, 4)
    assert (judged.sum(axis=0) == 1).all()
    for fit, judge in zip(fitted, judged, strict=True):
        distance = np.abs(groups[fit][:, None] - groups[judge])
        assert distance.min() > 1
    assert set(groups[fitted[1]]) == {0, 1, 6, 8, 9}  # block 3, 4 with the neighbour 5


def test_windows_of_different_folds_share_no_samples() -> None:
    system = lotka_volterra()
    run = system.trajectory()
    (problem, _) = Weak().assemble([run], system.model.library, rng=np.random.default_rng(0))
    assert problem.noisy is not None
    used = problem.noisy.mean.toarray() != 0.0
    fitted, judged = blocked_folds(problem.groups[~problem.test], 5)
    for fit, judge in zip(fitted, judged, strict=True):
        assert not (used[fit].any(axis=0) & used[judge].any(axis=0)).any()


def test_too_few_groups_or_folds_are_refused() -> None:
    with pytest.raises(ValueError, match="n_folds must be at least 2: 1 came"):
        CrossValidation(n_folds=1)
    with pytest.raises(ValueError, match="3 groups came for 5 folds; lower n_folds"):
        blocked_folds(np.repeat([0, 1, 2], 4), 5)
    front = independent_rows(noise=0.1)
    halves = replace(front.problem, groups=np.arange(300) // 150)
    with pytest.raises(ValueError, match="needs as many rows outside of a block"):
        CrossValidation(n_folds=2).scores([replace(front, problem=halves)])


# Integrals

WRONG = {
    # Candidates next to the truth: one term short, another wrong, one too many.
    "Lotka-Volterra": {
        "x": [{"x*y": -0.5}, {"x": 0.66, "x*y": -1.0, "x^2": 0.003}],
        "y": [{"x*y": 0.4}, {"y": -1 / 3, "x*y": 1.0, "y^2": 1e-9}],
    },
    "Lorenz": {
        "x": [{"x": -0.1}],
        "y": [{"x": 26.5, "x*z": -0.97}, {"x": 28.0, "y": -1.0, "x*z": -1.0, "z": 1e-9}],
        "z": [{"x*y": 0.1}, {"x*y": 1.0, "z": -8 / 3, "1": 3.0}],
    },
}


def choices_with_truth(system: System) -> dict[str, list[dict[str, float]]]:
    return {
        state: sorted([*wrong, system.model.terms(state)], key=len)
        for state, wrong in WRONG[system.name].items()
    }


@pytest.mark.parametrize("system", [lotka_volterra(), lorenz()], ids=lambda s: s.name)
def test_the_integral_score_selects_the_truth_among_wrong_candidates(system: System) -> None:
    fronts = fronts_of([system.trajectory()], system.model.library, choices_with_truth(system))
    assert picked(IntegralScore(), fronts) == [system.model.terms(f.equation) for f in fronts]
    for scores in IntegralScore().scores(fronts):
        assert scores.min() < FLOOR


@pytest.mark.parametrize("system", SYSTEMS, ids=lambda s: s.name)
def test_the_truth_follows_noise_free_samples(system: System) -> None:
    run = system.trajectory()
    n_steps = run.n_samples // 10
    starts = np.arange(0, run.n_samples - n_steps, n_steps)
    windows = DrivenWindows.of(run, run.states, run.state_names, (), starts, n_steps)
    truth = Ensemble(system.model.library, run.state_names, system.model.coef[:, :, None])
    centre, spread = run.states.mean(axis=0), run.states.std(axis=0)
    assert truth.errors(windows, centre=centre, spread=spread).max() < 1e-3 * FLOOR


def test_equations_are_selected_together() -> None:
    # x' = 2 v with v' = -x / 2 keeps to x exactly, so neither equation can be judged alone.
    system = damped_oscillator(zeta=0.0, omega=1.0)
    t = np.linspace(0.0, 20.0, 400)
    run = Trajectory(t, np.stack([np.cos(t), -np.sin(t)], axis=1), system.model.states)
    choices = {"x": [{"v": 1.0}, {"v": 2.0, "x": 0.0}], "v": [{"x": -0.5}, {"x": -1.0, "v": 0.0}]}
    assert picked(IntegralScore(), fronts_of([run], system.model.library, choices)) == [
        {"v": 1.0},
        {"x": -1.0, "v": 0.0},
    ]


def test_the_winners_argmins_are_one_combination_even_among_ties() -> None:
    # Exact twins: either equation could carry the needless term; the fewest in total win.
    system = lotka_volterra()
    choices = {
        s: [system.model.terms(s), {**system.model.terms(s), "1": 0.0}] for s in system.model.states
    }
    fronts = fronts_of([system.trajectory()], system.model.library, choices)
    scores = IntegralScore().scores(fronts)
    for front, score in zip(fronts, scores, strict=True):
        assert selected(front, score).n_terms == 2
        assert (score == score.min()).sum() == 1
        assert score[2] == pytest.approx(score[1], rel=1e-12)


def test_inputs_drive_the_integration() -> None:
    # x' = u - x with u = 2 cos t: x = cos t + sin t; samples at unequal steps.
    t = np.sort(np.random.default_rng(0).uniform(0.0, 30.0, 600))
    u = 2.0 * np.cos(t)
    run = Trajectory(t, (np.cos(t) + np.sin(t))[:, None], ["x"], u[:, None], ["u"])
    library = polynomial(["u", "x"], degree=1)  # the library's order is its own
    truth = {"u": 1.0, "x": -1.0}
    fronts = fronts_of([run], library, {"x": [{"u": 1.0}, truth]})
    assert picked(IntegralScore(), fronts) == [truth]
    assert IntegralScore().scores(fronts)[0].min() < FLOOR


def test_windows_never_cross_trajectories() -> None:
    # Joined, the jump from one run to the next would be an error of order one.
    system = lotka_volterra()
    run = system.trajectory()
    whole = fronts_of([run], system.model.library, choices_with_truth(system))
    parts = [run.window(0, 400), run.window(600, 650), run.window(650, 655)]
    split = fronts_of(parts, system.model.library, choices_with_truth(system))
    assert picked(IntegralScore(), split) == picked(IntegralScore(), whole)
    assert IntegralScore().scores(split)[0].min() < FLOOR


def test_a_diverging_combination_gets_the_largest_error() -> None:
    system = damped_oscillator()
    library = polynomial(["x", "v"], degree=3)
    choices = {"x": [{"v": 1.0}, {"1": 1e3, "x^3": 1e6}], "v": [{"x": -9.0, "v": -0.6}]}
    scores = IntegralScore().scores(fronts_of([system.trajectory()], library, choices))
    assert scores[0][2] == MAX_ERROR
    assert scores[0][1] < FLOOR


def test_runs_in_blocks_are_runs_all_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    system = lotka_volterra()
    fronts = fronts_of([system.trajectory()], system.model.library, choices_with_truth(system))
    at_once = IntegralScore().scores(fronts)
    monkeypatch.setattr("ep2sindy.model.many.RUN_BLOCK", 3 * 20)  # three of 16 models
    for whole, blocks in zip(at_once, IntegralScore().scores(fronts), strict=True):
        assert blocks == pytest.approx(whole, rel=1e-12)


def test_units_do_not_matter_to_the_integral_score() -> None:
    system = lotka_volterra()
    run = system.trajectory(noise=0.05, rng=np.random.default_rng(1))
    plain = fronts_of([run], system.model.library, choices_with_truth(system))
    dense = Trajectory(run.t, run.states * 1e18, run.state_names)
    library = system.model.library

    def in_units(terms: dict[str, float]) -> dict[str, float]:
        degree = dict(zip(library.names, library.exponents.sum(axis=1), strict=True))
        return {name: coef * 1e18 ** (1.0 - degree[name]) for name, coef in terms.items()}

    choices = {s: list(map(in_units, cs)) for s, cs in choices_with_truth(system).items()}
    scaled = fronts_of([dense], system.model.library, choices)
    for a, b in zip(IntegralScore().scores(plain), IntegralScore().scores(scaled), strict=True):
        assert b == pytest.approx(a, rel=1e-6)


def test_what_cannot_be_integrated_is_refused() -> None:
    system = lotka_volterra()
    fronts = fronts_of([system.trajectory()], system.model.library, choices_with_truth(system))
    with pytest.raises(ValueError, match=r"at most 15 combinations .* make 16; lower depth"):
        IntegralScore(max_combinations=15).scores(fronts)
    with pytest.raises(ValueError, match=r"every state needs one front: \['x'\] came"):
        IntegralScore().scores(fronts[:1])
    alone = [replace(f, problem=replace(f.problem, trajectories=())) for f in fronts]
    with pytest.raises(ValueError, match="the rows must know their trajectories"):
        IntegralScore().scores(alone)
    with pytest.raises(ValueError, match="window_s must be positive: 0"):
        IntegralScore(window_s=0.0)
    with pytest.raises(ValueError, match="n_windows must be at least 1: 0 came"):
        IntegralScore(n_windows=0)


# From data to equations


def found_by(
    rule: Selection, system: System, bootstraps: Bootstraps, *, noise: float = 0.0
) -> dict[str, dict[str, float]]:
    rng = np.random.default_rng(0)
    found = discover(
        [system.trajectory(noise=noise, rng=rng)],
        system.model.library,
        Recipe(formulation=Weak(), search=BestSubset(), bootstraps=bootstraps, selection=rule),
        seed=rng,
    )
    return {state: found.model.terms(state) for state in system.model.states}


@pytest.mark.parametrize(
    ("rule", "bootstraps"),
    [
        (Stability(), Bootstraps(n=32, n_culled=1)),
        (CrossValidation(), NO_BOOTSTRAPS),
        (IntegralScore(), NO_BOOTSTRAPS),
    ],
    ids=["stability", "cross-validation", "integral score"],
)
def test_every_rule_finds_lorenz_in_exact_samples(rule: Selection, bootstraps: Bootstraps) -> None:
    system = lorenz()
    found = found_by(rule, system, bootstraps)
    for state, terms in found.items():
        assert terms == pytest.approx(system.model.terms(state), rel=1e-4)


@pytest.mark.parametrize("rule", [CrossValidation(), IntegralScore()], ids=lambda r: r.label)
def test_noise_leaves_the_support_of_lotka_volterra(rule: Selection) -> None:
    system = lotka_volterra()
    for state, terms in found_by(rule, system, NO_BOOTSTRAPS, noise=0.05).items():
        assert set(terms) == set(system.model.terms(state))
