import numpy as np
import pytest

import ep2sindy as ep
from ep2sindy.regression import bootstraps
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.rows import RegressionRows


def test_bootstraps_draw_neighbours_together() -> None:
    system = ep.lorenz()
    (problem,) = ep.Differential().assemble(
        [system.trajectory()], system.model.library, rng=np.random.default_rng(0)
    )
    terms = np.ones(len(system.model.library), dtype=np.bool_)
    # A block of all training rows, drawn whole: every draw is the training set itself.
    n_train = len(problem.train_columns.T)
    whole = Bootstraps(n=2, n_culled=0, smallest=1.0, largest=1.0, block=n_train)
    sums, _ = whole.draw(problem, terms, np.random.default_rng(0))
    once = problem.train_products
    np.testing.assert_allclose(sums, np.array([once, once]), rtol=1e-12, atol=1e-14)


def test_weights_of_a_long_record_are_held_for_some_draws_at_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    system = ep.lorenz()
    (problem,) = ep.Differential().assemble(
        [system.trajectory().window(0, 400)], system.model.library, rng=np.random.default_rng(0)
    )
    terms, held = np.ones(len(system.model.library), dtype=np.bool_), []
    together = Bootstraps(n=7).draw(problem, terms, np.random.default_rng(0))
    resampled_products = RegressionRows.resampled_products

    def tell(problem: RegressionRows, weights: np.ndarray) -> np.ndarray:
        held.append(weights.size)
        return resampled_products(problem, weights)

    monkeypatch.setattr(RegressionRows, "resampled_products", tell)
    monkeypatch.setattr(bootstraps, "MOST_WEIGHTS", 2 * problem.n_train)
    in_parts = Bootstraps(n=7).draw(problem, terms, np.random.default_rng(0))
    assert max(held) <= 2 * problem.n_train
    np.testing.assert_allclose(in_parts[0], together[0], rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(in_parts[1], together[1])


def test_blocks_never_cross_trajectories() -> None:
    system = ep.lorenz()
    run = system.trajectory()
    (problem,) = ep.Differential().assemble(
        [run, run], system.model.library, rng=np.random.default_rng(0)
    )
    terms = np.ones(len(system.model.library), dtype=np.bool_)
    with pytest.raises(
        ValueError, match="cross from one trajectory to the next, got 2 trajectories"
    ):
        Bootstraps(block=2).draw(problem, terms, np.random.default_rng(0))
