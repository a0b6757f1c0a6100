import numpy as np
import pytest

import ep2sindy as ep


@pytest.mark.parametrize(
    ("system", "n_samples", "n_terms"),
    [
        (ep.systems.damped_oscillator(), 3000, 3),
        (ep.lotka_volterra(), 1000, 4),
        (ep.systems.van_der_pol(), 1000, 4),
        (ep.lorenz(), 3000, 7),
    ],
    ids=lambda v: getattr(v, "name", None),
)
def test_systems_are_sampled_as_in_the_thesis(
    system: ep.systems.System, n_samples: int, n_terms: int
) -> None:
    assert system.trajectory().n_samples == n_samples
    assert np.count_nonzero(system.model.coef) == n_terms


def test_damped_oscillator_matches_its_solution() -> None:
    run = ep.systems.damped_oscillator().trajectory()
    damped = 3.0 * np.sqrt(1 - 0.1**2)
    exact = np.exp(-0.3 * run.t) * (np.cos(damped * run.t) + 0.3 / damped * np.sin(damped * run.t))
    assert run.states[:, 0] == pytest.approx(exact, abs=1e-8)


def test_noise_is_a_share_of_the_rms() -> None:
    system = ep.lorenz()
    clean = system.trajectory().states
    noisy = system.trajectory(noise=0.05, rng=np.random.default_rng(0)).states
    rms = np.sqrt(np.square(clean).mean(axis=0))
    # 3000 samples: the spread of a standard deviation is 1/sqrt(2 n) = 1.3 %.
    assert (noisy - clean).std(axis=0) / rms == pytest.approx(0.05, rel=4 * 0.013)
