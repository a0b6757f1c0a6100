"""Cycles whose period, shape and multipliers are known, and who ends on them."""

from collections.abc import Mapping

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from ep2sindy.library.library import polynomial
from ep2sindy.model.draws import starts_around
from ep2sindy.model.model import SparseModel
from ep2sindy.model.stability import (
    LimitCycle,
    basin_stability,
    limit_cycle,
    periods_to_reach,
)
from tests.models import model_of

Equations = Mapping[str, Mapping[str, float]]

# r' = r (1 - r^2), phase' = 1: the unit circle, period 2 pi, multiplier exp(-4 pi).
HOPF = {
    "x": {"x": 1.0, "y": -1.0, "x^3": -1.0, "x*y^2": -1.0},
    "y": {"x": 1.0, "y": 1.0, "x^2*y": -1.0, "y^3": -1.0},
}
VAN_DER_POL = {"x": {"y": 1.0}, "y": {"x": -1.0, "y": 1.0, "x^2*y": -1.0}}
PREDATOR_PREY = {"x": {"x": 2 / 3, "x*y": -1.0}, "y": {"x*y": 1.0, "y": -1 / 3}}
# The breathing mode of a Hall thruster at 300 V and 5 mg/s, as it was refined on a simulation.
BREATHING = {
    "n_i": {"n_i": -3.92e5, "n_n": 4.83e3, "n_i*n_n": 4.57e-14},
    "n_n": {"1": -7.82e22, "n_i": -4.78e5, "n_n": 6.86e4},
}
FEW = 10.0  # periods, after which these cycles hold whoever starts in their basin
SOLVED = 1e-8  # of the integration at 1e-11, over a period, with room for what it amplifies


def reversed_in_time(equations: Equations) -> Equations:
    return {s: {name: -value for name, value in terms.items()} for s, terms in equations.items()}


def in_units(equations: Equations, size: Mapping[str, float], time: float) -> Equations:
    """The same equations of states `size` times as large, in a time `time` times as long."""
    library = polynomial(tuple(equations), degree=3)
    numbers = np.prod(np.array([size[s] for s in equations]) ** library.exponents, axis=1)
    factor = dict(zip(library.names, numbers.tolist(), strict=True))
    return {
        s: {name: value * size[s] / factor[name] / time for name, value in terms.items()}
        for s, terms in equations.items()
    }


def found(
    equations: Equations, start: list[float], period_s: float, n_samples: int = 128
) -> tuple[SparseModel, LimitCycle]:
    model = model_of(equations)
    cycle = limit_cycle(model, np.array(start), period_s=period_s, n_samples=n_samples)
    assert cycle is not None
    return model, cycle


def liouville(model: SparseModel, cycle: LimitCycle) -> float:
    """Product of the multipliers: exp of the divergence, integrated over the period."""
    trace = np.trace(model.field.jacobian(cycle.states), axis1=1, axis2=2)
    return float(np.exp(trace.mean() * cycle.period_s))  # spectral: the samples are periodic


def test_hopf_normal_form_has_its_exact_cycle() -> None:
    model, cycle = found(HOPF, [1.2, 0.1], 6.0)
    assert cycle.period_s == pytest.approx(2.0 * np.pi, rel=SOLVED)
    np.testing.assert_allclose(np.linalg.norm(cycle.states, axis=1), 1.0, atol=SOLVED)
    phase = np.unwrap(np.arctan2(cycle.states[:, 1], cycle.states[:, 0]))
    np.testing.assert_allclose(np.diff(phase), 2.0 * np.pi / 128, atol=SOLVED)
    np.testing.assert_allclose(cycle.multipliers, [1.0, np.exp(-4.0 * np.pi)], atol=SOLVED)
    assert cycle.stability == "attracting"
    assert basin_stability(model, cycle, n_periods=FEW) == 1.0


