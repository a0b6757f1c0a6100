import numpy as np
import pytest
from scipy.linalg import cho_factor, cho_solve, null_space

from ep2sindy.signals import smoothers
from ep2sindy.signals.smoothers import KalmanSmoother, Smoother, WienerProcess, most_likely_ratios
from ep2sindy.systems.systems import System, damped_oscillator, lorenz, lotka_volterra, van_der_pol

SYSTEMS = [damped_oscillator(), lotka_volterra(), van_der_pol(), lorenz()]
UNEQUAL = np.array([0.0, 0.7, 1.9, 2.4, 3.9, 4.6, 5.1, 7.0, 7.9, 8.3, 9.8, 11.0])
CROWDED = np.array([0.0, 0.01, 0.02, 0.05, 0.2, 0.8, 3.0, 5.0, 7.0, 9.0, 11.0, 11.01])
TIMES = {"equal": np.arange(12.0), "unequal": UNEQUAL, "crowded": CROWDED}
RATIOS = [-6.0, -2.0, 0.0, 4.0]
NOISE = np.random.default_rng(0).standard_normal((12, 2))

every_time = pytest.mark.parametrize("t", TIMES.values(), ids=TIMES.keys())
few_too = pytest.mark.parametrize("t", [*TIMES.values(), UNEQUAL[:5], UNEQUAL[:6]])
every_ratio = pytest.mark.parametrize("log10_ratio", RATIOS)


def covariance(a: np.ndarray, b: np.ndarray, power: int) -> np.ndarray:
    """Of the process (power 2) or its slope (power 1) at a with the process at b, zero at t = 0.

    Its third derivative is white: the integrand is of degree four at most, three nodes do.
    """
    nodes, weights = np.polynomial.legendre.leggauss(3)
    half = 0.5 * np.minimum.outer(a, b)[..., None]
    u = half * (nodes + 1.0)
    left = (a[:, None, None] - u) ** power / power
    return (half * weights * left * (b[None, :, None] - u) ** 2 / 2.0).sum(axis=-1)


def universal_kriging(
    t: np.ndarray, values: np.ndarray, ratio: float
) -> tuple[np.ndarray, np.ndarray]:
    """Signal and slope by dense algebra, with a parabola of unknown coefficients."""
    parabola = t[:, None] ** np.arange(3)
    parabola_slope = np.stack([np.zeros_like(t), np.ones_like(t), 2.0 * t], axis=1)
    total = cho_factor(np.eye(len(t)) + ratio * covariance(t, t, 2))
    weighted = cho_solve(total, parabola)
    coef = np.linalg.solve(parabola.T @ weighted, weighted.T @ values)
    rest = ratio * cho_solve(total, values - parabola @ coef)
    signal = parabola @ coef + covariance(t, t, 2) @ rest
    return signal, parabola_slope @ coef + covariance(t, t, 1) @ rest


def restricted_likelihood(
    t: np.ndarray, values: np.ndarray, ratio: float
) -> tuple[np.ndarray, np.ndarray]:
    """Of all that is left of the values once any parabola is taken out, by dense algebra."""
    contrast = null_space((t[:, None] ** np.arange(3)).T).T
    total = contrast @ (np.eye(len(t)) + ratio * covariance(t, t, 2)) @ contrast.T
    left, n_free = contrast @ values, len(t) - 3
    noise = (left * np.linalg.solve(total, left)).sum(axis=0) / n_free
    return -0.5 * (n_free * np.log(noise) + np.linalg.slogdet(total)[1]), noise


@few_too
@every_ratio
def test_smoother_is_the_process_conditioned_on_the_samples(
    t: np.ndarray, log10_ratio: float
) -> None:
    process, noise = WienerProcess.at(np.diff(t)), NOISE[: len(t)]
    signal = process.signal(noise, 10.0**log10_ratio)
    exact_signal, exact_slope = universal_kriging(t, noise, 10.0**log10_ratio)
    # Dense algebra loses the digits here: its condition number reaches ratio * 11^5.
    assert np.allclose(signal, exact_signal, atol=1e-8)
    assert np.allclose(process.slope(signal), exact_slope, atol=1e-8 * np.abs(exact_slope).max())


@few_too
@every_ratio
def test_likelihood_is_that_of_the_joint_normal(t: np.ndarray, log10_ratio: float) -> None:
    process, noise = WienerProcess.at(np.diff(t)), NOISE[: len(t)]
    found, found_noise = process.likelihood(noise, 10.0**log10_ratio)
    exact, exact_noise = restricted_likelihood(t, noise, 10.0**log10_ratio)
    # Contrasts of another length add a constant: compare with the likelihood of ratio 1.
    found -= process.likelihood(noise, 1.0)[0]
    exact -= restricted_likelihood(t, noise, 1.0)[0]
    assert found == pytest.approx(exact, abs=1e-8)
    assert found_noise == pytest.approx(exact_noise, rel=1e-8)


