"""What a search costs: its memory and time, reported before it begins, and a limit to its time.

A search that reaches its limit, or is interrupted, ends with the best that it has.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

from ep2sindy.data.trajectory import Trajectory, spread_blocks
from ep2sindy.library.library import Library
from ep2sindy.runtime.progress import SILENT, Advance, Progress, nothing
from ep2sindy.trust.memory import check_memory, free_bytes

SMALL = 20  # terms of an equation that are all weighed from the start; else about as many are
# Held in memory per coefficient that is weighed, sample and state, and per term and sample.
NUMBERS, PER_TERM = 2.5, 10.0
# Seconds of one core per sample and state, and more per square of the coefficients weighed.
SECONDS, MORE_SECONDS = 2.5e-5, 0.8e-8
# Samples of the parts of a long record that a search with a limit takes first, in blocks.
PARTS, BLOCKS = tuple(4**k for k in range(7, 16)), 8
SOON_S = 60.0  # a search that takes longer is announced


class SlowSearch(UserWarning):
    """Warning that a search over so many coefficients at once takes long."""


class OutOfTimeError(Exception):
    """A search has reached the limit of its time."""


@dataclass(eq=False)
class SearchMonitor:
    """Shows how a search goes, keeps the best that it has found, and ends it at its limit.

    limit_s: wall time after which the search ends, once there is a first model; None for no limit.
    clock: tells the time, in s. best: the best solution so far, or the latest fit before there is
    one; None before that. ended: true once the search was ended early.
    """

    progress: Progress = SILENT
    limit_s: float | None = None
    clock: Callable[[], float] = field(default_factory=lambda: time.monotonic)
    advance: Advance = nothing
    best: Any = None
    ended: bool = False

    def __post_init__(self) -> None:
        self.started = self.clock()

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
        """Count a step of a fit, and look at the time."""
        self.advance(1)
        self.look()

    def look(self) -> None:
        """Raises OutOfTimeError at the limit, but not before there is a model.

        To be called before each pass over the samples, of which a step makes many.
        """
        late = self.limit_s is not None and self.elapsed_s > self.limit_s
        if late and self.best is not None and not self.ended:
            raise OutOfTimeError(f"the search must end within limit_s={self.limit_s:g} s")

    @property
    def elapsed_s(self) -> float:
        return self.clock() - self.started


def growing_parts(
    runs: Sequence[Trajectory], bytes_each: float, monitor: SearchMonitor
) -> Iterator[Sequence[Trajectory]]:
    """The runs; if the search has a limit, parts of long ones first, so that there is a model soon.

    A larger part follows as long as time, at the pace of the one before, and memory suffice, at so
    many bytes a sample.
    """
    n = sum(run.n_samples for run in runs)
    sizes = [] if monitor.limit_s is None else [size for size in PARTS if 2 * size < n]
    for size, following in pairwise([*sizes, n]):
        began = monitor.elapsed_s
        yield spread_blocks(runs, most=size, block=size // BLOCKS)
        ends = monitor.elapsed_s + (monitor.elapsed_s - began) * following / size
        if monitor.ended or ends > monitor.limit_s or bytes_each * following > free_bytes():
            return
    yield runs


def check_limit_s(limit_s: float | None) -> None:
    """Raise ValueError for a limit that is not positive."""
    if limit_s is not None and not limit_s > 0.0:
        raise ValueError(f"limit_s must be positive, in s, or None for no limit, got {limit_s!r}")


def check_size(
    runs: Sequence[Trajectory],
    library: Library,
    terms: Mapping[str, Sequence[str]],
    *,
    coupled: bool = False,
    limit_s: float | None = None,
) -> float:
    """Bytes that a search takes per sample. Raises ValueError for more than memory holds.

    It warns of a long search, with its time and memory.

    terms: for each state whose equation is known but for its coefficients, all terms of that
    equation. tied: true if relations or hidden states tie the equations together, so that all
    coefficients are weighed at once. limit_s: a search that has one need not hold all samples, and
    is warned of if it would take longer.
    """
    states = runs[0].state_names
    sizes = [len(terms.get(state, library)) for state in states]
    weighed = [
        size if coupled or state in terms else min(size, SMALL)
        for state, size in zip(states, sizes, strict=True)
    ]
    n, d, p = sum(run.n_samples for run in runs), len(states), sum(weighed)
    what = f"{sum(sizes)} coefficients ({len(library)} terms, {d} states)"
    what = f"{what}, of which {p} are weighed at once from {n} samples"
    each = 8.0 * (NUMBERS * p * d + PER_TERM * len(library))
    fixed = 8.0 * (NUMBERS * p**2 + d * len(library) ** 2)
    check_memory(
        fixed + each * (n if limit_s is None else min(n, 2 * PARTS[0])),
        f"{what},",
        hint="take fewer terms or a lower degree, every second sample "
        "(ep2sindy.data.decimate), limit_s=60 for a search of parts, or a search equation by "
        "equation: Regression(WeightedWeak()), or search=best_subset selection=ebic",
    )
    seconds = n * d * (SECONDS + MORE_SECONDS * p**2)
    if seconds > max(limit_s or 0.0, SOON_S):
        warnings.warn(
            f"{what}: this may take some {_spoken(seconds)} of one core "
            f"and {(fixed + each * n) / 1e9:.2g} GB. limit_s ends it with the best so far; fewer "
            "terms, or a search equation by equation, Regression(WeightedWeak()), are faster",
            SlowSearch,
            stacklevel=2,
        )
    return each


def _spoken(seconds: float) -> str:
    """A rough time: two digits would say more than is known."""
    for size, unit in ((86400.0, "days"), (3600.0, "hours"), (60.0, "minutes")):
        if seconds >= 1.5 * size:
            return f"{float(f'{seconds / size:.1g}'):g} {unit}"
    return "minute"
