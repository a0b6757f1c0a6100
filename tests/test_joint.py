from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
import pytest

import ep2sindy as ep
from benchmarks.breathing_family import PARAMETERS, realization, system_at
from benchmarks.joint import find, run_family
from ep2sindy.operating.fit_rows import fit_law
from ep2sindy.regression.rows import Formulation, RegressionRows
from ep2sindy.runtime.parallel import Serial
from ep2sindy.selection.criteria import Selection, log_supports
from tests.models import plain_rows

METHOD = ep.Regression(
    ep.WeightedWeak(ep.Weak(test_functions=ep.Bumps(half_width_s=1.5), split=ep.RandomSplit(0.0))),
    ep.BestSubset(n_best=5),
    selection=ep.EBIC(),
    depth=5,
)
NAMES = ["a", "b", "c", "d", "e", "f"]
BIC = ep.EBIC(gamma=0.0, coarsening=None)


@dataclass(frozen=True)
class Given:
    """Rows made by a test, found by the label of their trajectory."""

    rows: Mapping[str, RegressionRows]
    smoother: None = None

    def assemble(
        self,
        trajectories: Sequence[ep.Trajectory],
        library: ep.Library,
        *,
        rng: np.random.Generator,
    ) -> tuple[RegressionRows, ...]:
        return (self.rows[trajectories[0].label],)


def rows_of(
    coef: Mapping[str, float],
    *,
    seed: int,
    noise: float = 0.0,
    n_rows: int = 60,
    silent: Sequence[str] = (),
) -> RegressionRows:
    """Rows of six unrelated terms and a target that some of them make up; silent ones are zero."""
    rng = np.random.default_rng(seed)
    theta = rng.normal(size=(n_rows, 6))
    theta[:, [NAMES.index(name) for name in silent]] = 0.0
    error = noise * rng.normal(size=n_rows)
    truth = np.array([coef.get(name, 0.0) for name in NAMES])
    return plain_rows(theta, (theta @ truth + error)[:, None], NAMES)


def searched(rows: Mapping[str, RegressionRows], *, selection: Selection) -> ep.SharedDiscovery:
    def label(point: str) -> ep.Trajectory:
        ramp = np.arange(3.0)
        values = np.ones((3, 6))
        return ep.Trajectory(ramp, ramp[:, None], ["y"], values, NAMES, label=point)

    return ep.discover_shared(
        {point: [label(point)] for point in rows},
        ep.named_terms(NAMES, NAMES),
        ep.Regression(formulation=Given(rows), search=ep.BestSubset(), selection=selection),
        seed=np.random.default_rng(0),
    )


@pytest.mark.parametrize(
    ("formulation", "selection"),
    [(ep.Differential(), ep.Knee()), (ep.WeightedWeak(), ep.EBIC()), (ep.Weak(), BIC)],
    ids=lambda value: type(value).__name__,
)
def test_one_point_gives_what_discover_does(formulation: Formulation, selection: Selection) -> None:
    run = ep.lotka_volterra().trajectory(noise=0.05, rng=np.random.default_rng(0)).window(0, 300)
    library = ep.polynomial(["x", "y"], degree=3)
    recipe = ep.Regression(formulation, ep.BestSubset(n_best=3), selection=selection, depth=3)
    alone = ep.discover([run], library, recipe, seed=1)
    joint = ep.discover_shared({"A": [run]}, library, recipe, seed=1)
    for state, front in alone.fronts.items():
        assert joint.fronts[state].supports == tuple(c.terms for c in front.candidates)
        assert joint.fronts[state].errors == pytest.approx(front.errors, rel=1e-12)
        assert joint.scores[state] == pytest.approx(alone.scores[state], rel=1e-12)
    assert np.array_equal(joint.models["A"].coef, alone.model.coef)
    if alone.model.covariance is not None:
        assert np.array_equal(joint.models["A"].covariance, alone.model.covariance)


