"""Splits that choose the held-out groups of rows."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool

from ep2sindy.runtime.values import set_counts


@runtime_checkable
class Split(Protocol):
    """Interface that chooses the held-out groups of one trajectory; groups are in time order."""

    def held_out(self, n_groups: int, rng: np.random.Generator) -> Bool[np.ndarray, " groups"]: ...


@dataclass(frozen=True)
class RandomSplit:
    """Hold out a random share of the groups of each trajectory, as in the thesis."""

    test_fraction: float = 0.25

    def __post_init__(self) -> None:
        _check_fraction(self.test_fraction)

    def held_out(self, n_groups: int, rng: np.random.Generator) -> Bool[np.ndarray, " groups"]:
        return BlockSplit(self.test_fraction, max(n_groups, 1)).held_out(n_groups, rng)


@dataclass(frozen=True)
class BlockSplit:
    """Hold out contiguous blocks of each trajectory.

    Neighbours in a time series are correlated, so randomly held-out rows would resemble training
    rows.
    """

    test_fraction: float = 0.25
    n_blocks: int = 20

    def __post_init__(self) -> None:
        _check_fraction(self.test_fraction)
        set_counts(self, {"n_blocks": 1})

    def held_out(self, n_groups: int, rng: np.random.Generator) -> Bool[np.ndarray, " groups"]:
        n_blocks = min(self.n_blocks, n_groups)
        chosen = rng.permutation(n_blocks)[: round(self.test_fraction * n_blocks)]
        return np.isin(np.arange(n_groups) * n_blocks // max(n_groups, 1), chosen)


def _check_fraction(fraction: float) -> None:
    if not 0.0 <= fraction < 1.0:
        raise ValueError(f"test_fraction must lie in [0, 1): {fraction} came")
