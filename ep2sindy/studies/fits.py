"""Fits of known structures, side by side: `+exp=weak`, `constrained`, `ils` and `theories`.

A config names structures, and the ways in which their coefficients are found. Every model is then
run freely over the same part of a record.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import count, product
from time import process_time
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import ConstantStateError, Trajectory
from ep2sindy.figures.fits import loss_against_window_figure, sustained_figure
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint
from ep2sindy.model.comparison import Status, samples_in
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.windows import MIN_SAMPLES
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.document import Result, Text
from ep2sindy.report.models import equations, interval_table
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, Metrics, ResultTable, View
from ep2sindy.runtime.progress import count_pieces
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.fitted import (
    FITTED,
    SEVERAL,
    SEVERAL_NOTE,
    STARTED,
    FirstModel,
    Fit,
    Fitted,
    RecordParts,
    Way,
    count_words,
    first_model,
    fitted_start,
    n_sustained,
    ways_of,
    worst_amplitude,
    wrong_signs,
)
from ep2sindy.studies.point_sources import Points, given_points
from ep2sindy.studies.processes import Zones
from ep2sindy.studies.source import DivergedError, Source, split_in_time, zones_of
from ep2sindy.studies.structures import Structures
from ep2sindy.studies.study import Count, Fraction, Positive, PositiveOrAll, ZeroOrMore
from ep2sindy.studies.views import (
    PlotRange,
    add_figures,
    add_samples,
    best_run,
    found_model,
)

if TYPE_CHECKING:
    from ep2sindy.refinement.problem import Iteration
    from ep2sindy.refinement.refine import Refinement

INTERVALS = (
    "The intervals say how far noise, or the residuals of windows, move the coefficients if these "
    "terms are the whole law; what the terms lack, they do not count."
)
NOTE = (
    "Amplitude: standard deviation against the data's. In files, started: from a start fitted to "
    "the first one and a half periods, since a single sample may lie off every orbit of the model; "
    "r2: of the derivative, on the rows of the fit, which windows average."
)
WINDOWS_CAPTION = (
    "Refinement with windows of several lengths: loss on the fitted part, where each window has a "
    "start of its own; frequency error and nrmse of the run, from its first sample (full) "
    "and from a fitted start (dashed). The dotted line marks one period, the grey one 1 %."
)
POINTS_NOTE = (
    f"{SEVERAL_NOTE} Signs wrong: terms whose sign contradicts the recorded balance of the same "
    "process, and at how many points."
)
POINTS_CAPTION = (
    "What becomes of every model, run freely from one sample at every operating point, by the way "
    "its coefficients were found. Colour: error of the amplitude of the state that is farthest off."
)
BEST = "of {} fits, the one that runs best: by its status, and then by its distance to the data"
FIGURES = ("trajectories", "phase")


@dataclass(frozen=True)
class Study:
    """Fit structures of models in several ways, run every model freely, and compare them.

    models: structures by name. fits: the ways of fitting, by name. forms: forms of the regression
    besides the formulation, by name. held_out: fraction at the end of the record over which models
    run; None fits and runs over all of it. rollout_s: longest run; None means to the end.
    n_windows, periods, window, n_reweights: of refinements, see `RefinementSettings`. windows:
    lengths for loss against window length. n_draws: number of draws of windows, for the spread of
    the refinements. points: operating points, at each of which all is fitted; None for one record.
    parameters: their places in the data group; labels: their names in figures.
    """

    source: Source
    formulation: Formulation
    models: Structures
    fits: Mapping[str, Fit]
    figures: PlotRange
    forms: Mapping[str, Formulation] = field(default_factory=dict)
    held_out: Fraction | None = None
    rollout_s: PositiveOrAll = None
    n_windows: Count = 30
    periods: Positive = 2.0
    window: Count | None = None
    n_reweights: ZeroOrMore = 1
    windows: Sequence[int] = ()
    n_draws: ZeroOrMore = 0
    points: Points | None = None
    parameters: Mapping[str, str | None] = field(default_factory=dict)
    labels: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _ = self._ways, self._libraries
        for name, structure in self.models.items():
            if unknown := {*(structure.fits or ())} - {*self.fits}:
                raise ValueError(
                    f"models.{name}.fits must name some of {list(self.fits)}: got {sorted(unknown)}"
                )

    @cached_property
    def _ways(self) -> list[Way]:
        return ways_of(self.fits, self.forms, self.formulation)

    @cached_property
    def _libraries(self) -> dict[str, Library]:
        states = self.source.states
        return {name: each.library(name, states) for name, each in self.models.items()}

    def run(self, report: Report) -> None:
        if self.points is not None:
            at_points = {r.data.label: self._fit_all(r, report) for r in self._records(report)}
            add_points(at_points, self.labels, report)
            return
        field, data = self.source.opened(self._libraries.values(), report)
        record = self._parted(data, zones_of(self.source, field, report))
        report.summary["data"]["n_held_out"] = record.held.n_samples if self.held_out else 0
        fits = self._fit_all(record, report)
        self._add_fits(fits, record, report)
        refined = {name: each for name, each in fits.items() if each.refinement}
        if self.windows and refined:
            self._add_windows(refined, record, report)
        if self.n_draws and refined:
            self._add_draws(refined, record, report)

    def _records(self, report: Report) -> Iterator[RecordParts]:
        """The record of every operating point that has one."""
        assert self.points is not None
        given = given_points(self.points, self.parameters, self.source)
        if given.left_out:
            report.say(f"left out, for their names hold no number: {', '.join(given.left_out)}")
        inputs = self.source.inputs(self._libraries.values())
        for point in count_pieces(report.watch, given.sources, "operating point"):
            try:
                field = point.source.field()
                data = point.run(field, inputs)
            except (ConstantStateError, DivergedError) as error:
                report.warn(f"{point.label} is left out: {error}")
                continue
            yield self._parted(data, zones_of(point.source, field, report))

    def _parted(self, data: Trajectory, zones: Zones) -> RecordParts:
        parts = (data, data) if self.held_out is None else split_in_time(data, self.held_out)
        asked = {"window": [self.window or MIN_SAMPLES], "windows": self.windows}
        for key, lengths in asked.items():
            for length in lengths:
                if not MIN_SAMPLES <= length <= parts[0].n_samples:
                    raise ValueError(
                        f"{key} must hold {MIN_SAMPLES} samples or more and fit the first part of "
                        f"the data, {parts[0].n_samples} samples: got {length}"
                    )
        return RecordParts(data, *parts, zones)

    def _fit_all(self, record: RecordParts, report: Report) -> dict[str, Fitted]:
        """Every structure in every way that it takes part in, by name.

        The fits of one structure have the same random numbers, so that they differ by the way
        alone.
        """
        streams = np.random.default_rng(report.seed).spawn(len(self.models))
        seeds = {n: int(each.integers(2**63)) for n, each in zip(self.models, streams, strict=True)}
        pieces = [
            (name, way)
            for (name, structure), way in product(self.models.items(), self._ways)
            if structure.fits is None or way.name in structure.fits
        ]
        found = {}
        for name, way in count_pieces(report.watch, pieces, "fit", record.data.label):
            title = way.name if len(self.models) == 1 else f"{name}_{way.name}"
            found[title] = self._fit(name, way, seeds[name], record, report, title)
        return found

    def _fit(
        self, name: str, way: Way, seed: int, record: RecordParts, report: Report, title: str
    ) -> Fitted:
        structure, begun = self.models[name], process_time()
        first = first_model(structure, self._libraries[name], way, record, seed=seed)
        model, refinement = first.model, None
        if way.fit.refine and first.held_to is not None:
            begun = process_time()
            watch = watcher(report.board.scalars, title, first.held_to)
            refinement = self._refine(first, record, report, watch=watch)
            model = refinement.model
        cpu_s = process_time() - begun
        runs = self._evaluate(model, record), self._evaluate(model, record, started=True)
        wrong = wrong_signs(model, first.held_to, record)
        return Fitted(name, structure, way, first, model, *runs, cpu_s, refinement, wrong)

    def _refine(
        self,
        first: FirstModel,
        record: RecordParts,
        report: Report,
        *,
        window: int | None = None,
        seed: int = 0,
        watch: Callable[[Iteration], None] | None = None,
    ) -> Refinement:
        """Follow trajectories. window: in samples, in place of the study's."""
        from ep2sindy.refinement.refine import refine  # PyTorch takes seconds to load

        window = window or self.window
        return refine(
            first.model, [record.train], n_windows=self.n_windows, window=window,
            periods=self.periods if window is None else None, constraint=first.held_to,
            n_reweights=self.n_reweights, seed=seed, callback=watch, progress=report.watch,
        )  # fmt: skip

    def _evaluate(
        self, model: SparseModel, record: RecordParts, *, started: bool = False
    ) -> Evaluation:
        """The free run over the held-out part, from its first sample or from a fitted start."""
        held = record.held
        initial = fitted_start(model, held) if started else None
        n = None if self.rollout_s is None else samples_in(held, self.rollout_s)
        return evaluate(model, held, initial=initial, n_samples=n)

    def _add_fits(self, fits: Mapping[str, Fitted], record: RecordParts, report: Report) -> None:
        """The runs of all models, their equations, and the best of them."""
        held, clock = record.held, record.held.clock
        f_Hz = dominant_frequency(held.t, held.states[:, 0])
        where = "held-out time" if self.held_out else "the record"
        since = f"time since start of {'held-out part' if self.held_out else 'record'}"
        report.section(f"Run freely over {where}")
        report.table(
            "fits",
            ResultTable(fits, FITTED),
            heading="fit",
            title="from the first sample (nrmse 1: no better than a constant)",
            note=f"The data have {clock.frequency_text(f_Hz)}. {NOTE}",
        )
        runs = {name: each.from_sample for name, each in fits.items()}
        draw = partial(add_figures, report, data=held, shown=self.figures, since=since)
        draw(FIGURES, runs=runs)
        add_samples(report, held, runs)
        started = {name: each.from_fit for name, each in fits.items()}
        draw(["trajectories"], runs=started, suffix=STARTED)
        relations = dict.fromkeys(t for each in self.models.values() for t in each.relations)
        report.section("Equations", *(f"relation: {text}" for text in relations))
        if any(each.model.covariance is not None for each in fits.values()):
            report.add(Text(INTERVALS, page_only=True))
        for name, each in fits.items():
            held_to = each.first.held_to
            report.section(name, *equations(each.model, clock, held=held_to), level=3)
            report.add(*interval_table(each.model, clock, page_only=True))
            report.model(name, each.model, held=held_to, shown=False)
        best = best_run(runs)
        report.found(
            found_model(
                best, runs[best], file=best, picture="trajectories",
                more=[Text(BEST.format(len(fits)))], where=where, seen=not self.held_out,
                held=fits[best].first.held_to,
            )
        )  # fmt: skip

    def _add_windows(self, fits: Mapping[str, Fitted], record: RecordParts, report: Report) -> None:
        """Loss, and how the models run, against the length of windows."""
        train = record.train
        period = 1.0 / (dominant_frequency(train.t, train.states[:, 0]) * train.dt_s)
        rows = []
        for name, each in fits.items():
            for length in count_pieces(report.watch, self.windows, "window length", name):
                found = self._refine(each.first, record, report, window=length)
                row: dict[str, Any] = {
                    "fit": name,
                    "window": length,
                    "loss": found.loss,
                    "status": str(found.status),
                }
                for end in ("", STARTED):
                    run = self._evaluate(found.model, record, started=bool(end))
                    row |= {f"f_error{end}": run.f_error, f"nrmse{end}": run.nrmse}
                rows.append(row)
        table = pd.DataFrame(rows)
        report.section("Loss against window length")
        report.table("loss_against_window", table, shown=False)
        draw = partial(loss_against_window_figure, table, period=period)
        report.figure("loss_against_window", draw, WINDOWS_CAPTION)

    def _add_draws(self, fits: Mapping[str, Fitted], record: RecordParts, report: Report) -> None:
        """How far the runs from the first sample depend on the draw of windows."""
        draws = {}
        for name, each in fits.items():
            seeds = count_pieces(report.watch, range(self.n_draws), "draw", name)
            refinements = [self._refine(each.first, record, report, seed=seed) for seed in seeds]
            draws[name] = [self._evaluate(found.model, record) for found in refinements]
        report.section(f"Over {self.n_draws} draws of windows")
        report.table(
            "spread",
            ResultTable(draws, SEVERAL),
            heading="fit",
            note=SEVERAL_NOTE,
        )


