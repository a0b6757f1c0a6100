"""Inputs that are known exactly: what was set, beside what was measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.trajectory import Trajectory

# Less noise than this share of an input's own deviation is lost beside that of any state.
NEGLIGIBLE = 1e-3

# Noise above half a step of its digits lets a record repeat its last value less often than this.
HELD = 0.5

MOST_LEVELS = 8  # that a switch has; a record of noise has more, however coarse its digits


def exact_columns(
    run: Trajectory,
    names: Sequence[str],
    declared: Sequence[str] | None,
    noise_std: Float[np.ndarray, " variables"] | None,
) -> Bool[np.ndarray, " variables"]:
    """Which of some variables are exact: never a state, and of the inputs those declared.

    None declared: inputs that are switched, held or constant, or of negligible noise as far as
    that was estimated.
    Raises ValueError for a declared name that is no input.
    """
    unknown = [name for name in declared or () if name not in run.input_names]
    if unknown:
        raise ValueError(
            f"exact_inputs must name inputs: {unknown} came; this trajectory has the inputs "
            f"{list(run.input_names)}"
        )
    if declared is not None:
        return np.isin(names, list(declared))
    exact = np.zeros(len(names), dtype=np.bool_)
    for k, (name, column) in enumerate(zip(names, run.columns(names).T, strict=True)):
        if name in run.input_names:
            noise = np.inf if noise_std is None else noise_std[k]
            exact[k] = is_switched(column) or bool(noise <= NEGLIGIBLE * column.std())
    return exact


def is_switched(samples: Float[np.ndarray, " samples"]) -> bool:
    """Whether a signal holds its value over most steps, or jumps between a few levels."""
    held = np.mean(np.diff(samples) == 0.0)
    return bool(held >= HELD) or len(np.unique(samples)) <= MOST_LEVELS
