"""One model at many operating points, and its laws: `+exp=parametric` and `+exp=predict`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product
from math import prod

import numpy as np
import pandas as pd

from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import Regression
from ep2sindy.library.facts import Known
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.operating.given_models import (
    REFINED,
    FittingSettings,
    GivenModel,
    PointResult,
    fit_models,
    fits_of,
)
from ep2sindy.operating.law import LawFunctions, constrain_law, make_basis, read_law
from ep2sindy.operating.quantities import Quantity
from ep2sindy.operating.records import OperatingRecord, branches_of, read_points
from ep2sindy.regression.formulations import Differential, RandomSplit, WeightedWeak
from ep2sindy.regression.rows import Formulation
from ep2sindy.regression.searches import BestSubset
from ep2sindy.report.document import Text
from ep2sindy.report.report import Report
from ep2sindy.runtime.parallel import Workers
from ep2sindy.signals.embedding import Embedded, embed_alike
from ep2sindy.signals.signal import MIN_PERIODS, prepare_signal
from ep2sindy.signals.spectrum import Oscillation
from ep2sindy.studies.law_tables import FoundLaw, add_law, find_law
from ep2sindy.studies.point_sources import (
    Functions,
    GivenPoints,
    OpenedPoint,
    Points,
    given_points,
    nothing_moves,
    open_points,
)
from ep2sindy.studies.quantity_tables import Published, add_quantities, read_published
from ep2sindy.studies.resume import resumed
from ep2sindy.studies.source import Source
from ep2sindy.studies.structures import Terms, terms_of
from ep2sindy.studies.study import Count, Positive

# Name of models whose terms were searched for; most of them, and sizes of their supports: of every
# state's, and of a signal's second state's.
FOUND, MOST_FOUND, SIZES, SIGNAL_SIZES = "found", 27, (2, 3, 4), (4, 5, 6)

Records = Mapping[int, tuple[OperatingRecord, str]]  # by number of the point, with its cycle's name


@dataclass(frozen=True)
class ModelSettings:
    """The terms of every state, with relations and known coefficients that hold at every point.

    quantities: what coefficients stand for; their control laws are found.
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
    published quantities by model. keep: whether a run continues with the finished pieces of one
    that was interrupted.
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
    map_points: Count | None = None
    degree: Count | None = None
    thesis: Published | None = None
    keep: bool = True

    def __post_init__(self) -> None:
        self._given_models(self.models or {})
        names, _ = self._given.names, self._published
        points = read_points([source.parameters for source in self._given.sources], names)
        if any(model.quantities for model in (self.models or {}).values()):
            return
        # Points too few for a law, even if all oscillate, are refused before any simulation.
        law = self._functions()
        smallest = law if isinstance(law, Library) else polynomial(names, degree=1)
        remedy = "give it more values, or leave it out (~parameters.{name})"
        make_basis(smallest, points, n_spare=1, remedy=remedy)

    def run(self, report: Report) -> None:
        if self._given.left_out:
            words = "left out, for their names hold no number there"
            report.say(f"{words}: {', '.join(self._given.left_out)}")
        self._report_known(report)
        sources = self._given.sources
        with resumed(self.keep, report, self.parallel) as workers:
            inputs = self.source.inputs([self._given_models(self.models or {})[0]])
            opened, signal = open_points(sources, inputs, workers=workers, report=report), None
            if self._is_signal:
                opened, signal = embed_points(opened)
            models = self.models or self._search(opened, signal, report)
            library, given = self._given_models(models)
            n_windows, periods = self._windows.n_windows, self._windows.periods
            how = FittingSettings(library, self.formulation, n_windows, periods)
            (rng, _) = np.random.default_rng(report.seed).spawn(2)
            fitted = fit_models(
                [point.run for point in opened], given, how, workers=workers, rng=rng,
                tell=lambda k, result: report.board.scalars(_live(result), step=k),
                progress=report.watch,
            )  # fmt: skip
            results = [
                fitted.get(k, PointResult(point.parameters, point.status))
                for k, point in enumerate(opened)
            ]
            records = records_of(opened, results, report)
            try:
                law = self._law(records, results, given, workers, report)
            except ValueError as error:
                if not any(model.quantities for model in given.values()):
                    raise
                law = None
                report.warn(f"no law of whole models: {error}")
        self._report(report, results, records, library, given, law)

    def _law(
        self,
        records: Records,
        results: Sequence[PointResult],
        given: Mapping[str, GivenModel],
        workers: Workers,
        report: Report,
    ) -> FoundLaw:
        """The law of the records on the cycle that most of them are on."""
        if not records:
            statuses = [result.status for result in results]
            raise ValueError(
                f"a law needs records of {MIN_PERIODS:g} periods or more: none has them"
                if Oscillation.OSCILLATING in statuses
                else nothing_moves(statuses)
            )
        main, n_main = Counter(cycle for _, cycle in records.values()).most_common(1)[0]
        used = [k for k, (_, cycle) in records.items() if cycle == main]
        if others := [record.label for record, cycle in records.values() if cycle != main]:
            report.warn(
                f"two cycles coexist: the law is that of the {n_main} points on the {main} one; "
                f"on the other are {', '.join(others)}"
            )
        report.say(f"fitting a law to {n_main} points ...")
        return find_law(
            {
                name + end: fits_of(name + end, model, [results[k] for k in used])
                for name, model in given.items()
                for end in ("", REFINED)
            },
            [records[k][0] for k in used],
            self._functions(),
            [result.parameters for result in results],
            cycle=main, periods=max(1.0, self._windows.periods), n_map=self.map_points,
            workers=workers, report=report,
        )  # fmt: skip

    def _report(
        self,
        report: Report,
        results: Sequence[PointResult],
        records: Records,
        library: Library,
        given: Mapping[str, GivenModel],
        law: FoundLaw | None,
    ) -> None:
        """Fill the report: quantities, law, points, models."""
        n_oscillating = sum(bool(result.fits) for result in results)
        report.headline |= {"n_points": len(results), "n_oscillating": n_oscillating}
        report.table("fits", fits_table(results), shown=False)
        found, errors = None, law.errors if law else {}
        if any(model.quantities for model in given.values()):
            found = add_quantities(
                report, library, given, results, errors, self._published, self.labels
            )
        points = points_table(results, records)
        if law is not None:
            if law.at_points:
                points["law"] = law.outcomes
            others = "other models or models=null" if self.models else "another ++degree=..."
            of_law = add_law(report, law, points, self.labels, others)
            found = replace(found, blocks=[*found.blocks, Text(law.text)]) if found else of_law
        assert found is not None
        report.found(found)
        report.section("Operating points", "Units are SI, unless a name ends in another.")
        report.table("points", points)
        for k, result in enumerate(results):
            for name, fit in result.fits.items():
                report.model(f"point_{k}_{name}", fit.model, shown=False)
            if law is not None and k in records and records[k][1] == law.cycle:
                model = read_law(law.law, result.parameters)
                report.model(f"point_{k}_law", model, shown=False)

    @property
    def _is_signal(self) -> bool:
        return len(self.source.states) == 1

    @property
    def _windows(self) -> RefiningWindows:
        return self.windows or WINDOWS[self._is_signal]

    def _search(
        self, opened: Sequence[OpenedPoint], signal: Embedded | None, report: Report
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
            runs, library, Regression(rows, search, depth=n_best), shared=True, seed=report.seed,
            progress=report.watch,
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

    @cached_property
    def _published(self) -> pd.DataFrame:
        return read_published(self.thesis or {}, self._given.names)

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

    def _report_known(self, report: Report) -> None:
        """Next to data of files, say what the models hold for known, and how to change it."""
        known = {name: model.known for name, model in (self.models or {}).items() if model.known}
        if known and "path" in self.source.data.settings:
            name, held = list(known.items())[-1]
            report.say(
                f"models of these files hold coefficients for known, models.{name}.known={held}: "
                "they must be those of your thruster (as shipped, the simulator's) in each of "
                f"{list(known)}; or leave such models out: ~models.{name}"
            )


def embed_points(opened: Sequence[OpenedPoint]) -> tuple[list[OpenedPoint], Embedded]:
    """The signal of every point with the states that one embedding makes of it at all points.

    A record that does not oscillate for long enough has no part in it; its status says so.
    """
    traces, made = {}, list(opened)
    for k, point in enumerate(opened):
        if point.run is not None:
            made[k] = replace(point, run=None, status=Oscillation.NO_PERIOD)
            with suppress(ValueError):
                traces[k] = prepare_signal(point.run)
    if not traces:
        raise ValueError("no signal oscillates for six periods: record for longer")
    states = embed_alike(list(traces.values()))
    for k, own in zip(traces, states, strict=True):
        made[k] = replace(opened[k], run=own.run)
    return made, states[0]


def records_of(
    opened: Sequence[OpenedPoint], results: Sequence[PointResult], report: Report
) -> Records:
    """Every record that repeats a cycle, with the cycle's name, by the number of its point.

    The name is `all` if there is one cycle, else `strong` or `weak`.
    """
    known: dict[int, OperatingRecord] = {}
    for k, (point, result) in enumerate(zip(opened, results, strict=True)):
        if point.run is not None and result.fits:
            try:
                record = OperatingRecord(point.run)
                _ = record.cycle
                known[k] = record
            except ValueError as error:
                report.warn(str(error))
    if not known:
        return {}
    numbers = branches_of(list(known.values()))
    names = [("strong", "weak")[n] if numbers.any() else "all" for n in numbers]
    return dict(zip(known, zip(known.values(), names, strict=True), strict=True))


def points_table(results: Sequence[PointResult], records: Records) -> pd.DataFrame:
    """One row per operating point: status of its record, and its cycle."""
    rows = []
    for k, result in enumerate(results):
        record, cycle = records.get(k, (None, ""))
        row = {**result.parameters, "status": result.status, "branch": cycle}
        row |= {
            "f_kHz": 1e-3 * (record.cycle.frequency_Hz if record else result.f_Hz),
            "n_samples": result.n_samples,
            "dt_s": result.dt_s,
        }
        rows.append(row | {"relative_amplitude": record.relative_amplitude if record else np.nan})
    return pd.DataFrame(rows)


def fits_table(results: Sequence[PointResult]) -> pd.DataFrame:
    """One row per point and fit: its status, loss and R2 of the derivatives."""
    rows = [
        {**result.parameters, "fit": fit, "status": fitted.status, "loss": fitted.loss,
         **{f"r2_{state}": value for state, value in fitted.r2.items()}}
        for result in results
        for fit, fitted in result.fits.items()
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=None if rows else ["fit", "status", "loss"])


def _live(result: PointResult) -> dict[str, float]:
    """Scalars that TensorBoard shows for a point as soon as it is done."""
    scalars: dict[str, float] = {}
    for fit, fitted in result.fits.items():
        scalars |= {f"{fit}/{name}": each.value for name, each in fitted.estimates.items()}
        scalars |= {f"{fit}/r2/{state}": value for state, value in fitted.r2.items()}
    return scalars
