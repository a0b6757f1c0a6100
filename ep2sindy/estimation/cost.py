"""What a search costs: its memory and time, told before it begins, and a limit to its time.

A search that reaches its limit, or is interrupted, ends with the best that it has.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.runtime.progress import SILENT, Advance, Progress, nothing
from ep2sindy.trust.memory import check_memory

SMALL = 20  # terms of an equation that are all weighed from the start; else about as many are
# Held in memory per coefficient that is weighed, sample and state, and per term and sample.
NUMBERS, PER_TERM = 2.5, 10.0
SECONDS = 0.8e-8  # of one core per sample and state, and per square of the coefficients weighed
SOON_S = 60.0  # a search that takes longer is told of


class SlowSearch(UserWarning):
    """Warning that a search over so many coefficients at once takes long."""


class OutOfTimeError(Exception):
    """A search has reached the limit of its time."""


@dataclass(eq=False)
class Watch:
    """Shows how a search goes, keeps the best that it has found, and ends it at its limit.

    limit_s: wall time after which the search ends, once there is a first model; None for no limit.
    best: a problem and its best solution so far, or its latest fit; None before there is one.
    ended: true once the search was ended early.
    """

    progress: Progress = SILENT
    limit_s: float | None = None
    started: float = field(default_factory=lambda: time.monotonic())
    advance: Advance = nothing
    best: tuple[Any, Any] | None = None
    ended: bool = False

    @contextmanager
    def stage(self, label: str) -> Iterator[None]:
        """Show a part of the search, whose steps are counted."""
        before = self.advance
        with self.progress.stage(None, "step", label) as self.advance:
            try:
                yield
            finally:
                self.advance = before

    def step(self) -> None:
        """Count a step. Raises OutOfTimeError at the limit, but not before there is a model."""
        self.advance(1)
        late = self.limit_s is not None and self.elapsed_s > self.limit_s
        if late and self.best is not None and not self.ended:
            raise OutOfTimeError(f"the search must end within limit_s={self.limit_s:g} s")

    @property
    def elapsed_s(self) -> float:
        return time.monotonic() - self.started


def check_limit_s(limit_s: float | None) -> None:
    """Raise ValueError for a limit that is not positive."""
    if limit_s is not None and not limit_s > 0.0:
        raise ValueError(f"limit_s must be positive, in s, or None for no limit: {limit_s!r} came")


def check_size(
    runs: Sequence[Trajectory],
    library: Library,
    terms: Mapping[str, Sequence[str]],
    *,
    tied: bool = False,
    told: bool = True,
) -> None:
    """Raise ValueError for a search that memory does not hold; warn of a long one.

    terms: for each state whose equation is known but for its coefficients, all terms of that
    equation. tied: true if relations or hidden states tie the equations together, so that all
    coefficients are weighed at once. told: false if a long search needs no warning.
    """
    states = runs[0].state_names
    sizes = [len(terms.get(state, library)) for state in states]
    weighed = [
        size if tied or state in terms else min(size, SMALL)
        for state, size in zip(states, sizes, strict=True)
    ]
    n, d, p = sum(run.n_samples for run in runs), len(states), sum(weighed)
    what = f"{sum(sizes)} coefficients ({len(library)} terms, {d} states)"
    products = len(library) * (PER_TERM * n + d * len(library))
    check_memory(
        8.0 * (NUMBERS * p * (p + n * d) + products),
        f"{what}, of which {p} are weighed at once from {n} samples,",
        way_out="take fewer terms or a lower degree, every second sample "
        "(ep2sindy.prepare.decimate), or a search equation by equation: "
        "Regression(WeightedWeak()), or search=best_subset selection=ebic",
    )
    seconds = SECONDS * n * d * p**2
    if told and seconds > SOON_S:
        warnings.warn(
            f"{what}, of which {p} are weighed at once from {n} samples: this may take some "
            f"{_spoken(seconds)} of one core. limit_s ends it with the best so far; fewer terms, "
            "or a search equation by equation, Regression(WeightedWeak()), are faster",
            SlowSearch,
            stacklevel=2,
        )


def _spoken(seconds: float) -> str:
    """A rough time: two digits would say more than is known."""
    for size, unit in ((86400.0, "days"), (3600.0, "hours"), (60.0, "minutes")):
        if seconds >= 1.5 * size:
            return f"{float(f'{seconds / size:.1g}'):g} {unit}"
    return "minute"