def test_noise_free_equations_come_back_at_every_point() -> None:
    found = find(METHOD, realization(0.0, 0))
    for point, parameters in PARAMETERS.items():
        truth = system_at(parameters).model
        assert found.models[point].coef == pytest.approx(truth.coef, rel=1e-8)
        assert found.models[point].provenance["point"] == point


@pytest.mark.parametrize("n_best", [1, 3])
@pytest.mark.parametrize("seed", range(3))
def test_shared_subsets_match_exhaustive_enumeration(seed: int, n_best: int) -> None:
    rng = np.random.default_rng(seed)
    theta = 2.0 * rng.normal(size=(3, 40, 1)) + rng.normal(size=(3, 40, 9))
    theta[0, :, 2] = 0.0  # a term that the first problem cannot show
    theta[1, :, 5] = theta[1, :, 0] - theta[1, :, 1]  # dependent in the second
    norms = np.linalg.norm(theta, axis=1, keepdims=True)
    theta /= np.where(norms > 0.0, norms, 1.0)
    target = theta[:, :, :4] @ [1.0, -2.0, 0.5, 1.5] + 0.3 * rng.normal(size=(3, 40))
    target *= np.array([[1.0], [1e-6], [1e9]])

    def log_product(columns: tuple[int, ...]) -> float:
        residuals = [
            np.linalg.norm(y - x[:, columns] @ np.linalg.lstsq(x[:, columns], y)[0])
            for x, y in zip(theta, target, strict=True)
        ]
        return float(np.log(residuals).sum())

    masks = ep.BestSubset(max_terms=9, n_best=n_best).shared_supports(
        np.einsum("pri,prj->pij", theta, theta),
        np.einsum("pri,pr->pi", theta, target),
        np.square(target).sum(axis=1),
    )
    assert not masks[0].any()
    for size in range(1, 10):
        ranked = sorted(combinations(range(9), size), key=log_product)
        found = {tuple(np.flatnonzero(m)) for m in masks if m.sum() == size}
        assert found == set(ranked[:n_best])


def test_a_term_that_some_points_cannot_show_is_found() -> None:
    rows = {
        "coefficient vanishes": rows_of({"a": 1.0}, seed=0, noise=0.1),
        "signal vanishes": rows_of({"a": 1.0, "b": 0.5}, seed=1, noise=0.1, silent=["b"]),
        "both show": rows_of({"a": 2.0, "b": -0.5}, seed=2, noise=0.1),
        "both show again": rows_of({"a": 1.5, "b": 0.6}, seed=3, noise=0.1),
    }
    found = searched(rows, selection=ep.EBIC())
    assert found.chosen["y"] == ("a", "b")
    assert found.models["both show"].terms("y") == pytest.approx({"a": 2.0, "b": -0.5}, abs=0.05)
    assert found.models["coefficient vanishes"].terms("y")["b"] == pytest.approx(0.0, abs=0.05)
    assert list(found.models["signal vanishes"].terms("y")) == ["a"]
    assert (
        found.ambiguities["signal vanishes"][0].message
        == "'b' is zero on every row and is left out"
    )
    assert found.ambiguities["both show"] == ()
    for point in ("coefficient vanishes", "signal vanishes"):
        alone = searched({point: rows[point]}, selection=ep.EBIC())
        assert alone.chosen["y"] == ("a",)


def test_terms_taken_in_by_chance_at_single_points_are_dropped() -> None:
    truth = {"a": 1.0, "b": -0.6, "c": 0.4}
    rows = {f"P{k}": rows_of(truth, seed=k, noise=0.5, n_rows=30) for k in range(8)}
    alone = [searched({p: r}, selection=BIC).chosen["y"] for p, r in rows.items()]
    assert sum(set(terms) - set(truth) != set() for terms in alone) >= 2
    assert searched(rows, selection=BIC).chosen["y"] == ("a", "b", "c")


