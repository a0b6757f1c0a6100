"""What an estimation costs is known before it begins."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.machine.memory import check_memory

NUMBERS = 3.5  # held at once for each pair of coefficients, and for each coefficient and state

SOON = 300  # coefficients that are searched within a minute or so


class SlowSearch(UserWarning):
    """So much is to be searched at once that it takes long."""


def check_size(
    runs: Sequence[Trajectory], library: Library, terms: Mapping[str, Sequence[str]]
) -> None:
    """Raise ValueError for more coefficients than memory holds; warn of a long search.

    terms: by state, all the terms of an equation that is known but for its coefficients.
    """
    states = runs[0].state_names
    n = sum(len(terms.get(state, library)) for state in states)
    n_samples = sum(run.n_samples for run in runs)
    what = f"{n} coefficients ({len(library)} terms, {len(states)} states)"
    check_memory(
        8.0 * NUMBERS * n * (n + n_samples * len(states)),
        f"{what} that are estimated together from {n_samples} samples",
        way_out="take fewer terms or a lower degree, every second sample "
        "(ep2sindy.prepare.decimate), or a search equation by equation: Recipe(WeightedWeak()), "
        "or search=best_subset selection=ebic",
    )
    if n > SOON:
        warnings.warn(
            f"{what} are searched together, which may take many minutes: fewer "
            "terms, or a search equation by equation, Recipe(WeightedWeak()), take seconds",
            SlowSearch,
            stacklevel=2,
        )
