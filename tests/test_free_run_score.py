"""Selection by free run, relations in the search, and what a rule that refines hands on."""

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.library.relations import binding, complete, parse_relation
from ep2sindy.model.stability import limit_cycle
from ep2sindy.model.vector_field import VectorField
from ep2sindy.selection import free_run
from ep2sindy.selection.free_run import CycleRuns
from ep2sindy.selection.systems import (
    ConfirmedSystem,
    Segment,
    Trial,
    describe_shared,
    find_sustained,
    folds,
    list_others,
    order_equals,
)
from ep2sindy.signals.attractor import Cycle
from tests.models import model_of

PREY = replace(ep.lotka_volterra(), rate_Hz=5.0)  # 69 samples a period
THRUSTER = {
    "n_i": {"n_i": -3.92e5, "n_n": 4.83e3, "n_i*n_n": 4.57e-14},
    "n_n": {"1": -7.82e22, "n_i": -4.78e5, "n_n": 6.86e4},
}
LIBRARY = ep.polynomial(["n_i", "n_n"], degree=2)


def record(n_periods=24.0, *, noise=0.0, seed=0):
    """A cycle that attracts, as the breathing mode's: 27 samples in 71 us."""
    t = 2.64e-6 * np.arange(round(27 * (n_periods + 10)))
    states = model_of(THRUSTER).simulate(t, [1e18, 1e19]).states[270:]
    rms = np.sqrt(np.square(states).mean(axis=0))
    states = states + noise * rms * np.random.default_rng(seed).standard_normal(states.shape)
    return ep.Trajectory(t[270:], states, ("n_i", "n_n"), units={"n_i": "m^-3", "n_n": "m^-3"})


def recipe(*, max_terms=3, n_best=2, formulation=None, **settings):
    return ep.Regression(
        formulation or ep.Differential(),
        ep.BestSubset(max_terms=max_terms, n_best=n_best),
        ep.FreeRunScore(n_windows=4, n_folds=2, **settings),
        ep.Bootstraps(n=0),
        depth=n_best,
    )


@pytest.fixture(scope="module")
def found():
    return ep.discover(record(), LIBRARY, recipe())


def test_the_truth_is_found_refined_and_handed_on(found):
    for state, terms in THRUSTER.items():
        # One Runge-Kutta step per sample: (omega dt)^4 / 120 for a sine, and six harmonics.
        assert found.model.terms(state) == pytest.approx(terms, rel=1e-3)
        chosen = found.chosen[state]
        assert chosen.coef_by_term == found.model.terms(state)
        scores, front = found.scores[state], found.fronts[state]
        assert front.candidates[int(np.argmin(scores))].terms == chosen.terms
        low, high = found.model.intervals(state)[chosen.terms[0]]
        assert low < chosen.coef[0] < high
    assert found.note.startswith("sustained, ")
    assert found.note in repr(found)
    assert ep.evaluate(found.model, record()).status is ep.model.Status.SUSTAINED


def test_noise_is_no_obstacle():
    run = record(noise=0.1)
    noisy = ep.discover(run, LIBRARY, recipe(formulation=ep.WeightedWeak()))
    assessed = ep.evaluate(noisy.model, record())
    # On the data's cycle; from one sample its phase may be off by more than a first period allows.
    assert assessed.status in (ep.model.Status.SUSTAINED, ep.model.Status.WRONG_FREQUENCY)
    assert abs(assessed.f_error) < 0.01
    # It is sustained, and yet it is not the truth: it leaves more than noise, and has no intervals.
    assert noisy.lack_of_fit
    assert noisy.model.covariance is None


def test_a_cycle_that_attracts_comes_before_one_that_does_not(found):
    cycle = limit_cycle(found.model, record().states[0], period_s=71.3e-6)
    assert cycle.stability == "attracting"
    library = ep.polynomial(["x", "y"], degree=2)
    neutral = ep.discover(PREY.trajectory(), library, recipe(max_terms=2, n_best=1))
    assert neutral.model.terms("x") == pytest.approx(PREY.model.terms("x"), rel=1e-3)
    assert "on a cycle that does not attract" in neutral.note


