"""One signal as states: what is known of them, what noise leaves of them, and what is refused."""

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.signals.embedding import DROWNED
from ep2sindy.signals.log_smoother import ratio_bound

A, B = 2.0, 1.0  # of the Toda oscillator: g' = A - B x


def toda(n_periods=20.0, *, per_period=80, start=(0.3, 0.0)):
    """x' = x g, g' = A - B x: closed orbits around x = A / B."""
    library = ep.polynomial(["x", "g"], degree=2)
    coef = ep.coef_matrix(library, [{"x*g": 1.0}, {"1": A, "x": -B}])
    model = ep.SparseModel(library, ["x", "g"], coef)
    # The period of small departures; those of large ones are longer.
    t = 2 * np.pi / np.sqrt(A) * np.arange(round(n_periods * per_period)) / per_period
    return model.simulate(t, list(start))


def recorded(t, x, name="x", unit="A"):
    return ep.Trajectory(t, np.asarray(x)[:, None], (name,), units={name: unit})


def sine(n_periods=20.0, *, per_period=60, mean=0.0):
    turn = np.arange(round(n_periods * per_period)) / per_period
    return recorded(1e-3 * turn, mean + np.sin(2 * np.pi * turn))


def chosen_for(run):
    return ep.signals.embed(ep.signals.from_one_signal(run))


def discovered(states, *, degree, max_terms):
    recipe = ep.Regression(
        ep.Differential(ep.signals.KalmanSmoother()), ep.BestSubset(max_terms=max_terms)
    )
    library = ep.polynomial(states.run.state_names, degree=degree)
    known = {"relations": states.relations, "terms": states.terms}
    return ep.discover(states.run, library, recipe, **known).model


def test_the_growth_rate_is_that_of_the_signal():
    run = toda()
    chosen = chosen_for(recorded(run.t, run.states[:, 0]))
    assert chosen.embedding == ep.signals.LogRate()
    states = chosen.embedded.run
    assert states.state_names == ("x", "g")
    assert states.units == {"x": "A", "g": "s^-1"}
    inner = slice(20, -20)
    off = (states.states[:, 1] - run.states[:, 1])[inner]
    # What lies above the seventh harmonic of this cycle.
    assert off.std() < 0.02 * run.states[:, 1].std()


def test_the_toda_oscillator_is_found_with_its_known_equation_exact():
    run = toda()
    found = chosen_for(recorded(run.t, run.states[:, 0])).embedded
    model = discovered(found, degree=3, max_terms=3)
    assert model.terms("x") == {"x*g": 1.0}
    kept = {term: model.terms("g")[term] for term in ("1", "x")}
    assert kept == pytest.approx({"1": A, "x": -B}, rel=0.03)


def test_a_sine_of_either_sign_is_a_harmonic_oscillator():
    found = chosen_for(sine())
    assert found.embedding == ep.signals.Rate()
    assert "either sign" in found.reason
    assert found.embedded.run.units == {"x": "A", "v": "A s^-1"}
    model = discovered(found.embedded, degree=2, max_terms=2)
    assert model.terms("x") == {"v": 1.0}
    assert model.terms("v")["x"] == pytest.approx(-((2e3 * np.pi) ** 2), rel=0.01)


def test_delays_are_the_signal_a_part_of_a_period_before():
    embedded = ep.signals.Delays().embed(ep.signals.from_one_signal(sine()))
    x, before = embedded.run.states[40:-40].T
    phase = 2e3 * np.pi * embedded.run.t[40:-40]
    np.testing.assert_allclose(x, np.sin(phase), atol=0.01)
    np.testing.assert_allclose(before, -np.cos(phase), atol=0.01)
    assert embedded.relations == ()
    assert embedded.searched == ["x", "x_before"]


def test_noise_that_drowns_the_derivative_asks_for_delays():
    clean = sine(60.0)
    noise = 1.5 * DROWNED * np.random.default_rng(0).standard_normal(clean.n_samples)
    chosen = chosen_for(recorded(clean.t, clean.states[:, 0] + noise))
    assert chosen.embedding == ep.signals.Delays()
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


def test_units_scale_the_log_smoother():
    run = toda()
    x = run.states[:, 0] * (1 + 0.01 * np.random.default_rng(0).standard_normal(len(run.t)))
    one, other = (ep.signals.LogSmoother().estimate(run.t, k * x) for k in (1.0, 1e-3))
    np.testing.assert_allclose(one.rate, other.rate, rtol=1e-6, atol=1e-6)
    assert other.noise_std == pytest.approx(1e-3 * one.noise_std)


