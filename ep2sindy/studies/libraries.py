"""Several libraries on the same data, side by side: `+exp=breathing`, `+exp=discover`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING

import numpy as np
import xarray as xr

from ep2sindy.data.quantities import KNOWN_UNITS
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.data.zones import ZoneAverage
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import AnyMethod, Regression, of_means
from ep2sindy.forecasting.evaluation import evaluate
from ep2sindy.library.functions import function_names
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.roles import Roles
from ep2sindy.model.comparison import samples_in
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.document import Text
from ep2sindy.report.report import Report
from ep2sindy.runtime.parallel import SURROUNDING, Workers
from ep2sindy.runtime.progress import Progress, count_pieces
from ep2sindy.selection.criteria import Knee
from ep2sindy.signals.attractor import find_cycle
from ep2sindy.signals.driving import DRIVE, add_drive, ask_whether_driven, drop_repeats
from ep2sindy.signals.signal import average_long, prepare_signal
from ep2sindy.studies.discoveries import (
    LibraryResult,
    add_candidates,
    add_estimate,
    add_evaluations,
    add_tables,
    find_best,
    refit,
    refitted_model,
)
from ep2sindy.studies.point_sources import Points
from ep2sindy.studies.processes import NO_ZONES, ComparedProcess, Zones
from ep2sindy.studies.source import Source, columns_beside, n_before, split_in_time, zones_of
from ep2sindy.studies.study import Coefficients, Fraction, PositiveOrAll, Terms, ZeroOrMore
from ep2sindy.studies.sustained import (
    SustainedModel,
    SustainedSearch,
    add_balance,
    add_sustained,
    model_balance,
    start_of,
)
from ep2sindy.studies.views import (
    PlotRange,
    add_figures,
    add_forecasts,
    add_samples,
    skill_of,
    why_none,
)
from ep2sindy.trust.user_code import load_user_module

if TYPE_CHECKING:
    from ep2sindy.studies.points import Study as OverPoints

FIGURES = ("data", "trajectories", "phase")
HELD_OUT = 0.25  # fraction of a record that tests self-sustained models, unless a config says
_FROM_MODULE = re.compile(r"(?P<module>[^\W\d][\w.]*)\.(?P<name>[^\W\d]\w*)(?P<argument>\(.*\))?")


@dataclass(frozen=True)
class LibraryCase:
    """A polynomial library; variables_if_present are left out if the field lacks them.

    Of several zones, each variable stands for its averages in all of them.
    functions, function_degree: as in `ep.polynomial`; `my_module.tanh` is the function that
    my_module registers by that name. n_norm: the knee's norm for this library, if it differs from
    the method's.
    """

    variables: Sequence[str]
    degree: int
    variables_if_present: Sequence[str] = ()
    products: Sequence[str] = ()
    functions: Sequence[str] = ()
    function_degree: int = 1
    n_norm: str | None = None

    def library(self, data: xr.Dataset, sampling: ZoneAverage, more: Sequence[str] = ()) -> Library:
        """The library over the data's variables, and over more, which the data lack."""
        optional = [name for name in self.variables_if_present if name in data]
        names = [*sampling.columns([*self.variables, *optional]), *more]
        library = polynomial(
            names,
            degree=self.degree,
            products=list(self.products),
            functions=[registered(str(name)) for name in self.functions],
            function_degree=self.function_degree,
        )
        return drop_repeats(library)

    def method(self, method: AnyMethod) -> AnyMethod:
        """The shared method, with this library's norm if the selection rule has one."""
        if self.n_norm is None or not isinstance(method.selection, Knee):
            return method
        return replace(method, selection=replace(method.selection, n_norm=self.n_norm))