def test_a_state_that_was_not_measured_need_not_keep_its_waveform(found):
    run = record()
    # What the model cannot follow, in the second state alone: ten times faster.
    wiggle = 0.4 * run.states[:, 1].std() * np.sin(10 * 2 * np.pi * run.t / 71.3e-6)
    spoilt = ep.Trajectory(run.t, run.states + np.outer(wiggle, [0, 1]), run.state_names)
    assert ep.evaluate(found.model, spoilt).status is ep.model.Status.WRONG_CYCLE
    assessed = ep.evaluate(found.model, spoilt, assessed=["n_i"])
    assert assessed.status in (ep.model.Status.SUSTAINED, ep.model.Status.WRONG_FREQUENCY)
    assert assessed.waveform_error["n_n"] > 0.2
    with pytest.raises(ValueError, match=r"assessed must name some of the states .*, got \['T'\]"):
        ep.evaluate(found.model, run, assessed=["T"])


def test_starts_at_other_phases_refuse_what_is_sustained_from_one(found):
    several = ep.discover(record(), LIBRARY, recipe(n_starts=4))
    assert several.note.startswith("sustained, ")
    for state in ("n_i", "n_n"):
        assert list(several.model.terms(state)) == list(found.model.terms(state))
        assert (several.scores[state] >= found.scores[state] - 1e-9).all()


def circle(phase):
    return np.stack([np.cos(phase), -np.sin(phase)], axis=1)


@pytest.fixture(params=[(), ("u",)], ids=["free", "driven"])
def rounds(request):
    """24 rounds on a circle, 40 samples each, as a record and by its equations."""
    t, rule = 0.025 * np.arange(960), ep.FreeRunScore(n_starts=4)
    phase, turns = 2 * np.pi * t, {"x": {"y": 2 * np.pi}, "y": {"x": -2 * np.pi}}
    inputs = np.ones((960, len(request.param)))
    run = ep.Trajectory(t, circle(phase), ["x", "y"], inputs, request.param)
    cycle = Cycle(1.0, phase, np.zeros(2), np.array([[1.0, 1.0j]]), 1.0)
    model = model_of(turns, request.param)
    field = VectorField.of(model.library, ["x", "y", *request.param], model.coef[None])
    return CycleRuns(rule, [run], [], [run.states], [cycle], rule.bounds), field


@pytest.mark.parametrize(
    ("part", "n_samples", "starts"),
    [
        # A run lasts 16 periods at least; starts beyond a short part are its last sample.
        ((480, 960), {"free": 640, "driven": 960}, {"free": [480, 530, 580, 630], "driven": [0]}),
        ((240, 960), {"free": 720, "driven": 720}, {"free": [240, 290, 340, 390], "driven": [240]}),
        ((880, 940), {"free": 640, "driven": 960}, {"free": [880, 930, 939, 939], "driven": [0]}),
    ],
)
def test_runs_start_at_phases_spread_over_the_period(rounds, part, n_samples, starts):
    runs, field = rounds
    kind = "driven" if runs.runs[0].input_names else "free"
    found = list(runs._run(field, [Segment(0, *part)]))
    assert len(found) == len(starts[kind])
    for (t, paths, cycle), start in zip(found, starts[kind], strict=True):
        assert len(t) == n_samples[kind]
        phase = 2 * np.pi * (t - t[0] + 0.025 * start)
        # Two Runge-Kutta steps per sample, each with an error of (2 pi/80)^5/120.
        limit = 2 * len(t) * (np.pi / 40) ** 5 / 120
        np.testing.assert_allclose(paths[0], circle(phase), rtol=0, atol=limit)
        error, f_error, amplitude, waveform = runs._compare(t, 0.95 * paths, cycle, ["x", "y"])[0]
        assert f_error < 1e-4
        assert amplitude == pytest.approx(0.05, abs=1e-4)
        assert error == amplitude / runs.bounds.amplitude > waveform / runs.bounds.waveform


def test_the_longest_record_confirms_a_system(rounds, monkeypatch):
    runs, seen = rounds[0], []
    both = [runs.runs[0].window(0, 400), runs.runs[0]]
    verdict = SimpleNamespace(comparison=SimpleNamespace(stays=False))
    monkeypatch.setattr(free_run, "evaluate", lambda _, run, **__: seen.append(run) or verdict)
    tried = Trial(SimpleNamespace(broken=lambda model: []))
    for order in (both, both[::-1]):
        replace(runs, runs=order, cycles=[*runs.cycles] * 2).confirm(tried, None)
    assert [run.n_samples for run in seen] == [960, 960]


