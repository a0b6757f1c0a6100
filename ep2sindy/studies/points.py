"""One law over many operating points: `+exp=predict`, `+exp=parametric`, breathing over points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from ep2sindy.data.numbers import least_squares
from ep2sindy.data.trajectory import point_label
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import Regression
from ep2sindy.discovery.result import Discovery
from ep2sindy.discovery.several_points import WINDOWS, LawSearch
from ep2sindy.library.facts import Known
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.library.roles import Roles
from ep2sindy.operating.law import LawFunctions, constrain_law, make_basis, read_law
from ep2sindy.operating.left_out import LawChoice, LawTrial, choose_law
from ep2sindy.operating.map import MapPoint, law_map, map_points
from ep2sindy.operating.quantities import Quantity
from ep2sindy.operating.quiet import quiet_points
from ep2sindy.operating.records import Point, read_points
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.document import Result, Text
from ep2sindy.report.report import Report
from ep2sindy.runtime.parallel import Workers, collect
from ep2sindy.signals.embedding import Embedded, embed_alike
from ep2sindy.signals.signal import prepare_signal
from ep2sindy.signals.spectrum import Oscillation
from ep2sindy.studies.point_processes import add_processes
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
from ep2sindy.studies.processes import fit_roles
from ep2sindy.studies.resume import resumed
from ep2sindy.studies.source import Source
from ep2sindy.studies.structures import Terms, terms_of
from ep2sindy.studies.study import Count, Positive
from ep2sindy.studies.sustained import SustainedSearch

EXACT = 1e-3  # part of a known value that may be left, as where a record's balance is averaged

MAP_POINTS = 13  # along each parameter of a map, where a config does not say

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

    def library(self, name: str, states: Sequence[str], parameters: Sequence[str]) -> Library:
        """The library of these terms, with what is known of them."""
        library, terms = terms_of(self.terms, states=states, key=f"models.{name}.terms")
        try:
            known = library.relate(*self.relations).known(self.known).only(terms)
            held = constrain_law(known, terms, parameters=parameters)
            for quantity in self.quantities.values():
                quantity.place(held.common, library)
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
    degree: None means 3 of up to two states, else 2. windows: of the refinements; None takes those
    of `LawSearch`. law: functions of the parameters that give all coefficients: the degree of
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
        if self._roles is not None and not {*self._roles.states} <= {*self.source.states}:
            raise ValueError(
                f"roles must name states, got {list(self._roles.states)} and the states "
                f"{list(self.source.states)}: take sustained=none for terms of any kind, or state "
                "roles of your own, sustained.roles (docs/roles.md)"
            )
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
            opened = mark_quiet(opened)
            if self._is_signal:
                opened, signal = embed_points(opened)
            runs = [point.run for point in opened if point.run is not None]
            statuses = [point.status for point in opened]
            if Oscillation.OSCILLATING not in statuses:
                if self._has_quantities:
                    report.table("points", points_table(opened))
                    n = len(opened)
                    report.found(Result(f"No control laws: none of {n} points oscillates", []))
                    return
                raise ValueError(nothing_moves(statuses))
            libraries = self._libraries or {"": self._library(opened, signal, report)}
            by_model = {
                name: self._discover(runs, name, library, workers, report)
                for name, library in libraries.items()
            }
            warnings = [text for own in by_model.values() for text in own.data_warnings]
            for text in dict.fromkeys(warnings):
                report.warn(text)
            found = self._join(by_model, opened, report)
            if found.choice is not None:
                maps = self._map(found.choice, opened, workers, report)
                found = replace(found, maps=maps)
        self._report(found, report)

    def _discover(
        self, runs: Sequence[Any], name: str, library: Library, workers: Workers, report: Report
    ) -> Discovery:
        """What the door finds; where points do not suffice for the law, with constants alone."""
        windows = None
        if self.windows is not None:
            n, periods = self.windows.n_windows, self.windows.periods
            windows = RefinementSettings(n_windows=n, periods=periods)
        search = LawSearch(self._functions, windows, name)
        method = None
        if library.facts.roles is not None and self.sustained is not None:
            own = self.sustained
            method = Regression(
                self.formulation, own.search, selection=own.selection, depth=own.depth
            )
        elif self.models:
            method = Regression(self.formulation)
            search = replace(search, windows=windows or WINDOWS)
        find = partial(
            discover, runs, library, method, seed=report.seed, workers=workers,
            progress=report.watch,
        )  # fmt: skip
        try:
            return find(law=search)
        except ValueError as error:
            if not self._has_quantities:
                raise
            constants = replace(search, functions=named_terms(self._given.names, ["1"]))
            found, reason = find(law=constants), f"no law of whole models: {error}"
            return replace(found, law=None, data_warnings=(*found.data_warnings, reason))

    def _join(
        self, by_model: Mapping[str, Discovery], opened: Sequence[OpenedPoint], report: Report
    ) -> PointsFound:
        """What was found for every model, and the best of all their laws.

        Models whose law holds on one of two cycles alone give way to those of all records.
        """
        most = max(len(own.points) for own in by_model.values())
        if fewer := [name for name, own in by_model.items() if len(own.points) < most]:
            report.warn(f"left out, for their laws hold on one cycle alone: {', '.join(fewer)}")
        by_model = {name: own for name, own in by_model.items() if name not in fewer}
        first = next(iter(by_model.values()))
        choices = [own.law_choice for own in by_model.values() if own.law_choice is not None]
        trials = [trial for own in choices for trial in own.trials]
        choice = None if first.law is None else choices[0]
        if choice is not None and len(choices) > 1:
            choice = replace(choose_law(trials), cycle=choice.cycle)
        return PointsFound(trials, choice, by_model, opened)

    def _library(
        self, opened: Sequence[OpenedPoint], signal: Embedded | None, report: Report
    ) -> Library:
        """The terms that are searched: of a signal, under roles, or all products."""
        if signal is not None:
            return signal.library(self.degree or 3)
        states, own = list(self.source.states), self.sustained
        degree = self.degree or (own and own.degree)
        if self._roles is None:
            return polynomial(states, degree=degree or (3 if len(states) < 3 else 2))
        known = self._known(self._roles, opened, report)
        return polynomial(states, degree=degree or 3).with_roles(known)

    def _known(self, roles: Roles, opened: Sequence[OpenedPoint], report: Report) -> Roles:
        """The roles with what is supplied at each point, by functions of it; else free."""
        known = [(p.parameters, fit_roles(p.zones.balances, p.run)) for p in opened if p.run]
        inflow = dict(roles.inflow)
        for state in roles.inflow:
            name = f"{state} in"
            if name in roles.open and not all(name in rates for _, rates in known):
                report.say(
                    f"the inflow of {state} is free: densities alone hardly tell how much passes "
                    f"through, so state it if you can, sustained.roles.inflow.{state}=NUMBER in SI"
                )
            elif name in roles.open:
                values = np.array([rates[name].terms["1"] for _, rates in known])
                inflow[state] = functions_through(values, [point for point, _ in known])
                words = " + ".join(f"{v:.4g} {f}" for f, v in inflow[state].items())
                report.say(f"inflow of {state}, by the records' balances: {words}")
        return replace(roles, inflow=inflow).with_known({})

    def _map(
        self, choice: LawChoice, opened: Sequence[OpenedPoint], workers: Workers, report: Report
    ) -> list[MapPoint]:
        """The law's models at all points, and then over a grid that encloses these."""
        records = [record for record in choice.records if record.repeats]
        if not choice.runs or not records:
            return []
        points = [point.parameters for point in opened]
        at = [*points, *(map_points(points, self.map_points) if self.map_points else [])]
        pieces = [at[first : first + N_TOGETHER] for first in range(0, len(at), N_TOGETHER)]
        stage = report.watch.stage(len(at), "point", "map of the law")
        one = partial(law_map, choice.law, records)
        return [p for piece in collect(workers, one, pieces, stage, size=len) for p in piece]

    def _report(self, found: PointsFound, report: Report) -> None:
        """Fill the report: quantities, law, processes, points, models."""
        opened, choice, shown = found.opened, found.choice, None
        n_oscillating = sum(point.status == Oscillation.OSCILLATING for point in opened)
        report.headline |= {"n_points": len(opened), "n_oscillating": n_oscillating}
        report.table("fits", fits_table(found), shown=False)
        if self._has_quantities:
            quantities = {name: own.quantities for name, own in (self.models or {}).items()}
            shown = add_quantities(report, found, quantities, self._published, self.labels)
        points = points_table(opened, found)
        if choice is not None:
            others = "other models or models=null" if self.models else "another ++degree=..."
            of_law = add_law(report, found, points, self.labels, others)
            if choice.choice.fits.relations.common.processes:
                zones = {point.label: point.zones for point in opened}
                add_processes(report, choice, zones, self.labels)
            more = [Text(choice.text)] if choice.text else []
            shown = replace(shown, blocks=[*shown.blocks, *more]) if shown else of_law
        assert shown is not None
        report.found(shown)
        report.section("Operating points", "Units are SI, unless a name ends in another.")
        report.table("points", points)
        numbers = {point.label: k for k, point in enumerate(opened)}
        for j, label in enumerate(found.fitted):
            k = numbers[label]
            for name, trial in found.last.items():
                report.model(f"point_{k}_{name}", trial.fits.models[j], shown=False)
                report.board.scalars(_live(name, trial, j), step=k)
            if choice is not None:
                model = read_law(choice.law, opened[k].parameters)
                report.model(f"point_{k}_law", model, shown=False)

    @property
    def _is_signal(self) -> bool:
        return len(self.source.states) == 1 and not self.models

    @property
    def _roles(self) -> Roles | None:
        """The roles under which terms are searched; None of given terms and of one signal."""
        if self.models or self._is_signal or self.sustained is None:
            return None
        return self.sustained.roles

    @property
    def _has_quantities(self) -> bool:
        return any(model.quantities for model in (self.models or {}).values())

    @cached_property
    def _functions(self) -> LawFunctions:
        """The functions of a law: a degree, named ones, or those that are chosen."""
        if self.law is None or isinstance(self.law, int):
            return self.law or "auto"
        return named_terms(self._given.names, self.law)

    @cached_property
    def _given(self) -> GivenPoints:
        return given_points(self.points, self.parameters, self.source)

    @cached_property
    def _published(self) -> pd.DataFrame:
        return read_published(self.thesis or {}, self._given.names)

    @cached_property
    def _libraries(self) -> dict[str, Library]:
        """The libraries of the models that are given."""
        states, parameters = self.source.states, self._given.names
        models = (self.models or {}).items()
        return {name: own.library(name, states, parameters) for name, own in models}