@pytest.mark.parametrize("jitter", [0.0, 0.3])
def test_both_factorisations_give_one_likelihood(
    monkeypatch: pytest.MonkeyPatch, jitter: float
) -> None:
    rng = np.random.default_rng(0)
    steps = 1.0 + jitter * rng.uniform(-1.0, 1.0, 2999)
    process, values = WienerProcess.at(steps), np.cumsum(rng.normal(size=(3000, 2)), axis=0)
    ratios = 10.0 ** np.arange(-10.0, 5.0, 2.0)
    plain = [process.likelihood(values, ratio) for ratio in ratios]
    monkeypatch.setattr(smoothers, "WELL_CONDITIONED", np.inf)
    joint = [process.likelihood(values, ratio) for ratio in ratios]
    np.testing.assert_allclose(plain, joint, rtol=1e-6, atol=0.01)  # as WELL_CONDITIONED says


@every_time
@every_ratio
def test_smoother_is_a_symmetric_matrix(t: np.ndarray, log10_ratio: float) -> None:
    process = WienerProcess.at(np.diff(t))
    matrix = process.signal(np.eye(12), 10.0**log10_ratio)
    assert np.allclose(matrix, matrix.T, atol=1e-10)
    assert np.allclose(process.signal(NOISE, 10.0**log10_ratio), matrix @ NOISE)
    eigenvalues = np.linalg.eigvalsh(matrix)
    assert eigenvalues.min() >= -1e-10
    assert eigenvalues.max() <= 1.0 + 1e-10


@every_time
@pytest.mark.parametrize("log10_ratio", [None, *RATIOS])
def test_a_parabola_passes_unchanged(t: np.ndarray, log10_ratio: float | None) -> None:
    values = (3.0 - 2.0 * t + 0.5 * t**2)[:, None]
    estimate = KalmanSmoother(log10_ratio=log10_ratio).estimate(t, values)
    assert np.allclose(estimate.smoothed, values, atol=1e-9)
    assert np.allclose(estimate.derivative[:, 0], t - 2.0, atol=1e-9)
    assert estimate.noise_std[0] < 1e-10


@pytest.mark.parametrize("log10_ratio", [None, -2.0])
def test_a_constant_comes_back_without_noise(log10_ratio: float | None) -> None:
    values = np.stack([np.full(12, 0.1), NOISE[:, 0]], axis=1)
    estimate = KalmanSmoother(log10_ratio=log10_ratio).estimate(UNEQUAL, values)
    assert np.array_equal(estimate.smoothed[:, 0], values[:, 0])
    assert np.array_equal(estimate.derivative[:, 0], np.zeros(12))
    assert estimate.noise_std[0] == 0.0
    assert estimate.log10_ratio[0] == (-14.0 if log10_ratio is None else log10_ratio)
    assert estimate.noise_std[1] > 0.0


def test_units_of_time_and_values_change_units_alone() -> None:
    run = van_der_pol().trajectory(noise=0.05, rng=np.random.default_rng(1))
    t, values = run.t[:200], run.states[:200]
    plain = KalmanSmoother().estimate(t, values)
    scaled = KalmanSmoother().estimate(3.0 + 1e-6 * t, 2.0 + 1e5 * values)
    # 3 s of offset leave the microsecond steps 3e-16 / 2e-8 of their size.
    assert scaled.smoothed == pytest.approx(2.0 + 1e5 * plain.smoothed, rel=1e-6)
    assert scaled.derivative == pytest.approx(1e11 * plain.derivative, rel=1e-5)
    assert scaled.noise_std == pytest.approx(1e5 * plain.noise_std, rel=1e-6)
    assert scaled.log10_ratio == pytest.approx(plain.log10_ratio, abs=1e-6)


@pytest.mark.parametrize("log10_ratio", [None, -2.0])
def test_time_has_no_preferred_direction(log10_ratio: float | None) -> None:
    smoother = KalmanSmoother(log10_ratio=log10_ratio)
    forward = smoother.estimate(UNEQUAL, NOISE)
    backward = smoother.estimate(-UNEQUAL[::-1], NOISE[::-1])
    assert backward.smoothed[::-1] == pytest.approx(forward.smoothed, abs=1e-9)
    assert backward.derivative[::-1] == pytest.approx(-forward.derivative, abs=1e-9)
    assert backward.noise_std == pytest.approx(forward.noise_std, rel=1e-9)


def test_columns_do_not_touch_each_other() -> None:
    both = KalmanSmoother().estimate(UNEQUAL, NOISE)
    for j in range(2):
        alone = KalmanSmoother().estimate(UNEQUAL, NOISE[:, j : j + 1])
        assert np.array_equal(alone.smoothed[:, 0], both.smoothed[:, j])
    assert KalmanSmoother().smooth(UNEQUAL, NOISE[:, :0]).shape == (12, 0)


