"""Laws of the operating point: known families, points left out, files, and what is refused."""

from collections.abc import Mapping
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.operating.fit import SETTINGS, LeaveOneOut, OperatingFit, leave_one_out, operating_fit
from ep2sindy.operating.law import OperatingLaw, in_hull, make_basis
from ep2sindy.operating.records import (
    OperatingRecord,
    branches_of,
    check_records,
    interpolation_errors,
)
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting

STATES = ("x", "y")
LIBRARY = ep.polynomial(STATES, degree=3)
STRUCTURE = {"x": ["x", "y", "x^3"], "y": ["x"]}
# Lienard's van der Pol at two parameters, every coefficient linear in them.
LAW = {"x": {"x": (0.8, 0.3, 0.0), "y": (-1.0, 0.0, -0.2), "x^3": (-0.4, 0.0, 0.1)},
       "y": {"x": (1.0, 0.2, 0.1)}}  # fmt: skip
SHORT = replace(SETTINGS, n_windows=3, periods=1.0)
GRID = [{"a": a, "b": b} for a in (0.5, 1.0, 1.5) for b in (0.0, 0.5, 1.0)]


def model_at(a: float, b: float) -> ep.SparseModel:
    terms = [{t: c[0] + c[1] * a + c[2] * b for t, c in LAW[s].items()} for s in STATES]
    return ep.SparseModel(LIBRARY, STATES, ep.coef_matrix(LIBRARY, terms))


@cache
def recorded(a: float, b: float, end: float = 60.0) -> OperatingRecord:
    t = np.arange(0.0, end, 0.1)
    run = model_at(a, b).simulate(np.append(0.0, 40.0 + t), [1.0, 0.0])
    states = run.states[1:]
    return OperatingRecord.of({"a": a, "b": b}, ep.Trajectory(t, states, STATES))


@cache
def records() -> tuple[OperatingRecord, ...]:
    return tuple(recorded(**point) for point in GRID)


@cache
def fit() -> OperatingFit:
    return operating_fit(records(), LIBRARY, STRUCTURE, settings=SHORT)


@cache
def law() -> OperatingLaw:
    return fit().refine_law(fit().functions(1))[0]


def truth() -> np.ndarray:
    return np.array([row for state in STATES for row in LAW[state].values()])