def functions_through(
    values: Float[np.ndarray, " points"], points: Sequence[Point]
) -> dict[str, float]:
    """Factors of the functions of the point that a known value is a sum of, the fewest first.

    It is one number, in proportion to one parameter, or linear in all; in this order the first that
    is within EXACT of the values, or the last.
    """
    names = list(points[0])
    columns = np.column_stack([np.ones(len(points)), read_points(points, names)])
    functions = ["1", *names]
    found: dict[str, float] = {}
    for chosen in [*([k] for k in range(len(functions))), list(range(len(functions)))]:
        own = columns[:, chosen]
        coef = least_squares(own, values)
        found = dict(zip([functions[k] for k in chosen], coef.tolist(), strict=True))
        if np.abs(own @ coef - values).max() <= EXACT * np.abs(values).max():
            break
    return found


def mark_quiet(opened: Sequence[OpenedPoint]) -> list[OpenedPoint]:
    """The points, of which those are steady whose records are quiet next to the others."""
    runs = [[point.run] for point in opened if point.run is not None]
    states = runs[0][0].state_names if runs else ()
    quiet = {point_label(each.parameters) for each in quiet_points(runs, states)} if runs else ()
    return [
        replace(point, given=Oscillation.STEADY)
        if point.label in quiet and point.status == Oscillation.OSCILLATING
        else point
        for point in opened
    ]


