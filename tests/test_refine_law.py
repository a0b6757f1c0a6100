"""One refinement of all operating points: laws that are known, and what must not change them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

import ep2sindy as ep
from benchmarks.breathing_family import LAW, PARAMETERS, TRUTH, realization, system_at
from ep2sindy.refinement.judge import fit_and_judge, is_stationary
from ep2sindy.refinement.law import LawRefinement, refine_law
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.problem import LawMap
from ep2sindy.refinement.problem import RefinementProblem as Problem
from ep2sindy.regression.pooled import Basis, invert_covariance, pool_coefficients
from tests.models import model_of
from tests.single_shooting import SingleShooting

POINTS = list(PARAMETERS)
WINDOW, N_WINDOWS = 60, 4
SETTINGS = ep.RefinementSettings(n_windows=N_WINDOWS, window=WINDOW, n_reweights=0)
BASIS = LAW.evaluate(np.array([[PARAMETERS[p][v] for v in LAW.variables] for p in POINTS]))
TRUE_LAW = np.array([row for terms in TRUTH.values() for row in terms.values()])


@pytest.mark.parametrize(
    ("off", "change", "stationary"),
    [
        (1.0, 1e-2, False),  # one more step removes a part of the loss, and moves a scaling
        (1.0, 1e-4, True),  # it removes some of the loss, but moves no scaling: a clean record
        (1e-2, 1e-2, True),  # it moves a scaling without gain: one that the data do not determine
    ],
)
def test_a_fit_is_stationary_in_its_loss_or_in_its_scalings(
    off: float, change: float, stationary: bool
) -> None:
    rows = np.array([[[100.0 * off, 1.0]]])  # one window: derivative by the scaling, and residual
    changed = np.array([change])
    found = is_stationary(rows, changed, scaling_change=changed[None], scaling=np.ones((1, 1)))
    assert found == stationary


@cache
def runs(noise: float = 0.0, number: int = 0) -> tuple[tuple[ep.Trajectory, ...], ...]:
    found = realization(noise, number)
    return tuple(tuple(found[point]) for point in POINTS)


@cache
def truths() -> tuple[ep.SparseModel, ...]:
    models = (system_at(PARAMETERS[point]).model for point in POINTS)
    return tuple(models)


def near(share: float = 0.1) -> list[ep.SparseModel]:
    """The true models, every coefficient off in a way of its own."""
    rng = np.random.default_rng(0)
    return [
        replace(m, coef=m.coef * (1.0 + share * rng.choice([-1.0, 1.0], m.coef.shape)))
        for m in truths()
    ]


def pooled(
    models: Sequence[ep.SparseModel],
    data: Sequence[Sequence[ep.Trajectory]],
    basis: np.ndarray = BASIS,
    **settings: object,
) -> LawRefinement:
    return refine_law(models, data, basis, replace(SETTINGS, **settings), seed=0)


def test_exact_data_give_the_exact_law() -> None:
    found = pooled(near(), runs())
    assert found.status == "converged"
    assert found.coefficients == tuple((s, t) for s, terms in TRUTH.items() for t in terms)
    # Rounding aside, rk4 at 0.1 of a time unit of one errs by h^4 / 120.
    size = np.abs(TRUE_LAW * BASIS.max(axis=0)).max(axis=1, keepdims=True)
    np.testing.assert_allclose(
        found.law * BASIS.max(axis=0) / size, TRUE_LAW * BASIS.max(axis=0) / size, atol=2e-6
    )
    for model, truth in zip(found.models, truths(), strict=True):
        np.testing.assert_allclose(model.coef, truth.coef, rtol=3e-6)


def test_a_saturated_basis_gives_what_separate_refinements_do() -> None:
    data = runs(0.02)
    method = MultipleShooting(tolerance=1e-9)
    apart = ep.refine(near(), data, replace(SETTINGS, method=method), seed=0)
    for basis in (np.eye(6), np.random.default_rng(1).normal(size=(6, 6))):
        found = pooled(near(), data, basis, method=method)
        for model, own in zip(found.models, apart, strict=True):
            np.testing.assert_allclose(model.coef, own.model.coef, rtol=1e-6, atol=1e-12)
        np.testing.assert_allclose(found.loss, [own.loss for own in apart], rtol=1e-6)


def test_pooling_never_lowers_the_loss() -> None:
    data = runs(0.02)
    free, law = pooled(near(), data, np.eye(6)), pooled(near(), data)
    assert free.loss.mean() < law.loss.mean() < 1.2 * free.loss.mean()


def test_in_noise_a_pooled_law_is_closer_to_the_truth_than_one_through_separate_fits() -> None:
    """One pulse leaves directions of a point free that the others fix."""
    data = runs(0.05)
    apart = ep.refine(near(), data, replace(SETTINGS, n_reweights=1), seed=0)
    used = truths()[0].coef.T != 0.0
    own = np.array([each.model.coef.T[used] for each in apart])
    truth = np.array([each.coef.T[used] for each in truths()])

    def missed(law: np.ndarray) -> float:
        return float(np.sqrt(np.square(BASIS @ law.T / truth - 1.0).mean()))

    found = pooled([each.model for each in apart], data)
    assert missed(found.law) < 0.7 * missed(pool_coefficients(own, None, Basis(BASIS)))


def test_intervals_hold_the_truth() -> None:
    systems = [replace(system_at(PARAMETERS[point]), duration_s=50.0) for point in POINTS]
    z = []
    for number in range(10):
        data = [[each.trajectory(noise=0.01, rng=6 * number + k)] for k, each in enumerate(systems)]
        # Twenty windows a point, none twice: 120 clusters for 12 coefficients.
        settings = ep.RefinementSettings(n_windows=20, window=25, n_reweights=0)
        found = refine_law(truths(), data, BASIS, settings, seed=number)
        assert found.covariance is not None
        assert found.covariance.shape == (12, 12)
        z.append((found.law - TRUE_LAW).ravel() / np.sqrt(np.diag(found.covariance)))
    # One, from ten draws of 12 coefficients that go together in part.
    assert 0.5 < np.square(z).mean() < 1.6
    assert set(found.models[0].intervals("n_i")) == set(TRUTH["n_i"])


def test_units_change_nothing() -> None:
    data = runs(0.02)
    found = pooled(near(), data)
    kilovolts = pooled(near(), data, BASIS / np.array([1.0, 1e3, 1.0]))
    np.testing.assert_allclose(kilovolts.law, found.law * [1.0, 1e3, 1.0], rtol=1e-7)
    factor = 1e18
    larger = [[replace(run, states=run.states * factor) for run in at_point] for at_point in data]
    ones = np.full((1, 2), factor)
    rescaled = [replace(m, coef=m.coef * factor / m.library.evaluate(ones).T) for m in near()]
    other = pooled(rescaled, larger)
    by_term = dict(zip(found.coefficients, found.law, strict=True))
    for (state, term), row in zip(other.coefficients, other.law, strict=True):
        degree = {"1": 0, "n_i*n_n": 2}.get(term, 1)
        np.testing.assert_allclose(row * factor ** (degree - 1), by_term[state, term], rtol=1e-7)


def test_the_order_of_points_does_not_matter() -> None:
    data, method = runs(), MultipleShooting(tolerance=1e-9)
    order = [3, 0, 5, 1, 4, 2]
    found = pooled(near(), data, method=method)
    other = pooled(
        [near()[k] for k in order], [data[k] for k in order], BASIS[order], method=method
    )
    np.testing.assert_allclose(other.law, found.law, rtol=1e-5, atol=1e-9)


def test_relations_hold_at_every_point() -> None:
    library = truths()[0].library
    support = {state: tuple(terms) for state, terms in TRUTH.items()}
    relations = ep.constraint(library, support, ["n_i: n_i*n_n == -1 * n_n: n_i*n_n"])
    found = pooled(near(), runs(0.02), constraint=relations)
    assert len(found.coefficients) == 3
    assert found.law.shape == (3, 3)
    for model in found.models:
        gain, loss = model.terms("n_i")["n_i*n_n"], model.terms("n_n")["n_i*n_n"]
        assert gain == pytest.approx(-loss, rel=1e-12)
        assert model.covariance is not None
        assert model.covariance.shape == (4, 4)


def test_reweighting_and_fixed_starts_find_the_exact_law_too() -> None:
    for settings in ({"n_reweights": 1}, {"free_start": False}):
        found = pooled(near(0.05), runs(), **settings)
        np.testing.assert_allclose(
            [m.coef for m in found.models], [m.coef for m in truths()], rtol=1e-5
        )


def test_what_does_not_stay_finite_comes_back_as_it_was() -> None:
    wild = [replace(m, coef=-30.0 * m.coef) for m in truths()]
    found = pooled(wild, runs(), method=MultipleShooting(first_memory=60, max_iter=1))
    assert found.status in ("non_finite", "max_iter", "flat")
    if found.status == "non_finite":
        assert found.covariance is None
        np.testing.assert_allclose(
            [m.coef for m in found.models], [m.coef for m in wild], rtol=1e-9
        )


def test_information_weighting_is_exact_for_linear_problems() -> None:
    """The minimisers of |A_p z - y_p| with their A_p^T A_p hold all that a law needs."""
    rng = np.random.default_rng(3)
    n_points, n_coefs = 8, 3
    basis = np.column_stack([np.ones(n_points), rng.normal(size=n_points)])
    A = rng.normal(size=(n_points, 20, n_coefs)) * np.array([1.0, 1e-2, 1e3])
    y = rng.normal(size=(n_points, 20))
    own = np.array([np.linalg.lstsq(*pair)[0] for pair in zip(A, y, strict=True)])
    information = A.transpose(0, 2, 1) @ A
    size = np.sqrt(np.square(own).mean(axis=0))
    weight = 1.0 / np.sqrt(np.einsum("pkk,k->p", information, size**2))
    rows = np.einsum("p,prk,pm->prkm", weight, A, basis).reshape(n_points * 20, -1)
    direct = np.linalg.lstsq(rows * np.kron(size, [1.0, 1.0]), (weight[:, None] * y).ravel())[0]
    expected = direct.reshape(n_coefs, 2) * size[:, None]
    known = Basis(basis)
    np.testing.assert_allclose(pool_coefficients(own, information, known), expected, rtol=1e-9)
    inverses = np.array([invert_covariance(np.linalg.inv(each)) for each in information])
    np.testing.assert_allclose(pool_coefficients(own, inverses, known), expected, rtol=1e-7)


def test_an_information_of_one_direction_still_gives_a_law() -> None:
    information = np.zeros((3, 2, 2))
    information[:, 0, 0] = 1.0
    law = pool_coefficients(np.ones((3, 2)), information, Basis(np.ones((3, 1))))
    np.testing.assert_allclose(law, [[1.0], [0.0]], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"basis": BASIS[:, [0, 1, 1]]}, "6 points do not tell the 3 terms of a law apart"),
        ({"basis": BASIS[:5]}, "must be one per point: 6, 6 and 5 came"),
        (
            {"method": SingleShooting(), "free_start": False},
            "MultipleShooting alone: SingleShooting",
        ),
        (
            {"models": [model_of({"n_i": {"n_i": 1.0}, "n_n": {"n_n": 1.0}}), *truths()[1:]]},
            "must have the same terms: 2 structures came",
        ),
    ],
)
def test_what_cannot_be_pooled_says_why(change: Mapping[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pooled(**{"models": near(), "data": runs(), **change})


def problem_of(
    models: Sequence[ep.SparseModel], data: Sequence[Sequence[ep.Trajectory]]
) -> Problem:
    batches = SETTINGS.cut(models, data, np.random.default_rng(0))
    return Problem.of(models, batches, [None] * len(models), n_reweights=1)


@pytest.mark.parametrize("free_start", [True, False])
def test_a_law_of_identities_is_no_law_to_rounding(free_start: bool) -> None:
    """A point alone takes the same steps; points together find the same minimum of each."""
    problem = replace(problem_of(near()[:1], runs(0.02)[:1]), free_start=free_start)
    method = MultipleShooting()
    free, (own,) = fit_and_judge(problem, method)
    pooled, (law,) = fit_and_judge(replace(problem, law=LawMap.identity(problem.n_free)), method)
    assert own.status == law.status == "converged"
    np.testing.assert_allclose(pooled.scaling, free.scaling, rtol=1e-12)
    np.testing.assert_allclose(pooled.nodes, free.nodes, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(law.covariance, own.covariance, rtol=1e-9)
    np.testing.assert_allclose(law.window_loss, own.window_loss, rtol=1e-10)


def test_records_of_unlike_length_need_as_many_windows() -> None:
    data = [list(at_point) for at_point in runs()]
    data[0] = [data[0][0].window(0, WINDOW + 1)]
    with pytest.raises(ValueError, match=r"as many windows: \[2, 4\] came"):
        pooled(near(), data)
