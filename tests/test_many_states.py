"""Refinement of four states and more, and of many models, each with its own constraint."""

import numpy as np
import pytest

import ep2sindy as ep
from benchmarks.many_states import cases, record, starts

PREY = ep.lotka_volterra()


@pytest.mark.parametrize("number", [0, 2, 4])
def test_true_terms_that_are_off_come_back(number: int) -> None:
    case = cases()[number]
    run = record(case)
    truth = case.truth
    for found in ep.refine(
        starts(case, run)[:3], [[run]] * 3, ep.refinement.RefinementSettings(n_windows=10), seed=0
    ):
        assert found.status == "converged"
        assert not found.message
        covariance = found.model.covariance
        assert covariance is not None
        used = truth.coef.T != 0.0
        off = found.model.coef.T[used] - truth.coef.T[used]
        assert (np.abs(off) < 5.0 * np.sqrt(np.diag(covariance))).all()


@pytest.fixture(scope="module")
def lacking() -> tuple[list[ep.SparseModel], ep.Trajectory]:
    """Starts of models that miss hidden states, and the record."""
    case = cases()[7]
    run = record(case)
    return starts(case, run), run


def test_models_that_miss_hidden_states_follow_what_they_can(lacking) -> None:
    """Most of these ended without a finite trajectory before steps were damped."""
    models, run = lacking
    settings = ep.refinement.RefinementSettings(n_windows=5, n_reweights=0)
    for found in ep.refine(models[:3], [[run]] * 3, settings, seed=0):
        assert found.status not in ("non_finite", "flat")


def test_every_model_of_a_list_keeps_its_own_constraint() -> None:
    run, truth = PREY.trajectory(), PREY.model
    model = ep.SparseModel(truth.library, truth.states, 1.1 * truth.coef)
    support = {state: tuple(model.terms(state)) for state in model.states}
    (term, *_), row = support["x"], model.library.index(support["x"][0])
    known = [
        ep.library.constraint(model.library, support, [f"x: {term} == {v}"]) for v in (0.7, 0.6)
    ]
    settings = ep.refinement.RefinementSettings(window=60, n_windows=6)
    together = ep.refine([model] * 3, [[run]] * 3, settings, constraints=[*known, None], seed=0)
    held = [found.model.coef[row, 0] for found in together[:2]]
    np.testing.assert_allclose(held, [0.7, 0.6], rtol=1e-12)
    np.testing.assert_allclose(together[2].model.coef, truth.coef, rtol=1e-5, atol=1e-12)
    alone = ep.refine([model], [[run]], settings, constraint=known[0], seed=0)[0]
    np.testing.assert_allclose(together[0].model.coef, alone.model.coef, rtol=1e-8)
    with pytest.raises(ValueError, match=r"one entry per model.* 2 for 3 models$"):
        ep.refine([model] * 3, [[run]] * 3, constraints=known, seed=0)
