"""Whether something outside drives a signal: inputs, a known period, and the question."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.signals.driving import (
    ask_whether_driven,
    describe_set,
    drop_repeats,
    propose_inputs,
    report_unknown_drive,
)
from ep2sindy.signals.signal import Signal, prepare_signal
from tests.programs import composed, computed

PERIOD_S = 5.3
TURN = 2.0 * np.pi


def moved(
    rates: Callable[[np.ndarray, float], Sequence[float]], start: Sequence[float], *,
    fraction: float,
    n_periods: int = 150, per_period: int = 40, period_s: float = TURN, seed: int = 0,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Times and first state of noisy equations; fraction: process noise a period."""
    rng, n_fine = np.random.default_rng(seed), 8
    h = period_s / per_period / n_fine
    x, t, found = np.array(start), 0.0, []
    for k in range((n_periods + 10) * per_period * n_fine):
        if k % n_fine == 0:
            found.append((t, x[0]))
        half = x + 0.5 * h * np.asarray(rates(x, t))
        x = x + h * np.asarray(rates(half, t + 0.5 * h))
        x = x + fraction * np.sqrt(h / period_s) * rng.standard_normal(len(x))
        t += h
    times, samples = np.array(found[10 * per_period :]).T
    return times, samples + 0.01 * samples.std() * rng.standard_normal(len(samples))


def forced(x: np.ndarray, t: float) -> list[float]:
    return [x[1], -x[0] - 0.8 * x[1] + np.cos(0.9137 * t)]


def van_der_pol(x: np.ndarray, t: float) -> list[float]:
    return [x[1], (1.0 - x[0] ** 2) * x[1] - x[0]]


def sampled(wave: np.ndarray, t: np.ndarray, noise: float = 0.02) -> Signal:
    noisy = wave + noise * wave.std() * np.random.default_rng(1).standard_normal(len(wave))
    return prepare_signal((t, noisy))


def swept(f_Hz: float = 0.1387, n_periods: int = 40) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Times, a triangle, and x' = 3 (V + V^2 - x) driven by it."""
    t = np.arange(50 * n_periods) / (50 * f_Hz)
    sweep = 4.0 * np.abs((t * f_Hz) % 1.0 - 0.5) - 1.0
    x, h = np.zeros(len(t)), t[1]
    decay = np.exp(-3.0 * h)
    for k in range(len(t) - 1):
        level = sweep[k : k + 2] + sweep[k : k + 2] ** 2
        x[k + 1] = decay * x[k] + (1.0 - decay) * level.mean()
    return t, sweep, x


def test_a_phase_that_is_moved_by_process_noise_and_returns_is_asked_about() -> None:
    signal = prepare_signal(moved(forced, [0.0, 0.0], fraction=0.1, period_s=TURN / 0.9137))
    question = ask_whether_driven(signal, {})
    assert question is not None
    assert "period_s=6.8" in question
    assert report_unknown_drive(signal) is None


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_phase_that_walks_is_not(seed: int) -> None:
    t, x = moved(van_der_pol, [2.0, 0.0], fraction=0.1, period_s=6.66, seed=seed)
    assert ask_whether_driven(prepare_signal((1.0371 * t, x)), {}) is None


def test_a_record_in_which_nothing_moves_tells_neither() -> None:
    signal = prepare_signal(moved(van_der_pol, [2.0, 0.0], fraction=0.0, n_periods=40))
    assert ask_whether_driven(signal, {}) is None
    assert "one cannot tell whether" in (report_unknown_drive(signal) or "")


def test_what_falls_between_coarse_samples_is_no_push() -> None:
    t = np.arange(1000.0) / 10.43
    x = np.tanh(8.0 * np.sin(TURN * t))
    assert ask_whether_driven(prepare_signal((1.0371 * t, x)), {}) is None