@dataclass(frozen=True)
class Study:
    """Discover a model with every library, integrate it from the first sample, and compare.

    formulation, bootstraps: those of the regression rows, also used where the method searches
    trajectories. rollout_s: integration time; None, or a time beyond the data, means to the data's
    end. thesis: published equations by library: state -> term -> SI coefficient. They are fitted as
    well if the library has the terms and the data can tell them from others. sustained: how
    libraries without inputs are searched for a self-sustained model; None leaves that out.
    held_out: the last fraction of the record, on which such a model is tested; None means a
    quarter. forecasts: number of starts of forecasts, over the held-out part of a self-sustained
    model, or else over the last quarter of the record; zero leaves them out. inputs: variables of
    every library that are no states. period_s: of a drive that is known by its period, which
    becomes the inputs `cos_drive` and `sin_drive` of every library. hidden: states that nobody
    measured, relations between coefficients, terms that an equation may not have (exclude), roles,
    and means over samples (decimate), as for `discover`. points: operating points, for which one
    self-sustained model is searched whose coefficients are functions of the point, and nothing
    else; parameters: their places in the data group; labels: their names in figures. Raises
    ValueError for hidden states with several libraries or with a search for a self-sustained model,
    which needs samples of all states.
    """

    source: Source
    method: AnyMethod
    formulation: Formulation
    bootstraps: Bootstraps
    libraries: Mapping[str, LibraryCase]
    rollout_s: PositiveOrAll
    figures: PlotRange
    thesis: Mapping[str, Coefficients] = field(default_factory=dict)
    sustained: SustainedSearch | None = None
    held_out: Fraction | None = None
    forecasts: ZeroOrMore = 0
    inputs: Sequence[str] = ()
    period_s: PositiveOrAll = None
    hidden: Sequence[str] = ()
    relations: Sequence[str] = ()
    exclude: Terms | None = None
    roles: Roles | None = None
    decimate: int | str | None = None
    points: Points | None = None
    parameters: Mapping[str, str | None] = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)
    parallel: Workers = SURROUNDING

    def __post_init__(self) -> None:
        _ = self._over_points
        if self.hidden and (self.sustained is not None or len(self.libraries) > 1):
            raise ValueError(
                "hidden states go with one library and sustained=none, got "
                f"hidden={list(self.hidden)}"
                f" with {len(self.libraries)} libraries; take +exp=discover"
            )
        if self.exclude and self.sustained is not None:
            raise ValueError(
                "exclude goes with sustained=none, since roles say which terms there are, got "
                f"exclude={dict(self.exclude)}; take +exp=discover"
            )

    @cached_property
    def _over_points(self) -> OverPoints | None:
        """The study of operating points; None without any."""
        if self.points is None:
            return None
        # This loads torch, only for operating points.
        from ep2sindy.studies.points import MAP_POINTS
        from ep2sindy.studies.points import Study as OverPoints

        return OverPoints(
            self.source, self.formulation, self.parallel, self.points, self.parameters,
            sustained=self.sustained, labels=self.labels, map_points=MAP_POINTS,
        )  # fmt: skip

    @property
    def acting(self) -> object:
        """The study that runs and is described on the page: that of operating points, if any."""
        return self._over_points or self

    def run(self, report: Report) -> None:
        if self._over_points is not None:
            self._over_points.run(report)
            return
        with report.watch.stage(None, "", "data"):
            fields = self.source.fields()
        cases = self._served_by(fields[0], report)
        runs, averaged = average_long(self._records(fields, cases, report), self.decimate)
        method = of_means(self.method) if averaged else self.method
        for text in averaged:
            report.say(text)
        # Each case has its own random stream, so that adding a case changes no other.
        streams = np.random.default_rng(report.seed).spawn(len(cases))
        pairs = list(zip(cases.items(), streams, strict=True))
        zones = NO_ZONES if self.sustained is None else zones_of(self.source, fields[0], report)
        results = {}
        for (name, case), rng in count_pieces(report.watch, pairs, "library"):
            drive = () if self.period_s is None else DRIVE
            more = [*self.hidden, *drive]
            library = case.library(fields[0], self.source.trajectory, more)
            results[name] = self._result(
                runs, library, case.method(method), self.thesis.get(name, {}), zones,
                rng=rng, progress=report.watch,
            )  # fmt: skip
        files = [str(field.attrs.get("file", "")) for field in fields]
        estimates = [result.discovery.estimate for result in results.values()]
        estimated = [found.runs[0] for found in estimates if found and self.hidden]
        self._tell(report, [*estimated, runs[0]][0], results, files)

    def _served_by(self, field: xr.Dataset, report: Report) -> dict[str, LibraryCase]:
        """The libraries without those of quantities that a field lacks; all, if none is left.

        A name that is no known quantity stays, to be refused.
        """
        cases = {
            name: replace(case, variables=list(dict.fromkeys([*case.variables, *self.inputs])))
            for name, case in self.libraries.items()
        }
        lacking = {
            name: [each for each in case.variables if each in KNOWN_UNITS and each not in field]
            for name, case in cases.items()
        }
        if all(lacking.values()):
            return cases
        for name, variables in lacking.items():
            if variables:
                words = f"the library {name} is left out: the data have no {', '.join(variables)}"
                report.say(words)
        return {name: case for name, case in cases.items() if not lacking[name]}

    def _records(
        self, fields: Sequence[xr.Dataset], cases: Mapping[str, LibraryCase], report: Report
    ) -> list[Trajectory]:
        """The trajectory of every record, with what is to be reported about them."""
        seen = [case.library(fields[0], self.source.trajectory) for case in cases.values()]
        runs = [self.source.sampled(field, seen, report) for field in fields]
        if self.period_s is not None:
            runs = [add_drive(run, self.period_s) for run in runs]
        if len(runs) > 1:
            report.say(f"{len(runs)} records in one search; figures show the first")
        if not self.hidden and (hint := alone(runs[0])):
            report.warn(hint)
        if question := self._ask_whether_driven(runs[0], fields[0]):
            report.warn(question)
        if self.forecasts and (reason := why_none(runs[0], self._n_fitted(runs[0]))):
            report.say(reason)
        return runs

    def _ask_whether_driven(self, run: Trajectory, field: xr.Dataset) -> str | None:
        """The question for the first state that looks driven; None for none, or with inputs."""
        beside = {} if run.input_names else columns_beside(self.source.data, field, run.names)
        for name in run.state_names:
            with suppress(ValueError):  # a state that does not oscillate
                if question := ask_whether_driven(prepare_signal(run, name), beside):
                    return question
        return None

    def _n_fitted(self, run: Trajectory) -> int:
        """Samples before the part that forecasts are tested on."""
        return n_before(run, self.held_out or HELD_OUT)

    def _result(
        self,
        runs: Sequence[Trajectory],
        library: Library,
        method: AnyMethod,
        thesis: Coefficients,
        zones: Zones,
        *,
        rng: np.random.Generator,
        progress: Progress,
    ) -> LibraryResult:
        """Discovery of one library in all records, and free runs; a sustained one of the first."""
        measured = runs[0]
        barred = {state: list(map(str, names)) for state, names in (self.exclude or {}).items()}
        known = library.exclude(barred).relate(*self.relations).with_roles(self.roles)
        search = partial(discover, list(runs), known, method, hidden=self.hidden, decimate=None)
        found = search(seed=rng, progress=progress)
        runs = runs if found.estimate is None else found.estimate.runs
        s = self.rollout_s
        n_samples = [run.n_samples if s is None else samples_in(run, s) for run in runs]
        refitted = refit(found, thesis, self.formulation, runs, rng)
        published = refitted_model(found, refitted)
        sustained, processes = None, list[ComparedProcess]()
        if self.sustained is not None and not found.model.inputs:
            sustained, processes = self._sustain(
                self.sustained, runs[0], library, zones, rng=rng, progress=progress
            )
        skill = skill_of(
            found.model if sustained is None else sustained.model, measured, starts=self.forecasts,
            n_fitted=self._n_fitted(measured), seen=sustained is None, progress=progress,
        )  # fmt: skip
        sustained = sustained and sustained.forecasting(skill)
        with progress.stage(None, "", "free runs"):
            pairs = zip(runs, n_samples, strict=True)
            over = [partial(evaluate, runs=run, n_samples=n) for run, n in pairs]
            own = skill if sustained is None else None
            return LibraryResult(
                discovery=found,
                runs=[replace(each(found.model), forecasts=lambda: own) for each in over],
                thesis=thesis,
                refitted=refitted,
                published=None if published is None else over[0](published),
                sustained=sustained,
                processes=processes,
                skill=skill,
            )

    def _sustain(
        self, settings: SustainedSearch, run: Trajectory, library: Library, zones: Zones, *,
        rng: np.random.Generator, progress: Progress,
    ) -> tuple[SustainedModel, list[ComparedProcess]]:  # fmt: skip
        """The self-sustained model of a record, and its processes next to the recorded ones."""
        rows = Regression(self.formulation, bootstraps=self.bootstraps)
        train, held = split_in_time(run, self.held_out or HELD_OUT)
        found = settings.found(train, library, rows, zones, rng=rng, progress=progress)
        model, bounds = found.model, settings.bounds
        with progress.stage(None, "", "free run"):
            free = evaluate(model, held, initial=start_of(held, model), bounds=bounds)
        return SustainedModel(found, free), model_balance(model, found.constraint, run, zones)

    def _tell(
        self,
        report: Report,
        data: Trajectory,
        results: Mapping[str, LibraryResult],
        files: Sequence[str],
    ) -> None:
        """All runs, self-sustained models with their sections, selected models, candidates."""
        report.found(find_best(results, len(files)))
        add_evaluations(report, results, files)
        for name, result in results.items():
            if result.sustained is not None:
                add_sustained(report, name, result.sustained)
                if result.processes:
                    cycle = result.sustained.run.cycle
                    add_balance(report, name, result.processes, data, cycle)
            if result.skill is not None:
                where = "seen by the search" if result.sustained is None else "held out"
                title = f"{name}: forecasts over time {where}"
                add_forecasts(report, name, data, result.skill, title=title)
        self._add_selected(report, data, results)
        for name, result in results.items():
            found = result.discovery
            add_candidates(report, name, found, note=result.note, beside=result.beside)
            if found.estimate is not None:
                add_estimate(report, name, found)
        add_tables(report, results)

    def _add_selected(
        self, report: Report, data: Trajectory, results: Mapping[str, LibraryResult]
    ) -> None:
        """The selected models of all libraries, and those of published terms, from the start."""
        clock, figures = data.clock, partial(add_figures, report, data=data, shown=self.figures)
        report.section("The selected model" if len(results) == 1 else "The selected models")
        for name, result in results.items():
            report.add(Text(f"{name}, run freely: {result.runs[0].text}", page_only=True))
            held = result.discovery.constraint
            report.model(name, result.discovery.model, clock=clock, held=held)
        selected = {name: result.runs[0] for name, result in results.items()}
        published = {f"{n}_thesis_terms": r.published for n, r in results.items() if r.published}
        figures(FIGURES, runs=selected)
        add_samples(report, data, selected | published)
        for name, run in published.items():
            report.model(name, run.model, clock=clock, shown=False)
        if published:
            figures(["trajectories"], runs=published, suffix="_thesis")


def alone(data: Trajectory) -> str | None:
    """A message if a single oscillating state without inputs is modelled; otherwise None."""
    if len(data.names) > 1 or find_cycle(data.t, data.states) is None:
        return None
    (name,) = data.names
    return (
        f"{name} oscillates, and one first-order equation cannot: where it rises it never falls "
        f"again. Name a second state, say that one was not measured (hidden=[g]), or let "
        f"+exp=trace signal={name} make one of the signal"
    )


def registered(text: str) -> str:
    """A function's name in the form that a library takes.

    `my_module.tanh(2*x)` imports my_module and becomes `tanh(2*x)`.
    Raises ValueError for a module that cannot be imported or does not register the name.
    """
    found = _FROM_MODULE.fullmatch(text.strip())
    if found is None:
        return text
    module, name = found["module"], found["name"]
    try:
        load_user_module(module)
    except ImportError as error:
        raise ValueError(
            f"functions may name one of your own as MODULE.NAME, got {text!r}, and {error}; the "
            "module must lie below the folder that you start in"
        ) from error
    if name not in function_names():
        raise ValueError(
            f"{module} must register {name!r} when it is imported, by "
            f"ep.register_function({name!r}, value, derivative): it has not"
        )
    return name + (found["argument"] or "")
