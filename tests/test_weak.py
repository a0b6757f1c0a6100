from dataclasses import replace

import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.signals.smoothers import NoSmoothing
from ep2sindy.systems.systems import System, damped_oscillator, van_der_pol

SYSTEMS = [damped_oscillator(), ep.lotka_volterra(), van_der_pol(), ep.lorenz()]
EVERY_ROW = ep.Weak(split=ep.regression.RandomSplit(test_fraction=0.0))
# The thesis's: no smoothing, no weights.
RAW_BOXES = ep.Weak(
    test_functions=ep.regression.Boxes(n_windows=300, n_points=20),
    smoother=NoSmoothing(),
    smooth_library=False,
    errors_in_variables=False,
)


def assembled(
    form: ep.Weak, runs: list[ep.Trajectory], library: ep.Library | None = None
) -> tuple[RegressionRows, ...]:
    library = ep.polynomial(list(runs[0].state_names), degree=2) if library is None else library
    return form.assemble(runs, library, rng=np.random.default_rng(0))


def found_in(run: ep.Trajectory, library: ep.Library, form: ep.Weak = EVERY_ROW) -> ep.Discovery:
    return ep.discover(
        [run],
        library,
        ep.Regression(form),
        seed=np.random.default_rng(1),
    )


def noisy(system: System, noise: float = 0.01) -> ep.Trajectory:
    return system.trajectory(noise=noise, rng=np.random.default_rng(0))


def dense(problem: RegressionRows) -> tuple[np.ndarray, np.ndarray]:
    """Weights of the training rows on the samples: of the terms, and of the state."""
    assert problem.noisy is not None
    mean, slope = problem.noisy.windows.mean, problem.noisy.windows.slope
    return mean.toarray(), slope.toarray()


@pytest.mark.parametrize("form", [ep.Weak(), EVERY_ROW], ids=["held out", "every row"])
@pytest.mark.parametrize("system", SYSTEMS, ids=lambda s: s.name)
def test_known_systems_come_back_from_samples_without_noise(system: System, form: ep.Weak) -> None:
    found = found_in(system.trajectory(), system.model.library, form)
    for state in system.model.states:
        truth = system.model.terms(state)
        # Integrated to 1e-10, and bumps end at 1e-10 of their height; nothing else is lost.
        assert found.model.terms(state) == pytest.approx(truth, rel=2e-9)


def test_every_state_has_a_regression_of_its_own() -> None:
    problems = assembled(EVERY_ROW, [noisy(ep.lotka_volterra())])
    assert [p.equations for p in problems] == [("x",), ("y",)]
    assert len(problems[0].theta) != len(problems[1].theta)  # x is faster than y


def test_rows_are_means_of_terms_and_slopes_over_windows() -> None:
    run = noisy(ep.lotka_volterra())
    run = replace(run, inputs=np.sin(run.t)[:, None], input_names=["u"])
    library = ep.polynomial(["u", "x", "y"], degree=2)  # in an order of its own
    form = replace(EVERY_ROW, smooth_library=False)
    for state, problem in enumerate(assembled(form, [run], library)):
        mean, slope = dense(problem)
        values = run.columns(library.variables)
        assert problem.theta == pytest.approx(mean @ library.evaluate(values))
        assert problem.target[:, 0] == pytest.approx(slope @ run.states[:, state])


@pytest.mark.parametrize("smooth_library", [True, False])
def test_windows_never_cross_trajectories(smooth_library: bool) -> None:
    first = noisy(ep.lotka_volterra())
    second = noisy(replace(ep.lotka_volterra(), rate_Hz=25.0, initial=np.array([0.3, 1.2])))
    second = second.window(0, 700)
    form = replace(EVERY_ROW, smooth_library=smooth_library)
    together = assembled(form, [first, second])
    apart = [assembled(form, [run]) for run in (first, second)]
    for both, a, b in zip(together, *apart, strict=True):
        assert both.theta == pytest.approx(np.concatenate([a.theta, b.theta]), rel=1e-12)
        assert both.target == pytest.approx(np.concatenate([a.target, b.target]), rel=1e-12)
        assert np.array_equal(both.groups[: len(a.groups)], a.groups)
        assert np.array_equal(both.groups[len(a.groups) :], b.groups + a.groups.max() + 1)
        for joined, left, right in zip(dense(both), dense(a), dense(b), strict=True):
            assert np.array_equal(joined[: len(left), : left.shape[1]], left)
            assert np.array_equal(joined[len(left) :, left.shape[1] :], right)
            assert not joined[: len(left), left.shape[1] :].any()
            assert not joined[len(left) :, : left.shape[1]].any()
        for name in ("values", "smoothed", "noise_std"):
            parts = [getattr(p.noisy, name) for p in (a, b)]
            assert np.array_equal(getattr(both.noisy, name), np.concatenate(parts))


