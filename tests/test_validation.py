from collections.abc import Sequence

import numpy as np
import pytest

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.recipe import Recipe
from ep2sindy.library.library import Library, named_terms
from ep2sindy.regression.rows import Regression
from ep2sindy.regression.weak import Weak
from ep2sindy.search.bootstraps import Bootstraps
from ep2sindy.search.front import Candidate, ParetoFront, fit_support
from ep2sindy.search.searches import BestSubset
from ep2sindy.selection.resampled import Stability
from ep2sindy.selection.rule import Selection, selected
from ep2sindy.synthetic.systems import (
    System,
    damped_oscillator,
    lorenz,
    lotka_volterra,
)

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


def test_stable_terms_of_lorenz_are_found_in_exact_samples() -> None:
    system = lorenz()
    found = found_by(Stability(), system, Bootstraps(n=32, n_culled=1))
    for state, terms in found.items():
        assert terms == pytest.approx(system.model.terms(state), rel=1e-4)