@pytest.mark.parametrize("start", [[1.0, 0.0], [1.05, 0.05], [0.9, 0.1]])
def test_hopf_normal_form_in_reversed_time_repels(start: list[float]) -> None:
    """A start just outside is lost within a period, one just inside falls to the origin."""
    model, cycle = found(reversed_in_time(HOPF), start, 6.0)
    assert cycle.period_s == pytest.approx(2.0 * np.pi, rel=SOLVED)
    np.testing.assert_allclose(np.linalg.norm(cycle.states, axis=1), 1.0, atol=1e-6)
    turning = np.cross(np.append(cycle.states[0], 0.0), np.append(cycle.states[1], 0.0))[2]
    assert turning < 0.0  # clockwise: samples run forwards in time
    assert cycle.multipliers[1] == pytest.approx(np.exp(4.0 * np.pi), rel=1e-4)
    assert cycle.stability == "repelling"
    assert basin_stability(model, cycle, n_periods=FEW) == 0.0


def test_van_der_pol_has_its_tabulated_period_and_liouvilles_multiplier() -> None:
    model, cycle = found(VAN_DER_POL, [2.0, 0.0], 6.4)
    assert cycle.period_s == pytest.approx(6.6632868593231301, rel=SOLVED)
    assert cycle.multipliers[1] == pytest.approx(liouville(model, cycle), abs=SOLVED)
    assert cycle.stability == "attracting"
    assert basin_stability(model, cycle, n_periods=FEW) == 1.0


def test_neutral_cycles_of_predator_and_prey_are_found_next_to_the_start() -> None:
    model, cycle = found(PREDATOR_PREY, [1.0, 0.5], 14.0)
    np.testing.assert_allclose(cycle.multipliers, 1.0, atol=1e-6)
    assert cycle.stability == "neutral"
    x, y = cycle.states.T
    conserved = x - np.log(x) / 3.0 + y - 2.0 / 3.0 * np.log(y)
    assert np.ptp(conserved) < SOLVED
    assert conserved[0] == pytest.approx(1.5 - 2.0 / 3.0 * np.log(0.5), rel=0.01)
    # Means over a closed orbit are those of the fixed point, whatever its size.
    np.testing.assert_allclose(cycle.states.mean(axis=0), [1 / 3, 2 / 3], rtol=SOLVED)
    assert basin_stability(model, cycle, n_periods=FEW) < 0.2  # only those that start on it


@pytest.mark.parametrize("z", [{"z": -1.0}, {"z": -1.0, "x": 1.0}], ids=["still", "driven"])
def test_a_third_state_adds_its_own_multiplier(z: dict[str, float]) -> None:
    model, cycle = found({**HOPF, "z": z}, [1.2, 0.1, 0.4], 6.0)
    exact = [1.0, np.exp(-2.0 * np.pi), np.exp(-4.0 * np.pi)]
    np.testing.assert_allclose(cycle.multipliers, exact, atol=SOLVED)
    x, y = cycle.states[:, :2].T
    follows = 0.5 * (x + y) if "x" in z else np.zeros(len(x))  # of z' = x - z, x = cos t
    np.testing.assert_allclose(cycle.states[:, 2], follows, atol=SOLVED)
    assert basin_stability(model, cycle, n_periods=FEW) == 1.0


def test_the_breathing_mode_attracts_in_si_units() -> None:
    model, cycle = found(BREATHING, [2.8e17, 8.07e18], 70e-6)
    assert cycle.period_s == pytest.approx(71.278e-6, rel=1e-4)
    assert cycle.stability == "attracting"
    assert 0.0 < abs(cycle.multipliers[1]) < 0.1
    assert liouville(model, cycle) == pytest.approx(cycle.multipliers[1].real, rel=1e-6)
    closing = model.simulate([0.0, cycle.period_s], cycle.states[0], rtol=1e-10).states[-1]
    np.testing.assert_allclose(closing, cycle.states[0], rtol=1e-7)
    # From the other 21 starts neutrals fall below zero, as LSODA finds too, and run away.
    assert basin_stability(model, cycle) == 43 / 64
    assert basin_stability(model, cycle, n_periods=FEW, spread=(0.8, 1.25)) == 1.0


def test_a_start_far_from_an_attracting_cycle_is_let_run_first() -> None:
    _, near = found(BREATHING, [2.8e17, 8.07e18], 70e-6)
    _, far = found(BREATHING, [1e18, 9e18], 70e-6)
    assert far.period_s == pytest.approx(near.period_s, rel=1e-7)


