from itertools import combinations

import numpy as np
import pytest

pytest.importorskip("pysindy")

from benchmarks.pysindy_variants import (
    PySINDyEnsemble,
    PySINDySmoothing,
    PySINDySsr,
    PySINDyStlsq,
    PySINDySubsets,
    PySINDyVariant,
    PySINDyWeakForm,
    best_of_each_size,
    least_aicc,
    pysindy_library,
)
from ep2sindy.library.library import named_terms
from ep2sindy.systems.systems import lotka_volterra

METHODS = [
    PySINDyStlsq(),
    PySINDySsr(),
    pytest.param(PySINDyEnsemble(), marks=pytest.mark.slow),
    PySINDyWeakForm(),
    PySINDySubsets(PySINDySmoothing()),
    PySINDySubsets(PySINDyWeakForm()),
]


@pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)
def test_every_method_has_the_truth_on_the_front_without_noise(method) -> None:
    system = lotka_volterra()
    run = system.trajectory()
    rng = np.random.default_rng(0)
    truth = {state: frozenset(system.model.terms(state)) for state in system.model.states}
    found = method.candidates([run], system.model.library, rng=rng)
    for candidates in found.values():
        supports = [terms for terms, _ in candidates]
        assert len(set(supports)) == len(supports)
        assert all(r2 <= 1.0 for _, r2 in candidates)
    # Two runs give the same names, their rows put one after the other.
    halves = [run.window(0, 500), run.window(500, 1000)]
    for runs in ([run], halves):
        finding = PySINDyVariant(method).find(runs, system.model.library, rng=rng)
        assert finding.selected is None
        assert all(truth[state] in finding.kept[state] for state in truth)


def test_a_front_holds_the_best_of_each_size_and_the_empty_support() -> None:
    candidates = [(("x",), 0.1), (("y",), 0.5), (("x", "y"), 0.9), (("x", "1"), 0.6)]
    assert best_of_each_size(candidates) == [
        frozenset(),
        frozenset({"y"}),
        frozenset({"x", "y"}),
    ]
    assert best_of_each_size([]) == [frozenset()]


def test_pysindy_columns_are_put_in_our_order() -> None:
    states = ("x", "y")
    names = ("y^3", "x*y^2", "1", "x^3", "x^2*y", "y", "x*y", "x^2", "x", "y^2")
    library = named_terms(states, names)
    values = np.random.default_rng(1).normal(size=(7, 2))
    features, order = pysindy_library(library, states)
    theta = np.asarray(features.transform(values))[:, order]
    np.testing.assert_allclose(theta, library.evaluate(values), rtol=1e-14)


def test_r2_is_that_of_a_least_squares_refit() -> None:
    system = lotka_volterra()
    rng = np.random.default_rng(3)
    run = system.trajectory(noise=0.05, rng=rng)
    library = system.model.library
    rows = PySINDySmoothing().rows([run], library)
    for terms, r2 in PySINDyStlsq().candidates([run], library, rng=rng)["x"]:
        columns = rows.theta[:, [library.index(name) for name in terms]]
        coef = np.linalg.lstsq(columns, rows.x_dot[:, 0], rcond=None)[0]
        residual = rows.x_dot[:, 0] - columns @ coef
        assert r2 == pytest.approx(1.0 - residual.var() / rows.x_dot[:, 0].var(), abs=1e-3)
        total = np.square(rows.x_dot[:, 0] - rows.x_dot[:, 0].mean()).sum()
        assert r2 == pytest.approx(1.0 - residual @ residual / total, abs=1e-12)


def test_subsets_are_the_best_of_every_size_on_pysindys_rows() -> None:
    system = lotka_volterra()
    rng = np.random.default_rng(2)
    run, library = system.trajectory(noise=0.2, rng=rng), system.model.library
    found = PySINDySubsets(PySINDySmoothing()).candidates([run], library, rng=rng)
    rows = PySINDySmoothing().rows([run], library)
    every = [c for n in range(1, 7) for c in combinations(range(len(library)), n)]
    masks = np.array([[[j in c for j in range(len(library))]] * 2 for c in every])
    tried = rows.candidates(masks, library, run.state_names)
    for state in run.state_names:
        assert best_of_each_size(found[state]) == best_of_each_size(tried[state])


@pytest.mark.parametrize(
    "variant", [PySINDyEnsemble(n_thresholds=2), PySINDyWeakForm(n_domains=60)]
)
def test_draws_come_from_the_rng_and_leave_the_global_state_alone(variant) -> None:
    system = lotka_volterra()
    run = system.trajectory(noise=0.05, rng=np.random.default_rng(5))
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    first, second = (
        variant.candidates([run], system.model.library, rng=np.random.default_rng(6))
        for _ in range(2)
    )
    assert first == second
    assert (np.random.get_state()[1] == before).all()  # noqa: NPY002


def test_the_least_aicc_is_chosen() -> None:
    """20 rows: a term more costs 2.6 here, so R2 must rise from 0.9 to above 0.913."""
    few, more = (("x",), 0.9), (("x", "y"), 0.905)
    assert least_aicc([few, more], 20) == {"x"}
    assert least_aicc([few, (("x", "y"), 0.93)], 20) == {"x", "y"}
    assert least_aicc([(("x",), 0.01)], 20) == frozenset()