def test_terms_that_repeat_each_other_at_one_point_are_told_apart_by_another() -> None:
    rows = {p: rows_of({"b": 1.0}, seed=k, noise=0.1) for k, p in enumerate(("A", "B"))}
    alike = rows["A"].theta.copy()
    alike[:, 0] = 3.0 * alike[:, 1]
    rows["A"] = replace(rows["A"], theta=alike)
    assert searched({"A": rows["A"]}, selection=ep.EBIC()).chosen["y"] == ("a",)
    assert searched(rows, selection=ep.EBIC()).chosen["y"] == ("b",)


def test_shared_errors_are_geometric_means_that_fall_with_size() -> None:
    truth = {"a": 1.0, "b": -0.6}
    rows = {f"P{k}": rows_of(truth, seed=k, noise=0.1 * 10.0**k) for k in range(3)}
    front = searched(rows, selection=BIC).fronts["y"]
    assert np.all(np.diff(front.errors) < 0)
    at_points = np.array([each.errors for each in front.points.values()])
    assert front.errors == pytest.approx(np.prod(at_points, axis=0) ** (1 / 3), rel=1e-12)


@pytest.mark.parametrize("selection", [BIC, ep.EBIC()], ids=lambda s: s.label)
def test_units_and_amplitude_of_one_point_change_nothing(selection: Selection) -> None:
    truth = {"a": 1.0, "b": -0.6, "c": 0.1}
    rows = {f"P{k}": rows_of(truth, seed=k, noise=0.5) for k in range(4)}
    plain = searched(rows, selection=selection)
    scale = np.array([1e18, 1e-14, 1.0, 1e30, 1e-5, 3.0])
    other = replace(rows["P1"], theta=rows["P1"].theta * scale, target=rows["P1"].target * 1e20)
    scaled = searched({**rows, "P1": other}, selection=selection)
    assert scaled.fronts["y"].supports == plain.fronts["y"].supports
    gaps, scaled_gaps = (np.diff(each.scores["y"]) for each in (plain, scaled))
    assert scaled_gaps == pytest.approx(gaps, rel=1e-9)
    coef = scaled.models["P1"].coef[:, 0] * scale / 1e20
    assert coef == pytest.approx(plain.models["P1"].coef[:, 0], rel=1e-9)


def test_order_of_points_changes_nothing() -> None:
    points = dict(list(realization(0.05, 1).items())[:3])
    split = replace(METHOD, formulation=ep.Weak(test_functions=ep.Bumps(half_width_s=0.8)))
    forth, back = find(split, points), find(split, dict(reversed(points.items())))
    assert forth.chosen == back.chosen
    for point in points:
        assert np.array_equal(forth.models[point].coef, back.models[point].coef)


def test_points_may_be_sampled_differently() -> None:
    fast, slow = (
        replace(ep.lotka_volterra(), rate_Hz=25.0, duration_s=30.0),
        ep.lotka_volterra(b=0.5),
    )
    found = ep.discover_shared(
        {
            "fast": [fast.trajectory()],
            "slow": [slow.trajectory().window(0, 600), slow.trajectory().window(600, 1000)],
        },
        ep.polynomial(["x", "y"], degree=3),
        ep.Regression(formulation=ep.WeightedWeak(), search=ep.BestSubset(), selection=ep.EBIC()),
        seed=np.random.default_rng(0),
    )
    assert found.models["fast"].terms("x") == pytest.approx({"x": 2 / 3, "x*y": -1.0}, rel=1e-6)
    assert found.models["slow"].terms("x") == pytest.approx({"x": 2 / 3, "x*y": -0.5}, rel=1e-6)


def test_the_count_of_supports_is_paid_once() -> None:
    rows = {f"P{k}": rows_of({"a": 1.0, "b": 0.5}, seed=k, noise=0.5) for k in range(5)}
    plain = searched(rows, selection=ep.EBIC(gamma=0.0))
    full = searched(rows, selection=ep.EBIC(gamma=0.7))
    library = ep.named_terms(NAMES, NAMES)
    counts = np.array([log_supports(library, terms) for terms in plain.fronts["y"].supports])
    assert full.scores["y"] == pytest.approx(plain.scores["y"] + 1.4 * counts, rel=1e-12)


