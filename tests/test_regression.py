from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.regression import formulations, rows
from ep2sindy.regression.ambiguity import ambiguities, few_rows, row_limit, usable_terms
from ep2sindy.regression.bootstraps import pool_supports
from ep2sindy.regression.rows import Formulation, RegressionRows
from ep2sindy.signals.smoothers import NoSmoothing, SavitzkyGolay
from tests.models import plain_rows


def cubic(t: np.ndarray, label: str) -> ep.Trajectory:
    return ep.Trajectory(t=t, states=(t**2 + 0.3)[:, None], state_names=["x"], label=label)


def test_rows_of_one_trajectory_do_not_depend_on_the_other() -> None:
    runs = [cubic(np.linspace(0, 1, 40), "a"), cubic(np.linspace(5, 9, 60), "b")]
    library = ep.polynomial(["x"], degree=2)
    (both,) = ep.Differential().assemble(runs, library, rng=np.random.default_rng(0))
    alone = [
        ep.Differential().assemble([r], library, rng=np.random.default_rng(0))[0] for r in runs
    ]
    assert np.array_equal(both.theta, np.concatenate([a.theta for a in alone]))
    assert np.array_equal(both.target, np.concatenate([a.target for a in alone]))
    assert both.target[:, 0] == pytest.approx(2 * np.concatenate([r.t for r in runs]), abs=1e-9)


def test_raw_and_smoothed_libraries_differ_only_in_theta() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.05, rng=np.random.default_rng(1))
    library = ep.polynomial(["x", "y"], degree=2)
    form = ep.Differential(smoother=SavitzkyGolay())
    raw_form = replace(form, smooth_library=False)
    (smooth,) = form.assemble([run], library, rng=np.random.default_rng(0))
    (raw,) = raw_form.assemble([run], library, rng=np.random.default_rng(0))
    assert np.array_equal(raw.theta, library.evaluate(run.states))
    assert np.array_equal(raw.target, smooth.target)
    assert np.abs(raw.theta - smooth.theta).max() > 1e-3


@pytest.mark.parametrize(
    "split", [ep.regression.RandomSplit(0.25), ep.regression.BlockSplit(0.25, n_blocks=20)]
)
def test_splits_hold_out_the_asked_share(
    split: ep.regression.RandomSplit | ep.regression.BlockSplit,
) -> None:
    held_out = split.held_out(400, np.random.default_rng(0))
    assert held_out.sum() == 100


def test_block_split_holds_out_whole_blocks() -> None:
    held_out = ep.regression.BlockSplit(0.25, n_blocks=20).held_out(400, np.random.default_rng(0))
    assert np.all(np.ptp(held_out.reshape(20, 20).astype(int), axis=1) == 0)


def test_gram_matrix_is_the_weighted_product_of_unit_columns() -> None:
    rng = np.random.default_rng(0)
    theta, target = rng.normal(size=(30, 3)) * [1e18, 1.0, 1e-14], rng.normal(size=(30, 1))
    problem = plain_rows(theta, target, ["a", "b", "c"])
    assert np.diag(problem.train_gram.xx) == pytest.approx(1.0)
    counts = rng.integers(0, 3, size=30).astype(float)
    repeated = np.repeat(theta / np.linalg.norm(theta, axis=0), counts.astype(int), axis=0)
    (sums,) = problem.resampled_products(counts[None])
    plain = np.column_stack([repeated, np.repeat(problem.train_columns[3], counts.astype(int))])
    assert np.allclose(sums, plain.T @ plain, atol=1e-14)


def test_columns_at_the_edge_of_the_number_format_keep_finite_norms() -> None:
    theta = np.array([[1e200, 1.0], [2e200, 3.0], [-1e200, 2.0]])
    problem = plain_rows(theta, np.ones((3, 1)), ["a", "b"])
    assert problem.theta_scale[0] == pytest.approx(np.sqrt(6.0) * 1e200)


def test_an_overflowing_term_is_named() -> None:
    t = np.linspace(0, 1, 40)
    run = ep.Trajectory(t=t, states=1e120 * (1 + t)[:, None], state_names=["n"])
    with pytest.raises(ValueError, match=r"'n\^3' is not on row 0; lower the degree"):
        ep.Differential().assemble(
            [run], ep.polynomial(["n"], degree=3), rng=np.random.default_rng(0)
        )


METRE, FOOT = (
    ep.Trajectory(np.arange(40.0), np.arange(40.0)[:, None], ["x"], units={"x": unit})
    for unit in ("m", "ft")
)


