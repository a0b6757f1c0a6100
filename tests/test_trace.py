"""One signal as states: what is known of them, what noise leaves of them, and what is refused."""

import re

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.discovery.one_signal import (
    Preparation,
    best_of,
    fitted_part,
    run_on_rest,
    try_in_turn,
)
from ep2sindy.signals.embedding import DROWNED, Embedding, embed_alike, unexplained
from ep2sindy.signals.signal import prepare_signal
from ep2sindy.signals.smoothers import ratio_bounds
from ep2sindy.signals.spectrum import dominant_frequency, signal_memory_s
from ep2sindy.studies.trace import lost_mean

A, B = 2.0, 1.0  # of the Toda oscillator: g' = A - B x


def toda(n_periods=20.0, *, per_period=80, start=(0.3, 0.0)):
    """x' = x g, g' = A - B x: closed orbits around x = A / B."""
    library = ep.polynomial(["x", "g"], degree=2)
    coef = ep.model.coef_matrix(library, [{"x*g": 1.0}, {"1": A, "x": -B}])
    model = ep.SparseModel(library, ["x", "g"], coef)
    # The period of small perturbations; those of large ones are longer.
    t = 2 * np.pi / np.sqrt(A) * np.arange(round(n_periods * per_period)) / per_period
    return model.simulate(t, list(start))


def recorded(t, x, name="x", unit="A"):
    return ep.Trajectory(t, np.asarray(x)[:, None], (name,), units={name: unit})


def sine(n_periods=20.0, *, per_period=60, mean=0.0):
    turn = np.arange(round(n_periods * per_period)) / per_period
    return recorded(1e-3 * turn, mean + np.sin(2 * np.pi * turn))


def discovered(states, *, degree, max_terms):
    recipe = ep.Regression(
        ep.Differential(ep.signals.KalmanSmoother()), ep.BestSubset(max_terms=max_terms)
    )
    return ep.discover(states.run, states.library(degree), recipe).model


def test_the_growth_rate_is_that_of_the_signal():
    run = toda()
    chosen = ep.embed(recorded(run.t, run.states[:, 0]))
    assert chosen.embedding == Embedding("rate")
    states = chosen.run
    assert states.state_names == ("x", "g")
    assert states.units == {"x": "A", "g": "s^-1"}
    inner = slice(20, -20)
    off = (states.states[:, 1] - run.states[:, 1])[inner]
    # What lies above the seventh harmonic of this cycle.
    assert off.std() < 0.02 * run.states[:, 1].std()


def test_the_toda_oscillator_is_found_with_its_known_equation_exact():
    run = toda()
    found = ep.embed(recorded(run.t, run.states[:, 0]))
    model = discovered(found, degree=3, max_terms=3)
    assert model.terms("x") == {"x*g": 1.0}
    kept = {term: model.terms("g")[term] for term in ("1", "x")}
    assert kept == pytest.approx({"1": A, "x": -B}, rel=0.03)


def test_a_sine_of_either_sign_is_a_harmonic_oscillator():
    found = ep.embed(sine())
    assert found.embedding == Embedding("derivative")
    assert "either sign" in found.reason
    assert found.run.units == {"x": "A", "v": "A s^-1"}
    model = discovered(found, degree=2, max_terms=2)
    assert model.terms("x") == {"v": 1.0}
    assert model.terms("v")["x"] == pytest.approx(-((2e3 * np.pi) ** 2), rel=0.01)


def test_delays_are_the_signal_a_part_of_a_period_before():
    embedded = ep.embed(sine(), "delays")
    x, before = embedded.run.states[40:-40].T
    phase = 2e3 * np.pi * embedded.run.t[40:-40]
    np.testing.assert_allclose(x, np.sin(phase), atol=0.01)
    np.testing.assert_allclose(before, -np.cos(phase), atol=0.01)
    assert not embedded.known


def test_noise_that_drowns_the_derivative_asks_for_delays():
    clean = sine(60.0)
    noise = 1.5 * DROWNED * np.random.default_rng(0).standard_normal(clean.n_samples)
    chosen = ep.embed(recorded(clean.t, clean.states[:, 0] + noise))
    assert chosen.embedding == Embedding("delays")
    assert "noise" in chosen.reason


def test_a_trough_below_the_noise_keeps_its_logarithm():
    run = toda(60.0, start=(0.02, 0.0))
    x = run.states[:, 0]
    sigma = 0.02 * x.mean()
    noisy = x + sigma * np.random.default_rng(1).standard_normal(len(x))
    assert noisy.min() < 0.0  # its own logarithm does not exist
    found = ep.signals.LogSmoother().estimate(run.t, noisy)
    assert found.noise_std == pytest.approx(sigma, rel=0.05)  # 4800 samples: 1 %, and Laplace's
    high = x > 0.5
    assert np.abs(found.log - np.log(x))[high].max() < 0.1
    assert np.sqrt(np.mean((found.log - np.log(x)) ** 2)) < 0.25
    assert np.std(found.rate - run.states[:, 1]) < 0.25 * run.states[:, 1].std()