@pytest.mark.parametrize(
    "split", [ep.regression.RandomSplit(0.25), ep.regression.BlockSplit(0.3, n_blocks=5)]
)
@pytest.mark.parametrize(
    "form", [replace(ep.Weak(), smooth_library=False), RAW_BOXES], ids=["bumps", "boxes"]
)
def test_no_training_row_shares_a_sample_with_a_held_out_row(
    form: ep.Weak, split: ep.regression.RandomSplit | ep.regression.BlockSplit
) -> None:
    run = noisy(ep.lotka_volterra())
    rng = np.random.default_rng(0)
    windows = [form.test_functions.windows(run.t, x, rng=rng) for x in run.states.T]
    for state, problem in enumerate(assembled(replace(form, split=split), [run])):
        touched = np.zeros((2, run.n_samples), dtype=bool)
        every_target = windows[state].slope @ run.states[:, state]
        for target, test in zip(problem.target[:, 0], problem.test, strict=True):
            k = int(np.argmin(np.abs(every_target - target)))
            assert every_target[k] == pytest.approx(target, rel=1e-12)
            touched[int(test), windows[state].first[k] : windows[state].last[k] + 1] = True
        assert touched.any(axis=1).all()
        assert not touched.all(axis=0).any()
        # Nor do they share a group, and time runs along the groups.
        assert not set(problem.groups[problem.test]) & set(problem.groups[~problem.test])
        assert np.all(np.diff(problem.groups) >= 0)


def test_noise_is_followed_into_the_training_rows_alone() -> None:
    run = noisy(ep.lotka_volterra())
    problem = assembled(replace(ep.Weak(), smooth_library=False), [run])[0]
    assert problem.test.any()
    mean, slope = dense(problem)
    train = ~problem.test
    assert problem.theta[train] == pytest.approx(mean @ problem.library.evaluate(run.states))
    assert problem.target[train, 0] == pytest.approx(slope @ run.states[:, 0])


def test_a_record_of_a_few_windows_holds_nothing_out() -> None:
    run = noisy(ep.lotka_volterra()).window(0, 60)
    for problem in assembled(
        replace(ep.Weak(), test_functions=ep.regression.Bumps(half_width_s=1.0)), [run]
    ):
        assert not problem.test.any()


def test_raw_and_smoothed_libraries_differ_only_in_theta() -> None:
    run = noisy(ep.lotka_volterra(), 0.05)
    raw_form = replace(EVERY_ROW, smooth_library=False)
    for smooth, raw in zip(assembled(EVERY_ROW, [run]), assembled(raw_form, [run]), strict=True):
        assert np.array_equal(raw.target, smooth.target)
        assert np.abs(raw.theta - smooth.theta).max() > 1e-3
        assert raw.noisy is not None
        assert smooth.noisy is not None
        assert np.array_equal(raw.noisy.smoothed, smooth.noisy.smoothed)
        assert np.array_equal(raw.noisy.values, run.states)


def test_without_errors_in_variables_no_noise_is_estimated() -> None:
    for problem in assembled(replace(ep.Weak(), errors_in_variables=False), [noisy(van_der_pol())]):
        assert problem.noisy is None


def test_rescaling_units_rescales_coefficients_and_nothing_else() -> None:
    run = noisy(ep.lotka_volterra())
    scale, tempo = np.array([1e18, 3e-14]), 1e-5
    rescaled = ep.Trajectory(t=run.t * tempo, states=run.states * scale, state_names=["x", "y"])
    library = ep.polynomial(["x", "y"], degree=2)
    plain, other = (found_in(r, library) for r in (run, rescaled))
    unit = (scale**library.exponents).prod(axis=1)[:, None]
    # The smoother's ratio is found to 0.01 of a decade, and rounding may stop it elsewhere.
    assert other.model.coef * unit * tempo / scale == pytest.approx(plain.model.coef, rel=1e-6)
    for state, front in plain.fronts.items():
        assert len(plain.model.terms(state)) == 2
        terms = [c.terms for c in front.candidates]
        assert [c.terms for c in other.fronts[state].candidates] == terms
        assert other.scores[state] == pytest.approx(plain.scores[state], abs=1e-3)


def test_an_input_that_never_changes_is_no_obstacle() -> None:
    """x' = -x + 2 u with u = 1.5."""
    t = np.linspace(0.0, 8.0, 801)[:, None]
    run = ep.Trajectory(t[:, 0], 3.0 - 3.0 * np.exp(-t), ["x"], np.full_like(t, 1.5), ["u"])
    found = found_in(run, ep.polynomial(["x", "u"], degree=1))
    assert found.model.terms("x") == pytest.approx({"1": 3.0, "x": -1.0}, rel=1e-7)
    messages = [a.message for a in found.ambiguities]
    assert "'u' is a multiple of '1' on every row and is left out" in messages


def test_overlapping_boxes_have_no_errors_in_variables() -> None:
    with pytest.raises(ValueError, match="needs smooth test functions, got Boxes; use Bumps, or"):
        ep.Weak(test_functions=ep.regression.Boxes())
