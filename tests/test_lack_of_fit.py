"""What a model leaves over: noise of any kind, or its own error."""

from __future__ import annotations

import re
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

import ep2sindy as ep
from benchmarks.estimation import chemical
from benchmarks.known_systems import KINDS, noisy
from benchmarks.spoilt import spoilt
from ep2sindy.data.gaps import between_gaps
from ep2sindy.estimation import explanation
from ep2sindy.estimation.likelihood import TrajectoryFit
from ep2sindy.estimation.noise import ALIKE_SAMPLES, Noise, noise_beside
from ep2sindy.estimation.observation import LackOfFit
from ep2sindy.estimation.open_loop import try_open_loop
from ep2sindy.estimation.problem import scale_problem
from ep2sindy.estimation.solver import from_smooth
from ep2sindy.systems.systems import System


def noise_of(
    runs: list[ep.Trajectory], paths: list[np.ndarray], library: ep.Library | None = None
) -> Noise:
    """The noise next to given paths, in SI, of a model of no terms."""
    problem = scale_problem(runs, library or ep.polynomial(runs[0].state_names, degree=2))
    path, none = np.concatenate(paths) / problem.scale, np.zeros(problem.n_free)
    return noise_beside(TrajectoryFit(problem, np.ones(path.shape), 1.0, path, none, none > 0.0))


def at_rest(run: ep.Trajectory) -> np.ndarray:
    return np.tile(run.states.mean(axis=0), (run.n_samples, 1))


@pytest.mark.parametrize("n", [160, 1000])
def test_34_clean_cycles_are_not_the_noise_of_a_state_at_rest(n: int) -> None:
    run = chemical(0, noise=0.0, duration_s=34 * 7.157, n=n)
    noise = noise_of([run], [at_rest(run)])
    assert noise.patterned.all()
    assert not noise.memory.any()


def test_the_deviance_of_noise_with_a_memory_is_that_of_an_ar1_process() -> None:
    rng, n = np.random.default_rng(0), 400
    white, memory = rng.normal(size=(n, 2)), np.array([0.6, 0.0])
    noise = np.zeros((n, 2))
    for k in range(n):
        noise[k] = memory * noise[k - 1] + white[k]
    t = np.arange(float(n))
    moves = 5.0 * np.cos(np.stack([t, t + 1.0], axis=1))  # what rests has no noise that lasts
    run = ep.Trajectory(t, moves + noise, ["x", "y"])
    found = noise_of([run], [moves])
    assert found.memory == pytest.approx(memory, abs=0.1)
    variance = np.square(found.std)
    alike = variance + ALIKE_SAMPLES / n * variance.mean()
    assert found.deviance == pytest.approx(
        n * (np.log(alike) + np.log(1.0 - np.square(found.memory))).sum()
    )


def test_a_line_is_found_in_pieces_of_a_record_and_at_unequal_steps() -> None:
    run = chemical(0, noise=0.02, duration_s=34 * 7.157, n=1200)
    pieces = [run.window(k, k + 300) for k in range(0, 1200, 300)]
    kept = np.flatnonzero(np.random.default_rng(0).random(1200) > 0.5)
    uneven = ep.Trajectory(run.t[kept], run.states[kept], run.state_names)
    for runs in (pieces, [uneven]):
        assert noise_of(runs, [at_rest(each) for each in runs]).patterned.all()


@pytest.mark.parametrize("kind", KINDS)
def test_noise_of_any_kind_is_not_the_error_of_the_true_path(kind: str) -> None:
    for name, number in product(("lorenz", "lotka_volterra", "brusselator"), range(2)):
        system, run = noisy(name, 0.2, number, kind)
        _, clean = noisy(name, 0.0, number, kind)
        ends = [end for _, end in between_gaps(run.t)[:-1]]
        states = np.split(clean.states, ends)
        assert not noise_of([run], states, system.model.library).is_error.any()


@pytest.mark.parametrize("memory", [0.7, 0.95])
def test_noise_that_lasts_is_not_the_error_of_the_true_path(memory: float) -> None:
    for name, number in product(("lorenz", "lotka_volterra", "brusselator"), range(2)):
        system, clean = noisy(name, 0.0, number)
        noise = np.random.default_rng(number).standard_normal(clean.states.shape)
        for k in range(1, len(noise)):
            noise[k] = memory * noise[k - 1] + np.sqrt(1.0 - memory**2) * noise[k]
        states = clean.states + 0.2 * noise * clean.states.std(axis=0)
        run = ep.Trajectory(clean.t, states, clean.state_names)
        assert not noise_of([run], [clean.states], system.model.library).is_error.any()


