"""One law over many operating points: `+exp=predict`, `+exp=parametric`, breathing over points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import Regression
from ep2sindy.discovery.result import Discovery
from ep2sindy.discovery.several_points import FOUND, LawSearch
from ep2sindy.library.facts import Known
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.library.relations import constraint
from ep2sindy.library.roles import Roles
from ep2sindy.operating.law import LawFunctions, make_basis
from ep2sindy.operating.left_out import LawChoice, choose_law
from ep2sindy.operating.map import law_map, map_points
from ep2sindy.operating.quantities import Quantity
from ep2sindy.operating.records import OperatingRecord, read_points
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.report import Report
from ep2sindy.runtime.parallel import Workers, collect
from ep2sindy.signals.embedding import Embedded, embed_alike
from ep2sindy.signals.signal import prepare_signal
from ep2sindy.signals.spectrum import Oscillation, oscillation
from ep2sindy.studies.point_sources import (
    Functions,
    GivenPoints,
    OpenedPoint,
    Points,
    given_points,
    nothing_moves,
    open_points,
)
from ep2sindy.studies.point_tables import (
    PointsFound,
    Published,
    add_law,
    add_quantities,
    fits_table,
    points_table,
    read_published,
)
from ep2sindy.studies.processes import inflow_of_points
from ep2sindy.studies.resume import resumed
from ep2sindy.studies.source import Source
from ep2sindy.studies.structures import Terms, terms_of
from ep2sindy.studies.study import Count, Positive
from ep2sindy.studies.sustained import SustainedSearch

N_TOGETHER = 24  # points of a map computed as one piece: the records are sent with each piece


@dataclass(frozen=True)
class ModelSettings:
    """The terms of every state, with relations and known coefficients that hold at every point.

    quantities: what coefficients stand for; their control laws are found.
    """

    terms: Terms
    relations: Sequence[str] = ()
    known: Known = field(default_factory=dict)
    quantities: Mapping[str, Quantity] = field(default_factory=dict)

    def library(self, name: str, states: Sequence[str]) -> Library:
        """The library of these terms, with what is known of them."""
        library, terms = terms_of(self.terms, states=states, key=f"models.{name}.terms")
        try:
            known = library.relate(*self.relations).known(self.known).only(terms)
            held = constraint(library, terms, known.facts.relations)
            for quantity in self.quantities.values():
                quantity.place(held, library)
        except ValueError as error:
            raise ValueError(
                f"models.{name} cannot hold: {error} (or leave it out: ~models.{name})"
            ) from error
        return known


@dataclass(frozen=True)
class RefiningWindows:
    """Windows of every record: number, and length in periods of its oscillation."""

    n_windows: Count
    periods: Positive


@dataclass(frozen=True, eq=False)
class Study:
    """Find one structure for all operating points, and how its coefficients depend on the point.

    It prints what `ep.discover(runs, library, law=...)` returns. parameters: the place of each
    parameter in the data group; None if it has none. points: blocks, each with one value or a list
    of values for all parameters, and `data` for other differences from the data group; or the
    pattern of files, which names the parameters. models: by name, with their terms. Without any,
    terms are searched: under the roles of `sustained`; or if that is None, or a single signal was
    recorded, of which a second state is made, among the products of the states up to a degree.
    degree: None means 2, and 3 of a signal. windows: of the refinements; None takes those of
    `LawSearch`. law: functions of the parameters that give all coefficients: the degree of
    polynomials, or names such as ["1", "V_D_V"]; None chooses them. map_points: number of points
    along each parameter, of a map over the law; None: no map. labels: names of parameters and
    quantities in figures. thesis: published quantities by model. keep: whether a run continues with
    the finished pieces of one that was interrupted.
    """

    source: Source
    formulation: Formulation
    parallel: Workers
    points: Points
    parameters: Mapping[str, str | None] = field(default_factory=dict)
    models: Mapping[str, ModelSettings] | None = None
    sustained: SustainedSearch | None = None
    windows: RefiningWindows | None = None
    law: Functions = None
    labels: Mapping[str, str] = field(default_factory=dict)
    map_points: Count | None = None
    degree: Count | None = None
    thesis: Published | None = None
    keep: bool = True

    def __post_init__(self) -> None:
        names, _, _ = self._given.names, self._published, self._libraries
        points = read_points([source.parameters for source in self._given.sources], names)
        if self._has_quantities:
            return
        # Points too few for a law, even if all oscillate, are refused before any simulation.
        law = self._functions
        smallest = law if isinstance(law, Library) else polynomial(names, degree=1)
        remedy = "give it more values, or leave it out (~parameters.{name})"
        make_basis(smallest, points, n_spare=1, remedy=remedy)

    def run(self, report: Report) -> None:
        if self._given.left_out:
            words = "left out, for their names hold no number there"
            report.say(f"{words}: {', '.join(self._given.left_out)}")
        with resumed(self.keep, report, self.parallel) as workers:
            inputs = self.source.inputs(self._libraries.values())
            sources = self._given.sources
            opened, signal = open_points(sources, inputs, workers=workers, report=report), None
            if self._is_signal:
                opened, signal = embed_points(opened)
            runs = [point.run for point in opened if point.run is not None]
            statuses = [_status(point) for point in opened]
            if Oscillation.OSCILLATING not in statuses:
                if self._has_quantities:
                    report.table("points", points_table(opened, statuses, None))
                    return
                raise ValueError(nothing_moves(statuses))
            libraries = self._libraries or {FOUND: self._library(opened, signal, report)}
            by_model = {
                name: self._discover(runs, library, workers, report)
                for name, library in libraries.items()
            }
            choice = _best_law(by_model)
            maps = self._map(choice, opened, workers, report)
        found = PointsFound(by_model, choice, opened, statuses, maps)
        self._report(found, report)

    def _discover(
        self, runs: Sequence[Any], library: Library, workers: Workers, report: Report
    ) -> Discovery:
        """What the door finds; where points do not suffice for the law, with constants alone."""
        windows = self.windows and RefinementSettings(self.windows.n_windows,
                                                      periods=self.windows.periods)  # fmt: skip
        search = LawSearch(self._functions, windows)
        method = None
        if library.facts.roles is not None and self.sustained is not None:
            own = self.sustained
            method = Regression(
                self.formulation, own.search, selection=own.selection, depth=own.depth
            )
        elif self.models:
            method = Regression(self.formulation)
        find = dict(seed=report.seed, workers=workers, progress=report.watch)
        try:
            return discover(runs, library, method, law=search, **find)
        except ValueError as error:
            if not self._has_quantities:
                raise
            report.warn(f"no law of whole models: {error}")
            constants = replace(search, functions=named_terms(self._given.names, ["1"]))
            found = discover(runs, library, method, law=constants, **find)
            return replace(found, law=None)

    def _library(
        self, opened: Sequence[OpenedPoint], signal: Embedded | None, report: Report
    ) -> Library:
        """The terms that are searched: of a signal, under roles, or all products."""
        if signal is not None:
            return signal.library(self.degree or 3)
        states = list(self.source.states)
        if self.sustained is None or self.sustained.roles is None:
            return polynomial(states, degree=self.degree or 2)
        roles = self.sustained.roles
        library = polynomial(states, degree=self.sustained.degree or self.degree or 3)
        return library.with_roles(self._known(roles, opened, report))

    def _known(self, roles: Roles, opened: Sequence[OpenedPoint], report: Report) -> Roles:
        """The roles with what is supplied at each point, by functions of it; else free."""
        inflow, words = inflow_of_points(roles, opened)
        report.say(words)
        return replace(roles, inflow=inflow)

    def _map(
        self, choice: LawChoice, opened: Sequence[OpenedPoint], workers: Workers, report: Report
    ) -> Sequence[Any]:
        """The law's models at all points, and then over a grid that encloses these."""
        if choice.law.model_has_inputs or not any(r.repeats for r in choice.records):
            return []
        points = [point.parameters for point in opened]
        at = [*points, *(map_points(points, self.map_points) if self.map_points else [])]
        pieces = [at[first : first + N_TOGETHER] for first in range(0, len(at), N_TOGETHER)]
        stage = report.watch.stage(len(at), "point", "map of the law")
        records = [record for record in choice.records if record.repeats]
        one = partial(law_map, choice.law, records)
        return [p for piece in collect(workers, one, pieces, stage, size=len) for p in piece]

    def _report(self, found: PointsFound, report: Report) -> None:
        """Fill the report: quantities, law, points, models."""