def embed_points(opened: Sequence[OpenedPoint]) -> tuple[list[OpenedPoint], Embedded]:
    """The signal of every point with the states that one embedding makes of it at all points.

    A quiet record has its states from the embedding of the others. One that is not quiet, but does
    not oscillate for long enough, has no part in it; its status says so.
    """
    traces, made = {}, list(opened)
    for k, point in enumerate(opened):
        if point.run is not None:
            made[k] = replace(point, run=None, given=Oscillation.NO_PERIOD)
            with suppress(ValueError):
                traces[k] = prepare_signal(point.run)
    if not traces:
        raise ValueError("no signal oscillates for six periods: record for longer")
    states = embed_alike(list(traces.values()))
    for k, own in zip(traces, states, strict=True):
        made[k] = replace(opened[k], run=own.run)
    for k, point in enumerate(opened):
        if point.run is not None and point.status == Oscillation.STEADY:
            with suppress(ValueError):
                run = states[0].along(point.run)
                run = replace(run, parameters=point.run.parameters, label=point.run.label)
                made[k] = replace(point, run=run)
    return made, states[0]


def _live(name: str, trial: LawTrial, number: int) -> dict[str, float]:
    """Scalars that TensorBoard shows for a point: its coefficients, and the loss."""
    model, fits = trial.fits.models[number], trial.fits
    scalars = {f"{name}/{s}/{t}": v for s in model.states for t, v in model.terms(s).items()}
    return scalars | ({f"{name}/loss": fits.losses[number]} if fits.losses else {})