def test_a_round_frequency_of_a_phase_that_walks_is_not_asked_about() -> None:
    """A walk leaves its frequency unknown to more than the distance of round numbers."""
    t, x = moved(van_der_pol, [2.0, 0.0], fraction=0.1, period_s=6.66, seed=3)
    own_Hz = prepare_signal((t, x)).frequency_Hz
    assert ask_whether_driven(prepare_signal((t * own_Hz / 500.0, x)), {}) is None


@pytest.mark.parametrize(
    ("f_Hz", "words", "period_s"),
    [
        (500.0, "its frequency is a round 500 Hz", "0.002"),
        (60.01, "its frequency is 60 Hz, as of the mains,", "0.0166667"),
        (1.0 / (365.2 * 86400.0), "its frequency is one per year", "3.15576e+07"),
    ],
)
def test_a_round_frequency_is_asked_about(f_Hz: float, words: str, period_s: str) -> None:
    t = np.arange(4000) / (50.0 * f_Hz)
    wave = np.exp(np.cos(TURN * f_Hz * t))
    question = ask_whether_driven(sampled(wave, t), {})
    assert question is not None
    assert f"{words} to its resolution" in question
    assert question.endswith(f"or period_s={period_s}")


def test_a_frequency_that_is_not_round_is_not() -> None:
    t = np.arange(4000) / (50.0 * 487.31)
    assert ask_whether_driven(sampled(np.exp(np.cos(TURN * 487.31 * t)), t), {}) is None


def test_a_column_that_looks_set_is_named() -> None:
    t, sweep, x = swept()
    signal = sampled(x, t)
    assert ask_whether_driven(signal, {}) is None
    question = ask_whether_driven(signal, {"noise": (t, x[::-1]), "V": (t, sweep)})
    assert question is not None
    assert question.endswith("name it, inputs=[V]")


def test_the_other_state_of_an_oscillator_does_not_look_set() -> None:
    run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    beside = {"y": (run.t, run.states[:, 1])}
    assert ask_whether_driven(prepare_signal(run, "x"), beside) is None
    assert propose_inputs(run.t, {"x": run.states[:, 0], "y": run.states[:, 1]}) == {}


T = np.arange(1000) * 0.1