def test_an_exponential_passes_the_log_smoother_unchanged():
    t = np.cumsum(np.random.default_rng(0).uniform(0.5, 1.5, 200)) / 200.0
    found = ep.signals.LogSmoother().estimate(t, 3.0 * np.exp(2.0 * t - t**2))
    # A parabola in the logarithm has no third derivative, on whatever steps.
    np.testing.assert_allclose(found.log, np.log(3.0) + 2.0 * t - t**2, atol=1e-5)


def test_crowded_samples_do_not_stop_the_log_smoother():
    t = np.sort(np.random.default_rng(0).uniform(0.0, 30.0, 500))  # some steps are 1e-5 s
    found = ep.signals.LogSmoother().estimate(t, np.exp(np.sin(t)))
    np.testing.assert_allclose(found.log, np.sin(t), atol=1e-3)


def test_units_scale_the_log_smoother():
    run = toda()
    x = run.states[:, 0] * (1 + 0.01 * np.random.default_rng(0).standard_normal(len(run.t)))
    one, other = (ep.signals.LogSmoother().estimate(run.t, k * x) for k in (1.0, 1e-3))
    np.testing.assert_allclose(one.rate, other.rate, rtol=1e-6, atol=1e-6)
    assert other.noise_std == pytest.approx(1e-3 * one.noise_std)


def test_what_is_faster_than_asked_counts_as_noise():
    assert ratio_bounds(None, None, 1.0, (-9.0, 8.0)) == (-9.0, 8.0)
    assert ratio_bounds(10.0, 100.0, 1.0, (-14.0, 4.0)) == pytest.approx((-12.0, -6.0))
    # The signal is followed if the bounds contradict each other.
    assert ratio_bounds(10.0, 1.0, 1.0, (-14.0, 4.0)) == pytest.approx((0.0, 0.0))
    clean = sine(40.0, mean=3.0)
    x = clean.states[:, 0] + 0.1 * np.sin(25 * 2e3 * np.pi * clean.t)
    fine = ep.embed(recorded(clean.t, x), "rate", harmonics=7.0)
    assert fine.noise_std > 0.05  # 0.1 / sqrt(2) of it
    assert np.abs(fine.run.states[20:-20, 0] - clean.states[20:-20, 0]).max() < 0.03


def test_fine_samples_are_averaged_unless_told_not_to():
    fine = sine(10.0, per_period=1000)
    kept = ep.signals.prepare_signal(fine, decimate=None)
    assert len(kept.x) == fine.n_samples
    few = ep.signals.prepare_signal(fine)
    assert few.done == ("means over 10 samples: 1000 are left",)
    assert few.per_period == pytest.approx(100.0, rel=1e-3)
    assert few.x[0] == pytest.approx(fine.states[:10, 0].mean())
    assert few.period_s == pytest.approx(1e-3, rel=1e-4)


def test_a_long_record_is_averaged_after_a_look_at_its_means():
    n, per_period = 200_000, 4000
    x = 2.0 + np.sin(2 * np.pi * np.arange(n) / per_period)
    found = ep.signals.prepare_signal(recorded(1e-6 * np.arange(n), x))
    assert found.per_period == pytest.approx(100.0, rel=0.01)


@pytest.mark.parametrize("mean", [0.0, 1.2])
def test_a_drift_is_taken_out_and_nothing_else(mean):
    run = sine(20.0, mean=mean)
    line = 0.6 * (run.t / run.t[-1] - 0.5)
    drifting = recorded(run.t, run.states[:, 0] + line)
    straight = ep.signals.prepare_signal(drifting)
    assert "a straight line taken out, which rises by 0." in straight.done[0]
    np.testing.assert_allclose(straight.x, run.states[:, 0], atol=2e-3)
    kept = ep.signals.prepare_signal(drifting, detrend=False)
    assert re.search(r"x drifts by 0\.\d+ over the record", kept.advice[0])
    np.testing.assert_array_equal(kept.x, drifting.states[:, 0])
    assert ep.signals.prepare_signal(run).done == ()