def test_a_note_says_what_becomes_of_the_cycle_and_what_all_sustained_systems_share():
    run = SimpleNamespace(run_text="sustained", comparison=SimpleNamespace(stays=True))
    tried, model = Trial(None), SimpleNamespace(inputs=())
    expected = "sustained, on a cycle that attracts; 2 of 9 systems are sustained where not fitted"
    assert ConfirmedSystem(tried, model, (), 0.25, run).text(2, 9) == expected
    both = [Trial(SimpleNamespace(parts={"x'": terms})) for terms in (("x", "y"), ("y", "x*y"))]
    assert describe_shared(both) == "; all of these have x': y"
    assert describe_shared([trial("a"), trial("b")]) == "; these have no term in common"
    assert describe_shared(both[:1]) == ""


def test_noise_that_more_terms_follow_does_not_make_a_cycle_attract():
    how = recipe(max_terms=3, n_best=1, formulation=ep.WeightedWeak())
    found = ep.discover(
        PREY.trajectory(noise=0.05, rng=3), ep.polynomial(["x", "y"], degree=2), how
    )
    for state in ("x", "y"):
        assert list(found.model.terms(state)) == list(PREY.model.terms(state))


def test_where_nothing_is_sustained_the_best_comes_back_with_its_verdict():
    dead = ep.discover(record(), LIBRARY, recipe(max_terms=1, n_best=1))
    assert dead.note.endswith("; none of 4 systems are sustained where not fitted")
    assert not dead.note.startswith("sustained")
    assert dead.scores["n_i"].min() > 1.0


@pytest.mark.parametrize(
    ("run", "reason"),
    [
        (record(4.5), r"the record holds \d\.\d periods, not six: chosen by windows held out"),
        (ep.systems.damped_oscillator().trajectory(), "record 'damped oscillator' has no period"),
    ],
)
def test_a_record_without_a_cycle_is_assessed_by_windows(run, reason):
    library = ep.polynomial(run.state_names, degree=2)
    other = ep.discover(run, library, recipe(max_terms=3, n_best=1))
    assert re.match(reason, other.note)
    assert (other.model.covariance is None) == bool(other.lack_of_fit)


@pytest.mark.parametrize("zeta", [pytest.param(-0.01, marks=pytest.mark.slow), 0.01])
def test_a_spiral_is_no_cycle_to_stay_on(zeta):
    # Fourteen periods whose amplitude changes by a third from third to third.
    system = replace(ep.systems.damped_oscillator(zeta=zeta), rate_Hz=25.0)
    run = system.trajectory(noise=0.05, rng=0)
    assert ep.signals.find_cycle(run.t, run.states) is not None
    other = ep.discover(run, system.model.library, recipe(formulation=ep.WeightedWeak(), n_best=1))
    assert "spirals: chosen by windows held out" in other.note
    for state in system.model.states:
        assert list(other.model.terms(state)) == list(system.model.terms(state))


def test_units_change_nothing(found):
    run = record()
    plain = ep.Trajectory(1e6 * run.t, run.states / [1e18, 1e19], run.state_names)
    again = ep.discover(plain, LIBRARY, recipe())
    for state in ("n_i", "n_n"):
        assert list(again.model.terms(state)) == list(found.model.terms(state))
        np.testing.assert_allclose(again.scores[state], found.scores[state], rtol=1e-4)


def test_folds_share_no_sample_and_leave_none_out():
    run = record(8.0)
    for runs in ([run], [run] * 5):
        seen = []
        for fold in folds(runs, 3):
            held = {(part.run, k) for part in fold.held for k in range(part.start, part.stop)}
            kept = {(part.run, k) for part in fold.fitted for k in range(part.start, part.stop)}
            assert not held & kept
            assert len(held) + len(kept) == len(runs) * run.n_samples
            seen += list(held)
        assert sorted(seen) == [(j, k) for j in range(len(runs)) for k in range(run.n_samples)]
    assert [fold.held for fold in folds([run] * 3, 3)] == [[Segment(k, 0, 216)] for k in range(3)]
    short = folds([run.window(0, 30), run.window(0, 8)], 3)  # pieces of 5 samples are fitted
    fitted = [[(part.start, part.stop) for part in fold.fitted if part.run == 1] for fold in short]
    assert fitted == [[(2, 8)], [], [(0, 5)]]
    with pytest.raises(ValueError, match="runs must hold 30 samples to be parted in 3"):
        folds([run.window(0, 20)], 3)
    with pytest.raises(ValueError, match="got at most 20"):
        folds([run.window(0, 10), run.window(0, 20)], 3)


