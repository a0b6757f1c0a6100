"""The law of the operating point for records on one cycle: structure, degree, tests and map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from itertools import product

import numpy as np
from jaxtyping import Float

from ep2sindy.discovery.method import Regression
from ep2sindy.library.library import Library
from ep2sindy.operating.fit import (
    LeaveOneOut,
    OperatingFit,
    Structure,
    leave_one_out,
    operating_fit,
)
from ep2sindy.operating.law import Known, OperatingLaw, make_basis
from ep2sindy.operating.map import MapPoint, law_map, map_points
from ep2sindy.operating.records import (
    OperatingRecord,
    branches_of,
    check_records,
    interpolation_errors,
)
from ep2sindy.operating.shared_support import discover_shared
from ep2sindy.refinement.law import LawRefinement
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.regression.formulations import Differential
from ep2sindy.regression.searches import BestSubset
from ep2sindy.runtime.parallel import Serial, Workers, collect
from ep2sindy.runtime.progress import SILENT, Progress

N_TOGETHER = 24  # points of a map computed as one piece: the records are sent with each piece
CLOSE = 0.05  # deviation, as a share of its bound, that does not justify another term


@dataclass(frozen=True, eq=False)
class StructureCase:
    """Terms of every state, with relations and known coefficients as `operating_fit` takes them.

    name: by which results call it; empty for a structure that a search has found.
    """

    library: Library
    structure: Structure
    relations: Sequence[str] = ()
    known: Known = field(default_factory=dict)
    name: str = ""


@dataclass(frozen=True, eq=False)
class StructureTrial:
    """A structure with weighted laws of one degree, tested by leaving out each point in turn.

    errors: for each record, the largest deviation from its cycle in units of the bound, at most ten
    and at least a twentieth: smaller deviations do not justify another term.
    """

    case: StructureCase
    fit: OperatingFit
    degree: int
    left_out: Sequence[LeaveOneOut]

    @property
    def n_numbers(self) -> int:
        """Number of fitted numbers: those of the law of the free coefficients."""
        return self.fit.n_free * len(self.fit.functions(self.degree))

    @property
    def errors(self) -> np.ndarray:
        return np.maximum([each.error for each in self.left_out], CLOSE)


def candidate_structures(
    records: Sequence[OperatingRecord],
    library: Library,
    *,
    max_terms: int,
    progress: Progress = SILENT,
) -> list[StructureCase]:
    """All combinations of the best supports, of each size from two terms on, of every equation.

    One search over all records finds the supports: a term is in or out everywhere. The rows are
    those of the derivative.
    """
    method = Regression(formulation=Differential(), search=BestSubset(max_terms=max_terms))
    runs = {record.label: [record.run] for record in records}
    found = discover_shared(runs, library, method, progress=progress)
    sizes = {
        state: [support for support in front.supports if len(support) >= 2]
        for state, front in found.fronts.items()
    }
    return [
        StructureCase(library, dict(zip(sizes, chosen, strict=True)))
        for chosen in product(*sizes.values())
    ]


@dataclass(frozen=True, eq=False)
class BranchSettings:
    """Settings for finding the law of a branch.

    cases: structures to choose from; if there is none, supports of two to `max_terms` terms of the
    library in each equation. degrees: of the polynomials, tried in turn. n_map: points of the map
    along each parameter.
    """

    library: Library
    cases: Sequence[StructureCase]
    max_terms: int
    degrees: Sequence[int]
    settings: RefinementSettings
    n_map: int
    seed: int


def try_structures(
    records: Sequence[OperatingRecord],
    cases: Sequence[StructureCase],
    how: BranchSettings,
    *,
    workers: Workers | None = None,
    progress: Progress = SILENT,
) -> list[StructureTrial]:
    """Try every structure with every degree for which the points suffice with one left out.

    Raises ValueError if they suffice for none.
    """
    stage = progress.stage(len(cases), "structure", "laws at points left out")
    one = partial(_try_structure, records=records, how=how)
    by_structure = collect(workers or Serial(), one, cases, stage)
    found = [trial for trials in by_structure for trial in trials]
    if not found:
        n = len(records)
        raise ValueError(
            f"{n} operating points suffice for no law of degree {min(how.degrees)}, each left out "
            "in turn: add points, or lower the degree"
        )
    return found


def choose(found: Sequence[StructureTrial]) -> StructureTrial:
    """The trial with fewest numbers whose mean error is not distinguishable from the least.

    The difference of the errors, point by point, must be within one standard error.
    """
    best = min(found, key=lambda each: (float(each.errors.mean()), each.n_numbers))
    near = []
    for each in found:
        apart = each.errors - best.errors
        reach = apart.std(ddof=1) / np.sqrt(len(apart)) if len(apart) > 1 else 0.0
        if apart.mean() <= reach:
            near.append(each)
    return min(near, key=lambda each: (each.n_numbers, float(each.errors.mean())))


def _try_structure(
    case: StructureCase, *, records: Sequence[OperatingRecord], how: BranchSettings
) -> list[StructureTrial]:
    fit = operating_fit(
        records,
        case.library,
        case.structure,
        relations=case.relations,
        known=case.known,
        settings=how.settings,
        seed=how.seed,
    )
    found = []
    for degree in how.degrees:
        with suppress(ValueError):  # too few points for this degree
            found.append(
                StructureTrial(case, fit, degree, leave_one_out(fit, fit.functions(degree)))
            )
    return found


@dataclass(frozen=True, eq=False)
class Branch:
    """The records on one cycle, and their law.

    smooth: relative errors of frequency and amplitude if these are themselves interpolated, at
    points left out, by the law's functions. at_points: the law's models at all points of the study.
    map: the same over a grid that encloses these, empty for more than two parameters.
    """

    name: str
    trials: Sequence[StructureTrial]
    choice: StructureTrial
    law: OperatingLaw
    refinement: LawRefinement
    left_out: Sequence[LeaveOneOut]
    smooth: tuple[Float[np.ndarray, " records"], Float[np.ndarray, " records"]]
    at_points: Sequence[MapPoint]
    map: Sequence[MapPoint]

    @property
    def fit(self) -> OperatingFit:
        return self.choice.fit


def group_by_cycle(records: Sequence[OperatingRecord]) -> dict[str, list[OperatingRecord]]:
    """Records grouped by cycle: one group "all", or "strong" and "weak"."""
    check_records(records)
    number = branches_of(records)
    if not number.any():
        return {"all": list(records)}
    names = {"strong": 0, "weak": 1}
    return {
        name: [r for r, n in zip(records, number, strict=True) if n == which]
        for name, which in names.items()
    }


def find_branch(
    name: str,
    records: Sequence[OperatingRecord],
    points: Sequence[Mapping[str, float]],
    how: BranchSettings,
    workers: Workers,
    *,
    progress: Progress = SILENT,
) -> Branch:
    """Find the law of the records on one cycle, and evaluate it at points and over a map.

    Raises ValueError if the records do not suffice for a law.
    """
    check_records(records)
    cases = how.cases or candidate_structures(
        records, how.library, max_terms=how.max_terms, progress=progress
    )
    trials = try_structures(records, cases, how, workers=workers, progress=progress)
    choice = choose(trials)
    functions = choice.fit.functions(choice.degree)
    law, refinement = choice.fit.refine_law(functions, progress=progress)
    grid = map_points(points, how.n_map)
    return Branch(
        name=name,
        trials=trials,
        choice=choice,
        law=law,
        refinement=refinement,
        left_out=leave_one_out(
            choice.fit, functions, start=law, workers=workers, progress=progress
        ),
        smooth=interpolation_errors(records, make_basis(functions, choice.fit.points)),
        at_points=_follow(law, records, points, workers, progress),
        map=_follow(law, records, grid, workers, progress),
    )


def _follow(
    law: OperatingLaw,
    records: Sequence[OperatingRecord],
    points: Sequence[Mapping[str, float]],
    workers: Workers,
    progress: Progress,
) -> list[MapPoint]:
    pieces = [points[first : first + N_TOGETHER] for first in range(0, len(points), N_TOGETHER)]
    stage = progress.stage(len(points), "point", "map of the law")
    maps = collect(workers, partial(law_map, law, records), pieces, stage, size=len)
    return [point for piece in maps for point in piece]