def test_what_is_faster_than_asked_counts_as_noise():
    assert ratio_bound(None, 1.0) > ratio_bound(0.5, 1.0) > ratio_bound(5.0, 1.0)
    assert ratio_bound(10.0, 1.0) == pytest.approx(-6.0)
    clean = sine(40.0, mean=3.0)
    x = clean.states[:, 0] + 0.1 * np.sin(25 * 2e3 * np.pi * clean.t)
    fine = ep.signals.LogRate(harmonics=7.0).embed(ep.signals.from_one_signal(recorded(clean.t, x)))
    assert fine.noise_std > 0.05  # 0.1 / sqrt(2) of it
    assert np.abs(fine.run.states[20:-20, 0] - clean.states[20:-20, 0]).max() < 0.03


def test_fine_samples_are_averaged_where_asked_and_offered_where_not():
    fine = sine(10.0, per_period=1000)
    kept = ep.signals.from_one_signal(fine)
    assert len(kept.x) == fine.n_samples
    assert "decimate=10" in kept.advice[0]
    few = ep.signals.from_one_signal(fine, decimate="auto")
    assert few.advice == ()
    assert len(few.x) == 1000
    assert "100 to a period" in few.done[0]
    assert few.x[0] == pytest.approx(fine.states[:10, 0].mean())
    assert few.period_s == pytest.approx(1e-3, rel=1e-4)


@pytest.mark.parametrize("mean", [0.0, 20.0])
def test_a_drift_is_offered_to_be_taken_out(mean):
    run = sine(20.0, mean=mean)
    drifting = recorded(run.t, run.states[:, 0] + 1.5 * run.t / run.t[-1])
    assert "detrend=true" in ep.signals.from_one_signal(drifting).advice[0]
    straight = ep.signals.from_one_signal(drifting, detrend=True)
    assert straight.advice == ()
    assert straight.x.mean() == pytest.approx(drifting.states.mean())
    line = np.polynomial.Polynomial.fit(run.t, straight.x, 1)(run.t)
    assert abs(line[-1] - line[0]) < 0.1


def test_a_signal_named_as_the_rate_keeps_its_name():
    run = sine(mean=3.0)
    found = chosen_for(recorded(run.t, run.states[:, 0], name="g")).embedded
    assert found.run.state_names == ("g", "g_rate")


@pytest.mark.parametrize(
    ("run", "message"),
    [
        (sine(5.0), r"must hold 6 periods or more: x holds about 5\.0 in 0\.00\d+ s; record"),
        (
            recorded(np.arange(2000.0), np.random.default_rng(0).standard_normal(2000)),
            "a trace must oscillate: no period explains a quarter of the variance of x",
        ),
        (recorded(np.arange(500.0), np.exp(-np.arange(500.0) / 100)), "if it oscillates at all"),
    ],
)
def test_what_does_not_oscillate_is_refused(run, message):
    with pytest.raises(ValueError, match=message):
        ep.signals.from_one_signal(run)


@pytest.mark.parametrize("mean", [0.0, 0.9])
def test_logarithms_of_a_signal_with_zeros_are_refused(mean):
    signal = ep.signals.from_one_signal(sine(mean=mean))
    message = r"needs a positive signal: x falls to .* \(embedding=rate"
    with pytest.raises(ValueError, match=message):
        ep.signals.LogRate().embed(signal)
    assert ep.signals.embed(signal).embedding == ep.signals.Rate()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ep.signals.LogRate(0.5), "harmonics must be one or more: 0.5 came"),
        (lambda: ep.signals.Delays(share=1.0), "share of the period must lie between 0 and 1"),
        (lambda: ep.signals.LogSmoother(0.0), "finest_s must be a positive time"),
        (
            lambda: ep.signals.from_one_signal(sine(), decimate=0),
            "decimate must be auto, null or a whole number",
        ),
        (lambda: ep.signals.from_one_signal(sine(), "y"), "unknown variable 'y'"),
        (
            lambda: ep.signals.from_one_signal(ep.lotka_volterra().trajectory()),
            "one signal must be named",
        ),
        (
            lambda: ep.signals.LogSmoother().estimate(np.arange(9.0), -np.ones(9)),
            "a signal must be positive for its logarithm",
        ),
        (lambda: ep.signals.LogSmoother().estimate(np.arange(5.0), np.ones(5)), "needs 8 samples"),
    ],
)
def test_settings_that_cannot_be_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