def watcher(
    tell: Callable[..., None], name: str, constraint: Constraint
) -> Callable[[Iteration], None]:
    """A callback that logs every iteration of a refinement as scalars; the step is its number.

    At step zero are the scalings before the first iteration, which are one.
    """
    free = [constraint.coefficients[k] for k in constraint.free]
    names = [f"{name}/scaling/{state}/{term.replace('*', '.')}" for state, term in free]
    tell(dict.fromkeys(names, 1.0), step=0)
    steps = count(1)

    def watch(iteration: Iteration) -> None:
        scalars = {
            f"{name}/loss": iteration.loss,
            f"{name}/step": iteration.step,
            f"{name}/defect": iteration.defect,
            f"{name}/window_stage": iteration.memory,
        }
        scalars |= dict(zip(names, iteration.scaling.tolist(), strict=True))
        tell(scalars, step=next(steps))

    return watch


def _runs(fits: Sequence[Fitted]) -> list[Evaluation]:
    return [fit.from_sample for fit in fits]


AT_POINTS: Metrics[Sequence[Fitted]] = [
    Metric("n_free", lambda fits: max(fit.n_free for fit in fits), View.SHOWN, "free"),
    *(metric.of(_runs) for metric in SEVERAL),
    Metric(
        "wrong_signs", lambda fits: count_words([t for fit in fits for t in fit.wrong], "; "),
        View.SHOWN, "signs wrong",
    ),
    Metric("source", lambda fits: fits[0].structure.source),
]  # fmt: skip