@pytest.mark.parametrize("equations", [HOPF, VAN_DER_POL, reversed_in_time(HOPF)])
def test_units_change_nothing(equations: Equations) -> None:
    size, time = {"x": 3e18, "y": 2e-5}, 1e-6
    start = np.array([1.02, 0.05]) if equations is not VAN_DER_POL else np.array([2.0, 0.0])
    model, cycle = found(equations, start.tolist(), 6.4)
    there = in_units(equations, size, time)
    scale = np.array(list(size.values()))
    other_model, other = found(there, (start * scale).tolist(), 6.4 * time)
    assert other.period_s == pytest.approx(cycle.period_s * time, rel=SOLVED)
    np.testing.assert_allclose(other.multipliers, cycle.multipliers, rtol=1e-4, atol=SOLVED)
    # Rounding moves the state along the flow by what a small tolerance allows.
    np.testing.assert_allclose(other.states / scale, cycle.states, atol=1e-5)
    assert basin_stability(other_model, other, n_periods=FEW) == basin_stability(
        model, cycle, n_periods=FEW
    )


def test_a_guess_of_two_periods_gives_one() -> None:
    _, cycle = found(VAN_DER_POL, [2.0, 0.0], 13.0)
    assert cycle.period_s == pytest.approx(6.6632868593231301, rel=SOLVED)
    assert cycle.multipliers[1] == pytest.approx(8.597e-4, rel=1e-3)


@pytest.mark.parametrize(
    ("equations", "start"),
    [
        ({"x": {"v": 1.0}, "v": {"x": -9.0, "v": -0.6}}, [1.0, 0.0]),  # spirals in
        ({"x": {"v": 1.0}, "v": {"x": -9.0, "v": 0.6}}, [1.0, 0.0]),  # spirals out
        ({"x": {"x": 1.0}, "v": {"v": 30.0}}, [1.0, 1.0]),  # runs away
        ({"x": {"x^2": 1.0}, "v": {"x*v": -1.0}}, [1.0, 1.0]),  # in finite time
        ({"x": {"x": -1.0}, "v": {"v": -2.0}}, [1.0, 1.0]),  # falls to rest
        ({"x": {"v": 1.0}, "v": {"x": -9.0}}, [0.0, 0.0]),  # rests
        ({"x": {"v": 0.0}, "v": {"x": 0.0}}, [1.0, 0.0]),  # has no terms at all
        (HOPF, [0.0, 0.0]),  # rests where nothing attracts
    ],
)
def test_what_does_not_oscillate_has_no_cycle(equations: Equations, start: list[float]) -> None:
    assert limit_cycle(model_of(equations), np.array(start), period_s=2.1) is None


def test_starts_outside_a_bounded_basin_do_not_reach_the_cycle() -> None:
    """r' = r (1 - r^2) (1 - r^2 / 4): what starts beyond r = 2 runs away."""
    radial = {(1, 0): 1.0, (3, 0): -1.25, (1, 2): -1.25, (5, 0): 0.25, (3, 2): 0.5, (1, 4): 0.25}

    def names(own: str, other: str) -> dict[str, float]:
        return {
            "*".join(f"{v}^{p}" if p > 1 else v for v, p in sorted([(own, a), (other, b)]) if p): c
            for (a, b), c in radial.items()
        }

    equations = {"x": {**names("x", "y"), "y": -1.0}, "y": {**names("y", "x"), "x": 1.0}}
    model, cycle = found(equations, [1.1, 0.0], 6.0)
    starts = starts_around(cycle.states, 64, (0.3, 3.0))
    inside = np.linalg.norm(starts, axis=1) < 2.0
    assert basin_stability(model, cycle, n_periods=FEW) == inside.mean()
    assert inside.mean() == pytest.approx(np.pi / 9.0, abs=0.05)  # of a disc in the square


