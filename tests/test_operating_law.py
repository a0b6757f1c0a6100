"""Laws of the operating point: known families, points left out, files, and what is refused."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.model.comparison import Status
from ep2sindy.operating import law_fit
from ep2sindy.operating.law import OperatingLaw, constrain_law, in_hull, read_law
from ep2sindy.operating.left_out import (
    MOST,
    WORST,
    LawChoice,
    LawTrial,
    LeftOutRun,
    choose_law,
    error_statistics,
    run_freely,
    window_errors,
)
from ep2sindy.operating.point_fits import PointFits, fit_rows, fit_trajectories
from ep2sindy.operating.records import OperatingRecord, branches_of
from ep2sindy.refinement.refine import with_coef
from ep2sindy.regression.pooled import Basis, fewest_of_least, invert_covariance
from tests.models import plain_rows

STATES = ("x", "y")
LIBRARY = ep.polynomial(STATES, degree=3)
STRUCTURE = {"x": ["x", "y", "x^3"], "y": ["x"]}
# Lienard's van der Pol at two parameters, every coefficient linear in them.
LAW = {"x": {"x": (0.8, 0.3, 0.0), "y": (-1.0, 0.0, -0.2), "x^3": (-0.4, 0.0, 0.1)},
       "y": {"x": (1.0, 0.2, 0.1)}}  # fmt: skip
SHORT = ep.refinement.RefinementSettings(n_windows=3, periods=1.0, n_reweights=0)
GRID = [{"a": a, "b": b} for a in (0.5, 1.0, 1.5) for b in (0.0, 0.5, 1.0)]
LINEAR = ep.polynomial(["a", "b"], degree=1)
LINE = (0.5, 0.75, 1.0, 1.25, 1.5)


def model_at(a: float, b: float) -> ep.SparseModel:
    terms = [{t: c[0] + c[1] * a + c[2] * b for t, c in LAW[s].items()} for s in STATES]
    return ep.SparseModel(LIBRARY, STATES, ep.model.coef_matrix(LIBRARY, terms))


@cache
def recorded(a: float, b: float, end: float = 60.0) -> OperatingRecord:
    t = np.arange(0.0, end, 0.1)
    run = model_at(a, b).simulate(np.append(0.0, 40.0 + t), [1.0, 0.0])
    states = run.states[1:]
    return OperatingRecord(ep.Trajectory(t, states, STATES, parameters={"a": a, "b": b}))


@cache
def records() -> tuple[OperatingRecord, ...]:
    return tuple(recorded(**point) for point in GRID)


def by_rows(runs: Sequence[ep.Trajectory]) -> PointFits:
    """Fits to samples with the true derivatives."""
    parameters, problems = list(runs[0].parameters), []
    for run in runs:
        slopes = model_at(**{"b": 0.0, **run.parameters}).predict(run.states)
        rows = plain_rows(LIBRARY.evaluate(run.states), slopes, LIBRARY, STATES)
        problems.append([replace(rows, trajectories=(run,))])
    held = constrain_law(LIBRARY, STRUCTURE, parameters=parameters)
    values = np.array([list(run.parameters.values()) for run in runs])
    return fit_rows(parameters, values, problems, held, provenance={})


@cache
def fit() -> PointFits:
    """Refined at every point, from coefficients that are far off."""
    runs = [record.run for record in records()]
    rows = by_rows(runs)
    start = replace(rows, models=[replace(m, coef=1.1 * m.coef) for m in rows.models])
    return fit_trajectories([start], [[run] for run in runs], SHORT)[0]


@cache
def law() -> OperatingLaw:
    return fit().law(LINEAR)


def truth() -> np.ndarray:
    return np.array([row for state in STATES for row in LAW[state].values()])


def test_the_law_of_a_known_family_is_found() -> None:
    assert law().coefficients == (("x", "x"), ("x", "y"), ("x", "x^3"), ("y", "x"))
    # rk4 at 0.1 of a time unit near one, on a stiff corner of the relaxation oscillation.
    np.testing.assert_allclose(law().coef, truth(), atol=1e-4)
    assert law().left_out.max() < 1e-3
    exact = by_rows([record.run for record in records()]).law(LINEAR)
    np.testing.assert_allclose(exact.coef, truth(), atol=1e-10)
    assert exact.left_out.max() < 1e-10


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"coef": np.ones((3, 3))}, r"a finite number for every .* shape \(3, 3\) for \(4, 3\)"),
        ({"coefficients": (("x", "x"), ("x", "y"), ("x", "q"), ("y", "x"))}, "got q of x"),
        ({"left_out": np.zeros(4)}, r"an error for each of 9 points, got shape \(4,\)"),
    ],
)
def test_a_law_holds_numbers_that_fit_each_other(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(law(), **({"left_out": None} | change))


def test_a_model_between_the_points_is_the_true_one() -> None:
    at = {"a": 0.8, "b": 0.3}
    model = law().at(**at)
    np.testing.assert_allclose(model.coef, model_at(**at).coef, atol=1e-4)
    assert model.provenance["point"] == "a=0.8, b=0.3"
    low, high = model.intervals("x")["x"]
    assert low < model.terms("x")["x"] < high


def test_a_model_outside_the_points_must_be_asked_for() -> None:
    at = {"a": 2.0, "b": 0.5}
    with pytest.raises(ValueError, match=r"outside the points.* a 0.5 to 1.5, b 0 to 1"):
        law().at(**at)
    model = law().at(extrapolate=True, **at)
    np.testing.assert_allclose(model.coef, model_at(**at).coef, atol=1e-3)
    assert not law().is_inside(at)
    assert law().is_inside(GRID[0])


@pytest.mark.parametrize("at", [{"a": 1.0}, {"a": 1.0, "c": 0.0}, {"a": 1.0, "b": np.nan}])
def test_a_model_needs_every_parameter(at: Mapping[str, float]) -> None:
    with pytest.raises(ValueError, match="an operating point must"):
        law().at(**at)


def test_a_hull_may_be_flat_or_a_triangle() -> None:
    line = np.array([[0.0, 0.0], [1.0, 1e3]])
    assert in_hull(line, np.array([0.5, 500.0]))
    assert not in_hull(line, np.array([0.5, 600.0]))
    triangle = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert in_hull(triangle, np.array([0.5, 0.5]))
    assert not in_hull(triangle, np.array([0.51, 0.51]))


def test_every_number_survives_a_file() -> None:
    again = OperatingLaw.from_json(law().to_json())
    assert again.to_json() == law().to_json()
    np.testing.assert_array_equal(again.coef, law().coef)
    np.testing.assert_array_equal(again.covariance, law().covariance)
    with pytest.raises(ValueError, match="a law file must hold ep2sindy.OperatingLaw/1 JSON"):
        OperatingLaw.from_json("{}")


def test_intervals_follow_the_covariance() -> None:
    bounds = law().intervals()["x", "x"]
    assert list(bounds) == ["1", "a", "b"]
    reach = 0.5 * (bounds["1"][1] - bounds["1"][0])
    assert reach == pytest.approx(1.959964 * np.sqrt(law().covariance[0, 0]))
    with pytest.raises(ValueError, match="this law has none"):
        replace(law(), covariance=None).intervals()


def test_a_law_of_more_terms_than_the_records_determine_says_so() -> None:
    """On a cycle, x^2*y and x*y^2 make up for what they change in each other and in x."""
    line = [replace(recorded(a, 0.0).run, parameters={"a": a}) for a in LINE]
    noisy = [
        replace(run, states=run.states + 0.03 * np.random.default_rng(k).normal(size=(600, 2)))
        for k, run in enumerate(line)
    ]
    more = {"x": [*STRUCTURE["x"], "x^2*y", "x*y^2"], "y": ["x"]}
    right, wide = (
        ep.discover(noisy, LIBRARY.only(terms), ep.Regression(formulation=ep.Weak()), law=1).law
        for terms in (STRUCTURE, more)
    )
    assert right.undetermined == []
    assert "numbers of" not in right.text()
    assert wide.undetermined == [("x", "x^2*y"), ("x", "x*y^2")]
    assert wide.text().endswith(
        "12 numbers of 5 points: of 6 coefficients, 2 are not told from zero, x: x^2*y, x: x*y^2; "
        "leave terms out, or add points"
    )
    few = by_rows(line[:2]).law(ep.polynomial(["a"], degree=1))
    assert "8 numbers of 2 points: none is left over" in few.text()


def test_intervals_by_the_jackknife_hold_the_truth() -> None:
    """Noise that differs tenfold between the points, and coefficients that leave the law a bit."""
    p, held = np.linspace(1.0, 3.0, 12), []
    lib = ep.named_terms(["u", "v"], ["u", "v"])
    relations = constrain_law(lib, {"y": ["u", "v"]}, parameters=["p"])
    line, true = ep.polynomial(["p"], degree=1), np.array([[2.0, -3.0], [0.5, 1.0]])
    ramp = ep.Trajectory(np.arange(3.0), np.arange(3.0)[:, None], ["y"])
    for seed in range(60):
        rng, problems = np.random.default_rng(seed), []
        for value in p:
            theta = rng.normal(size=(40, 2))
            own = true @ [1.0, value] + 0.03 * rng.normal(size=2)
            noise = 0.05 * 10.0 ** rng.uniform() * rng.normal(size=40)
            rows = plain_rows(theta, (theta @ own + noise)[:, None], lib)
            problems.append([replace(rows, trajectories=(ramp,))])
        found = fit_rows(["p"], p[:, None], problems, relations, provenance={}).law(line)
        ends = found.intervals()
        held += [
            low <= value <= high
            for pair, row in zip(found.coefficients, true, strict=True)
            for (low, high), value in zip(ends[pair].values(), row, strict=True)
        ]
    assert 0.88 <= np.mean(held) <= 0.99


@cache
def trial() -> LawTrial:
    return LawTrial("free", fit(), LINEAR, records(), None, np.zeros(9))


@cache
def chosen() -> LawChoice:
    return choose_law([trial()])


def test_points_left_out_live_by_the_law_of_the_others() -> None:
    found = chosen().runs
    assert all(each.run.holds for each in found)
    # A frequency read off the periods of a record.
    assert max(abs(each.run.f_error) for each in found) < 5e-3
    # Of three by three the corners are outside of what the others enclose.
    assert [each.inside for each in found].count(True) == 5
    assert max(each.deviation for each in found) < 1.0
    numbers = error_statistics(found)
    assert (numbers["n"], numbers["n_sustained"], numbers["diverging"]) == (9, 9, 0)
    assert numbers["f_90"] < 5e-3


def test_interpolation_is_that_of_the_other_points_where_they_enclose_one() -> None:
    found = chosen().runs
    own = np.array([(r.cycle.frequency_Hz, *r.cycle.std) for r in records()])
    values = chosen().interpolation.functions.evaluate(fit().points)
    for k, each in enumerate(found):
        errors = tuple(each.interpolated.values())
        if not each.inside:
            assert np.isnan(errors).all()
            continue
        to_others = np.linalg.lstsq(np.delete(values, k, 0), np.delete(own, k, 0))[0]
        off = np.abs(values[k] @ to_others / own[k] - 1.0)
        assert errors == pytest.approx((off[0], off[1:].max()), rel=1e-6)
    numbers, inside = error_statistics(found), [each for each in found if each.inside]
    assert numbers["n_enclosed"] == 5
    own = [each.interpolated["frequency"] for each in inside]
    assert numbers["f_interpolated"] == np.median(own)
    assert numbers["f_enclosed"] == np.median([abs(each.run.f_error) for each in inside])


def gone(point: LeftOutRun) -> LeftOutRun:
    """The same point, at which the run diverges."""
    run = point.run
    lost = replace(run.comparison, status=Status.DIVERGES, is_similar=False, f_error=float("nan"))
    rollout = replace(run.rollout, diverged=True)
    return replace(point, run=replace(run, comparison=lost, rollout=rollout))


def test_a_point_without_a_frequency_has_an_infinite_error_of_it() -> None:
    found = chosen().runs
    numbers = error_statistics([gone(found[0]), *found[1:]])
    assert numbers["n_sustained"] == 8
    assert numbers["f_90"] == np.inf
    assert numbers["f_median"] < 5e-3


def test_windows_tell_the_true_model_from_a_biased_one_and_one_that_blows_up() -> None:
    (point,), record = GRID[4:5], records()[4]
    true = model_at(**point)
    biased, wild = (replace(true, coef=fraction * true.coef) for fraction in (1.02, -30.0))
    right, off, gone = window_errors([true, biased, wild], record.run)
    assert right < 1e-4
    assert 100.0 * right < off < 1.0
    assert gone == pytest.approx(1.0, abs=1e-3)
    longer = window_errors([true, biased], record.run, periods=3.0)
    assert longer[1] > 2.0 * off  # a wrong frequency shows in the phase


def test_a_law_fitted_to_windows_of_all_records_is_not_bent_by_points_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Fits of points err where their records hardly tell, each by a third of the coefficients."""
    monkeypatch.setattr(law_fit, "ACCURATE", 1e-9)  # of the steps, which else leave 3e-5
    runs = [replace(recorded(a, 0.0, 30.0).run, parameters={"a": a}) for a in LINE]
    straight, exact = ep.polynomial(["a"], degree=1), by_rows(runs)
    models = []
    for k, (own, model) in enumerate(zip(exact.information, exact.models, strict=True)):
        sloppy = np.linalg.eigh(own * np.outer(exact.size, exact.size))[1][:, 0] * exact.size
        common = exact.relations.at(exact.points)[k]
        coef = common.coef(exact.coefficients[k] + 0.3 * (-1.0) ** (k // 2) * sloppy)
        models.append(with_coef(model, common, coef)[0])
    bent = replace(exact, models=models)
    found = law_fit.follow_windows(bent, straight, runs, n_windows=6, periods=1.0)
    true = exact.pool(straight)
    for number in (None, 2):
        before, after = (each.pool(straight, without=number) for each in (bent, found))
        assert np.abs(before - true).max() > 1e-2
        np.testing.assert_allclose(after, true, atol=1e-6)
    law = bent.law_without(2, straight), found.law_without(2, straight)
    worse, better = window_errors([read_law(each, {"a": 1.0}) for each in law], runs[2])
    assert better < 0.1 * worse


@dataclass(frozen=True, eq=False)
class Rated(LawTrial):
    """A trial whose runs are known."""

    share_on_cycle: float = MOST
    score: float = 0.0


def test_a_law_is_chosen_that_holds_at_its_own_records_and_then_between_them() -> None:
    def rated(name: str, held: float, score: float, error: float, degree: int = 1) -> Rated:
        functions = ep.polynomial(["a", "b"], degree=degree)
        return Rated(name, fit(), functions, records(), None, np.full(9, error), held, score)

    fails, far = rated("fails", 0.8, 0.1, 1e-3), rated("far", MOST, 0.5, 1e-3)
    near = rated("near", MOST, 0.2, 0.1)
    assert choose_law([fails, far, near]).choice is near
    # Errors of integration do not tell laws apart; numbers do.
    more, fewer = rated("more", MOST, 0.2, 1e-7, 2), rated("fewer", MOST, 0.2, 1e-6)
    assert choose_law([near, more, fewer]).choice is fewer


def test_a_run_that_follows_has_no_deviation_and_one_that_fails_the_worst() -> None:
    at = chosen().runs[4]
    assert at.run.status is Status.FOLLOWS
    assert at.deviation == 0.0
    assert gone(at).deviation == WORST
    model = model_at(**GRID[4])
    fast = run_freely(replace(model, coef=1.005 * model.coef), at.record, None)
    assert fast.status is Status.SUSTAINED
    bound = fast.bounds.frequency
    assert replace(at, run=fast).deviation == pytest.approx(0.005 / bound, rel=1e-2)
    assert chosen().choice.share_on_cycle == MOST


def test_of_errors_that_cannot_be_told_apart_the_fewest_numbers_are_chosen() -> None:
    rng = np.random.default_rng(0)
    least = 1.0 + 0.1 * rng.normal(size=9)
    same, worse = least + 0.05 * (-1.0) ** np.arange(9) + 0.003, least + 0.3
    assert fewest_of_least([(least, 12), (same, 6), (worse, 3)]) == 1
    assert fewest_of_least([(least, 6), (least, 6)]) == 0
    assert fewest_of_least([(worse, 3)]) == 0
    assert fewest_of_least([(least[:1], 3), (least[:1] + 0.1, 2)]) == 0  # one point has no spread


def test_a_point_is_predicted_by_the_fit_to_all_others() -> None:
    rng = np.random.default_rng(2)
    theta, values = rng.normal(size=(7, 3)) * [1.0, 1e9, 1e-9], rng.normal(size=(7, 2))
    predicted = Basis(theta).predict_left_out(values)
    for k in range(7):
        others = np.delete(theta / theta[0], k, axis=0), np.delete(values, k, axis=0)
        law = np.linalg.lstsq(*others)[0]
        np.testing.assert_allclose(predicted[k], theta[k] / theta[0] @ law, rtol=1e-9)
    theta[1:, 2] = 0.0  # the first point alone tells of the third function
    assert np.isinf(Basis(theta).predict_left_out(values)).all()


def test_an_inverse_of_a_covariance_gives_no_weight_to_what_never_varies() -> None:
    covariance = np.array([[4.0, 1.0, 0.0], [1.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    size = np.array([1e9, 1e-9, 1.0])
    inverse = np.array([[1.0, -1.0, 0.0], [-1.0, 4.0, 0.0], [0.0, 0.0, 0.0]]) / 3.0
    found = invert_covariance(covariance * np.outer(size, size)) * np.outer(size, size)
    np.testing.assert_allclose(found, inverse, rtol=1e-12, atol=1e-14)


def test_a_fit_that_failed_tells_nothing_and_counts_as_missed() -> None:
    information = fit().information.copy()
    information[4] = 0.0
    broken = [replace(m, coef=7.0 * m.coef) if k == 4 else m for k, m in enumerate(fit().models)]
    found = replace(fit(), information=information, models=broken).law(LINEAR)
    np.testing.assert_allclose(found.coef, truth(), atol=1e-4)
    assert found.left_out[4] == 1.0
    assert np.delete(found.left_out, 4).max() < 1e-3


def test_a_record_must_hold_six_periods() -> None:
    run = records()[3].run
    period = round(1.0 / (records()[3].cycle.frequency_Hz * run.dt_s))
    with pytest.raises(ValueError, match=r"a=1, b=0: its record holds 4\.\d periods of the 6"):
        _ = OperatingRecord(run.window(0, round(4.5 * period))).cycle
    still = replace(run, states=1.0 + 1e-3 * np.random.default_rng(0).normal(size=run.states.shape))
    with pytest.raises(ValueError, match="its record has no period"):
        _ = OperatingRecord(still).cycle


def test_a_free_run_starts_where_the_states_move_least() -> None:
    record = records()[0]
    speed = np.linalg.norm(np.gradient(record.run.states / record.cycle.std, axis=0), axis=1)
    assert speed[record.slowest] <= np.quantile(speed, 0.05)
    assert record.from_slowest.t[0] == record.run.t[record.slowest]


def amplitudes(factors: Mapping[int, float]) -> list[OperatingRecord]:
    """The same records about a mean of ten, some larger or smaller than the family's."""
    return [
        OperatingRecord(replace(record.run, states=10.0 + factors.get(k, 1.0) * record.run.states))
        for k, record in enumerate(records())
    ]


def test_records_of_a_second_cycle_are_told_apart() -> None:
    assert not branches_of(amplitudes({})).any()
    assert np.flatnonzero(branches_of(amplitudes({4: 0.2}))).tolist() == [4]
    assert np.flatnonzero(branches_of(amplitudes({1: 0.3, 5: 0.2, 6: 0.1}))).tolist() == [1, 5, 6]


def test_an_amplitude_that_grows_with_a_parameter_is_no_second_cycle() -> None:
    growing = {k: float(np.exp(2.0 * point["a"])) for k, point in enumerate(GRID)}
    assert not branches_of(amplitudes({k: 0.05 * g for k, g in growing.items()})).any()