def law_rows(noise: float, *, seed: int = 0, bend: float = 0.0) -> dict[str, RegressionRows]:
    """a follows 2 - 3 p, b follows p + bend p^2 over four points."""
    return {
        f"p={p}": rows_of(
            {"a": 2.0 - 3.0 * p, "b": p + bend * p**2}, seed=10 * seed + p, noise=noise * (1 + p)
        )
        for p in range(1, 5)
    }


STRAIGHT = ep.polynomial(["p"], degree=1)
AT = {f"p={p}": {"p": float(p)} for p in range(1, 5)}


def test_a_law_that_holds_is_recovered_exactly() -> None:
    fit = fit_law(searched(law_rows(0.0), selection=ep.EBIC()), STRAIGHT, parameters=AT)
    test = fit.tests["y"]
    assert fit.law.coefficients == (("y", "a"), ("y", "b"))
    assert fit.law.coef == pytest.approx(np.array([[2.0, -3.0], [0.0, 1.0]]), abs=1e-12)
    assert list(test.r2_law.values()) == pytest.approx([1.0] * 4, abs=1e-12)
    assert test.p_value == pytest.approx(1.0)
    between = fit.law.model_at({"p": 2.5})
    assert between.terms("y") == pytest.approx({"a": -5.5, "b": 2.5}, rel=1e-12)


def test_the_order_of_points_does_not_matter_to_a_law() -> None:
    backwards = dict(reversed(law_rows(0.1).items()))
    found = searched(backwards, selection=ep.EBIC())
    assert list(found.models) != list(found.fronts["y"].points)
    other = fit_law(found, STRAIGHT, parameters=AT)
    fit = fit_law(searched(law_rows(0.1), selection=ep.EBIC()), STRAIGHT, parameters=AT)
    assert other.law.coef == pytest.approx(fit.law.coef, rel=1e-9)
    assert other.tests["y"].r2_law == pytest.approx(fit.tests["y"].r2_law, rel=1e-9)


def test_a_law_that_does_not_hold_is_refused_by_the_test_and_costs_r2() -> None:
    found = searched(law_rows(0.1, bend=0.3), selection=ep.EBIC())
    bent = fit_law(found, STRAIGHT, parameters=AT).tests["y"]
    assert bent.p_value < 1e-6
    assert all(bent.r2_law[p] < bent.r2_free[p] for p in AT)
    right = fit_law(found, ep.polynomial(["p"], degree=2), parameters=AT)
    assert right.tests["y"].p_value > 0.05
    assert right.law.coef[1] == pytest.approx([0.0, 1.0, 0.3], abs=0.15)


@pytest.mark.slow
def test_a_true_law_is_rejected_as_often_as_the_level_says() -> None:
    p_values = np.array(
        [
            fit_law(searched(law_rows(0.2, seed=k), selection=ep.EBIC()), STRAIGHT, parameters=AT)
            .tests["y"]
            .p_value
            for k in range(300)
        ]
    )
    for level in (0.05, 0.3, 0.7):
        share = np.mean(p_values < level)
        assert share == pytest.approx(level, abs=3.0 * np.sqrt(level * (1.0 - level) / 300))


def test_units_of_parameters_and_points_do_not_change_a_fit_law() -> None:
    rows = law_rows(0.1)
    plain = fit_law(searched(rows, selection=ep.EBIC()), STRAIGHT, parameters=AT)
    scaled_rows = {
        p: replace(r, theta=r.theta * 1e-15, target=r.target * 1e9) for p, r in rows.items()
    }
    at = {p: {"p": 1e-6 * v["p"]} for p, v in AT.items()}
    scaled = fit_law(searched(scaled_rows, selection=ep.EBIC()), STRAIGHT, parameters=at)
    back = scaled.law.coef * 1e-24 * np.array([1.0, 1e-6])
    assert back == pytest.approx(plain.law.coef, rel=1e-7)
    assert pytest.approx(plain.tests["y"].F, rel=1e-6) == scaled.tests["y"].F