@pytest.mark.parametrize("formulation", [ep.Differential(), ep.Weak()])
@pytest.mark.parametrize(
    ("runs", "variables", "message"),
    [
        ([METRE, FOOT], ["x"], "'x' is in m in trajectory 0 and in ft in trajectory 1"),
    ],
)
def test_trajectories_must_agree(
    formulation: Formulation, runs: list[ep.Trajectory], variables: list[str], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        formulation.assemble(runs, ep.polynomial(variables, degree=1), rng=np.random.default_rng(0))


def test_without_smoothing_the_derivative_is_the_plain_difference() -> None:
    run = cubic(np.linspace(0, 1, 40), "a")
    form = ep.Differential(smoother=NoSmoothing())
    (problem,) = form.assemble([run], ep.polynomial(["x"], degree=1), rng=np.random.default_rng(0))
    assert problem.target[:, 0] == pytest.approx(2 * run.t, abs=1e-12)


def degenerate() -> RegressionRows:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 50))
    columns = [np.ones(50), a, np.zeros(50), -3.0 * a, b, a + 2.0 * b, a + 1e-3 * b]
    names = ["one", "a", "zero", "minus_3a", "b", "a_plus_2b", "nearly_a"]
    return plain_rows(np.stack(columns, axis=1), (a + b)[:, None], names)


def test_zero_repeated_and_dependent_terms_are_left_out() -> None:
    assert usable_terms(degenerate()).tolist() == [True, True, False, False, True, False, False]


def test_of_dependent_terms_the_simplest_are_kept() -> None:
    """u is a switch between 0 and 30, so u^2 = 30 u; s and c are a sine and its cosine."""
    rng = np.random.default_rng(0)
    x, u = rng.normal(size=60), np.where(rng.random(60) < 0.5, 0.0, 30.0)
    names = ["u^2", "x*u^2", "x", "x*u", "u", "s^2", "c^2", "1"]
    library = ep.named_terms(["x", "u", "s", "c"], names)
    theta = library.evaluate(np.stack([x, u, np.sin(x), np.cos(x)], axis=1))
    problem = plain_rows(theta, x[:, None], library)
    kept = {name for name, k in zip(names, usable_terms(problem), strict=True) if k}
    assert kept == {"x", "x*u", "u", "s^2", "1"}
    assert [a.message for a in ambiguities(problem)] == [
        "'u^2' is a multiple of 'u' on every row and is left out",
        "'x*u^2' is a multiple of 'x*u' on every row and is left out",
        "c^2 is a linear combination of s^2, 1 on every row and is left out",
    ]


def test_a_combination_of_many_terms_is_named_and_stays_in_the_search() -> None:
    theta = np.random.default_rng(0).normal(size=(50, 5))
    theta[:, 4] = theta[:, :4].sum(axis=1)
    problem = plain_rows(theta, theta[:, 4:], list("abcde"))
    assert usable_terms(problem).all()
    (found,) = ambiguities(problem)
    words = "on every row: no data of this kind tell them apart"
    assert found.message == f"e is a linear combination of a, b, c, d {words}"


@pytest.mark.parametrize(("n_rows", "largest"), [(18, 6), (17, 3), (13, 2), (6, 1)])
def test_few_rows_hold_the_size_of_supports_down(n_rows: int, largest: int) -> None:
    theta = np.random.default_rng(0).normal(size=(n_rows, 6))
    problem = plain_rows(theta, theta[:, :1], list("abcdef"))
    n_terms = int(usable_terms(problem).sum())
    assert row_limit(n_terms, len(problem.train_columns.T)) == largest
    (supports,) = pool_supports(
        problem, ep.BestSubset(), ep.Bootstraps(n=0), rng=np.random.default_rng(0)
    )
    assert supports.masks.sum(axis=1).max() == largest
    assert bool(few_rows(problem)) == (largest < 6)


def test_a_healthy_library_has_no_ambiguities() -> None:
    theta = np.random.default_rng(0).normal(size=(50, 3))
    assert ambiguities(plain_rows(theta, theta[:, :1], ["a", "b", "c"])) == ()


def test_a_long_record_in_blocks_gives_the_same_regression(monkeypatch: pytest.MonkeyPatch) -> None:
    runs = [ep.lorenz().trajectory(noise=0.05, rng=k).window(0, 700) for k in range(2)]
    library = ep.lorenz().model.library
    method = ep.Regression(ep.Differential(), ep.BestSubset(), bootstraps=ep.Bootstraps(n=4))
    whole = method.search_equations(DiscoveryProblem(runs, library), rng=0)
    for module in (rows, formulations):
        monkeypatch.setattr(module, "MOST_ROWS", 300)
    for one, other in zip(
        whole, method.search_equations(DiscoveryProblem(runs, library), rng=0), strict=True
    ):
        assert "train_columns" not in vars(other.front.rows)  # no scaled copy of all rows was made
        assert isinstance(other.front.rows.theta, rows.TermsAt)  # nor were all terms held
        assert one.supports.masks.tolist() == other.supports.masks.tolist()
        for a, b in zip(one.front.candidates, other.front.candidates, strict=True):
            assert a.terms == b.terms
            np.testing.assert_allclose(a.coef, b.coef, rtol=1e-10)
            np.testing.assert_allclose([a.r2_train, a.r2_test], [b.r2_train, b.r2_test], atol=1e-13)
