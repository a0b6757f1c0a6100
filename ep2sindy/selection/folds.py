"""Records parted in turns: stretches to run freely over, and what is left to refine on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.refinement.windows import MIN_SAMPLES, WindowBatch, cut_windows


@dataclass(frozen=True)
class Stretch:
    """Samples start to stop (exclusive) of one of the runs."""

    run: int
    start: int
    stop: int


@dataclass(frozen=True, eq=False)
class Fold:
    """What is held out of the runs, and the pieces of them that are left."""

    held: Sequence[Stretch]
    fitted: Sequence[Stretch]

    def windows(
        self,
        runs: Sequence[Trajectory],
        states: Sequence[str],
        inputs: Sequence[str],
        *,
        window: int,
        n_windows: int,
        rng: np.random.Generator,
    ) -> WindowBatch:
        """Windows of the pieces that are left, no longer than the longest piece."""
        pieces = [runs[part.run].window(part.start, part.stop) for part in self.fitted]
        longest = max(piece.n_samples for piece in pieces)
        return cut_windows(
            pieces,
            states=states,
            inputs=inputs,
            n_windows=n_windows,
            window=min(window, longest),
            rng=rng,
        )


def folds_of(runs: Sequence[Trajectory], n_folds: int) -> list[Fold]:
    """Every run in turn where there are enough, else every run cut in blocks.

    Raises ValueError for runs too short to be cut.
    """
    lengths = [run.n_samples for run in runs]
    if len(runs) >= n_folds:
        whole = [Stretch(k, 0, length) for k, length in enumerate(lengths)]
        return [
            Fold(whole[k::n_folds], [part for part in whole if part.run % n_folds != k])
            for k in range(n_folds)
        ]
    if max(lengths) < 2 * MIN_SAMPLES * n_folds:
        raise ValueError(
            f"runs must hold {2 * MIN_SAMPLES * n_folds} samples to be parted in {n_folds}: at "
            f"most {max(lengths)} came; use longer records"
        )
    found = []
    for k in range(n_folds):
        held, fitted = [], []
        for run, length in enumerate(lengths):
            first, last = k * length // n_folds, (k + 1) * length // n_folds
            held.append(Stretch(run, first, last))
            fitted += [Stretch(run, 0, first), Stretch(run, last, length)]
        found.append(Fold(held, [part for part in fitted if part.stop - part.start >= MIN_SAMPLES]))
    return found