def test_a_law_with_a_term_per_point_is_free() -> None:
    points = dict(list(realization(0.05, 0).items())[:2])
    found = find(METHOD, points)
    at = {point: {"p": float(k)} for k, point in enumerate(points)}
    fit = fit_law(found, STRAIGHT, parameters=at)
    for point in points:
        free, pooled = found.models[point], fit.law.model_at(at[point])
        assert pooled.coef == pytest.approx(free.coef, rel=1e-6)
        assert free.covariance is not None
        assert pooled.covariance is not None
        # The noise level is estimated from the residuals too: n rows know it to 1/sqrt(2n).
        ratio = np.diag(pooled.covariance) / np.diag(free.covariance)
        assert ratio == pytest.approx(np.ones(len(ratio)), abs=0.8)
    assert np.isnan(fit.tests["n_i"].p_value)


@pytest.mark.slow
def test_joint_search_finds_the_family_where_single_points_fail() -> None:
    outcomes = run_family(METHOD, noises=[0.05], n_realizations=30, workers=Serial(), seed=9)
    assert outcomes["joint"].mean() >= 29 / 30
    assert outcomes[list(PARAMETERS)].mean().max() < 0.8
    # Three law terms for six points: half the coefficients, errors smaller by sqrt(2) or more.
    assert outcomes["error_law"].mean() < outcomes["error_free"].mean() / np.sqrt(2.0)


def pair(**changes: object) -> dict[str, list[ep.Trajectory]]:
    run = system_at(PARAMETERS["300V_5mgs"]).trajectory()
    return {"A": [run], "B": [replace(run, **changes)]}


@pytest.mark.parametrize(
    ("points", "changes", "message"),
    [
        ({}, {}, "no point came"),
        ({**pair(), "C": []}, {}, r"\['C'\] came without"),
        (pair(units={"n_i": "m^-3"}), {}, "'B' does not with trajectory 0 of 'A': units must"),
        (pair(), {"search": ep.AdaptiveLasso()}, "must weigh all points at once: AdaptiveLasso"),
    ],
)
def test_what_cannot_be_searched_jointly_is_refused(
    points: dict[str, list[ep.Trajectory]], changes: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        find(replace(METHOD, **changes), points)


@pytest.mark.parametrize(
    ("law", "parameters", "message"),
    [
        (STRAIGHT, {"p=1": {"p": 1.0}}, "every point needs parameters, and no other"),
        (
            STRAIGHT,
            {**AT, "p=2": {"q": 2.0}},
            r"one finite value for each of \['p'\]",
        ),
        (STRAIGHT, {p: {"p": 3.0} for p in AT}, "'p' is 3 at all 4 operating points"),
        (ep.polynomial(["p"], degree=4), AT, "a law of 5 terms needs as many points: 4 came"),
    ],
)
def test_laws_that_the_points_cannot_show_are_refused(
    law: ep.Library, parameters: dict[str, dict[str, float]], message: str
) -> None:
    found = searched(law_rows(0.1), selection=ep.EBIC())
    with pytest.raises(ValueError, match=message):
        fit_law(found, law, parameters=parameters)


def test_a_law_for_a_term_that_one_point_shows_is_refused() -> None:
    rows = {
        p: rows_of({"a": 1.0, "b": 2.0}, seed=k, noise=0.1, silent=["b"] if k else [])
        for k, p in enumerate(AT)
    }
    found = searched(rows, selection=ep.EBIC())
    assert found.chosen["y"] == ("a", "b")
    with pytest.raises(ValueError, match="too few points show the terms"):
        fit_law(found, STRAIGHT, parameters=AT)


def test_equations_without_terms_can_have_a_law() -> None:
    rows = {p: rows_of({}, seed=k, noise=1.0) for k, p in enumerate(AT)}
    found = searched(rows, selection=ep.EBIC())
    assert found.chosen["y"] == ()
    fit = fit_law(found, STRAIGHT, parameters=AT)
    assert fit.law.model_at({"p": 2.0}).terms("y") == {}
