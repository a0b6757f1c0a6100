"""One model at several operating points, its trends and control laws: `+exp=parametric`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np

from ep2sindy.constraints.relations import constraint
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.library.library import Library, polynomial
from ep2sindy.machine.parallel import Workers
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.run import Run
from ep2sindy.studies.kinds import Count, Kind
from ep2sindy.studies.known_terms import Terms, terms_of
from ep2sindy.studies.parametric.all_points import searched_jointly
from ep2sindy.studies.parametric.opening import PointSource, point_sources, say_used
from ep2sindy.studies.parametric.oscillation import point_label
from ep2sindy.studies.parametric.points import (
    Case,
    PointResult,
    PointStudy,
    Refining,
    parametric_study,
)
from ep2sindy.studies.parametric.quantities import Quantity
from ep2sindy.studies.parametric.summary import live
from ep2sindy.studies.parametric.tables import published_table
from ep2sindy.studies.parametric.time_bootstrap import TimeBootstrap
from ep2sindy.studies.parametric.trends import laws
from ep2sindy.studies.parametric.view import Outcome, Panels
from ep2sindy.studies.source import Source


@dataclass(frozen=True)
class CaseSettings:
    """One way to fit the terms: relations of their coefficients, and what these mean."""

    relations: Sequence[str] | None
    quantities: Mapping[str, Quantity]


@dataclass(frozen=True)
class Searched:
    """A polynomial library, the same for every point."""

    variables: Sequence[str]
    degree: int
    products: Sequence[str] = ()

    def library(self) -> Library:
        return polynomial(list(self.variables), degree=self.degree, products=list(self.products))


@dataclass(frozen=True)
class LawSettings:
    """Quantities as polynomials of the parameters.

    tied_degree: of the polynomials that tie the coefficients of the support for all points.
    """

    degree: int
    max_terms: Count | None
    tied_degree: int


@dataclass(frozen=True)
class Trend:
    """Along one parameter, the others held."""

    along: str
    at: Mapping[str, float]


Cases = Annotated[
    Mapping[str, CaseSettings],
    Kind(
        "like {free: {relations: [], quantities: {k: {coefficient: 'x: x'}}}}",
        lambda value: isinstance(value, dict) and bool(value),
    ),
]
Published = Mapping[str, Sequence[Mapping[str, float]]]  # fit -> points with their quantities


@dataclass(frozen=True, eq=False)
class Study:
    """Fit, refine and search every operating point; then laws, trends and one support for all.

    parameters: where the data group takes each; None for nowhere. points: values of all
    parameters each, and `data`: what else differs from the data group. model: state -> terms.
    thesis: published quantities; a fit that it has is shown beside ours.
    """

    source: Source
    recipe: AnyMethod
    formulation: Formulation
    parallel: Workers
    parameters: Mapping[str, str | None]
    points: Sequence[Mapping[str, Any]]
    model: Terms
    cases: Cases
    bootstrap: TimeBootstrap
    refining: Refining
    library: Searched
    law: LawSettings
    trends: Sequence[Trend]
    figures: Panels
    thesis: Published | None = None

    def __post_init__(self) -> None:
        names = list(self.parameters)
        for each in self.trends:
            if {each.along, *each.at} != set(names):
                raise ValueError(
                    f"a trend goes along one parameter and holds the others of {names}: {each} came"
                )
        known = {name for case in self.cases.values() for name in case.quantities}
        unknown = {name for panel in self.figures.panels for name in panel} - known
        if unknown:
            raise ValueError(f"figures.panels names {sorted(unknown)}; there are {sorted(known)}")

    def compute(self, run: Run) -> Outcome:
        # Everything but the data is built first: a misspelt setting must not cost a simulation.
        names = list(self.parameters)
        how = self.at_every_point()
        law, tying = (polynomial(names, degree=n) for n in (self.law.degree, self.law.tied_degree))
        published = published_table(self.thesis or {}, names)
        sources = point_sources(self.source, self.parameters, self.points)
        inputs = self.source.inputs([how.library, how.searched])
        opening = self.parallel.run(partial(PointSource.open, inputs=inputs), sources)
        points = _in_order(opening, len(sources), "opened", run)
        say_used(run, points)
        for point in points:
            for note in point.notes:
                run.warn(f"{point_label(point.parameters)}: {note}")
        alone, together = np.random.default_rng(run.seed).spawn(2)
        fitted = parametric_study(points, how, workers=self.parallel, rng=alone)
        results = _in_order(_tell(fitted, run), len(points), "fitted", run)
        return Outcome(
            study=how,
            results=results,
            laws=laws(results, law, max_terms=self.law.max_terms),
            joint=searched_jointly(points, results, how, tying, rng=together, progress=run.watch),
            along=[(each.along, each.at) for each in self.trends],
            published=published,
            shown=self.figures,
        )

    def at_every_point(self) -> PointStudy:
        library, terms = terms_of(self.model, states=self.source.states)
        return PointStudy(
            library=library,
            cases={
                name: Case(constraint(library, terms, case.relations or ()), case.quantities)
                for name, case in self.cases.items()
            },
            bootstrap=self.bootstrap,
            refining=self.refining,
            searched=self.library.library(),
            recipe=self.recipe,
            formulation=self.formulation,
        )


def _in_order(numbered: Iterable[tuple[int, Any]], total: int, verb: str, run: Run) -> list[Any]:
    found = {}
    with run.progress(total, f"point {verb}") as came:
        for number, result in numbered:
            found[number] = result
            came(1)
    return [found[number] for number in range(total)]


def _tell(
    numbered: Iterable[tuple[int, PointResult]], run: Run
) -> Iterator[tuple[int, PointResult]]:
    """Every result to TensorBoard as it comes; a step is the number of a point in the config."""
    for number, result in numbered:
        run.board.scalars(live(result), step=number)
        yield number, result
