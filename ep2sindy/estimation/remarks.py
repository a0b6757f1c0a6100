"""Remarks: sentences on where the samples deviate from what the estimation assumes of them."""

from __future__ import annotations

import numpy as np

from ep2sindy.estimation.noise import FLOOR, Noise
from ep2sindy.estimation.problem import EstimationProblem
from ep2sindy.runtime.screen import joined

HEAVY, STANDARD_ERRORS = 4.0, 5.0  # least kurtosis reported; least excess over 3
COLLINEAR = 5.0  # standard errors by which a variance may exceed that of noise
PART = 0.05  # share of the largest part: states with less are left out of a relation


def remark(problem: EstimationProblem, noise: Noise) -> tuple[str, ...]:
    """Remarks on sensor limits, on noise that is not white and normal, and on collinear states."""
    limits = [w for r in problem.records if r.limits is not None for w in r.limits.words]
    return (
        *(f"{words}: read as limits, not as values" for words in dict.fromkeys(limits)),
        *(
            f"{state} was measured at {count} of {problem.n_samples} samples"
            for state, count in zip(problem.states, problem.n_measured.tolist(), strict=True)
            if 0 < count < problem.n_samples
        ),
        *_of_noise(problem, noise),
        *_of_collinear_states(problem, noise),
    )


def _of_noise(problem: EstimationProblem, noise: Noise) -> list[str]:
    words = []
    error = np.sqrt(24.0 / problem.n_samples)
    for k, state in enumerate(problem.states):
        if noise.std[k] <= FLOOR or noise.is_error[k] or not problem.measured[k]:
            continue  # rounding, integration or model error, not noise
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


def _of_collinear_states(problem: EstimationProblem, noise: Noise) -> list[str]:
    """Remark on measured states of which a linear combination varies no more than their noise."""
    own, n = np.flatnonzero(problem.measured), problem.n_samples
    if len(own) < 2 or noise.is_error.any():
        return []  # the residuals then hold model error, perhaps as large as the states
    samples = np.concatenate([record.samples for record in problem.records])[:, own]
    std, scale = noise.std[own], problem.scale[own]
    variance, directions = np.linalg.eigh(np.cov(samples / std, rowvar=False))
    if variance[0] > 1.0 + COLLINEAR * np.sqrt(2.0 / n):
        return []
    # Weights in SI, and each state's part in the sum by its spread.
    weights = directions[:, 0] / std / scale
    parts = np.abs(weights) * samples.std(axis=0) * scale
    held = [k for k in range(len(own)) if parts[k] > PART * parts.max()]
    if len(held) < 2:
        return []
    states = {k: problem.states[own[k]] for k in held}
    total = " ".join(f"{weights[k] / weights[held[0]]:+.3g} {name}" for k, name in states.items())
    return [
        f"{joined(list(states.values()))} hang together: {total.removeprefix('+')} varies no "
        "more than their noise, so terms in one may stand for terms in the others"
    ]