def test_times_rounded_to_a_few_digits_are_taken_as_equal_steps():
    exact = 1.3e-6 * np.arange(80, 700)
    rounded = np.array([float(f"{t:.2E}") for t in exact])
    x = np.sin(2 * np.pi * exact / 5e-5)
    found = ep.signals.prepare_signal(recorded(rounded, x))
    assert found.done == ("times rounded to 3 digits taken as equal steps",)
    np.testing.assert_allclose(np.diff(found.t), 1.3e-6, rtol=2e-3)
    uneven = exact + 4e-7 * np.random.default_rng(0).random(len(exact))
    np.testing.assert_array_equal(ep.signals.prepare_signal(recorded(uneven, x)).t, uneven)


def test_a_smoother_follows_pulses_and_few_samples_to_a_period():
    """The likelihood alone takes such signals for noise; their spectrum says that they are none."""
    # The intensity of a laser that obeys the Lorenz equations, eight samples to a pulse.
    run = ep.lorenz().model.simulate(0.08 * np.arange(700), [1.0, 2.0, 20.0])
    t, x = np.arange(600.0), run.states[100:, 0] ** 2
    column = x[:, None]
    assert ep.signals.KalmanSmoother().estimate(t, column).noise_std[0] > 0.9 * x.std()
    memory_s = signal_memory_s(t, x)
    held = ep.signals.KalmanSmoother(coarsest_s=memory_s).estimate(t, column)
    assert held.noise_std[0] < 0.3 * x.std()
    assert np.std(held.smoothed[:, 0] - x) < 0.15 * x.std()
    # White noise has nothing to be followed.
    noise = np.random.default_rng(0).standard_normal(600)
    assert signal_memory_s(t, noise) == t[-1]


@pytest.mark.parametrize("fraction", [0.02, 0.05, 0.2])
def test_a_gap_does_not_change_the_frequency(fraction):
    rng = np.random.default_rng(3)
    t = 1.5e-6 * np.arange(3000)
    x = np.exp(2.0 * np.sin(2 * np.pi * 2e4 * t)) * (1.0 + 0.2 * rng.standard_normal(3000))
    gap = slice(1000, 1000 + round(3000 * fraction))
    kept = np.delete(np.arange(3000), gap)
    found = ep.signals.find_cycle(t[kept], x[kept, None])
    assert found.frequency_Hz == pytest.approx(2e4, rel=1e-3)
    assert dominant_frequency(t[kept], x[kept]) == pytest.approx(2e4, rel=5e-3)


def test_three_states_of_a_signal_are_a_chain_of_derivatives():
    t = np.linspace(0.0, 60.0, 3001)
    two_lines = recorded(t, np.sin(t) + 0.5 * np.sin(2 * t))
    signal = ep.signals.prepare_signal(two_lines, decimate=None)
    states = ep.embed(signal, n_states=3)
    assert states.run.state_names == ("x", "v", "w")
    assert states.run.units == {"x": "A", "v": "A s^-1", "w": "A s^-2"}
    assert states.known == {"x": "v", "v": "w"}
    inner = slice(100, -100)
    bend = -np.sin(t) - 2.0 * np.sin(2 * t)
    assert np.abs(states.run.states[:, 2] - bend)[inner].max() < 0.1
    found = ep.embed(recorded(t, np.exp(np.sin(t))), "rate", n_states=3, decimate=None)
    assert found.run.state_names == ("x", "g", "h")
    assert found.run.units == {"x": "A", "g": "s^-1", "h": "s^-2"}
    assert found.known == {"x": "x*g", "g": "h"}
    assert np.abs(found.run.states[:, 2] + np.sin(t))[inner].max() < 0.05
    before = ep.embed(signal, "delays", n_states=3)
    assert before.run.state_names == ("x", "x_before", "x_before2")
    hidden = ep.embed(signal, "hidden", n_states=3)
    assert hidden.run.state_names == ("x",)
    assert hidden.hidden == ("v", "w")
    assert hidden.library(degree=1).names == ("1", "x", "v", "w")


def test_signals_of_several_runs_get_one_embedding():
    high, low = (ep.signals.prepare_signal(sine(mean=mean)) for mean in (3.0, 0.0))
    assert [each.embedding.how for each in map(ep.embed, (high, low))] == ["rate", "derivative"]
    alike = embed_alike
    assert {each.embedding for each in alike([high, high])} == {Embedding("rate")}
    both = alike([high, low], n_states=3)
    assert {each.embedding for each in both} == {Embedding("derivative", n_states=3)}
    with pytest.raises(ValueError, match="a signal or more, got an empty list"):
        alike([])