def test_a_function_of_the_states_is_no_noise_that_lasts() -> None:
    system, clean = noisy("lotka_volterra", 0.0, 0)
    _, run = noisy("lotka_volterra", 0.02, 0)
    x, y = clean.states.T
    error = 0.03 * np.sin(3.0 * x) * np.cos(3.0 * y)
    off = ep.Trajectory(run.t, run.states + np.stack([error, 0.0 * error], axis=1), ["x", "y"])
    noise = noise_of([off], [clean.states], system.model.library)
    np.testing.assert_array_equal(noise.patterned, [True, False])


def lacking(duration_s: float) -> tuple[ep.Trajectory, System]:
    return chemical(0, noise=0.02, duration_s=duration_s), noisy("brusselator", 0.0, 0)[0]


@pytest.mark.parametrize("memory", [0.0, 0.8])
def test_what_lasts_about_a_rest_has_a_law(memory: float) -> None:
    """White samples about a rest are noise but for one record in 200; AR(1) ones have x' = -k x."""
    rng, called = np.random.default_rng(0), 0
    for _ in range(200):
        white = rng.standard_normal((60, 2))
        for k in range(1, len(white)):
            white[k] += memory * white[k - 1]
        run = ep.Trajectory(np.arange(60.0), white, ["x", "y"])
        called += int(noise_of([run], [at_rest(run)]).is_error.any())
    # Two states, two tests of each: four in 200 at most, and three standard errors.
    assert called <= 10 if memory == 0.0 else called >= 190


@pytest.mark.parametrize("memory", [0.0, 0.7])
def test_a_line_in_what_is_left_next_to_a_path_is_a_lack_of_fit(memory: float) -> None:
    """Next to noise of the same size, white or AR(1), in 200 records: Fisher's chance is 1e-5."""
    rng, n, called = np.random.default_rng(1), 300, np.zeros(2, dtype=np.int64)
    t = np.arange(float(n))
    path = 5.0 * np.cos(0.31 * t + np.array([[0.0], [1.0]])).T
    for _ in range(200):
        noise = rng.standard_normal((n, 2))
        for k in range(1, n):
            noise[k] = memory * noise[k - 1] + np.sqrt(1.0 - memory**2) * noise[k]
        noise[:, 1] += np.cos(1.7 * t + rng.uniform(0.0, 6.0))
        found = noise_of([ep.Trajectory(t, path + noise, ["x", "y"])], [path])
        called += found.is_error
    assert called[0] <= 1
    assert called[1] == 200


@pytest.mark.slow
@pytest.mark.parametrize("align", [False, True])
@pytest.mark.parametrize("duration_s", [30.0, 60.0])
def test_a_library_of_too_low_a_degree_is_no_late_sensor(duration_s: float, align: bool) -> None:
    run, system = lacking(duration_s)
    found = ep.estimate([run], ep.polynomial(["x", "y"], degree=2), align=align)
    assert found.lack_of_fit
    assert found.model.covariance is None
    assert not found.delays_s.any()
    right = ep.estimate([run], ep.polynomial(["x", "y"], degree=3), align=align)
    assert not right.lack_of_fit
    np.testing.assert_array_equal(right.model.coef != 0.0, system.model.coef != 0.0)


@pytest.mark.parametrize(("draw", "lacks"), [("brusselator", True), ("late", False)])
def test_a_delay_competes_with_products_of_one_degree_more(draw: str, lacks: bool) -> None:
    run = chemical(0) if lacks else spoilt("lotka_volterra", "lag 2", 0, 0.02)[1]
    problem, wider = (
        scale_problem([run], ep.polynomial(["x", "y"], degree=degree)) for degree in (2, 3)
    )
    problem = replace(problem, widen=lambda: wider)
    found = from_smooth(problem, None)
    late = explanation._align(found)
    if lacks:  # whatever delay its false equations may have
        late = found
    assert late is not None
    assert ("up to degree 3" in explanation._lacks_terms(late)) == lacks


