"""One model at many operating points, and its laws: `+exp=parametric` and `+exp=predict`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from math import prod
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import point_label
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import Regression
from ep2sindy.library.facts import Known
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.model.model import SparseModel
from ep2sindy.operating.given_models import (
    REFINED,
    FittingSettings,
    GivenModel,
    PointResult,
    fit_models,
    fits_of,
)
from ep2sindy.operating.law import LawFunctions, constrain_law, make_basis
from ep2sindy.operating.quantities import Quantity
from ep2sindy.operating.records import OperatingRecord, branches_of, read_points
from ep2sindy.regression.formulations import Differential, RandomSplit, WeightedWeak
from ep2sindy.regression.rows import Formulation
from ep2sindy.regression.searches import BestSubset
from ep2sindy.report.document import Captioned, Result, Section, Text
from ep2sindy.report.results import json_rows
from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Workers
from ep2sindy.signals.embedding import Embedded, embed_alike
from ep2sindy.signals.spectrum import Oscillation
from ep2sindy.signals.trace import MIN_PERIODS, prepare_signal
from ep2sindy.studies.fits import Terms, terms_of
from ep2sindy.studies.law_tables import FoundLaw, find_law
from ep2sindy.studies.point_sources import (
    Functions,
    GivenPoints,
    OpenedPoint,
    Points,
    given_points,
    nothing_moves,
    open_points,
)
from ep2sindy.studies.quantity_tables import FoundQuantities, check_published
from ep2sindy.studies.resume import resumed
from ep2sindy.studies.source import Source, compile_kernels
from ep2sindy.studies.study import Count, CountOrNone, Positive
from ep2sindy.studies.views import coefficients

# Name of models whose terms were searched for; most of them, and sizes of their supports: of every
# state's, and of a signal's second state's.
FOUND, MOST_FOUND, SIZES, SIGNAL_SIZES = "found", 27, (2, 3, 4), (4, 5, 6)


@dataclass(frozen=True)
class ModelSettings:
    """The terms of every state, with relations and known coefficients that hold at every point.

    quantities: what coefficients stand for; their control laws and trends are found.
    """

    terms: Terms
    relations: Sequence[str] = ()
    known: Known = field(default_factory=dict)
    quantities: Mapping[str, Quantity] = field(default_factory=dict)


@dataclass(frozen=True)
class RefiningWindows:
    """Windows of every record: number, and length in periods of its oscillation."""

    n_windows: Count
    periods: Positive


WINDOWS = {False: RefiningWindows(20, 2.0), True: RefiningWindows(10, 8.0)}  # of a signal: True


@dataclass(frozen=True, eq=False)
class Study:
    """Fit models at all operating points that oscillate, and find how they depend on the point.

    parameters: the place of each parameter in the data group; None if it has none. points: blocks,
    each with one value or a list of values for all parameters, and `data` for other differences
    from the data group; or the pattern of files, which names the parameters.
    models: by name; None searches products of the states up to a degree for terms that are the same
    at all points. Of one state, a signal, a second is made, its growth rate or derivative. degree:
    None means 2, and 3 of a signal. windows: of the refinements; None means 20 of two periods, and
    of a signal, whose second state is less certain, 10 of eight. law: functions of the parameters
    that give all coefficients: the degree of polynomials, or names such as ["1", "V_D_V"]; None
    chooses them at points left out. map_points: number of points along each parameter, of a map
    over the law; None: no map. labels: names of parameters and quantities in figures. thesis:
    published quantities by model. keep: whether a run goes on with the finished pieces of one that
    was broken off.
    """

    source: Source
    formulation: Formulation
    parallel: Workers
    parameters: Mapping[str, str | None]
    points: Points
    models: Mapping[str, ModelSettings] | None
    windows: RefiningWindows | None
    law: Functions
    labels: Mapping[str, str]
    map_points: CountOrNone = None
    degree: CountOrNone = None
    thesis: Mapping[str, Sequence[Mapping[str, float]]] | None = None
    keep: bool = True

    def __post_init__(self) -> None:
        self._given_models(self.models or {})
        check_published(self.thesis or {}, self._given.names)
        sources, names = self._given.sources(self.source), self._given.names
        points = read_points([source.parameters for source in sources], names)
        if any(model.quantities for model in (self.models or {}).values()):
            return
        # Points too few for a law, even if all oscillate, are refused before any simulation.
        law = self._functions()
        smallest = law if isinstance(law, Library) else polynomial(names, degree=1)
        remedy = "give it more values, or leave it out (~parameters.{name})"
        make_basis(smallest, points, n_spare=1, remedy=remedy)

    def compute(self, run: Run) -> Outcome:
        self._given.tell(run)
        if "path" in self.source.data.settings and (words := self._known_beside_files()):
            run.say(words)
        sources = self._given.sources(self.source)
        with run.progress(None, "", "kernels, compiled once"):
            compile_kernels([source.source.data for source in sources])
        with resumed(self.keep, run, self.parallel) as workers:
            inputs = self.source.inputs([self._given_models(self.models or {})[0]])
            opened = open_points(sources, inputs, workers=workers, run=run)
            return self._found(opened, workers, run)

    def _found(self, opened: Sequence[OpenedPoint], workers: Workers, run: Run) -> Outcome:
        signal = None
        if self._is_signal:
            opened, signal = embed_points(opened)
        models = self.models or self._search(opened, signal, run)
        library, given = self._given_models(models)
        windows = self.windows or WINDOWS[self._is_signal]
        how = FittingSettings(library, self.formulation, windows.n_windows, windows.periods)
        (rng, _) = np.random.default_rng(run.seed).spawn(2)
        fitted = fit_models(
            [point.run for point in opened], given, how, workers=workers, rng=rng,
            tell=lambda k, result: run.board.scalars(_live(result), step=k), progress=run.watch,
        )  # fmt: skip
        results = [
            fitted.get(k, PointResult(point.parameters, point.status))
            for k, point in enumerate(opened)
        ]
        found = Outcome(opened, results, given, None, {}, None, self.labels)
        has_quantities = any(model.quantities for model in given.values())
        try:
            records, law = self._law(opened, results, given, workers, run)
            found = replace(found, records=records, law=law)
        except ValueError as error:
            if not has_quantities:
                raise
            run.warn(f"no law of whole models: {error}")
        if has_quantities:
            errors = found.law.errors_by_fit() if found.law else {}
            published = self.thesis or {}
            quantities = FoundQuantities(library, given, results, errors, published, self.labels)
            found = replace(found, quantities=quantities)
        return found

    def _law(
        self,
        opened: Sequence[OpenedPoint],
        results: Sequence[PointResult],
        given: Mapping[str, GivenModel],
        workers: Workers,
        run: Run,
    ) -> tuple[dict[str, tuple[OperatingRecord, str]], FoundLaw]:
        """Every record with its cycle, by its label, and the law of those on the main cycle."""
        known: dict[str, tuple[OperatingRecord, PointResult]] = {}
        for point, result in zip(opened, results, strict=True):
            if point.run is not None and result.fits:
                try:
                    record = OperatingRecord(point.run)
                    _ = record.cycle
                    known[point.label] = record, result
                except ValueError as error:
                    run.warn(str(error))
        if not any(result.fits for result in results):
            raise ValueError(nothing_moves([result.status for result in results]))
        if not known:
            raise ValueError(
                f"a law needs records of {MIN_PERIODS:g} periods or more: none has them"
            )
        cycles = name_cycles([record for record, _ in known.values()])
        main, n_main = Counter(cycles).most_common(1)[0]
        used = [pair for pair, cycle in zip(known.values(), cycles, strict=True) if cycle == main]
        if others := [p for p, cycle in zip(known, cycles, strict=True) if cycle != main]:
            run.warn(
                f"two cycles coexist: the law is that of the {n_main} points on the {main} one; "
                f"on the other are {', '.join(others)}"
            )
        run.say(f"fitting a law to {n_main} points ...")
        law = find_law(
            {
                name + end: fits_of(name + end, model, [result for _, result in used])
                for name, model in given.items()
                for end in ("", REFINED)
            },
            [record for record, _ in used],
            self._functions(),
            [point.parameters for point in opened],
            cycle=main, periods=max(1.0, (self.windows or WINDOWS[self._is_signal]).periods),
            n_map=self.map_points, workers=workers, run=run,
        )  # fmt: skip
        run.write("law.json", law.law.save)
        if law.advice:
            run.warn(law.advice)
        pairs = zip(known.items(), cycles, strict=True)
        return {label: (record, cycle) for (label, (record, _)), cycle in pairs}, law

    @property
    def _is_signal(self) -> bool:
        return len(self.source.states) == 1

    def _search(
        self, opened: Sequence[OpenedPoint], signal: Embedded | None, run: Run
    ) -> dict[str, ModelSettings]:
        """Models of the terms that a search of all points finds; points left out choose of them.

        They are all combinations of the best supports of some sizes, or of a state whose front ends
        before these, as that of x' = y does, of the best support. Of a signal, the first equation
        is known, and the rows of the second are those of smoothed samples.
        """
        runs = [point.run for point in opened if point.run is not None]
        if not runs:
            raise ValueError(nothing_moves([point.status for point in opened]))
        sizes, n_best = (SIGNAL_SIZES, 2) if signal else (SIZES, 1)
        known = signal.terms if signal else {}
        degree = self.degree or (3 if signal else 2)
        names = runs[0].state_names
        library = signal.library(degree) if signal else polynomial(names, degree=degree)
        search = BestSubset(max_terms=sizes[-1], n_best=n_best)
        rows = Differential(split=RandomSplit(test_fraction=0.0)) if signal else WeightedWeak()
        found = discover(
            runs, library, Regression(rows, search, depth=n_best), shared=True, seed=run.seed,
            progress=run.watch,
        )  # fmt: skip
        supports = {
            state: [known[state]]
            if state in known
            else [c.terms for c in front.candidates if c.n_terms in sizes] or [front.best.terms]
            for state, front in found.fronts.items()
        }
        if prod(map(len, supports.values())) > MOST_FOUND:
            supports = {state: [front.best.terms] for state, front in found.fronts.items()}
        return {
            f"{FOUND}_{k}": ModelSettings(
                dict(zip(supports, map(list, terms), strict=True)),
                relations=list(signal.relations) if signal else (),
            )
            for k, terms in enumerate(product(*supports.values()), start=1)
        }

    def _functions(self) -> LawFunctions:
        """The functions of a law: a degree, named ones, or those that are chosen."""
        if self.law is None or isinstance(self.law, int):
            return self.law or "auto"
        return named_terms(self._given.names, self.law)

    @cached_property
    def _given(self) -> GivenPoints:
        return given_points(self.points, self.parameters, self.source)

    def _given_models(
        self, models: Mapping[str, ModelSettings]
    ) -> tuple[Library, dict[str, GivenModel]]:
        """The models, and a library that holds the terms of all of them."""
        states, parameters = self.source.states, self._given.names
        if self._is_signal and models:  # and the state that is made of it
            states = list(next(iter(models.values())).terms)
        terms = {name: terms_of(own.terms, states=states, key=f"models.{name}.terms")[1]
                 for name, own in models.items()}  # fmt: skip
        together = {
            s: list(dict.fromkeys(term for own in terms.values() for term in own[s]))
            for s in states
        }
        if not models:
            return polynomial(states, degree=1), {}
        library, _ = terms_of(together, states=states, key="models")
        found = {}
        for name, own in models.items():
            try:
                relations = constrain_law(
                    library.relate(*own.relations).known(own.known),
                    terms[name], parameters=parameters,
                )  # fmt: skip
                for quantity in own.quantities.values():
                    quantity.place(relations.common, library)
            except ValueError as error:
                raise ValueError(
                    f"models.{name} cannot hold: {error} (or leave it out: ~models.{name})"
                ) from error
            found[name] = GivenModel(relations, own.quantities)
        return library, found

    def _known_beside_files(self) -> str:
        """What the models hold for known beside data of files, and how to change it; or nothing."""
        places = [
            f"models.{name}.known.{state}.{term}.{function}={factor:g}"
            for name, model in (self.models or {}).items()
            for state, terms in model.known.items()
            for term, factors in terms.items()
            for function, factor in factors.items()
        ]
        if not places:
            return ""
        return (
            f"data are files, and models hold a known inflow, {places[-1]}, which as shipped is "
            "that of the package's thruster; set it to that of yours, for each model that has one, "
            f"or leave such models out: ~models.{places[-1].split('.')[1]}"
        )


def embed_points(opened: Sequence[OpenedPoint]) -> tuple[list[OpenedPoint], Embedded]:
    """The signal of every point with the states that one embedding makes of it at all points.

    A record that does not oscillate for long enough has no part in it; its status says so.
    """
    traces, quiet = {}, {}
    for k, point in enumerate(opened):
        if point.run is not None:
            try:
                traces[k] = prepare_signal(point.run)
            except ValueError as error:
                quiet[k] = replace(
                    point, run=None, status=Oscillation.NO_PERIOD, notes=[*point.notes, str(error)]
                )
    if not traces:
        raise ValueError("no signal oscillates for six periods: record for longer")
    states = dict(zip(traces, embed_alike(list(traces.values())), strict=True))
    made = [
        replace(point, run=states[k].run) if k in states else quiet.get(k, point)
        for k, point in enumerate(opened)
    ]
    return made, next(iter(states.values()))


def name_cycles(records: Sequence[OperatingRecord]) -> list[str]:
    """The cycle of every record: `all` if there is one, else `strong` or `weak`."""
    number = branches_of(records)
    return ["all"] * len(records) if not number.any() else [("strong", "weak")[n] for n in number]


@dataclass(frozen=True, eq=False)
class Outcome:
    """Results of all points, and what depends on the point: quantities, and the law of models.

    records: with the name of their cycle, by label; none without a law. One of quantities and law
    is not None. labels: names in figures.
    """

    opened: Sequence[OpenedPoint]
    results: Sequence[PointResult]
    given: Mapping[str, GivenModel]
    quantities: FoundQuantities | None
    records: Mapping[str, tuple[OperatingRecord, str]]
    law: FoundLaw | None
    labels: Mapping[str, str]

    def models(self) -> dict[str, SparseModel]:
        """Models by number of the point and name of the fit, and those of the law."""
        found = {
            f"point_{number}_{name}": fit.model
            for number, result in enumerate(self.results)
            for name, fit in result.fits.items()
        }
        if self.law is not None:
            for number, record in enumerate(self.law.records):
                found[f"law_{number}"] = self.law.model_at(record.parameters)
        return found

    @cached_property
    def _points(self) -> pd.DataFrame:
        """One row per operating point: status of its record, its cycle, and what the law says."""
        rows = []
        for k, (point, result) in enumerate(zip(self.opened, self.results, strict=True)):
            record, cycle = self.records.get(point.label, (None, ""))
            row: dict[str, Any] = {
                **point.parameters,
                "status": result.status,
                "branch": cycle,
                "f_kHz": 1e-3 * (record.cycle.frequency_Hz if record else result.f_Hz),
                "n_samples": result.n_samples,
                "dt_s": result.dt_s,
                **{f"spread_{state}": value for state, value in result.spread.items()},
            }
            row["relative_amplitude"] = record.relative_amplitude if record else np.nan
            if self.law is not None and self.law.at_points:
                row["law"] = str(self.law.at_points[k].status)
            rows.append(row)
        return pd.DataFrame(rows)

    def tables(self) -> dict[str, pd.DataFrame]:
        rows = [
            {**result.parameters, "fit": fit, "status": fitted.status, "loss": fitted.loss,
             **{f"r2_{state}": value for state, value in fitted.r2.items()}}
            for result in self.results
            for fit, fitted in result.fits.items()
        ]  # fmt: skip
        found = {"points": self._points, "fits": pd.DataFrame(rows)}
        found["coefficients_alone"] = coefficients(
            {f"{point_label(r.parameters)}, {name}": fit.model
             for r in self.results for name, fit in r.fits.items()},
            heading="model",
        )  # fmt: skip
        if self.quantities is not None:
            found |= self.quantities.tables()
        return found if self.law is None else found | self.law.tables()

    def figures(self) -> dict[str, Captioned]:
        found = {} if self.quantities is None else self.quantities.figures()
        return found if self.law is None else found | self._law_figures

    @cached_property
    def _law_figures(self) -> dict[str, Captioned]:
        assert self.law is not None
        return self.law.figures(self._points, self.labels)

    @property
    def _oscillates(self) -> dict[str, bool]:
        pairs = zip(self.opened, self.results, strict=True)
        return {point.label: result.status == Oscillation.OSCILLATING for point, result in pairs}

    def in_short(self) -> Result:
        """What was found: the laws of quantities, if any are asked for, else that of the model."""
        if self.quantities is not None:
            return self.quantities.in_short(self.law.compared if self.law else "")
        assert self.law is not None
        return self.law.in_short(self._oscillates, self._law_figures)

    def sections(self) -> list[Section]:
        found = [Section("Operating points", [Text(line) for line in self._lines()])]
        if self.quantities is not None and any(result.fits for result in self.results):
            found += self.quantities.sections()
        if self.law is not None:
            found += self.law.sections(self._oscillates, self._law_figures)
        return found

    def _lines(self) -> Iterator[str]:
        """`26 oscillating`, `2 steady at V_D_V, mdot_mg_s = (150, 3), (175, 2)`, `UNITS`."""
        groups: dict[str, list[Mapping[str, float]]] = {}
        for result in self.results:
            groups.setdefault(result.status, []).append(result.parameters)
        for status, points in groups.items():
            if status == Oscillation.OSCILLATING:
                yield f"{len(points)} {status}"
                continue
            texts = [", ".join(f"{value:g}" for value in point.values()) for point in points]
            texts = [f"({text})" for text in texts] if len(points[0]) > 1 else texts
            yield f"{len(points)} {status} at {', '.join(points[0])} = {', '.join(texts)}"
        yield "Units are SI, unless a name ends in another, such as mdot_mg_s."

    def summary(self) -> dict[str, Any]:
        tables = self.tables()
        found: dict[str, Any] = {name: json_rows(tables[name]) for name in ("points", "fits")}
        if self.quantities is not None:
            kept = tables["control_laws"].assign(law=tables["control_laws"]["law"].map(str))
            found["quantities"] = json_rows(tables["quantities"])
            found |= {"control_laws": json_rows(kept), "trends": json_rows(tables["trends"])}
            found["best_fit"] = self.quantities.best
        return found if self.law is None else found | {"law": self.law.summary(self._oscillates)}

    def headline(self) -> dict[str, float]:
        found = {
            "n_points": float(len(self.results)),
            "n_oscillating": float(sum(bool(result.fits) for result in self.results)),
        }
        if self.quantities is not None:
            found |= self.quantities.headline()
        return found if self.law is None else found | self.law.headline(self._oscillates)


def _live(result: PointResult) -> dict[str, float]:
    """Scalars that TensorBoard shows for a point as soon as it is done."""
    scalars: dict[str, float] = {}
    for fit, fitted in result.fits.items():
        scalars |= {f"{fit}/{name}": each.value for name, each in fitted.estimates.items()}
        scalars |= {f"{fit}/r2/{state}": value for state, value in fitted.r2.items()}
    return scalars