def test_neighbours_tell_how_many_states_there_are():
    lorenz = ep.lorenz().trajectory()
    signal = ep.signals.prepare_signal(recorded(lorenz.t, lorenz.states[:, 0]))
    assert signal.cycle is None
    assert signal.frequency_Hz == pytest.approx(0.9, rel=0.3)  # turns of either wing
    two, three = (unexplained(ep.embed(signal, "derivative", n_states=n)) for n in (2, 3))
    loop = ep.embed(sine(), "derivative")
    assert unexplained(loop) < 1e-3 < 0.5 * three < two


def test_a_signal_named_as_the_rate_keeps_its_name():
    run = sine(mean=3.0)
    found = ep.embed(recorded(run.t, run.states[:, 0], name="g"))
    assert found.run.state_names == ("g", "g_rate")


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (
            recorded(np.arange(2000.0), np.random.default_rng(0).standard_normal(2000)),
            "a trace must oscillate: no period explains a quarter of the variance of x",
        ),
        (
            recorded(np.arange(300.0), 2.0 + np.sin(2 * np.pi * np.arange(300.0) / 4.3)),
            r"sampled 6 times a period or more: x has 4\.3 samples .* is aliased",
        ),
    ],
)
def test_what_does_not_oscillate_is_refused(run, message):
    with pytest.raises(ValueError, match=message):
        ep.signals.prepare_signal(run)


@pytest.mark.parametrize("mean", [0.0, 0.9])
def test_logarithms_of_a_signal_with_zeros_are_refused(mean):
    signal = ep.signals.prepare_signal(sine(mean=mean))
    message = r"needs a positive signal: x falls to .* its derivative instead"
    with pytest.raises(ValueError, match=message):
        ep.embed(signal, "rate")
    assert ep.embed(signal).embedding == Embedding("derivative")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ep.embed(sine(), n_states=6), "n_states must be 2 to 5, got 6"),
        (
            lambda: ep.signals.LogSmoother().estimate(np.arange(5.0), np.ones(5)),
            "at least 8 samples",
        ),
    ],
)
def test_settings_that_cannot_be_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


# From a signal to a tested model


def tried(signal, method=None, *preparations, held_out=0.25):
    attempts = try_in_turn(fitted_part(signal, held_out), preparations, method or ep.Regression())
    return attempts, *run_on_rest(signal, best_of(attempts))


def test_hidden_states_that_explain_a_signal_end_the_list() -> None:
    """With g = 2/3 - y, x' = x (2/3 - y) and y' = y (x - 1/3) are these two equations."""
    prey = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    signal = ep.signals.prepare_signal(prey, "x", decimate=4)
    ways = [Preparation("hidden", degree=1), Preparation("hidden", degree=2), Preparation("auto")]
    (attempt,), states, free = tried(signal, None, *ways)
    assert attempt.preparation == ways[1]
    assert attempt.found.model.terms("x") == pytest.approx({"x*g": 1.0}, rel=1e-12)
    exact = {"1": 2 / 9, "x": -2 / 3, "g": -1 / 3, "x*g": 1.0}
    assert attempt.found.model.terms("g") == pytest.approx(exact, rel=0.05)
    assert attempt.searched == ["g"]
    assert np.isnan(attempt.fraction)
    assert free.comparison.is_similar
    assert free.record.t[0] == signal.t[round(0.75 * len(signal.t)) - 1]
    assert states.state_names == ("x", "g")
    assert free.forecast is not None


def test_a_later_preparation_must_forecast_clearly_better() -> None:
    signal = ep.signals.prepare_signal(sine())
    ways = [Preparation("delays", degree=0), Preparation("derivative", degree=1)]
    ways += [Preparation("derivative", degree=2), Preparation("derivative", n_states=3)]
    attempts, _, free = tried(signal, None, *ways, held_out=0.0)
    assert [each.preparation for each in attempts] == ways[:3]  # it repeats itself: two states do
    best = best_of(attempts)
    assert best is attempts[1]
    assert best.found.model.terms("x") == {"v": 1.0}
    rate = 2.0 * np.pi * signal.frequency_Hz
    assert best.found.model.terms("v") == pytest.approx({"x": -(rate**2)}, rel=1e-2)
    assert free.forecast is None
    assert free.record.n_samples == len(signal.t)


@pytest.mark.parametrize(
    ("mean", "asked"), [(0.0, True), (0.02, True), (0.3, False), (-0.3, False)]
)
def test_a_lost_mean_is_asked_for_only_where_the_mean_is_zero(mean, asked):
    """Mean in standard deviations, of pulses that cross zero over 20.5 periods."""
    pulses = toda(20.5, start=(0.05, 0.0))
    x = pulses.states[:, 0] - pulses.states[:, 0].mean()
    question = lost_mean(prepare_signal(recorded(pulses.t, x + mean * x.std()), detrend=False))
    assert (question is not None) == asked
    assert not asked or "did x lose its mean" in question