def test_the_law_of_a_known_family_is_found() -> None:
    assert law().coefficients == (("x", "x"), ("x", "y"), ("x", "x^3"), ("y", "x"))
    # rk4 at 0.1 of a time unit near one, on a stiff corner of the relaxation oscillation.
    np.testing.assert_allclose(law().coef, truth(), atol=1e-4)
    weighted = fit().fit_law(fit().functions(1))
    np.testing.assert_allclose(weighted.coef, truth(), atol=1e-4)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"coef": np.ones((3, 3))},
            r"a finite number for every .* shape \(3, 3\) came for \(4, 3\)",
        ),
        ({"coef": np.full((4, 3), np.nan)}, "a finite number for every coefficient"),
        ({"coefficients": (("x", "x"), ("x", "y"), ("x", "x^3"), ("z", "x"))}, "x of z came"),
        ({"coefficients": (("x", "x"), ("x", "y"), ("x", "q"), ("y", "x"))}, "q of x came"),
        ({"points": np.ones((4, 3))}, r"a column for each of \['a', 'b'\]"),
        ({"points": np.ones((0, 2))}, "a column for each"),
        ({"points": np.full((4, 2), np.inf)}, "points must be finite"),
        ({"covariance": np.eye(4)}, r"that of 12 numbers: shape \(4, 4\)"),
    ],
)
def test_a_law_holds_numbers_that_fit_each_other(change: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        replace(law(), **change)


def test_a_model_between_the_points_is_the_true_one() -> None:
    at = {"a": 0.8, "b": 0.3}
    model = law().model_at(at)
    np.testing.assert_allclose(model.coef, model_at(**at).coef, atol=1e-4)
    assert model.provenance["point"] == "a=0.8, b=0.3"
    low, high = model.intervals("x")["x"]
    assert low < model.terms("x")["x"] < high


def test_a_model_outside_the_points_must_be_asked_for() -> None:
    at = {"a": 2.0, "b": 0.5}
    with pytest.raises(ValueError, match=r"outside the points.* a 0.5 to 1.5, b 0 to 1"):
        law().model_at(at)
    model = law().model_at(at, extrapolate=True)
    np.testing.assert_allclose(model.coef, model_at(**at).coef, atol=1e-3)
    assert not law().is_inside(at)
    assert law().is_inside(GRID[0])


@pytest.mark.parametrize("at", [{"a": 1.0}, {"a": 1.0, "c": 0.0}, {"a": 1.0, "b": np.nan}])
def test_a_model_needs_every_parameter(at: Mapping[str, float]) -> None:
    with pytest.raises(ValueError, match="an operating point must"):
        law().model_at(at)


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


def test_a_law_that_an_earlier_version_saved_is_read() -> None:
    """The file is that of the predict study at toy size, before laws of all kinds became one."""
    path = Path(__file__).parent / "data" / "operating_law.json"
    saved = OperatingLaw.load(path)
    assert saved.to_json() == path.read_text("utf-8")
    assert (saved.parameters, saved.states) == (("V_D_V", "mdot_mg_s"), ("n_i", "n_n"))
    model = saved.model_at({"V_D_V": 300.0, "mdot_mg_s": 5.0})
    numbers = saved.numbers["n_n"]["1"]
    expected = numbers["1"] + 300.0 * numbers["V_D_V"] + 5.0 * numbers["mdot_mg_s"]
    assert model.terms("n_n")["1"] == pytest.approx(expected, rel=1e-12)
    assert model.covariance is not None


def test_intervals_follow_the_covariance() -> None:
    bounds = law().intervals()["x", "x"]
    assert list(bounds) == ["1", "a", "b"]
    assert law().covariance is not None
    reach = 0.5 * (bounds["1"][1] - bounds["1"][0])
    assert reach == pytest.approx(1.959964 * np.sqrt(law().covariance[0, 0]))
    with pytest.raises(ValueError, match="this law has none"):
        replace(law(), covariance=None).intervals()


def test_points_left_out_live_by_the_law_of_the_others() -> None:
    functions = fit().functions(1)
    for found in (leave_one_out(fit(), functions), leave_one_out(fit(), functions, start=law())):
        assert len(found) == 9
        assert [each.run.verdict for each in found] == [ep.Verdict.LIVES] * 9
        # A frequency read off the five periods of half a record.
        assert max(abs(each.run.f_error) for each in found) < 5e-3
        # Of three by three the corners are outside of what the others enclose.
        assert [each.inside for each in found].count(True) == 5
        assert max(each.error for each in found) < 0.5


def test_a_run_that_diverges_counts_as_ten_bounds() -> None:
    found = leave_one_out(fit(), fit().functions(1))[0]
    gone = replace(found.run, verdict=ep.Verdict.DIVERGES, f_error=float("nan"))
    assert LeaveOneOut(found.record, gone, inside=True).error == 10.0


def test_a_smooth_family_interpolates_its_own_frequency() -> None:
    quadratic = ep.polynomial(["a", "b"], degree=2)
    f, amplitude = interpolation_errors(records(), make_basis(quadratic, fit().points))
    assert f.shape == amplitude.shape == (9,)
    assert np.median(f) < 0.01


def test_a_point_that_the_law_needs_cannot_be_left_out() -> None:
    corner = [0, 1, 6]
    three = replace(
        fit(), records=[records()[k] for k in corner], fits=[fit().fits[k] for k in corner]
    )
    with pytest.raises(ValueError, match="a=0.5, b=0 cannot be left out: a law of 3 terms needs"):
        leave_one_out(three, three.functions(1))


def test_a_law_that_is_tested_needs_a_point_more_than_it_has_functions() -> None:
    functions, points = fit().functions(1), np.array([list(p.values()) for p in GRID])
    corners = points[[0, 2, 6]]
    assert len(functions) == 3
    make_basis(functions, corners)
    make_basis(functions, points[[0, 2, 6, 8]], n_spare=1)
    with pytest.raises(
        ValueError, match="a law of 3 functions .* more points than these.*: 3 came"
    ):
        make_basis(functions, corners, n_spare=1)


def test_parameters_must_vary_and_be_the_same_everywhere() -> None:
    with pytest.raises(ValueError, match="'a' is 0.5 at all 3 operating points"):
        check_records(records()[:3])
    other = replace(records()[1], parameters={"a": 1.0})
    with pytest.raises(ValueError, match=r"every operating point must have \['a', 'b'\]"):
        check_records([records()[0], other])
    with pytest.raises(ValueError, match="none came"):
        check_records([])


def test_a_record_must_hold_six_periods() -> None:
    run = records()[0].run
    period = round(1.0 / (records()[0].cycle.frequency_Hz * run.dt_s))
    with pytest.raises(ValueError, match=r"a=1, b=0: its record holds 4\.\d periods of the 6"):
        OperatingRecord.of({"a": 1.0, "b": 0.0}, run.window(0, round(4.5 * period)))
    still = replace(run, states=1.0 + 1e-3 * np.random.default_rng(0).normal(size=run.states.shape))
    with pytest.raises(ValueError, match="its record has no period"):
        OperatingRecord.of({"a": 1.0, "b": 0.0}, still)


def test_a_fit_needs_terms_of_every_state_and_no_constraint() -> None:
    with pytest.raises(ValueError, match=r"terms for each of \['x', 'y'\]"):
        operating_fit(records(), LIBRARY, {"x": ["x"]})
    pooled = replace(SETTINGS, constraint=ep.constraint(LIBRARY, STRUCTURE))
    with pytest.raises(ValueError, match="laws of the operating point take no constraint"):
        operating_fit(records(), LIBRARY, STRUCTURE, settings=pooled)


def test_a_start_that_is_given_leaves_the_method_as_it_was_set() -> None:
    poor = replace(law(), coef=1.2 * law().coef)
    for method, status in ((None, "converged"), (MultipleShooting(max_iter=1), "max_iter")):
        own = replace(fit(), settings=replace(fit().settings, method=method))
        assert own.refine_law(own.functions(1), start=poor)[1].status == status


def test_a_free_run_starts_where_the_states_move_least() -> None:
    record = records()[0]
    speed = np.linalg.norm(np.gradient(record.run.states / record.cycle.std, axis=0), axis=1)
    assert speed[record.slowest] <= np.quantile(speed, 0.05)
    assert record.from_slowest.t[0] == record.run.t[record.slowest]


def amplitudes(factors: Mapping[int, float]) -> list[OperatingRecord]:
    """The same records about a mean of ten, some larger or smaller than the family's."""
    found = []
    for k, record in enumerate(records()):
        run = replace(record.run, states=10.0 + factors.get(k, 1.0) * record.run.states)
        found.append(OperatingRecord.of(record.parameters, run))
    return found


def test_records_of_a_second_cycle_are_told_apart() -> None:
    assert not branches_of(amplitudes({})).any()
    assert np.flatnonzero(branches_of(amplitudes({4: 0.2}))).tolist() == [4]
    assert np.flatnonzero(branches_of(amplitudes({1: 0.3, 5: 0.2, 6: 0.1}))).tolist() == [1, 5, 6]


def test_an_amplitude_that_grows_with_a_parameter_is_no_second_cycle() -> None:
    growing = {k: float(np.exp(2.0 * point["a"])) for k, point in enumerate(GRID)}
    assert not branches_of(amplitudes({k: 0.05 * g for k, g in growing.items()})).any()


def test_few_records_are_one_branch() -> None:
    assert not branches_of(amplitudes({0: 0.1})[:3]).any()
