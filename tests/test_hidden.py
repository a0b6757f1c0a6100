"""Hidden states: laws of states that nobody measured, found from those that were."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.data.coerce import DiscoveryProblem, FailedTryError
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import _hidden_names
from ep2sindy.estimation import estimate, explanation
from ep2sindy.estimation.explanation import Explanation
from ep2sindy.estimation.hidden import Coupling, couplings, with_guess, with_guess_by, with_guesses
from ep2sindy.estimation.likelihood import TrajectoryFit, hessian_on, observe
from ep2sindy.estimation.noise import noise_beside
from ep2sindy.estimation.problem import EstimationProblem, by_run, scale_problem
from ep2sindy.estimation.solver import MAX_HIDDEN_DEFECT, hidden_defects
from tests.programs import composed, computed

PLANE = ep.lotka_volterra()
# Of the prey alone, with its growth rate g = 2/3 - y: insert y = 2/3 - g into the second equation.
GROWTH = {"1": 2.0 / 9.0, "x": -2.0 / 3.0, "g": -1.0 / 3.0, "x*g": 1.0}


def only(name: str, *, noise: float = 0.05, system: ep.systems.System = PLANE) -> Trajectory:
    full = system.trajectory(noise=noise, rng=0)
    return Trajectory(full.t, full.columns([name]), [name], units={name: "m^-3"})


@pytest.fixture(scope="module")
def found() -> ep.Discovery:
    return ep.discover(only("x"), hidden=["g"])


def test_the_law_of_one_species_alone(found: ep.Discovery) -> None:
    assert found.lack_of_fit == ""
    assert found.model.terms("x") == {"x*g": 1.0}
    own = found.model.terms("g")
    assert set(own) == set(GROWTH)
    assert own == pytest.approx(GROWTH, rel=0.05)
    held = [low <= GROWTH[term] <= high for term, (low, high) in found.model.intervals("g").items()]
    assert sum(held) >= 3
    assert (
        "g was not measured: its scale is such that x' has the term x*g" in found.data_warnings[0]
    )


def test_the_hidden_state_is_what_it_stands_for(found: ep.Discovery) -> None:
    (run,) = found.estimate.runs
    truth = 2.0 / 3.0 - PLANE.trajectory().columns(["y"])
    assert run.state_names == ("x", "g")
    assert run.columns(["x"]) == pytest.approx(only("x").states, rel=1e-12)
    assert np.abs(run.columns(["g"]) - truth).max() < 0.05 * truth.std()
    assert run.units["g"] == "s^-1"
    assert np.isnan(found.estimate.noise_std[1])
    assert found.estimate.noise_std[0] == pytest.approx(0.05 * 0.464, rel=0.1)


def test_a_signal_of_either_sign_shows_its_derivative() -> None:
    run = only("x", system=ep.systems.van_der_pol())  # as Lienard writes it: y' = x / 2
    model = ep.discover(run, ep.polynomial(["x", "w"], degree=3), hidden=["w"]).model
    assert dict(model.terms("x")) == pytest.approx({"w": 1.0})
    law = {"x": -1.0, "w": 2.0, "x^2*w": -2.0}  # the second derivative of x
    assert dict(model.terms("w")) == pytest.approx(law, rel=0.05)


def test_the_model_tells_the_hidden_states_of_a_record() -> None:
    system = ep.lorenz()
    truth, states = (
        system.trajectory(),
        ep.model.estimate_states(system.model, only("x", system=system).window(0, 1500)),
    )
    assert states.state_names == ("x", "y", "z")
    for name in "yz":
        clean = truth.columns([name])[:1500]
        off = states.columns([name]) - clean
        assert np.sqrt(np.square(off).mean()) < 0.02 * clean.std()


@pytest.mark.slow
def test_forecasts_need_the_measured_states_alone(found: ep.Discovery) -> None:
    run = only("x")
    ahead = ep.forecast(found.model, run.window(0, 800), 10.0)
    low, high = (side[:, 0] for side in ahead.band())
    after = run.states[800 : 800 + len(low), 0]
    assert 0.8 < np.mean((low <= after) & (after <= high)) <= 1.0
    assert np.isnan(ahead.noise_std[1])
    skill = ep.model.forecast_skill(found.model, run, n_fitted=750, starts=10)
    assert np.mean(skill.nrmse["model"]) < 0.5 * np.mean(skill.nrmse["persistence"])
    assert 0.75 <= skill.coverage_90 <= 1.0


def test_the_experiment_finds_it_too(tmp_path) -> None:
    path = tmp_path / "prey.csv"
    only("x").to_dataframe().to_csv(path)
    given = ["+exp=discover", "data=recognised", f"data.path={path}", "trajectory.states=[x]"]
    more = ["hidden=[g]", "relations=['g: x*g == 1']", "forecasts=4", f"output={tmp_path}"]
    summary = computed(composed(*given, *more)).summary
    terms = summary["models"]["model"]["equations"]["g"]
    assert set(terms) == set(GROWTH)
    assert terms["x*g"] == pytest.approx(1.0, rel=1e-12)
    assert list(summary["samples_model"][0]["noise_std"]) == ["x"]


def test_a_hidden_state_that_shrinks_gains_no_freedom() -> None:
    run = PLANE.trajectory(noise=0.05, rng=0)
    problem = scale_problem([run], ep.polynomial(["x", "y"], degree=2), measured=["x"])
    sizes = []
    for factor in (1.0, 1e-6):
        path = problem.records[0].samples * [1.0, factor]
        free = np.zeros(problem.n_free)
        ones, path = np.ones(path.shape), path + np.array([0.05, 0.0])
        fit = TrajectoryFit(problem, ones, 1.0, path, free, free != 0.0)
        noise = noise_beside(fit)
        sizes.append(noise.white[0])
        assert noise.kurtosis[1] != noise.kurtosis[1]  # NaN: there is no noise of it
    assert sizes[1][0] == sizes[0][0]
    assert sizes[1][1] == pytest.approx(1e-6 * sizes[0][1])


def test_a_number_of_hidden_states_makes_names_that_no_run_has() -> None:
    assert _hidden_names(1, ["x"]) == ["h"]
    assert _hidden_names(2, ["x", "h1"]) == ["h2", "h3"]
    assert _hidden_names(["w"], ["x"]) == ["w"]
    with pytest.raises(ValueError, match="hidden must be a whole number, zero or more, got -1"):
        ep.discover(only("x"), hidden=-1)


def test_a_relation_sets_the_scale() -> None:
    model = ep.discover(
        only("x"), ep.polynomial(["x", "w"]).relate("x: x*w == 2"), hidden=["w"]
    ).model
    assert model.terms("x") == {"x*w": 2.0}
    law = {"1": 1.0 / 9.0, "x": -1.0 / 3.0, "w": -1.0 / 3.0, "x*w": 1.0}  # w = g / 2
    assert dict(model.terms("w")) == pytest.approx(law, rel=0.05)


# How hidden states may enter.


def test_ways_in_from_one_state() -> None:
    library = ep.polynomial(["x", "v", "h"], degree=2)
    ways = couplings(library, ["x"], ["v", "h"])
    assert {way.term for way, _ in ways} == {"v", "x*v"}
    assert {(way.state, way.term) for _, way in ways} == {("v", "h"), ("v", "x*h"), ("v", "v*h")}
    assert len(ways) == 6


def test_ways_in_from_two_states_and_by_a_relation() -> None:
    library = ep.polynomial(["x", "y", "z"], degree=2)
    ways = couplings(library, ["x", "y"], ["z"])
    terms = {"z", "x*z", "y*z"}
    assert {(w.state, w.term) for (w,) in ways} == {(s, t) for s in "xy" for t in terms}
    fixed = library.relate("2 * y: x*z == -4")
    assert couplings(fixed, ["x", "y"], ["z"]) == [(Coupling("z", "y", "x*z", -2.0, given=True),)]
    with pytest.raises(ValueError, match="'z' has none in"):
        couplings(ep.polynomial(["x", "y"], degree=2), ["x", "y"], ["z"])


def test_only_positive_states_have_growth_rates_which_come_first() -> None:
    library = ep.polynomial(["x", "g"], degree=2)
    for shift, first, n_groups in ((0.0, "x*g", 2), (-1.0, "g", 1)):
        run = only("x")
        moved = Trajectory(run.t, run.states + shift, ["x"])
        groups = list(with_guesses(DiscoveryProblem([moved], library, hidden=["g"])))
        assert len(groups) == n_groups
        ((known, ways),) = groups[0]
        assert ways[0].term == first
        assert known.facts.only == {"x": (first,)}
        assert known.hidden == ()


def test_a_guess_outside_the_domain_of_a_function_is_a_way_that_failed() -> None:
    library = ep.polynomial(["x", "g"], functions=["log(g)"])
    with pytest.raises(FailedTryError, match=r"no guess of the hidden states: log\(g\) needs"):
        list(with_guesses(DiscoveryProblem([only("x")], library, hidden=["g"])))


def test_a_hidden_state_that_rests_is_a_try_that_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    def at_rest(problem: EstimationProblem, paths: list[np.ndarray], runs: list[Trajectory]) -> Any:
        return by_run(problem, [np.where(problem.measured, path, 1.0) for path in paths], runs)

    monkeypatch.setattr(estimate, "by_run", at_rest)
    library = ep.polynomial(["x", "g"], degree=1)
    with pytest.raises(FailedTryError, match="no states fit the data: a state must vary: 'g'"):
        ep.estimate(only("x").window(0, 60), library, hidden=["g"])


@pytest.mark.slow
def test_ways_are_followed_that_process_noise_explains(monkeypatch: pytest.MonkeyPatch) -> None:
    followed = []

    def explain(problem: EstimationProblem, **settings: Any) -> Explanation:
        followed.append(settings["under_noise"].solution.fits)
        return explanation.explain(problem, **settings)

    monkeypatch.setattr(estimate, "explain", explain)
    lorenz = only("x", noise=0.01, system=ep.lorenz())
    library = ep.polynomial(["x", "v", "h"], degree=2)
    assert not ep.estimate(lorenz, library, hidden=["v", "h"]).lack_of_fit
    assert followed == [True]  # of three ways
    followed.clear()
    assert ep.estimate(walk(lorenz.t[:1200]), library, hidden=["v", "h"]).lack_of_fit
    assert followed
    assert not any(followed)


def walk(t: np.ndarray) -> Trajectory:
    """A random walk, which no exact trajectory follows."""
    steps = np.random.default_rng(0).standard_normal((len(t), 1))
    return Trajectory(t, np.cumsum(steps, axis=0), ["x"])


def test_guesses_are_close_without_noise() -> None:
    run, library = only("x", noise=0.0), ep.polynomial(["x", "g"], degree=2)
    truth = 2.0 / 3.0 - PLANE.trajectory().columns(["y"])[:, 0]
    guess = with_guess(run, library, [Coupling("g", "x", "x*g")]).columns(["g"])[:, 0]
    inner = slice(20, -20)
    # The division is held back a little where the factor is small.
    assert np.corrcoef(guess[inner], truth[inner])[0, 1] > 0.98
    other = with_guess_by(PLANE.model, run)
    assert np.corrcoef(other.columns(["y"])[inner, 0], truth[inner])[0, 1] < -0.98


# The likelihood without the samples of a state.


def test_a_hidden_state_that_follows_nothing_is_astray() -> None:
    run = PLANE.trajectory(noise=0.05, rng=0).window(0, 40)
    problem = scale_problem([run], ep.polynomial(["x", "y"], degree=1), measured=["x"])
    free, still = np.zeros(problem.n_free), np.ones(40)  # nothing moves
    everything, noise = np.ones(len(free), dtype=bool), np.ones((40, 2))
    for hidden, is_astray in (
        (np.sin(np.arange(40.0)), True),
        (1e-9 * np.sin(np.arange(40.0)), True),
        (still, False),
    ):
        path = np.column_stack([np.sin(np.arange(40.0)), hidden])
        fraction = hidden_defects(TrajectoryFit(problem, noise, 1e-4, path, free, everything))
        assert (fraction > MAX_HIDDEN_DEFECT).tolist() == [False, is_astray]


def test_what_was_not_measured_counts_nothing() -> None:
    run = PLANE.trajectory(noise=0.05, rng=0).window(0, 40)
    library = ep.polynomial(["x", "y"], degree=2)
    problem = scale_problem([run], library, measured=["x"])
    (record,) = problem.records
    path, ones = record.samples + 0.1, np.ones((40, 2))
    seen = observe(record, path, ones)
    assert np.isnan(seen.residuals[:, 1]).all()
    assert seen.squares[:, 0] == pytest.approx(0.01)
    assert not seen.squares[:, 1].any()
    assert problem.n_squares == 40
    free = np.zeros(problem.n_free)
    support = np.ones(len(free), dtype=bool)
    fit = TrajectoryFit(problem, 0.1 * ones, 1.0, path, free, support)
    least = hessian_on(fit, fit.support)[2]
    far = replace(record, samples=record.samples + np.array([0.0, 5.0]))  # a guess is no sample
    moved = replace(problem, records=(far,))
    assert hessian_on(replace(fit, problem=moved), fit.support)[2] == pytest.approx(least)


def test_what_cannot_be_hidden_is_refused() -> None:
    with pytest.raises(ValueError, match="one that no run has"):
        ep.discover(only("x"), hidden=["x"])
    with pytest.raises(ValueError, match="a regression needs samples of every state"):
        ep.discover(only("x"), method=ep.Regression(), hidden=["g"])
    with pytest.raises(ValueError, match="none of .'x', 'y'. does"):
        ep.model.estimate_states(ep.lorenz().model, only("z", system=ep.lorenz()))
