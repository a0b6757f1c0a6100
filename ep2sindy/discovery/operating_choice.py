"""Structure and order of a law of the operating point, chosen by leaving points out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from ep2sindy.discovery.method import Regression
from ep2sindy.discovery.operating_fit import (
    LeftOut,
    OperatingFit,
    Structure,
    Windows,
    left_out,
    operating_fit,
)
from ep2sindy.discovery.operating_points import OperatingRecord, point_text
from ep2sindy.discovery.shared_support import discover_jointly
from ep2sindy.library.library import Library
from ep2sindy.machine.parallel import Serial, Workers
from ep2sindy.machine.progress import SILENT, Progress
from ep2sindy.regression.differential import Differential
from ep2sindy.search.searches import BestSubset

CLOSE = 0.05  # of its bound: a deviation that is no reason for another term


@dataclass(frozen=True, eq=False)
class Tried:
    """A structure with laws of one degree, weighted by information, at points left out.

    errors: by record, the largest deviation from its cycle in units of its bound, ten at most, and
    no less than a twentieth: what is closer buys no term.
    """

    fit: OperatingFit
    degree: int
    found: Sequence[LeftOut]

    @property
    def n_numbers(self) -> int:
        return self.fit.n_coefs * len(self.fit.functions(self.degree))

    @property
    def errors(self) -> np.ndarray:
        return np.maximum([each.error for each in self.found], CLOSE)


def candidate_structures(
    records: Sequence[OperatingRecord],
    library: Library,
    *,
    max_terms: int,
    progress: Progress = SILENT,
) -> list[Structure]:
    """The best support of every size from two on for each equation, in all combinations.

    One search over all records: a term is in or out everywhere. Rows are those of the derivative.
    """
    method = Regression(formulation=Differential(), search=BestSubset(max_terms=max_terms))
    runs = {point_text(record.parameters): [record.run] for record in records}
    found = discover_jointly(runs, library, method, progress=progress)
    sizes = {
        state: [support for support in front.supports if len(support) >= 2]
        for state, front in found.fronts.items()
    }
    return [dict(zip(sizes, chosen, strict=True)) for chosen in product(*sizes.values())]


def tried(
    records: Sequence[OperatingRecord],
    library: Library,
    structures: Sequence[Structure],
    degrees: Sequence[int],
    *,
    windows: Windows,
    seed: int = 0,
    workers: Workers | None = None,
    progress: Progress = SILENT,
) -> list[Tried]:
    """Every structure with every degree that leaves a point over.

    Raises ValueError where the records suffice for none.
    """
    one = partial(
        _tried, records=records, library=library, degrees=degrees, windows=windows, seed=seed
    )
    done = {}
    with progress.stage(len(structures), "structure", "laws at points left out") as advance:
        for number, trials in (workers or Serial()).run(one, structures):
            done[number] = trials
            advance(1)
    found = [each for k in range(len(structures)) for each in done[k]]
    if not found:
        n = len(records)
        raise ValueError(
            f"{n} operating points suffice for no law of degree {min(degrees)}, each left out in "
            "turn: add points, or lower the degree"
        )
    return found


def chosen(found: Sequence[Tried]) -> Tried:
    """The one of fewest numbers whose mean error is not told apart from the least.

    That is within one standard error of the difference, point by point.
    """
    best = min(found, key=lambda each: (float(each.errors.mean()), each.n_numbers))
    near = []
    for each in found:
        apart = each.errors - best.errors
        reach = apart.std(ddof=1) / np.sqrt(len(apart)) if len(apart) > 1 else 0.0
        if apart.mean() <= reach:
            near.append(each)
    return min(near, key=lambda each: (each.n_numbers, float(each.errors.mean())))


def _tried(
    structure: Structure,
    *,
    records: Sequence[OperatingRecord],
    library: Library,
    degrees: Sequence[int],
    windows: Windows,
    seed: int,
) -> list[Tried]:
    fit = operating_fit(records, library, structure, windows=windows, seed=seed)
    found = []
    for degree in degrees:
        try:
            found.append(Tried(fit, degree, left_out(fit, fit.functions(degree))))
        except ValueError:
            continue  # too few points for this degree
    return found
