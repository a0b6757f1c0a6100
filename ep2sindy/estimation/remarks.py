"""What a reader must know of samples and of their noise, beside a fit, in sentences."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ep2sindy.estimation.joint import Aligned
from ep2sindy.estimation.noise import FLOOR, Noise
from ep2sindy.estimation.problem import Problem

HEAVY, STANDARD_ERRORS = 4.0, 5.0  # a kurtosis that is told; by which it must be above 3
COLLINEAR = 5.0  # standard errors of a variance that is no more than noise
PART = 0.05  # of the largest share: states with less have no part in a relation


def remarks(problem: Problem, noise: Noise) -> tuple[str, ...]:
    """What sensors did, how the noise differs from white and normal, which states hang together."""
    limits = [w for r in problem.records if r.limits is not None for w in r.limits.words]
    return (
        *(f"{words}: read as limits, not as values" for words in dict.fromkeys(limits)),
        *_of_noise(problem, noise),
        *_of_collinear_states(problem, noise),
    )


def delay_words(problem: Problem, delays: Float[np.ndarray, " d"]) -> str:
    """`z comes 0.00333 s late (0.99 samples)`, of every state that does."""
    parts = [
        f"{state} comes {abs(delay) * problem.step_s:.3g} s {'late' if delay > 0.0 else 'early'} "
        f"({abs(delay):.2f} samples)"
        for state, delay in zip(problem.states, delays, strict=True)
        if delay
    ]
    return " and ".join(parts)


def late_words(problem: Problem, late: Aligned) -> str:
    """Why samples with a late channel are a misfit, and the way out."""
    return (
        f"{delay_words(problem, late.delays)}: brought together, the samples are better explained "
        "by other equations; ask for those by ep.Recipe(search=ep.Joint(align=True)), in configs "
        "search.align=true. These are of the samples as they are"
    )


def _of_noise(problem: Problem, noise: Noise) -> list[str]:
    words = []
    error = np.sqrt(24.0 / problem.n_samples)
    for k, state in enumerate(problem.states):
        if noise.std[k] <= FLOOR or noise.unexplained[k]:
            continue  # rounding and integration, or the model's error, and no noise of samples
        if noise.memory[k]:
            words.append(f"noise of {state} lasts: {noise.memory[k]:.2f} from sample to sample")
        if noise.kurtosis[k] > max(HEAVY, 3.0 + STANDARD_ERRORS * error):
            words.append(
                f"noise of {state} has {noise.outliers[k]} outliers beyond five standard "
                f"deviations, kurtosis {noise.kurtosis[k]:.3g} (normal: 3)"
            )
        elif noise.growth[k]:
            words.append(f"noise of {state} grows with {state}")
    return words


def _of_collinear_states(problem: Problem, noise: Noise) -> list[str]:
    """States of which a sum varies no more than their noise."""
    d, n = len(problem.states), problem.n_samples
    if d < 2 or noise.unexplained.any():
        return []  # what is left is then the model's error, which may be as large as the states
    samples = np.concatenate([record.samples for record in problem.records])
    variance, directions = np.linalg.eigh(np.cov(samples / noise.std, rowvar=False))
    if variance[0] > 1.0 + COLLINEAR * np.sqrt(2.0 / n):
        return []
    # In SI, and beside the spread of every state.
    weights = directions[:, 0] / noise.std / problem.scale
    parts = np.abs(weights) * samples.std(axis=0) * problem.scale
    held = [k for k in range(d) if parts[k] > PART * parts.max()]
    if len(held) < 2:
        return []
    names = _listed([problem.states[k] for k in held])
    total = " ".join(f"{weights[k] / weights[held[0]]:+.3g} {problem.states[k]}" for k in held)
    return [
        f"{names} hang together: {total.removeprefix('+')} varies no more than their noise, so "
        "terms in one may stand for terms in the others"
    ]


def _listed(names: Sequence[str]) -> str:
    return f"{', '.join(names[:-1])} and {names[-1]}"
