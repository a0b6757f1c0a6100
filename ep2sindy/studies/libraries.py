"""Several libraries on the same data, side by side: `+exp=breathing`, `+exp=discover`."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from ep2sindy.data.quantities import KNOWN_UNITS
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import AnyMethod, Regression
from ep2sindy.figures.fronts import front_figure
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.forecasting.skill import ForecastSkill
from ep2sindy.library.functions import function_names
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.roles import Roles
from ep2sindy.model.comparison import samples_in
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.document import Block, Captioned, Result, Section, Table, Text, pictures
from ep2sindy.report.results import ResultTable
from ep2sindy.report.run import Run
from ep2sindy.runtime.progress import Progress, count_pieces
from ep2sindy.selection.criteria import Knee
from ep2sindy.signals.attractor import find_cycle
from ep2sindy.signals.smoothers import Smoother
from ep2sindy.studies.balance import ModelBalance, model_balance
from ep2sindy.studies.fits import Terms, n_before, split_in_time
from ep2sindy.studies.forecasts import (
    forecast_errors,
    forecast_picture,
    forecast_section,
    skill_of,
    why_none,
)
from ep2sindy.studies.library_result import (
    RECORDS,
    LibraryResult,
    frequencies,
    left_over_of_all,
    refit,
    run_refitted,
)  # fmt: skip
from ep2sindy.studies.living import LIVING, Living, LivingSearch, living_model, living_tables
from ep2sindy.studies.source import NO_ZONES, Sampling, Source, Zones, data_summary, zones_of
from ep2sindy.studies.study import Coefficients, PositiveOrAll, ShareOrNone, Starts
from ep2sindy.studies.views import (
    FROM_DERIVATIVES,
    INTEGRATED,
    PlotRange,
    best_run,
    display_equation,
    found_model,
    interval_table,
    rollout_tables,
    run_figures,
    trajectories,
    worst_run,
)
from ep2sindy.trust.user_code import load_user_module

FIGURES = ("data", "trajectories", "trajectories_thesis", "derivatives", "phase")
THESIS = "The same with the thesis's terms, fitted to these data."
FRONT = (
    "Error against number of terms: every support that the search proposed, and the best of each "
    "size; the star is selected. Carets at the upper edge: models far worse than none."
)
SCORED = (
    "Score against number of terms, the best of each size; the star is selected. States and "
    "coefficients were estimated together: there are no rows to have an error."
)
HELD_OUT = 0.25  # share of a record on which a model that lives is tested, unless a config says
EVERY_RECORD = "the selected models, integrated from the first sample of every record"
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

    def library(self, data: xr.Dataset, sampling: Sampling, hidden: Sequence[str] = ()) -> Library:
        """The library over the data's variables, and over states that the data lack."""
        optional = [name for name in self.variables_if_present if name in data]
        names = [*sampling.columns([*self.variables, *optional]), *hidden]
        return polynomial(
            names,
            degree=self.degree,
            products=list(self.products),
            functions=[registered(str(name)) for name in self.functions],
            function_degree=self.function_degree,
        )

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
    well if the library has the terms and the data can tell them from others. living: how libraries
    without inputs are searched for a model that lives; None leaves that out. held_out: the last
    share of the record, on which such a model is tested; None means a quarter. forecasts: number of
    starts of forecasts, over the held-out part of a living model, or else over the last quarter of
    the record; zero leaves them out. hidden: states that nobody measured, relations between
    coefficients, terms that an equation may not have (exclude), and roles, as for `discover`.
    Raises ValueError for hidden states with several libraries or with living, which need samples of
    all states.
    """

    source: Source
    method: AnyMethod
    formulation: Formulation
    bootstraps: Bootstraps
    libraries: Mapping[str, LibraryCase]
    rollout_s: PositiveOrAll
    figures: PlotRange
    thesis: Mapping[str, Coefficients] = field(default_factory=dict)
    living: LivingSearch | None = None
    held_out: ShareOrNone = None
    forecasts: Starts = 0
    hidden: Sequence[str] = ()
    relations: Sequence[str] = ()
    exclude: Terms | None = None
    roles: Roles | None = None

    def __post_init__(self) -> None:
        if self.hidden and (self.living is not None or len(self.libraries) > 1):
            raise ValueError(
                f"hidden states go with one library and without living: hidden={list(self.hidden)} "
                f"came with {len(self.libraries)} libraries; take +exp=discover"
            )
        if self.exclude and self.living is not None:
            raise ValueError(
                "exclude goes without living, whose roles say which terms there are: "
                f"exclude={dict(self.exclude)} came; take +exp=discover"
            )

    def compute(self, run: Run) -> Outcome:
        with run.progress(None, "", "data"):
            opened = self.source.fields()
        chosen = self._served_by(opened[0], run)
        methods = {name: case.method(self.method) for name, case in chosen.items()}
        sampling = self.source.trajectory
        seen = [case.library(opened[0], sampling) for case in chosen.values()]
        runs = [self.source.sampled(field, seen, run) for field in opened]
        libraries = {
            name: case.library(opened[0], sampling, self.hidden) for name, case in chosen.items()
        }
        if len(runs) > 1:
            run.say(f"{len(runs)} records in one search; figures show the first")
        if not self.hidden and (hint := alone(runs[0])):
            run.warn(hint)
        n_fitted = n_before(runs[0], self.held_out or HELD_OUT)
        if self.forecasts and (reason := why_none(runs[0], n_fitted)):
            run.say(reason)
        # Each case has its own random stream, so that adding a case changes no other.
        streams = np.random.default_rng(run.seed).spawn(len(libraries))
        pairs = list(zip(libraries.items(), streams, strict=True))
        zones = NO_ZONES if self.living is None else zones_of(self.source, opened[0], run)
        watch = run.watch
        results = {
            name: self._result(runs, name, library, methods[name], zones, rng=rng, progress=watch)
            for (name, library), rng in count_pieces(watch, pairs, "library")
        }
        files = [str(field.attrs.get("file", "")) for field in opened]
        estimated = [result.discovery.estimate for result in results.values()]
        with_hidden = [found.runs[0] for found in estimated if found and self.hidden]
        data = (with_hidden or runs)[0]
        return Outcome(data, results, self.figures, self.formulation.smoother, files)

    def _served_by(self, field: xr.Dataset, run: Run) -> dict[str, LibraryCase]:
        """The libraries without those of quantities that a field lacks; all, if none is left.

        A name that is no known quantity stays, to be refused.
        """
        lacking = {
            name: [each for each in case.variables if each in KNOWN_UNITS and each not in field]
            for name, case in self.libraries.items()
        }
        if all(lacking.values()):
            return dict(self.libraries)
        for name, variables in lacking.items():
            if variables:
                run.say(f"the library {name} is left out: the data have no {', '.join(variables)}")
        return {name: case for name, case in self.libraries.items() if not lacking[name]}

    def _result(
        self,
        runs: Sequence[Trajectory],
        name: str,
        library: Library,
        method: AnyMethod,
        zones: Zones,
        *,
        rng: np.random.Generator,
        progress: Progress,
    ) -> LibraryResult:
        """Discovery of one library in all records; free runs of its model and the published one.

        Both run over the first record, the discovered model over the others, too. A model that
        lives is searched for in the first one.
        """
        s, measured = self.rollout_s, runs[0]
        barred = {state: list(map(str, names)) for state, names in (self.exclude or {}).items()}
        found = discover(
            list(runs), library, method, hidden=self.hidden, relations=self.relations,
            exclude=barred, roles=self.roles, seed=rng, progress=progress,
        )  # fmt: skip
        runs = runs if found.estimate is None else found.estimate.runs
        first, *others = [(run, run.n_samples if s is None else samples_in(run, s)) for run in runs]
        data, n_samples = first
        published = self.thesis.get(name, {})
        rows = Regression(self.formulation, bootstraps=self.bootstraps)
        refitted = refit(found, published, rows, runs, rng)
        lives = beside = None
        if self.living is not None and not found.model.inputs:
            lives, beside = self._lives(
                data, library, rows, found.model, zones, rng=rng, progress=progress
            )
        skill = skill_of(
            found.model if lives is None else lives.model, measured, starts=self.forecasts,
            n_fitted=n_before(measured, self.held_out or HELD_OUT), progress=progress,
        )  # fmt: skip
        with progress.stage(None, "", "free runs"):
            return LibraryResult(
                discovery=found,
                selected=evaluate(found.model, data, n_samples=n_samples),
                given=published,
                refitted=refitted,
                published=run_refitted(found, refitted, data, n_samples),
                living=lives,
                balance=beside,
                elsewhere=[evaluate(found.model, run, n_samples=n) for run, n in others],
                skill=skill,
            )

    def _lives(
        self,
        data: Trajectory,
        library: Library,
        rows: Regression,
        selected: SparseModel,
        zones: Zones,
        *,
        rng: np.random.Generator,
        progress: Progress,
    ) -> tuple[Living, ModelBalance]:
        """A model that lives, and the balance of its zones beside it."""
        assert self.living is not None
        parts = split_in_time(data, self.held_out or HELD_OUT)
        lives = living_model(
            *parts, library, rows, self.living, selected, zones, rng=rng, progress=progress
        )
        beside = model_balance(
            lives.model, lives.discovery.constraint, data, *parts, zones, self.living.bounds,
            period_s=None if lives.cycle is None else lives.cycle.period_s, progress=progress,
        )  # fmt: skip
        return lives, beside


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
            f"functions may name one of your own as MODULE.NAME: {text!r} came, and {error}; the "
            "module must lie below the folder that you start in"
        ) from error
    if name not in function_names():
        raise ValueError(
            f"{module} must register {name!r} when it is imported, by "
            f"ep.register_function({name!r}, value, derivative): it has not"
        )
    return name + (found["argument"] or "")


@dataclass(frozen=True, eq=False)
class Outcome:
    """The discoveries of all libraries in the same data.

    files: names of all records; data is the first of them. smoother: gives the data's derivative.
    """

    data: Trajectory
    results: Mapping[str, LibraryResult]
    shown: PlotRange
    smoother: Smoother | None
    files: Sequence[str] = ()

    @property
    def published(self) -> dict[str, Evaluation]:
        """Free runs of the models of published terms, if these could be fitted to our data."""
        return {n: r.published for n, r in self.results.items() if r.published is not None}

    @property
    def selected(self) -> dict[str, Evaluation]:
        return {name: result.selected for name, result in self.results.items()}

    @property
    def living(self) -> dict[str, Living]:
        """The living models that were searched for, by library."""
        return {n: r.living for n, r in self.results.items() if r.living is not None}

    @property
    def skills(self) -> dict[str, ForecastSkill]:
        return {n: r.skill for n, r in self.results.items() if r.skill is not None}

    def models(self) -> dict[str, SparseModel]:
        found = {name: result.discovery.model for name, result in self.results.items()}
        return found | {f"{name}_living": each.model for name, each in self.living.items()}

    def tables(self) -> dict[str, pd.DataFrame]:
        found: dict[str, pd.DataFrame] = {}
        for name, result in self.results.items():
            found |= result.front_tables(name)
        published = {f"{name}_thesis_terms": each for name, each in self.published.items()}
        found |= rollout_tables(self.data, self.selected | published)
        for name, result in self.results.items():
            if result.balance is not None:
                found |= result.balance.tables(name)
        for name, skill in self.skills.items():
            found[f"forecast_{name}"] = forecast_errors(skill)
        found |= living_tables(self.living) | {"comparison": self.comparison.csv("model")}
        return found | ({"records": self.records.csv()} if len(self.files) > 1 else {})

    @property
    def comparison(self) -> ResultTable[Evaluation]:
        """One row per model: frequencies, trajectory error, and the verdict on the trajectory."""
        published = {f"{name}, thesis's terms": each for name, each in self.published.items()}
        return ResultTable(self.selected | published, frequencies(self.data))

    @property
    def records(self) -> ResultTable[tuple[str, str, Evaluation]]:
        """One row per model and record."""
        runs = [
            (name, file, each)
            for name, result in self.results.items()
            for file, each in zip(self.files, result.runs, strict=True)
        ]
        return ResultTable(runs, RECORDS)

    def figures(self) -> dict[str, Captioned]:
        drawn = run_figures(FIGURES, self.data, self.selected, self.shown, smoother=self.smoother)
        if self.published:
            drawn["trajectories_thesis"] = trajectories(
                self.data, self.published, self.shown, THESIS
            )
        for name, result in self.results.items():
            found = result.discovery
            front = partial(front_figure, found.fronts, label=result.label)
            has_rows = any(each.has_errors for each in found.fronts.values())
            drawn[f"front_{name}"] = Captioned(front, FRONT if has_rows else SCORED)
        for name, living in self.living.items():
            drawn |= living.figures(name)
        for name, result in self.results.items():
            drawn |= result.balance.figures(name) if result.balance is not None else {}
        skills = self.skills.items()
        return drawn | {f"forecast_{name}": forecast_picture(self.data, s) for name, s in skills}

    def in_short(self) -> Result:
        """The living model, or the best of those that were run; and what its rows leave over."""
        runs = {name: each.run for name, each in self.living.items()}
        runs = runs or {name: worst_run(each.runs) for name, each in self.results.items()}
        best = best_run(runs)
        is_living = bool(self.living)
        records = f"the worst of {len(self.files)} records" if len(self.files) > 1 else "the record"
        shown = [f"free_run_{best}", "trajectories", *(drawn := self.figures())]
        return found_model(
            f"Found with the library {best}",
            runs[best],
            file=f"{best}_living" if is_living else best,
            picture=next((name for name in shown if name in drawn), ""),
            more=self._cautions(best) if is_living else [],
            where="held-out time" if is_living else records,
            seen=not is_living,
            misfit="" if is_living else self.results[best].discovery.misfit,
            held=self.living[best].discovery.constraint if is_living else None,
        )

    def _cautions(self, best: str) -> list[Block]:
        """A neutral cycle of the living model, and what fits of derivatives leave beyond noise."""
        tests = [result.discovery.noise_test for result in self.results.values()]
        caution = self.living[best].run.caution
        return [*([Text(caution, warning=True)] if caution else []), *left_over_of_all(tests)]

    def sections(self) -> list[Section]:
        found = [self._of_all()]
        for name, result in self.results.items():
            found += result.sections(name, self.data)
        for name, result in self.results.items():
            if result.living is not None:
                found.append(result.living.section(name))
            if result.balance is not None:
                found.append(result.balance.section(name))
            if result.skill is not None:
                where = "that it has seen" if result.living is None else "held out"
                title = f"{name}: forecasts over time {where}"
                found.append(forecast_section(result.skill, f"forecast_{name}", title=title))
        note = FROM_DERIVATIVES if self.living else ""
        rows = self.comparison.screen("model", by_state=True)
        compared: list[Block] = [Table(rows, title=INTEGRATED, note=note), *pictures(FIGURES)]
        found.append(Section("Run freely from the first sample", compared))
        if len(self.files) > 1:
            found.append(Section("Every record", [Table(self.records.screen(), EVERY_RECORD)]))
        return found

    def _of_all(self) -> Section:
        """The equations of all libraries and how they run, page only."""
        blocks: list[Block] = []
        for name, result in self.results.items():
            living, clock = result.living, self.data.clock
            run = result.selected if living is None else living.run
            text = f"{name}: equations {result.how}; run freely: {run.text}"
            blocks.append(Text(text, page_only=True))
            held = None if living is None else living.discovery.constraint
            shown = partial(display_equation, run.model, clock=clock, held=held, on_screen=False)
            blocks += [shown(state) for state in run.model.states]
            if living is None:
                blocks += interval_table(run.model, clock=clock, page_only=True)
        return Section("All libraries", blocks)

    def summary(self) -> dict[str, Any]:
        models = {name: result.summary() for name, result in self.results.items()}
        return {"data": data_summary(self.data), "models": models}

    def headline(self) -> dict[str, float]:
        living = {f"{name}/living": each for name, each in self.living.items()}
        scalars: dict[str, float] = {}
        for name, result in self.results.items():
            scalars |= result.headline(name)
        return scalars | ResultTable(living, LIVING).headline()