def add_points(
    found: Mapping[str, Mapping[str, Fitted]], labels: Mapping[str, str], report: Report
) -> None:
    """Every fit over all points, and the models of each point.

    found: by point, then by fit. labels: of parameters, for the figure.
    Raises ValueError if no point has a record.
    """
    if not found:
        raise ValueError("structures need a record to be fitted to: no operating point has one")
    first = next(iter(found.values()))
    over = {name: [fits[name] for fits in found.values()] for name in first}
    sources = {fit.name: fit.structure.source for fit in first.values()}
    report.section(f"{len(over)} fits at {len(found)} operating points")
    draw = partial(sustained_figure, _rows(found), labels=labels)
    report.figure("sustained", draw, POINTS_CAPTION)
    report.table("over_points", ResultTable(over, AT_POINTS), heading="fit", note=POINTS_NOTE)
    report.section("Structures", *(f"{key}: {text}" for key, text in sources.items() if text))
    rows = {f"{n}, {p}": fit for n in over for p, fit in zip(found, over[n], strict=True)}
    report.section("Every point")
    report.table("fits", ResultTable(rows, FITTED), heading="fit", page_only=True)
    for number, (point, fits) in enumerate(found.items()):
        report.section(point, level=3)
        for name, fit in fits.items():
            held_to = fit.first.held_to
            report.add(*equations(fit.model, held=held_to, lead=name, on_screen=False))
            report.model(f"{name}_{number}", fit.model, held=held_to, shown=False)
    counts = {name: n_sustained(_runs(fits)) for name, fits in over.items()}
    lines = [
        Text(f"fits that sustain it at {n} of {len(found)} points: {', '.join(names)}")
        for n in range(len(found), 0, -1)
        if (names := [name for name, count in counts.items() if count == n])
    ]
    structures = {over[name][0].name for name, n in counts.items() if n == len(found)}
    report.found(
        Result(
            f"{len(structures)} of {len(sources)} structures sustain the oscillation at all "
            f"{len(found)} points",
            lines or [Text("no fit sustains the oscillation at any point")],
            load='pandas.read_csv("{}/tables/over_points.csv")',
            picture="sustained",
        )
    )


def _rows(found: Mapping[str, Mapping[str, Fitted]]) -> pd.DataFrame:
    """One row per structure, way and point: what the figure draws."""
    rows = [
        (fit.name, fit.way.name, point,
         str(Status.SUSTAINED if fit.from_sample.holds else fit.from_sample.status),
         abs(worst_amplitude(fit.from_sample) - 1.0))
        for point, fits in found.items()
        for fit in fits.values()
    ]  # fmt: skip
    return pd.DataFrame(rows, columns=["structure", "way", "point", "status", "amplitude_error"])