@pytest.mark.parametrize(
    ("u", "how"),
    [
        ((T // 7.0) % 2.0, "held between steps"),
        (np.random.default_rng(0).uniform(size=25).repeat(40), "held between steps"),
        (np.clip(4.0 * np.sin(TURN * T / 11.0), -1.0, 1.0), "held between steps"),  # with ramps
        (np.sin(T), "a sine"),
        (np.abs((T / 9.0) % 1.0 - 0.5), "a triangle or a sweep"),
        ((T / 9.0) % 1.0, "a triangle or a sweep"),
        (np.round(8.0 * np.sin(0.1 * T)), ""),  # a coarse scale
        (np.exp(np.sin(T)), ""),
        (np.random.default_rng(0).standard_normal(1000), ""),
        (np.ones(1000), ""),
    ],
)
def test_what_somebody_sets_is_recognised_by_its_form(u: np.ndarray, how: str) -> None:
    assert describe_set(T, u, []) == how


def test_a_sine_is_proposed_only_if_it_leads_what_is_no_sine() -> None:
    lagging = np.exp(np.sin(T - 1.0))
    assert propose_inputs(T, {"u": np.sin(T), "x": lagging}) == {"u": "a sine"}
    assert propose_inputs(T, {"u": np.sin(T - 2.0), "x": lagging}) == {}
    assert propose_inputs(T, {"u": np.sin(T), "x": np.sin(T - 1.0)}) == {}
    assert propose_inputs(T, {"u": np.sin(T)}) == {}


def duffing(noise: float) -> ep.Trajectory:
    """x'' = x - x^3 - 0.3 x' + 0.5 cos(2 pi t / 5.3), the first state alone."""
    library = ep.polynomial(["x", "v", "u"], degree=3)
    terms = [{"v": 1.0}, {"x": 1.0, "x^3": -1.0, "v": -0.3, "u": 0.5}]
    law = ep.SparseModel(library, ["x", "v"], ep.model.coef_matrix(library, terms))
    t = np.linspace(0.0, 25.0 * PERIOD_S, 1251)
    drive = np.cos(TURN * t / PERIOD_S)
    x = law.simulate(t, [0.5, 0.0], {"u": drive}).states[:, :1]
    rng = np.random.default_rng(0)
    x = x + noise * x.std() * rng.standard_normal(x.shape)
    return ep.Trajectory(t, x, ["x"], drive[:, None], ["u"])


def test_one_driven_signal_gives_its_law_by_its_column_or_its_period() -> None:
    run = duffing(0.05)
    terms = {"x", "x^3", "v", "u"}
    states = ep.embed(run, "hidden")
    assert states.run.input_names == ("u",)
    found = ep.discover(states.run, states.library(degree=3), hidden=states.hidden)
    assert set(found.model.terms("v")) == terms
    bare = replace(run, inputs=np.empty((0, 0)), input_names=())
    states = ep.embed(ep.signals.add_drive(bare, PERIOD_S), "hidden")
    found = ep.discover(states.run, states.library(degree=3), hidden=states.hidden)
    assert set(found.model.terms("v")) == terms - {"u"} | {"cos_drive"}
    assert found.model.terms("v")["cos_drive"] == pytest.approx(0.5, abs=0.02)


def test_a_signal_alone_is_a_state_if_it_has_inputs() -> None:
    t, sweep, x = swept()
    x = x + 0.02 * x.std() * np.random.default_rng(0).standard_normal(len(x))
    states = ep.embed(
        ep.Trajectory(t, x[:, None], ["x"], sweep[:, None], ["V"]), "hidden", n_states=1
    )
    assert states.embedding.says == "the signal alone"
    found = ep.discover(states.run, states.library(degree=2), hidden=states.hidden)
    assert set(found.model.terms("x")) == {"x", "V", "V^2"}


def test_means_over_samples_are_of_inputs_too() -> None:
    t = np.arange(6000) * 1e-3
    run = ep.Trajectory(t, np.sin(TURN * 3.0 * t)[:, None], ["x"], t[:, None], ["u"])
    few = prepare_signal(run, decimate=10).run
    np.testing.assert_allclose(few.inputs[:, 0], few.t)
    late = ep.embed(run, "delays", decimate=10).run
    np.testing.assert_allclose(late.inputs[:, 0], late.t)


def test_a_library_of_a_drive_lacks_what_its_sum_of_squares_says() -> None:
    library = drop_repeats(ep.polynomial(["x", "cos_drive", "sin_drive"], degree=2))
    assert "sin_drive^2" not in library.names
    assert {"cos_drive^2", "cos_drive*sin_drive", "x*sin_drive"} <= set(library.names)
    plain = ep.polynomial(["x"], degree=2)
    assert drop_repeats(plain) is plain


def test_a_study_takes_the_column_that_drives_a_signal(tmp_path: Path) -> None:
    t, sweep, x = swept()
    x = x + 0.02 * x.std() * np.random.default_rng(0).standard_normal(len(x))
    path = tmp_path / "probe.csv"
    columns = np.column_stack([t, x, sweep])
    np.savetxt(path, columns, delimiter=",", header="time,x,V", comments="")
    given = ["+exp=discover", "data=file", f"data.path={path}", "data.z.name=null"]
    given += ["~data.variables", "trajectory.states=[x]", f"output={tmp_path}", "forecasts=0"]
    both = "+data.variables={x:{name:x,unit:1},V:{name:V,unit:1}}"
    found = computed(composed(*given, both, "inputs=[V]")).summary
    assert set(found["models"]["model"]["equations"]["x"]) == {"x", "V", "V^2"}