def test_smoother_protocol_returns_the_parts_of_the_estimate() -> None:
    smoother = KalmanSmoother()
    estimate = smoother.estimate(UNEQUAL, NOISE)
    assert isinstance(smoother, Smoother)
    assert np.array_equal(smoother.smooth(UNEQUAL, NOISE), estimate.smoothed)
    assert np.array_equal(smoother.derivative(UNEQUAL, NOISE), estimate.derivative)
    assert not estimate.smoothed.flags.writeable


def test_the_ratio_found_is_the_most_likely() -> None:
    run = lorenz().trajectory(noise=0.05, rng=np.random.default_rng(2))
    process, values = WienerProcess.at(np.ones(499)), run.states[:500, :1]
    (found,) = most_likely_ratios(process, values)
    fine = np.arange(-14.0, 4.0, 0.02)
    best = fine[np.argmax([process.likelihood(values, 10.0**r)[0][0] for r in fine])]
    assert found == pytest.approx(best, abs=0.02)


def test_the_bounds_can_be_found() -> None:
    t = np.arange(400.0)
    without_noise = np.sin(t / 3.0)
    without_signal = np.random.default_rng(0).standard_normal(400)
    estimate = KalmanSmoother().estimate(t, np.stack([without_noise, without_signal], axis=1))
    assert estimate.log10_ratio[0] == 4.0
    assert np.allclose(estimate.smoothed[:, 0], without_noise, atol=1e-3)
    assert estimate.log10_ratio[1] < -12.0


@pytest.mark.parametrize("noise", [0.05, 0.2])
@pytest.mark.parametrize("system", SYSTEMS, ids=lambda s: s.name)
def test_noise_is_recovered_and_reduced(system: System, noise: float) -> None:
    run = system.trajectory()
    rms = np.sqrt(np.square(run.states).mean(axis=0))
    drawn = noise * rms * np.random.default_rng(0).standard_normal(run.states.shape)
    estimate = KalmanSmoother().estimate(run.t, run.states + drawn)
    # Up to 120 of 1000 degrees of freedom go to the signal: 1/sqrt(2 * 1000) * sqrt(0.12) apart.
    assert estimate.noise_std == pytest.approx(drawn.std(axis=0), rel=4 * 0.008)
    error = estimate.smoothed - run.states
    assert np.all(error.std(axis=0) < 0.4 * drawn.std(axis=0))


def test_noise_and_ratio_are_those_of_a_draw_from_the_model() -> None:
    rng = np.random.default_rng(3)
    t = np.cumsum(rng.uniform(0.5, 1.5, 2000))
    steps = np.diff(t)
    state, signal = np.zeros(3), np.zeros(2000)
    for k, h in enumerate(steps, start=1):
        moved = np.array([[1.0, h, h * h / 2], [0.0, 1.0, h], [0.0, 0.0, 1.0]])
        cov = np.array(
            [
                [h**5 / 20, h**4 / 8, h**3 / 6],
                [h**4 / 8, h**3 / 3, h**2 / 2],
                [h**3 / 6, h**2 / 2, h],
            ]
        )
        state = moved @ state + rng.multivariate_normal(np.zeros(3), cov)
        signal[k] = state[0]
    estimate = KalmanSmoother().estimate(t, (signal + rng.standard_normal(2000))[:, None])
    assert estimate.noise_std[0] == pytest.approx(1.0, abs=4 / np.sqrt(2 * 2000))
    assert estimate.log10_ratio[0] == pytest.approx(0.0, abs=0.3)


def test_crowded_samples_cost_few_digits() -> None:
    t = np.concatenate([[0.0, 1e-3, 2e-3], 2e-3 + np.arange(1.0, 20.0)])
    values = (1.0 + t - 0.3 * t**2)[:, None]
    matrix = WienerProcess.at(np.diff(t) / np.diff(t).mean()).signal(np.eye(22), 1e-8)
    assert np.allclose(matrix, matrix.T, atol=1e-9)
    assert np.allclose(matrix @ values, values, atol=1e-8)


@pytest.mark.parametrize("log10_ratio", [-8.0, -2.0, 4.0])
def test_samples_that_nearly_coincide_are_two_samples_of_one_time(log10_ratio: float) -> None:
    t = np.arange(200.0)
    values = np.sin(t / 5.0) + 0.1 * np.random.default_rng(0).standard_normal(200)
    smoother, other = KalmanSmoother(log10_ratio=log10_ratio), values[[50]] + 0.1
    near, far = (
        smoother.estimate(np.insert(t, 51, 50.0 + gap), np.insert(values, 51, other)[:, None])
        for gap in (1e-12, 1e-5)
    )
    assert near.smoothed == pytest.approx(far.smoothed, abs=1e-4)
    assert near.noise_std == pytest.approx(far.noise_std, rel=1e-4)


def test_ratios_out_of_range_and_few_samples_are_refused() -> None:
    with pytest.raises(ValueError, match="must lie in"):
        KalmanSmoother(log10_ratio=-14.1).estimate(UNEQUAL, NOISE)
    with pytest.raises(ValueError, match="at least 5 samples"):
        KalmanSmoother().estimate(UNEQUAL[:4], NOISE[:4])