SHARED = "x: x*y == -1 * y: x*y"


@pytest.mark.parametrize(
    "rule", [ep.EBIC(), ep.FreeRunScore(bounds=None), ep.FreeRunScore(n_windows=4, n_folds=2)]
)
def test_relations_hold_to_the_last_digit(rule):
    run = PREY.trajectory(noise=0.02, rng=0)
    how = replace(recipe(max_terms=2, n_best=1, formulation=ep.WeightedWeak()), selection=rule)
    library = ep.polynomial(["x", "y"], degree=2)
    coupled = ep.discover(run, library.relate(SHARED), how).model
    assert coupled.terms("x")["x*y"] == -coupled.terms("y")["x*y"]
    assert coupled.terms("x")["x*y"] == pytest.approx(-1.0, rel=0.05)


def test_a_coefficient_keeps_the_value_it_is_given():
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    value, how = "x: x*y == -1.1", ep.Regression(ep.WeightedWeak())
    library = ep.polynomial(["x", "y"])
    free, fixed = (ep.discover(run, own, how) for own in (library, library.relate(value)))
    together = ep.discover(run, library.relate(value))
    for found in (fixed, together):
        assert found.model.terms("x")["x*y"] == -1.1
        assert found.lack_of_fit  # ten percent off in two percent of noise
    assert fixed.model.terms("x")["x"] > free.model.terms("x")["x"] * 1.01


def test_a_known_equation_is_not_searched():
    oscillator = ep.systems.damped_oscillator(zeta=0.05)
    run = oscillator.trajectory(noise=0.01, rng=0)
    known = ep.discover(run, ep.polynomial(["x", "v"]).only({"x": ["v"]}).relate("x: v == 1"))
    assert known.model.terms("x") == {"v": 1.0}
    assert [c.terms for c in known.fronts["x"].candidates][1:] == [("v",)]
    assert known.model.terms("v") == pytest.approx({"x": -9.0, "v": -0.3}, rel=0.05)


def test_supports_are_completed_by_what_relations_ask():
    library = ep.polynomial(["x", "y"], degree=2)  # 1, x, y, x^2, x*y, y^2
    masks = np.array([[0, 1, 0, 0, 0, 0], [0, 1, 0, 0, 1, 0]], dtype=bool)
    shared = [parse_relation(SHARED)]
    both = complete(masks, library, "x", shared)
    assert both.tolist() == [[False, True, False, False, False, False],
                             [False, True, False, False, True, False]]  # fmt: skip
    valued = complete(masks, library, "x", [parse_relation("x: 1 == 2")])
    assert valued[:, 0].all()
    assert len(valued) == 2
    assert binding(shared, {"x": ("x*y",), "y": ("y",)}) is None
    assert binding(shared, {"x": ("x",), "y": ("y",)}) == ()
    assert binding(shared, {"x": ("x*y",), "y": ("x*y",)}) == tuple(shared)
    assert binding([parse_relation("x: 1 == 2")], {"x": ("x",)}) is None


def confirmed(
    *, fraction, n_free=4, waveform=0.05, loss=1.0, broken=(), is_sustained=True, repels=False
):
    """A system as the rule has confirmed it, with these figures."""
    held = SimpleNamespace(n_free=n_free)
    run = SimpleNamespace(comparison=SimpleNamespace(rank=(not is_sustained, 0)))
    return ConfirmedSystem(
        Trial(held, 0.3, 0.0, 0.0, waveform, loss), None, broken, fraction, run, repels
    )