def test_a_delay_at_three_standard_errors_is_none() -> None:
    """The likeliest of two delays, one sample at three standard errors, is what noise shows."""
    system, run = noisy("brusselator", 0.2, 12)
    found = ep.estimate([run], system.model.library)
    assert not found.lack_of_fit
    np.testing.assert_array_equal(found.model.coef != 0.0, system.model.coef != 0.0)


def test_what_explains_more_comes_first_then_the_simpler() -> None:
    """An exact trajectory explains all states or none; under process noise each by itself."""
    run = ep.lotka_volterra().trajectory(noise=0.05, rng=0).window(0, 300)
    right = from_smooth(scale_problem([run], ep.polynomial(run.state_names, degree=2)), None)
    fails = LackOfFit(np.array([2.0, np.nan]), 1.0, "{state} is off by {value:g}")
    half = LackOfFit(np.array([0.0, 2.0]), 1.0, "both are off")
    observed = replace(right.observation, process=np.ones(2))
    likelier = replace(right, deviance=right.deviance - 1e3)
    moved = replace(likelier, observation=observed)
    order = [
        right,
        moved,  # as well, by more
        replace(moved, tests=(half,)),
        replace(likelier, tests=(half,)),
    ]
    explained = [each.explained.tolist() for each in order]
    assert explained == [[True, True], [True, True], [True, False], [False, False]]
    ranks = [each.rank for each in order]
    assert ranks == sorted(ranks)
    assert replace(right, tests=(fails, half)).signs == [
        "x is off by 2", "y is off by nan", "both are off",
    ]  # fmt: skip


def on_a_circle(law: dict[str, dict[str, float]]) -> TrajectoryFit:
    """The fit on the path of a run of the oscillator x' = y, y' = -x, with another law."""
    t = 0.3 * np.arange(200.0)
    run = ep.Trajectory(t, np.stack([np.cos(t), -np.sin(t)], axis=1), ["x", "y"])
    problem = scale_problem([run], ep.polynomial(["x", "y"], degree=1))
    coef = [
        law[problem.states[k]].get(problem.term_names[j], 0.0)
        for k, j in zip(problem.equation, problem.column, strict=True)
    ]
    free = np.array(coef) / problem.to_SI
    path = problem.all_records.samples
    return TrajectoryFit(problem, np.full(path.shape, 0.01), 1e-4, path, free, free != 0.0, 4)


@pytest.mark.parametrize(
    ("law", "keeps"),
    [
        ({"x": {"y": 1.0}, "y": {"x": -1.0}}, True),
        ({"x": {"y": 1.0}, "y": {"x": -1.0, "y": 0.2}}, False),  # grows, by e^6
        ({"x": {"y": 1.0}, "y": {"x": -1.0, "y": -0.2}}, False),  # decays
        ({"x": {"y": 2.0}, "y": {"x": -2.0}}, False),  # turns twice as often
    ],
)
def test_a_model_that_the_samples_steer_is_run_by_itself(
    law: dict[str, dict[str, float]], keeps: bool
) -> None:
    fit, small = on_a_circle(law), np.full(2, 1e-5)
    test = try_open_loop(fit, np.full(2, 0.01), np.zeros(2), start=small)
    assert test.passes.all() == keeps
    assert test.passes.any() == keeps


def test_process_noise_may_keep_up_what_would_die_out() -> None:
    law = {"x": {"y": 1.0}, "y": {"x": -1.0, "y": -0.2}}
    fit, small = on_a_circle(law), np.full(2, 1e-5)
    # The variance of a damped oscillator under noise: q^2 / (2 * 0.1) per unit of time, about one.
    process_noise = np.full(2, np.sqrt(0.2 * 0.3))
    assert try_open_loop(fit, np.full(2, 0.01), process_noise, start=small).passes.all()


def test_a_delay_is_stated_with_its_error() -> None:
    run = spoilt("lotka_volterra", "lag 2", 0, 0.02)[1]
    found = ep.estimate([run], ep.polynomial(["x", "y"], degree=2))
    match = re.search(r"y lags by \S+ s \((\S+) ± (\S+) samples\)", found.lack_of_fit)
    assert match is not None
    assert abs(float(match[1]) - 2.0) < 2.0 * float(match[2])
