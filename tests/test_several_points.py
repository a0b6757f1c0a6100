"""Equations of several operating points: one support, its coefficients at each, and their law."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import combinations

import numpy as np
import pandas as pd
import pytest

import ep2sindy as ep
from benchmarks import known_laws
from benchmarks.points import LIBRARY, METHOD, PARAMETERS, outcome, realization, system_at
from ep2sindy.discovery import several_points
from ep2sindy.operating.records import OperatingRecord, branches_of
from ep2sindy.regression.rows import Formulation, RegressionRows
from ep2sindy.selection.criteria import Selection, log_supports
from tests.models import lienard, plain_rows
from tests.test_operating_law import LIBRARY as OSCILLATOR
from tests.test_operating_law import STRUCTURE, recorded

NAMES = ["a", "b", "c", "d", "e", "f"]
BIC = ep.EBIC(gamma=0.0, coarsening=None)


@dataclass(frozen=True)
class Given:
    """Rows made by a test, found by the parameter of their trajectory."""

    rows: Mapping[float, RegressionRows]
    smoother: None = None

    def assemble(
        self,
        trajectories: Sequence[ep.Trajectory],
        library: ep.Library,
        *,
        rng: np.random.Generator,
    ) -> tuple[RegressionRows, ...]:
        rows = self.rows[trajectories[0].parameters["p"]]
        return (replace(rows, trajectories=tuple(trajectories)),)


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


def searched(
    rows: Mapping[float, RegressionRows],
    *,
    selection: Selection = METHOD.selection,
    **asked: object,
) -> ep.Discovery:
    """What is found from rows at points p; `points` of it has the labels "p=1" and so on."""
    ramp, values = np.arange(3.0), np.ones((3, 6))
    return ep.discover(
        [
            ep.Trajectory(ramp, ramp[:, None], ["y"], values, NAMES, parameters={"p": p})
            for p in rows
        ],
        ep.named_terms(NAMES, NAMES),
        ep.Regression(formulation=Given(rows), search=ep.BestSubset(), selection=selection),
        **({"shared": True} | asked),
    )


def terms_in(found: ep.Discovery, state: str = "y") -> tuple[str, ...]:
    """The support that all points share."""
    front = next(iter(found.points.values())).fronts[state]
    return front.best.terms


def family(noise: float, number: int) -> list[ep.Trajectory]:
    return [
        replace(run, parameters=PARAMETERS[point])
        for point, runs in realization(noise, number).items()
        for run in runs
    ]


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
    here = [replace(run, parameters={"a": 1.0})]
    (shared,) = ep.discover(here, library, recipe, shared=True, seed=1).points.values()
    for state, front in alone.fronts.items():
        own = shared.fronts[state]
        assert [c.terms for c in own.candidates] == [c.terms for c in front.candidates]
        assert own.errors == pytest.approx(front.errors, rel=1e-12)
        assert own.scores == pytest.approx(front.scores, rel=1e-12)
        assert shared.chosen[state].terms == alone.chosen[state].terms
    assert shared.model.coef == pytest.approx(alone.model.coef, rel=1e-6)


def test_noise_free_equations_come_back_at_every_point() -> None:
    found = ep.discover(family(0.0, 0), LIBRARY, METHOD, shared=True)
    for own, parameters in zip(found.points.values(), PARAMETERS.values(), strict=True):
        assert own.model.coef == pytest.approx(system_at(parameters).model.coef, rel=1e-8)


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
        1.0: rows_of({"a": 1.0}, seed=0, noise=0.1),  # its coefficient vanishes
        2.0: rows_of({"a": 1.0, "b": 0.5}, seed=1, noise=0.1, silent=["b"]),  # its signal does
        3.0: rows_of({"a": 2.0, "b": -0.5}, seed=2, noise=0.1),
        4.0: rows_of({"a": 1.5, "b": 0.6}, seed=3, noise=0.1),
    }
    found = searched(rows)
    assert found.points["p=4"].fronts["y"].best.terms == ("a", "b")
    models = {point: own.model.terms("y") for point, own in found.points.items()}
    assert models["p=3"] == pytest.approx({"a": 2.0, "b": -0.5}, abs=0.05)
    assert models["p=1"]["b"] == pytest.approx(0.0, abs=0.05)
    assert list(models["p=2"]) == ["a"]
    (ambiguity,) = found.points["p=2"].ambiguities
    assert ambiguity.message == "'b' is zero on every row and is left out"
    assert found.points["p=3"].ambiguities == ()
    for p in (1.0, 2.0):
        assert terms_in(searched({p: rows[p]})) == ("a",)


def test_terms_taken_in_by_chance_at_single_points_are_dropped() -> None:
    truth = {"a": 1.0, "b": -0.6, "c": 0.4}
    rows = {float(k): rows_of(truth, seed=k, noise=0.5, n_rows=30) for k in range(8)}
    alone = searched(rows, selection=BIC, shared=False).points.values()
    assert sum(set(own.chosen["y"].terms) - set(truth) != set() for own in alone) >= 2
    assert terms_in(searched(rows, selection=BIC)) == ("a", "b", "c")


def test_terms_that_repeat_each_other_at_one_point_are_told_apart_by_another() -> None:
    rows = {p: rows_of({"b": 1.0}, seed=k, noise=0.1) for k, p in enumerate((1.0, 2.0))}
    alike = rows[1.0].theta.copy()
    alike[:, 0] = 3.0 * alike[:, 1]
    rows[1.0] = replace(rows[1.0], theta=alike)
    assert terms_in(searched({1.0: rows[1.0]})) == ("a",)
    found = searched(rows)
    assert [own.chosen["y"].terms for own in found.points.values()] == [("b",)] * 2


def test_scores_are_common_and_errors_are_of_each_point() -> None:
    truth = {"a": 1.0, "b": -0.6}
    rows = {float(k): rows_of(truth, seed=k, noise=0.1 * 10.0**k) for k in range(3)}
    fronts = [own.fronts["y"] for own in searched(rows, selection=BIC).points.values()]
    for front in fronts[1:]:
        np.testing.assert_array_equal(front.scores, fronts[0].scores)
    shared = np.prod([front.errors for front in fronts], axis=0)
    assert np.all(np.diff(shared) < 0)  # each size is the best of its own, over all points
    single = [searched({p: r}, selection=BIC).points[f"p={p:g}"] for p, r in rows.items()]
    for front, own in zip(fronts, single, strict=True):
        at = [c.n_terms for c in own.fronts["y"].candidates]
        assert (front.errors[: len(at)] >= own.fronts["y"].errors * (1 - 1e-12)).all()


@pytest.mark.parametrize("selection", [BIC, ep.EBIC()], ids=lambda s: s.label)
def test_units_and_amplitude_of_one_point_change_nothing(selection: Selection) -> None:
    truth = {"a": 1.0, "b": -0.6, "c": 0.1}
    rows = {float(k): rows_of(truth, seed=k, noise=0.5) for k in range(4)}
    plain = searched(rows, selection=selection)
    scale = np.array([1e18, 1e-14, 1.0, 1e30, 1e-5, 3.0])
    other = replace(rows[1.0], theta=rows[1.0].theta * scale, target=rows[1.0].target * 1e20)
    scaled = searched({**rows, 1.0: other}, selection=selection)
    one, two = (found.points["p=1"] for found in (plain, scaled))
    before, after = (own.fronts["y"] for own in (one, two))
    assert [c.terms for c in after.candidates] == [c.terms for c in before.candidates]
    assert np.diff(after.scores) == pytest.approx(np.diff(before.scores), rel=1e-9)
    assert two.model.coef[:, 0] * scale / 1e20 == pytest.approx(one.model.coef[:, 0], rel=1e-9)


def test_order_of_points_changes_nothing() -> None:
    runs = family(0.05, 1)
    split = replace(
        METHOD, formulation=ep.Weak(test_functions=ep.regression.Bumps(half_width_s=0.8))
    )
    forth, back = (ep.discover(each, LIBRARY, split, law=1) for each in (runs, runs[::-1]))
    assert list(forth.points) == [*reversed(back.points)]
    for point, own in forth.points.items():
        assert np.array_equal(own.model.coef, back.points[point].model.coef)
    assert back.law.coef == pytest.approx(forth.law.coef, rel=1e-9)
    assert back.law.left_out == pytest.approx(forth.law.left_out[::-1], rel=1e-6)


def test_points_may_be_sampled_differently_and_have_several_runs() -> None:
    fast, slow = (
        replace(ep.lotka_volterra(), rate_Hz=25.0, duration_s=30.0).trajectory(),
        ep.lotka_volterra(b=0.5).trajectory(),
    )
    parts = [slow.window(0, 600), fast, slow.window(600, 1000)]  # runs of a point need not follow
    runs = [
        replace(run, parameters={"b": b}) for run, b in zip(parts, (0.5, 1.0, 0.5), strict=True)
    ]
    library = ep.polynomial(["x", "y"], degree=3)
    method = ep.Regression(ep.WeightedWeak(), ep.BestSubset(), selection=ep.EBIC())
    found = ep.discover(runs, library, method, shared=True)
    assert list(found.points) == ["b=0.5", "b=1"]
    for point, b in (("b=1", 1.0), ("b=0.5", 0.5)):
        terms = found.points[point].model.terms("x")
        assert terms == pytest.approx({"x": 2 / 3, "x*y": -b}, rel=1e-6)


def test_the_count_of_supports_is_paid_once() -> None:
    rows = {float(k): rows_of({"a": 1.0, "b": 0.5}, seed=k, noise=0.5) for k in range(5)}
    plain, full = (
        searched(rows, selection=ep.EBIC(gamma=gamma)).points["p=0"].fronts["y"]
        for gamma in (0.0, 0.7)
    )
    library = ep.named_terms(NAMES, NAMES)
    counts = np.array([log_supports(library, c.terms) for c in plain.candidates])
    assert full.scores == pytest.approx(plain.scores + 1.4 * counts, rel=1e-12)


def law_rows(
    noise: float, *, seed: int = 0, bend: float = 0.0, n_points: int = 6
) -> dict[float, RegressionRows]:
    """a follows 2 - 3 p, b follows p + bend p^2 over the points."""
    return {
        float(p): rows_of(
            {"a": 2.0 - 3.0 * p, "b": p + bend * p**2}, seed=20 * seed + p, noise=noise * (1 + p)
        )
        for p in range(1, 1 + n_points)
    }


def test_a_law_that_holds_is_recovered_exactly() -> None:
    law = searched(law_rows(0.0), law=1).law
    assert law.coefficients == (("y", "a"), ("y", "b"))
    assert law.coef == pytest.approx(np.array([[2.0, -3.0], [0.0, 1.0]]), abs=1e-12)
    assert law.left_out == pytest.approx(np.zeros(6), abs=1e-12)
    assert law.at(p=2.5).terms("y") == pytest.approx({"a": -5.5, "b": 2.5}, rel=1e-12)


def test_a_law_is_least_squares_over_the_rows_of_points_that_weigh_alike() -> None:
    rows = law_rows(0.3, bend=0.2)
    found = searched(rows, law=1)
    p = np.array(list(rows))
    own = np.array([each.model.coef[:2, 0] for each in found.points.values()])
    size = np.sqrt(np.square(own).mean(axis=0))  # of every coefficient over the points
    parts = [(r.theta[:, :2], r.target[:, 0]) for r in rows.values()]

    def pooled(kept: Sequence[int]) -> np.ndarray:
        weight = {k: 1.0 / np.linalg.norm(parts[k][0] * size) for k in kept}
        design = [weight[k] * np.kron(parts[k][0], [[1.0, p[k]]]) for k in kept]
        target = [weight[k] * parts[k][1] for k in kept]
        return np.linalg.lstsq(np.concatenate(design), np.concatenate(target))[0].reshape(2, 2)

    every = range(len(p))
    assert found.law.coef == pytest.approx(pooled(every), rel=1e-9)
    without = np.array([pooled([j for j in every if j != k]) for k in every])
    off = np.einsum("pcf,fp->pc", without, np.array([np.ones(6), p])) - own
    missed = [
        np.linalg.norm(theta @ d) / np.linalg.norm(theta @ z)
        for (theta, _), d, z in zip(parts, off, own, strict=True)
    ]
    assert found.law.left_out == pytest.approx(missed, rel=1e-9)
    # The jackknife: how far the law moves if a point is left out.
    apart = (without - without.mean(axis=0)).reshape(6, -1)
    assert found.law.covariance == pytest.approx(5 / 6 * apart.T @ apart, rel=1e-7)


@pytest.mark.parametrize(
    ("bend", "functions"),
    [({"b": "1/p"}, {"1", "p", "1/p"}), ({"b": "p^2"}, {"1", "p", "p^2"}), ({}, {"1", "p"})],
)
def test_the_functions_of_a_law_are_found(bend: Mapping[str, str], functions: set[str]) -> None:
    shape = {"1/p": lambda p: 8.0 / p, "p^2": lambda p: 0.3 * p**2}
    rows = {
        float(p): rows_of(
            {"a": 2.0 - 3.0 * p, "b": shape[bend["b"]](p) if bend else 0.7 * p}, seed=p, noise=0.02
        )
        for p in range(1, 11)
    }
    law = searched(rows, law="auto").law
    assert set(law.functions.names) >= functions
    if bend:
        assert set(law.functions.names) == functions
        given = searched(rows, law=[1, ep.named_terms(["p"], sorted(functions))]).law
        assert set(given.functions.names) == functions
    one = searched(rows, law=[1, 2, 3]).law
    assert len(one.functions) == {"1/p": 4, "p^2": 3}.get(bend.get("b", ""), 2)
    straight = searched(rows, law=1).law.left_out
    assert (law.left_out.max() < 0.3 * straight.max()) == bool(bend)


def test_units_of_parameters_and_points_do_not_change_a_law() -> None:
    rows = law_rows(0.1)
    plain = searched(rows, law=1).law
    small = {
        1e-6 * p: replace(r, theta=r.theta * 1e-15, target=r.target * 1e9) for p, r in rows.items()
    }
    scaled = searched(small, law=1).law
    back = scaled.coef * 1e-24 * np.array([1.0, 1e-6])
    assert back == pytest.approx(plain.coef, rel=1e-7)
    assert scaled.left_out == pytest.approx(plain.left_out, rel=1e-7)


def test_a_law_with_a_function_per_point_is_free_and_has_no_intervals() -> None:
    found = searched(law_rows(0.1, n_points=2), law=1)
    for own, p in zip(found.points.values(), (1.0, 2.0), strict=True):
        assert found.law.at(p=p).coef == pytest.approx(own.model.coef, rel=1e-9)
    assert found.law.covariance is None
    assert found.law.left_out is None
    with pytest.raises(ValueError, match="its points do not suffice for a law without each"):
        found.law.intervals()


def test_a_law_that_hangs_on_one_point_has_no_errors_where_it_is_left_out() -> None:
    rows = {
        float(k): rows_of({"a": 1.0, "b": 2.0}, seed=k, silent=["b"] if k > 1 else [])
        for k in range(1, 5)
    }
    law = searched(rows, law=1).law
    assert law.at(p=1.0).terms("y") == pytest.approx({"a": 1.0, "b": 2.0}, rel=1e-9)
    assert law.at(p=3.0).terms("y")["a"] == pytest.approx(1.0, rel=1e-9)
    assert law.left_out is None
    assert law.covariance is None


def test_equations_without_terms_can_have_a_law() -> None:
    rows = {float(k): rows_of({}, seed=k, noise=1.0) for k in range(1, 5)}
    found = searched(rows, law=1)
    assert terms_in(found) == ()
    assert found.law.at(p=2.0).terms("y") == {}


@pytest.mark.slow
def test_one_support_finds_the_family_where_single_points_fail() -> None:
    rows = pd.DataFrame([outcome((0.05, number)) for number in range(30)])
    assert rows["together"].mean() >= 29 / 30
    assert rows[[*PARAMETERS]].mean().max() < 0.8
    # Three functions for six points: half the numbers, errors smaller by sqrt(2) or more.
    assert rows["error_law"].mean() < rows["error_alone"].mean() / np.sqrt(2.0)


RELATIONS, KNOWN = ["n_i: n_i*n_n == -1 * n_n: n_i*n_n"], {"n_n": {"1": {"mdot_mgs": 0.015}}}


@pytest.mark.parametrize(
    "method", [METHOD, ep.TrajectorySearch(max_terms=3)], ids=lambda m: type(m).__name__
)
def test_relations_and_known_coefficients_are_exact_at_points_and_in_laws(
    method: ep.Regression | ep.TrajectorySearch,
) -> None:
    found = ep.discover(
        family(0.01, 2),
        LIBRARY.relate(*RELATIONS).known(KNOWN).exclude({"n_i": ["n_n"]}),
        method,
        law=1,
    )
    at = {"V_D": 310.0, "mdot_mgs": 4.4}
    models = [own.model for own in found.points.values()]
    places = list(zip(models, PARAMETERS.values(), strict=True))
    for model, point in [*places, (found.law.at(**at), at)]:
        n_i, n_n = model.terms("n_i"), model.terms("n_n")
        assert (set(n_i), set(n_n)) == ({"n_i", "n_i*n_n"}, {"1", "n_i*n_n"})
        assert n_i["n_i*n_n"] == -n_n["n_i*n_n"]
        assert n_n["1"] == pytest.approx(0.015 * point["mdot_mgs"], rel=1e-15)
    assert "exact: n_n: 1 == 0.015 * mdot_mgs" in repr(found)


@cache
def predators(noise: float = 0.0) -> tuple[ep.Trajectory, ...]:
    """What the prey loses, the predators gain: growth goes with the parameter."""
    return tuple(
        replace(
            ep.lotka_volterra(a=a, d=0.3 + 0.1 * a).trajectory(noise=noise, rng=k),
            parameters={"a": a},
        )
        for k, a in enumerate((0.5, 0.6, 0.7, 0.8, 0.9))
    )


def test_roles_hold_at_every_point_and_in_the_law() -> None:
    roles = ep.Roles(exchange=[("x", "y")], outflow=["y"], inflow={"x": ["x"]}, nonnegative=True)
    method = ep.Regression(selection=ep.FreeRunScore(bounds=None))
    runs = [run.window(0, 500) for run in predators()[:3]]
    found = ep.discover(runs, ep.polynomial(["x", "y"]).with_roles(roles), method, law=1)
    for model in [*(own.model for own in found.points.values()), found.law.at(a=0.65)]:
        assert model.terms("x")["x*y"] == -model.terms("y")["x*y"]
    assert found.law.at(a=0.65).terms("x") == pytest.approx({"x": 0.65, "x*y": -1.0}, rel=1e-4)


def test_points_without_a_law_are_searched_alone_as_by_themselves() -> None:
    runs, method = predators(0.02), ep.Regression()
    found = ep.discover(runs, method=method)
    assert found.law is None
    assert list(found.points) == [f"a={a}" for a in (0.5, 0.6, 0.7, 0.8, 0.9)]
    for run, own in zip(runs, found.points.values(), strict=True):
        assert own.model.coef == pytest.approx(
            ep.discover(run, method=method).model.coef, rel=1e-12
        )
    assert found.model == found.points["a=0.7"].model  # the most central point's


def test_every_number_of_a_discovery_of_points_survives_a_file() -> None:
    found = ep.discover(predators(0.02), method=ep.Regression(), law=1)
    again = ep.Discovery.from_json(found.to_json())
    assert again.to_json() == found.to_json()
    assert again.law.to_json() == found.law.to_json()
    assert list(again.points) == list(found.points)
    for own, other in zip(again.points.values(), found.points.values(), strict=True):
        assert own.model == other.model
    assert repr(again) == repr(found)


def lienards(scale: Mapping[tuple[float, ...], float], *names: str) -> list[ep.Trajectory]:
    """One record at every point (parameters), of cycles that are larger by a factor."""
    run = recorded(1.0, 0.0).run
    return [
        replace(run, states=run.states * each, parameters=dict(zip(names, point, strict=True)))
        for point, each in scale.items()
    ]


LIENARD = OSCILLATOR.only(STRUCTURE)


def test_where_no_law_holds_the_records_are_interpolated() -> None:
    """Everything is faster by half between the second point and the third."""
    runs = lienards({(1.0,): 1.0, (2.0,): 1.01, (3.0,): 1.02, (4.0,): 1.03}, "a")
    runs[2:] = [replace(run, t=run.t / 1.5) for run in runs[2:]]
    choice = ep.discover(runs, LIENARD, ep.Regression(), law=1).law_choice
    assert choice.heading == "interpolate: the law holds at 0 of 2 points left out"
    assert choice.text.endswith(
        "expect no less at a point that nobody measured, or record one nearby."
    )
    assert not choice.is_trusted
    cycle = choice.interpolation.at(a=2.5)
    slow = OperatingRecord(runs[0]).cycle.frequency_Hz
    assert slow < cycle.frequency_Hz[0] < 1.5 * slow
    assert {*cycle.amplitude} == {"x", "y"}


def test_a_second_cycle_is_set_aside_only_if_no_law_holds_at_both() -> None:
    places = {(0.5,): 1.0, (0.7,): 1.01, (0.9,): 1.02, (1.1,): 0.2, (1.3,): 1.03, (1.5,): 1.04,
              (1.7,): 1.05}  # fmt: skip
    found = ep.discover(lienards(places, "a"), LIENARD, ep.Regression(), law=1)
    assert [*found.points] == [f"a={a}" for (a,) in places if a != 1.1]
    assert len(found.law.points) == 6
    assert found.law_choice.cycle == "strong"
    (warning,) = found.data_warnings
    assert "of the 6 points on the strong one; on the other are a=1.1" in warning
    # The factor of x^3 is 1 + 24 a b, so that the amplitude is a fifth at the last point.
    points = [(0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (0.0, 0.5), (0.0, 1.0), (1.0, 0.04), (1.0, 1.0)]
    runs = lienards(
        {(a, b): (1.0 + 1e-3 * k) / np.sqrt(1.0 + 24.0 * a * b) for k, (a, b) in enumerate(points)},
        "a", "b",
    )  # fmt: skip
    assert branches_of([OperatingRecord(run) for run in runs]).tolist() == [0] * 6 + [1]
    both = ep.named_terms(["a", "b"], ["1", "a*b"])
    found = ep.discover(runs, LIENARD, ep.Regression(), law=both)
    assert (len(found.points), found.law_choice.cycle, found.data_warnings) == (7, "all", ())


def test_a_law_of_one_signal_is_judged_by_it_and_follows_long_windows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    signals, windows, refine = [], [], several_points.fit_trajectories
    for k, a in enumerate((0.9, 1.0, 1.1, 1.2)):
        run = lienard(a)
        x = run.states[:, :1] + 0.005 * np.random.default_rng(k).normal(size=(run.n_samples, 1))
        signal = ep.Trajectory(run.t, x, ["p"], parameters={"a": a})
        signals.append(ep.signals.prepare_signal(signal))

    def recorded(*given: object, **settings: object) -> object:
        windows.append(given[2].periods)
        return refine(*given, **settings)

    monkeypatch.setattr(several_points, "fit_trajectories", recorded)
    made = ep.signals.embed_alike(signals)
    library = made[0].library(degree=3).only({"v": ["p", "v", "p^2*v"]})
    choice = ep.discover([each.run for each in made], library, law="auto").law_choice
    assert windows == [8.0]
    assert choice.choice.assessed == ["p"]
    assert {(*point.run.assessed,) for point in choice.runs} == {(0,)}
    assert choice.is_trusted


UNLIKE = "runs of several operating points need the same parameters"


@pytest.mark.parametrize(
    ("changes", "asked", "message"),
    [
        ({"parameters": {"b": 1.0}}, {}, UNLIKE),
        (
            {"units": {"x": "m^-3"}},
            {"law": 1},
            "'x' is in 1 in trajectory 0 and in m.-3 in trajectory 2",
        ),
        ({}, {"law": 1, "hidden": ["z"]}, r"samples of every state, got .*z.* as hidden"),
        (
            {},
            {"law": 1, "method": ep.Regression(search=ep.AdaptiveLasso())},
            "must weigh all points at once: AdaptiveLasso",
        ),
    ],
)
def test_what_cannot_be_asked_of_several_points_is_refused(
    changes: dict[str, object], asked: dict[str, object], message: str
) -> None:
    runs = [*predators()[:2], replace(predators()[4], **changes)]
    with pytest.raises(ValueError, match=message):
        ep.discover(runs, **({"method": ep.Regression()} | asked))


def test_a_law_needs_parameters_that_vary() -> None:
    runs = [replace(run, parameters={"a": run.parameters["a"], "b": 2.0}) for run in predators()]
    with pytest.raises(ValueError, match="'b' is 2 at all 5 operating points; leave it out"):
        ep.discover(runs, method=ep.Regression(), law=1)


@pytest.mark.slow
@pytest.mark.parametrize("system", known_laws.LAWS)
def test_a_known_law_is_found_from_twelve_noisy_records(system: str) -> None:
    truth, points = known_laws.truth(system), known_laws.POINTS[system]
    runs = known_laws.records(system, noise=0.05, seed=0)
    found = ep.discover(runs, truth.library, law="auto")
    for state, terms in known_laws.LAWS[system].items():
        assert set(found.law.numbers[state]) == set(terms)
    true, own = (
        np.array([law.at(extrapolate=True, **at).coef for at in points])
        for law in (truth, found.law)
    )
    off = own[true != 0.0] / true[true != 0.0] - 1.0
    assert np.sqrt(np.square(off).mean()) < 0.01
    left_out = found.law.left_out[found.law.left_out < 1.0]  # of refinements that converged
    assert len(left_out) >= 11
    assert left_out.max() < 0.01