@pytest.mark.parametrize(
    ("others", "best"),
    [
        ([confirmed(fraction=0.6), confirmed(fraction=0.95, n_free=5)], 1),  # global attraction
        ([confirmed(fraction=0.6), confirmed(fraction=0.8)], 1),  # most starts of equals
        ([confirmed(fraction=0.6), confirmed(fraction=0.8, n_free=5)], 0),  # size
        ([confirmed(fraction=0.92), confirmed(fraction=1.0)], 0),  # both global: the first
        ([confirmed(fraction=0.0), confirmed(fraction=0.3, n_free=6)], 1),  # it attracts
        ([confirmed(fraction=1.0, broken=["x: y < 0"]), confirmed(fraction=0.1)], 1),
        ([confirmed(fraction=0.0, is_sustained=False), confirmed(fraction=0.0)], 1),
        ([confirmed(fraction=0.0, repels=True), confirmed(fraction=0.0, n_free=6)], 1),
    ],
)
def test_what_attracts_most_starts_is_preferred(others, best):
    assert min(others, key=lambda each: each.rank) is others[best]


def test_what_attracts_outdoes_a_neutral_cycle_as_an_equal_or_by_its_fit():
    resting = confirmed(fraction=0.0, loss=2.0)
    assert confirmed(fraction=1.0, waveform=0.07, loss=4.0).outdoes(resting)
    assert not confirmed(fraction=1.0, waveform=0.08, loss=4.0).outdoes(resting)
    assert not confirmed(fraction=1.0, n_free=5, loss=1.92).outdoes(resting)
    assert confirmed(fraction=1.0, n_free=5, loss=1.88).outdoes(resting)


def trial(name, *, n_free=4, error=0.3, waveform=0.05, loss=1.0, order=0):
    """The trial of a system whose only term is its name."""
    held = SimpleNamespace(n_free=n_free, parts={"x'": (name,)}, order=order)
    return Trial(held, error, 0.0, 0.0, waveform, loss)


def test_what_has_room_comes_first_then_the_smallest_then_the_closest() -> None:
    ranked = [
        trial("closest", error=0.6), trial("close", waveform=0.06),
        trial("larger", n_free=5, waveform=0.01), trial("at the bound", error=0.7, n_free=3),
    ]  # fmt: skip
    assert sorted([*reversed(ranked)], key=lambda t: t.rank(0.6)) == ranked


def test_of_systems_as_good_as_the_best_left_the_lowest_order_comes_first() -> None:
    best, simple = trial("a", order=3), trial("b", waveform=0.054, order=2)
    worse, larger = trial("c", waveform=0.056, order=1), trial("d", n_free=5)
    assert order_equals([best, simple, worse, larger]) == [simple, best, worse, larger]


@pytest.mark.parametrize(("least", "names"), [(1e-2, ["c", "b", "e"]), (1e-9, ["e"])])
def test_where_the_truth_is_in_the_library_no_other_counts_as_equal(least, names):
    trials = [
        trial("a", loss=least), trial("b", error=1.0), trial("c", waveform=0.04),
        trial("d", n_free=5), trial("e", loss=least, waveform=0.06), trial("f", error=1.1),
    ]  # fmt: skip
    found = list_others(find_sustained(trials), trials[0])
    assert [other.terms["x'"] for other in found] == [(name,) for name in names]


def test_the_other_systems_that_live_are_kept() -> None:
    """Other terms of van der Pol's equations live on its cycle, too."""
    oscillator = replace(ep.systems.van_der_pol(), duration_s=90.0, rate_Hz=10.0)
    run = oscillator.trajectory(noise=0.02, rng=1).window(200, 900)
    library = ep.polynomial(run.state_names, degree=3)
    found = ep.discover(run, library, recipe(max_terms=4, n_best=3))
    size = int((found.model.coef != 0.0).sum())
    ours = {f"{state}'": tuple(found.model.terms(state)) for state in found.model.states}
    for other in found.others:
        assert sum(map(len, other.terms.values())) == size
        assert other.terms != ours
        bounds = ep.model.FreeRunBounds()
        fractions = other.f_error / bounds.frequency, other.amplitude / bounds.amplitude
        assert other.deviation == max(*fractions, other.waveform / bounds.waveform) <= 1.0
    assert [o.waveform for o in found.others] == sorted(o.waveform for o in found.others)
    again = ep.Discovery.from_json(found.to_json())
    assert [each.terms for each in again.others] == [each.terms for each in found.others]
    assert found.others