def test_starts_keep_the_sign_that_the_cycle_keeps() -> None:
    states = np.array([[1.0, -3.0, -1.0], [3.0, -1.0, 1.0]])
    starts = starts_around(states, 256, (0.3, 3.0))
    low, high = starts.min(axis=0), starts.max(axis=0)
    np.testing.assert_allclose(low, [0.6, -6.0, -3.0], rtol=0.1)
    np.testing.assert_allclose(high, [6.0, -0.6, 3.0], rtol=0.1)
    # Half of them below the geometric middle.
    assert np.mean(starts[:, 0] < 2.0 * np.sqrt(0.9)) == pytest.approx(0.5, abs=0.02)


def test_fast_relaxation_is_resolved() -> None:
    stiff = {"x": {"y": 1.0}, "y": {"x": -1.0, "y": 5.0, "x^2*y": -5.0}}
    model, cycle = found(stiff, [2.0, 0.0], 11.5)

    def upwards(_: float, x: np.ndarray) -> float:
        return x[0]

    upwards.direction = 1.0  # type: ignore[attr-defined]
    run = solve_ivp(
        lambda _, x: [x[1], 5.0 * (1.0 - x[0] ** 2) * x[1] - x[0]],
        (0.0, 50.0),
        [2.0, 0.0],
        method="DOP853",
        events=upwards,
        rtol=1e-12,
        atol=1e-12,
    )
    assert cycle.period_s == pytest.approx(np.diff(run.t_events[0])[-1], rel=SOLVED)
    assert basin_stability(model, cycle, n_starts=8, n_periods=10.0, spread=(0.5, 1.5)) == 1.0


@pytest.mark.parametrize(
    ("modulus", "stability"),
    [(0.0, "attracting"), (0.998, "attracting"), (0.9995, "neutral"), (1.002, "repelling")],
)
def test_stability_is_that_of_the_largest_multiplier(modulus: float, stability: str) -> None:
    multipliers = np.array([1.0, modulus * np.exp(2.0j), 0.0])
    model = model_of({name: {name: 1.0} for name in "xyz"})
    assert LimitCycle(1.0, np.zeros((8, 3)), multipliers, model).stability == stability


def test_a_model_with_inputs_has_no_cycle_of_its_own() -> None:
    model = model_of({"x": {"y": 1.0}, "y": {"u": 1.0}}, inputs=["u"])
    cycle = LimitCycle(1.0, np.zeros((8, 2)), np.array([1.0 + 0j, 0.5]), model)
    with pytest.raises(ValueError, match=r"without inputs: this one has \['u'\]"):
        limit_cycle(model, np.ones(2), period_s=1.0)
    with pytest.raises(ValueError, match="without inputs"):
        basin_stability(model, cycle, n_periods=FEW)


@pytest.mark.parametrize(
    ("start", "settings", "message"),
    [
        ([1.0], {"period_s": 1.0}, r"for each of \['x', 'y'\], got \[1.0\]"),
        ([1.0, 0.0], {"period_s": 0.0}, "positive time in s, got 0.0"),
    ],
)
def test_a_search_needs_a_state_a_period_and_samples(
    start: list[float], settings: dict[str, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        limit_cycle(model_of(HOPF), np.array(start), **settings)  # type: ignore[arg-type]


def test_a_slow_cycle_is_waited_for() -> None:
    """A cycle whose perturbations shrink by 2 % in a period is reached, in some hundred periods."""
    rate = -np.log(0.98) / (2.0 * 2.0 * np.pi)  # of Hopf's normal form: exp(-2 rate period)
    slow = {
        "x": {"x": rate, "y": -1.0, "x^3": -rate, "x*y^2": -rate},
        "y": {"x": 1.0, "y": rate, "x^2*y": -rate, "y^3": -rate},
    }
    model, cycle = found(slow, [1.0, 0.0], 2.0 * np.pi)
    assert cycle.largest_multiplier == pytest.approx(0.98, abs=1e-6)
    assert periods_to_reach(cycle) == pytest.approx(-3.0 / np.log(0.98), rel=1e-3)
    assert basin_stability(model, cycle, n_starts=8, n_periods=40.0) < 1.0
    assert basin_stability(model, cycle, n_starts=8) == 1.0
