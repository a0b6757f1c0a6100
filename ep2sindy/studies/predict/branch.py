"""All that is made of the records of one cycle: structure, law, points left out and a map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from jaxtyping import Float

from ep2sindy.discovery.operating_choice import Tried, candidate_structures, chosen, tried
from ep2sindy.discovery.operating_fit import LeftOut, OperatingFit, Structure, Windows, left_out
from ep2sindy.discovery.operating_law import OperatingLaw
from ep2sindy.discovery.operating_map import MapPoint, law_map
from ep2sindy.discovery.operating_points import (
    OperatingRecord,
    branches_of,
    check_records,
    measured_left_out,
)
from ep2sindy.library.library import Library
from ep2sindy.machine.parallel import Workers
from ep2sindy.machine.progress import SILENT, Progress
from ep2sindy.refinement.law import LawRefinement

MOST_PARAMETERS = 2  # of a map that can be drawn


@dataclass(frozen=True)
class Searched:
    """Structures to try where none is given: supports of two to `max_terms` terms an equation."""

    degree: int
    max_terms: int


@dataclass(frozen=True, eq=False)
class How:
    """How the law of a branch is found.

    structure: None searches. degrees: of the polynomials, tried in turn. n_map: points of the map
    along each parameter.
    """

    library: Library
    structure: Structure | None
    searched: Searched
    degrees: Sequence[int]
    windows: Windows
    n_map: int
    seed: int


@dataclass(frozen=True, eq=False)
class Branch:
    """One cycle's records and their law.

    smooth: relative errors of frequency and amplitude, interpolated themselves at points left out
    by the law's functions. at_points: the law's models at all points of the study; map: over a
    grid that encloses these, empty for more than two parameters.
    """

    name: str
    trials: Sequence[Tried]
    choice: Tried
    law: OperatingLaw
    tied: LawRefinement
    left_out: Sequence[LeftOut]
    smooth: tuple[Float[np.ndarray, " records"], Float[np.ndarray, " records"]]
    at_points: Sequence[MapPoint]
    map: Sequence[MapPoint]

    @property
    def fit(self) -> OperatingFit:
        return self.choice.fit


def grouped(records: Sequence[OperatingRecord]) -> dict[str, list[OperatingRecord]]:
    """Records by cycle: all, or strong and weak."""
    check_records(records)
    number = branches_of(records)
    if not number.any():
        return {"all": list(records)}
    names = {"strong": 0, "weak": 1}
    return {
        name: [r for r, n in zip(records, number, strict=True) if n == which]
        for name, which in names.items()
    }


def branch_of(
    name: str,
    records: Sequence[OperatingRecord],
    points: Sequence[Mapping[str, float]],
    how: How,
    workers: Workers,
    *,
    progress: Progress = SILENT,
) -> Branch:
    """Find the law of one cycle's records, and follow it over points and a map.

    Raises ValueError where the records do not suffice for a law.
    """
    check_records(records)
    structures = (
        [how.structure] if how.structure is not None else _structures(records, how, progress)
    )
    trials = tried(
        records,
        how.library,
        structures,
        how.degrees,
        windows=how.windows,
        seed=how.seed,
        workers=workers,
        progress=progress,
    )
    choice = chosen(trials)
    functions = choice.fit.functions(choice.degree)
    law, found = choice.fit.tied(functions, progress=progress)
    grid = map_points(points, how.n_map)
    return Branch(
        name=name,
        trials=trials,
        choice=choice,
        law=law,
        tied=found,
        left_out=left_out(choice.fit, functions, start=law, workers=workers, progress=progress),
        smooth=measured_left_out(records, choice.fit.basis(functions)),
        at_points=_followed(law, records, points, workers, progress),
        map=_followed(law, records, grid, workers, progress),
    )


def map_points(points: Sequence[Mapping[str, float]], n: int) -> list[dict[str, float]]:
    """A grid over the ranges of the points, the last parameter varying fastest."""
    names = list(points[0])
    if len(names) > MOST_PARAMETERS:
        return []
    values = np.array([[point[name] for name in names] for point in points])
    axes = [np.linspace(low, high, n).tolist() for low, high in zip(*_ends(values), strict=True)]
    return [dict(zip(names, each, strict=True)) for each in product(*axes)]


def _ends(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return values.min(axis=0), values.max(axis=0)


def _structures(
    records: Sequence[OperatingRecord], how: How, progress: Progress
) -> list[Structure]:
    return candidate_structures(
        records, how.library, max_terms=how.searched.max_terms, progress=progress
    )


def _followed(
    law: OperatingLaw,
    records: Sequence[OperatingRecord],
    points: Sequence[Mapping[str, float]],
    workers: Workers,
    progress: Progress,
) -> list[MapPoint]:
    """In pieces: the records travel with each."""
    pieces = list(_pieces(points, 24))
    done = {}
    with progress.stage(len(points), "point", "map of the law") as advance:
        for number, piece in workers.run(partial(law_map, law, records), pieces):
            done[number] = piece
            advance(len(piece))
    return [point for k in range(len(pieces)) for point in done[k]]


def _pieces(
    points: Sequence[Mapping[str, float]], size: int
) -> Iterator[Sequence[Mapping[str, float]]]:
    for first in range(0, len(points), size):
        yield points[first : first + size]
