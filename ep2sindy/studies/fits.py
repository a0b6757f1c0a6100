"""Fits of known structures, side by side: `+exp=weak`, `constrained`, `ils` and `theories`.

A config names structures, and the ways in which their coefficients are found. Every model is then
run freely over the same part of a record.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import count, product
from time import process_time
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.optimize import least_squares

from ep2sindy.data.trajectory import ConstantStateError, Trajectory, point_label
from ep2sindy.figures.windows import loss_against_window_figure
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint
from ep2sindy.model.comparison import Status, samples_in
from ep2sindy.model.model import SparseModel
from ep2sindy.model.scores import r2
from ep2sindy.refinement.windows import MIN_SAMPLES, dominant_window
from ep2sindy.regression.constrained import constrained_fit
from ep2sindy.regression.formulations import Weak
from ep2sindy.regression.rows import Formulation, RegressionRows
from ep2sindy.regression.windows import Boxes
from ep2sindy.report.document import Result, Text
from ep2sindy.report.models import equations, interval_table
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, percent
from ep2sindy.runtime.progress import count_pieces
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.point_sources import Points, given_points
from ep2sindy.studies.processes import compared_processes
from ep2sindy.studies.source import NO_ZONES, DivergedError, Source, Zones, split_in_time, zones_of
from ep2sindy.studies.structures import Structure, Structures, balance_model
from ep2sindy.studies.study import (
    Check,
    Count,
    CountOrNone,
    Positive,
    PositiveOrAll,
    ShareOrNone,
)
from ep2sindy.studies.views import (
    EVALUATION,
    PlotRange,
    add_figures,
    add_samples,
    best_run,
    found_model,
)

if TYPE_CHECKING:
    from ep2sindy.refinement.problem import Iteration, RefinementSettings
    from ep2sindy.refinement.refine import Refinement

BALANCE = "balance"  # the form of a fit of every process to the recorded balance
DIVERGED = 10.0  # residual, in std, at samples that a run diverges before
STARTED = "_started"
INTERVALS = (
    "The intervals say how far noise, or the residuals of windows, move the coefficients if these "
    "terms are the whole law; what the terms lack, they do not count."
)
NOTE = (
    "Amplitude: standard deviation against the data's. In files, started: from a start fitted to the "
    "first one and a half periods, since a single sample may lie off every orbit of the model; r2: "
    "of the derivative, on the rows of the fit, which windows average."
)
CAPTION = (
    "Refinement with windows of several lengths: loss on the fitted part, where each window has a "
    "start of its own; frequency error and nrmse of the run, from its first sample (full) "
    "and from a fitted start (dashed). The dotted line marks one period, the grey one 1 %."
)
FIGURES = ("trajectories", "phase", "spectra")

Whole = Annotated[int, Check("a whole number, zero or more", lambda x: type(x) is int and x >= 0)]


@dataclass(frozen=True)
class Fit:
    """A way of finding coefficients.

    form: of the regression, one of those that the config names; None means the formulation;
    "balance" fits every process to the rate that a simulation records. relations: whether those of
    a structure hold. refine: whether trajectories are followed then. n_points, n_windows: of random
    windows, for a form that has them; every combination is a fit of its own, `n_points_70`.
    """

    form: str | None = None
    relations: bool = True
    refine: bool = False
    n_points: Sequence[int] = ()
    n_windows: Sequence[int] = ()


def expand(
    fits: Mapping[str, Fit], forms: Mapping[str, Formulation], usual: Formulation
) -> dict[str, tuple[Fit, Formulation | None]]:
    """Every fit with its form, one for each number and length of windows; None for the balance.

    Raises ValueError for a form that is not named, or without random windows where such are asked.
    """
    found: dict[str, tuple[Fit, Formulation | None]] = {}
    for name, fit in fits.items():
        if fit.form not in (None, BALANCE, *forms):
            raise ValueError(
                f"fits.{name}.form must be null, {BALANCE} or one of {list(forms)}: got {fit.form!r}"
            )
        form = usual if fit.form is None else forms.get(fit.form)
        if not fit.n_points:
            found[name] = fit, form
            continue
        if not (isinstance(form, Weak) and isinstance(form.test_functions, Boxes)):
            raise ValueError(
                f"fits.{name}.n_points is for a form of random windows (Weak with Boxes): got {form}"
            )
        own = form.test_functions
        for n_windows, n_points in product(fit.n_windows or [own.n_windows], fit.n_points):
            boxes = replace(own, n_points=n_points, n_windows=n_windows)
            varying = {"n_windows": n_windows} if len(fit.n_windows) > 1 else {}
            words = (f"{key}_{value}" for key, value in (varying | {"n_points": n_points}).items())
            found["_".join(words)] = fit, replace(form, test_functions=boxes)
    return found


@dataclass(frozen=True, eq=False)
class Record:
    """A record to fit: at a point, if there are several; its parts; and what its zones tell."""

    label: str
    data: Trajectory
    train: Trajectory
    held: Trajectory
    zones: Zones = NO_ZONES

    @cached_property
    def period_s(self) -> float:
        return 1.0 / dominant_frequency(self.train.t, self.train.states[:, 0])


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model of one structure, fitted in one way, and its free runs over the same samples.

    from_sample: from the first sample. from_fit: from a start fitted to the first samples. cpu_s:
    of the fit, without that of the model which it starts from. r2: of the derivative, by state, on
    the rows of the fit. refinement: how trajectories were followed, if they were. wrong: the terms
    whose sign contradicts the recorded balance.
    """

    model: SparseModel
    held_to: Constraint | None
    from_sample: Evaluation
    from_fit: Evaluation
    cpu_s: float
    r2: Mapping[str, float]
    refinement: Refinement | None = None
    wrong: Sequence[str] = ()

    @property
    def n_free(self) -> int:
        return 0 if self.held_to is None else len(self.held_to.free)


@dataclass(frozen=True)
class Study:
    """Fit structures of models in several ways, run every model freely, and compare them.

    models: structures by name. fits: the ways of fitting, by name. forms: forms of the regression
    besides the formulation, by name. held_out: share at the end of the record over which models
    run; None fits and runs over all of it. rollout_s: longest run; None means to the end.
    n_windows, periods, window, n_reweights: of refinements, see `ep.RefinementSettings`. windows:
    lengths for loss against window length. n_draws: number of draws of windows, for the spread of
    the refinements.
    points: operating points, at each of which all is fitted; None for one record. parameters: their
    places in the data group. thesis: published coefficients, shown beside ours.
    """

    source: Source
    formulation: Formulation
    models: Structures
    fits: Mapping[str, Fit]
    figures: PlotRange
    forms: Mapping[str, Formulation] = field(default_factory=dict)
    held_out: ShareOrNone = None
    rollout_s: PositiveOrAll = None
    n_windows: Count = 30
    periods: Positive = 2.0
    window: CountOrNone = None
    n_reweights: Whole = 1
    windows: Sequence[int] = ()
    n_draws: Whole = 0
    points: Points | None = None
    parameters: Mapping[str, str | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _ = self._ways
        for name, structure in self.models.items():
            structure.library(name, self.source.states)
            if unknown := {*(structure.fits or ())} - {*self.fits}:
                raise ValueError(
                    f"models.{name}.fits must name some of {list(self.fits)}: got {sorted(unknown)}"
                )

    @cached_property
    def _ways(self) -> dict[str, tuple[Fit, Formulation | None]]:
        return expand(self.fits, self.forms, self.formulation)

    def run(self, report: Report) -> None:
        libraries = {n: s.library(n, self.source.states) for n, s in self.models.items()}
        found = [
            (record, dict(self._fit_all(record, libraries, report)))
            for record in self._records(libraries, report)
        ]
        if self.points is None:
            self._add_one(*found[0], libraries, report)
        else:
            add_points({record.label: fits for record, fits in found}, self.models, report)

    def _records(self, libraries: Mapping[str, Library], report: Report) -> Iterator[Record]:
        """The record, or one at every operating point."""
        if self.points is None:
            field, data = self.source.opened(libraries.values(), report)
            yield self._parted("", data, zones_of(self.source, field, report))
            return
        given = given_points(self.points, self.parameters, self.source)
        inputs = self.source.inputs(libraries.values())
        for point in count_pieces(report.watch, given.sources(self.source), "operating point"):
            label, sampling = point_label(point.parameters), point.source.trajectory
            try:
                field = point.source.field()
                data = sampling.trajectory(field, inputs=inputs, label=label)
                data = replace(data, parameters=point.parameters)
                record = self._parted(label, data, zones_of(point.source, field, report))
            except (ConstantStateError, DivergedError) as error:
                report.warn(f"{label} is left out: {error}")
                continue
            yield record

    def _parted(self, label: str, data: Trajectory, zones: Zones) -> Record:
        parts = (data, data) if self.held_out is None else split_in_time(data, self.held_out)
        record = Record(label, data, *parts, zones)
        asked = {"window": [self.window or MIN_SAMPLES], "windows": self.windows}
        for key, lengths in asked.items():
            for length in lengths:
                if not MIN_SAMPLES <= length <= record.train.n_samples:
                    raise ValueError(
                        f"{key} must hold {MIN_SAMPLES} samples or more and fit the first part of "
                        f"the data, {record.train.n_samples} samples: got {length}"
                    )
        return record

    def _fit_all(
        self, record: Record, libraries: Mapping[str, Library], report: Report
    ) -> Iterator[tuple[str, Fitted]]:
        """Every structure in every way that it takes part in.

        The fits of one structure have the same random numbers, so that they differ by the way
        alone.
        """
        streams = np.random.default_rng(report.seed).spawn(len(self.models))
        seeds = {n: int(each.integers(2**63)) for n, each in zip(self.models, streams, strict=True)}
        pieces = [
            (name, way)
            for (name, structure), way in product(self.models.items(), self._ways)
            if structure.fits is None or self._is_of(way, structure.fits)
        ]
        for name, way in count_pieces(report.watch, pieces, "fit", record.label):
            structure, title = self.models[name], name_of(name, way, self.models)
            one = OneFit(self, structure, libraries[name], *self._ways[way], seeds[name])
            yield title, one.fitted(record, report, title)

    def _is_of(self, way: str, fits: Sequence[str]) -> bool:
        return any(self._ways[way][0] is self.fits[name] for name in fits)

    def settings(self, constraint: Constraint) -> RefinementSettings:
        from ep2sindy.refinement.problem import RefinementSettings  # PyTorch takes seconds to load

        periods = self.periods if self.window is None else None
        return RefinementSettings(
            self.n_windows, self.window, periods, constraint=constraint,
            n_reweights=self.n_reweights,
        )  # fmt: skip

    def evaluate(self, model: SparseModel, record: Record) -> tuple[Evaluation, Evaluation]:
        """Free runs over the held-out part, from its first sample and from a fitted start."""
        held = record.held
        n = held.n_samples if self.rollout_s is None else samples_in(held, self.rollout_s)
        run = partial(evaluate, model, held, n_samples=n)
        return run(), run(initial=fitted_start(model, held))

    def _add_one(
        self,
        record: Record,
        fits: Mapping[str, Fitted],
        libraries: Mapping[str, Library],
        report: Report,
    ) -> None:
        """Everything on the fits of one record."""
        held, clock = record.held, record.held.clock
        report.summary["data"]["n_held_out"] = held.n_samples if self.held_out else 0
        f_Hz = dominant_frequency(held.t, held.states[:, 0])
        where = "held-out time" if self.held_out else "the record"
        report.section(f"Run freely over {where}")
        report.table(
            "fits",
            ResultTable(fits, METHOD),
            heading="fit",
            title="from the first sample (nrmse 1: no better than a constant)",
            note=f"The data have {clock.frequency_text(f_Hz)}. {NOTE}",
        )
        runs = {name: each.from_sample for name, each in fits.items()}
        add_figures(report, FIGURES, held, runs, self.figures)
        add_samples(report, held, runs)
        started = {name: each.from_fit for name, each in fits.items()}
        add_figures(report, ["trajectories"], held, started, self.figures, suffix=STARTED)
        relations = dict.fromkeys(t for each in self.models.values() for t in each.relations)
        report.section("Equations", *(f"relation: {text}" for text in relations))
        if any(each.model.covariance is not None for each in fits.values()):
            report.add(Text(INTERVALS, page_only=True))
        for name, each in fits.items():
            report.section(name, *equations(each.model, clock), level=3)
            report.add(*interval_table(each.model, clock, page_only=True))
            report.model(name, each.model, shown=False)
        self._add_windows(record, libraries, report)
        best = best_run(runs)
        report.found(
            found_model(
                f"Found by the fit {best}", runs[best], file=best, picture="trajectories",
                more=[Text(f"the best of {len(fits)} fits")], where=where, seen=not self.held_out,
            )
        )  # fmt: skip

    def _add_windows(
        self, record: Record, libraries: Mapping[str, Library], report: Report
    ) -> None:
        """Loss against the length of windows, and how far results depend on their draw."""
        refined = {w: way for w, way in self._ways.items() if way[0].refine}
        pairs = list(product(self.models.items(), refined.items()))
        ones = {
            name_of(name, way, self.models): OneFit(self, structure, libraries[name], *how, 0)
            for (name, structure), (way, how) in pairs
            if structure.fits is None or self._is_of(way, structure.fits)
        }
        if self.windows and ones:
            rows = [
                {"fit": name, "window": length, **one.with_window(record, length, report)}
                for name, one in ones.items()
                for length in count_pieces(report.watch, self.windows, "window length", name)
            ]
            table = pd.DataFrame(rows)
            period = record.period_s / record.train.dt_s
            table.insert(2, "periods", (table["window"] - 1) / period)
            report.section("Loss against window length")
            report.table("loss_against_window", table, shown=False)
            draw = partial(loss_against_window_figure, table, period=period)
            report.figure("loss_against_window", draw, CAPTION)
        if self.n_draws and ones:
            draws = {
                name: [
                    one.with_seed(record, seed, report)
                    for seed in count_pieces(report.watch, range(self.n_draws), "draw", name)
                ]
                for name, one in ones.items()
            }
            report.section(f"Over {self.n_draws} draws of windows")
            report.table(
                "spread",
                ResultTable(draws, SPREAD),
                heading="fit",
                title="lowest and highest, from the first sample",
                note="Amplitude and waveform are those of the state that is farthest off.",
            )


@dataclass(frozen=True, eq=False)
class OneFit:
    """One structure fitted in one way."""

    study: Study
    structure: Structure
    library: Library
    fit: Fit
    form: Formulation | None
    seed: int

    def fitted(self, record: Record, report: Report, title: str) -> Fitted:
        begun = process_time()
        model, held_to, scores = self._start(record)
        refinement = None
        if self.fit.refine and held_to is not None:
            begun = process_time()
            refinement = self._refine(
                model, held_to, record, callback=watcher(report.board.scalars, title, held_to),
                progress=report.watch,
            )  # fmt: skip
            model, scores = refinement.model, {}
        cpu_s = process_time() - begun
        runs = self.study.evaluate(model, record)
        wrong = wrong_signs(model, held_to, record)
        return Fitted(model, held_to, *runs, cpu_s, scores, refinement, wrong)

    def _start(self, record: Record) -> tuple[SparseModel, Constraint | None, Mapping[str, float]]:
        """The model by least squares, or as it is given, with R2 by state."""
        train = record.train
        if self.structure.coefficients:
            return self.structure.given(self.library, train), None, {}
        held_to = self.structure.constraint(
            self.library, record.data, record.zones, relations=self.fit.relations
        )
        if self.form is None:
            model, _ = balance_model(self.library, held_to, record.data, record.zones)
            return model, held_to, {}
        rows = self.form.assemble([train], self.library, rng=np.random.default_rng(self.seed))
        words = {"formulation": repr(self.form), "trajectories": train.label}
        model = constrained_fit(rows, held_to, units=train.units, provenance=words)
        # Smoothed rows and overlapping windows are not independent: their intervals would be too
        # narrow. Rows that know the noise of their samples are.
        if any(problem.noisy is None for problem in rows):
            model = replace(model, covariance=None)
        return model, held_to, rows_r2(model, rows)

    def _refine(
        self, model: SparseModel, held_to: Constraint, record: Record, **how: Any
    ) -> Refinement:
        from ep2sindy.refinement.refine import refine  # PyTorch takes seconds to load

        how = {"seed": 0} | how
        return refine(model, [record.train], self.study.settings(held_to), **how)

    def with_window(self, record: Record, window: int, report: Report) -> dict[str, Any]:
        """The refinement with windows of this length, and how its model runs."""
        model, held_to, _ = self._start(record)
        assert held_to is not None
        study = replace(self.study, window=window)
        found = replace(self, study=study)._refine(model, held_to, record, progress=report.watch)
        row = {"loss": found.loss, "status": str(found.status), "text": found.model.text()}
        for run, suffix in zip(study.evaluate(found.model, record), ("", "_started"), strict=True):
            row |= {f"f_error{suffix}": run.f_error, f"nrmse{suffix}": run.nrmse}
        return row

    def with_seed(self, record: Record, seed: int, report: Report) -> Evaluation:
        """The run of the model of another draw of windows."""
        model, held_to, _ = self._start(record)
        assert held_to is not None
        found = self._refine(model, held_to, record, seed=seed, progress=report.watch)
        return self.study.evaluate(found.model, record)[0]


def name_of(structure: str, way: str, models: Mapping[str, Structure]) -> str:
    """What a fit is called: by its way, and by its structure if there are several."""
    return way if len(models) == 1 else f"{structure}_{way}"


def fitted_start(model: SparseModel, run: Trajectory) -> Float[np.ndarray, " n_states"]:
    """Initial state whose trajectory is closest to the first one and a half periods of data.

    Distances are in standard deviations of the data. The search starts from the first sample.
    """
    n_samples = min(dominant_window([run], model.states), run.n_samples)
    data = run.window(0, n_samples).columns(model.states)
    std = run.columns(model.states).std(axis=0)

    def residual(start: np.ndarray) -> np.ndarray:
        rollout = model.rollout(run, n_samples=n_samples, initial=start * std, rtol=1e-6)
        strayed = np.full(data.shape, DIVERGED)
        strayed[: len(rollout.t)] = (rollout.states - data[: len(rollout.t)]) / std
        return strayed.ravel()

    return least_squares(residual, data[0] / std, diff_step=1e-4).x * std


def rows_r2(model: SparseModel, problems: Sequence[RegressionRows]) -> dict[str, float]:
    """R2 of the derivative by state, on the rows of a fit."""
    found = {}
    for problem in problems:
        for k, state in enumerate(problem.equations):
            coef = model.coef[:, model.states.index(state)]
            columns = np.flatnonzero(coef)
            prediction = coef[None, columns] @ problem.theta[:, columns].T
            found[state] = float(r2(truth=problem.target[:, k], prediction=prediction)[0])
    return found


def wrong_signs(model: SparseModel, held_to: Constraint | None, record: Record) -> list[str]:
    """Terms of processes whose sign is not that by which the recorded balance has them."""
    if held_to is None or not held_to.processes or not record.zones.balances:
        return []
    return [
        f"{_arrow(*process.ends)} by {term}"
        for process in compared_processes(model, held_to, record.data, record.zones)
        for term, coef in process.coef.items()
        if coef * process.counterpart.get(term, coef) < 0.0
    ]


def _arrow(giver: str, taker: str) -> str:
    """`n_n to n_i`, `n_i out`, `n_n in`."""
    if giver and taker:
        return f"{giver} to {taker}"
    return f"{giver} out" if giver else f"{taker} in"


METHOD: Metrics[Fitted] = [
    Metric("n_free", lambda fitted: fitted.n_free, View.SHOWN, "free"),
    *(metric.of(lambda fitted: fitted.from_sample) for metric in EVALUATION),
    *(metric.of(lambda fitted: fitted.from_fit, "{}_started", View.FILES) for metric in EVALUATION),
    Metric("wrong_signs", lambda fitted: "; ".join(fitted.wrong), View.SHOWN, "signs wrong"),
    Metric("r2", lambda fitted: fitted.r2, View.FILES | View.HEADLINE),
    Metric("loss", lambda fitted: fitted.refinement and fitted.refinement.loss),
    Metric(
        "refinement",
        lambda fitted: fitted.refinement and str(fitted.refinement.status),
        View.SHOWN,
    ),
    Metric("cpu_s", lambda fitted: fitted.cpu_s, View.FILES | View.HEADLINE),
]


def _ends(value: Callable[[Evaluation], float], runs: Sequence[Evaluation]) -> list[float]:
    """Lowest and highest value over the runs that have it; NaN if none has it."""
    values = np.array([value(run) for run in runs])
    known = values[np.isfinite(values)]
    return [float(known.min()), float(known.max())] if known.size else [np.nan, np.nan]


def _range(ends: Sequence[float], form: str = "{:.3f} to {:.3f}", factor: float = 1.0) -> str:
    low, high = (factor * value for value in ends)
    return "-" if np.isnan(low) else form.format(low, high)


def _worst_amplitude(run: Evaluation) -> float:
    ratios = np.array(list(run.amplitude_ratio.values()))
    return float(ratios[np.argmax(np.abs(ratios - 1.0))])


def _worst_waveform(run: Evaluation) -> float:
    return max(run.waveform_error.values())


def _n_sustained(runs: Sequence[Evaluation]) -> int:
    return sum(run.status is Status.SUSTAINED for run in runs)


_PERCENT = partial(_range, form="{:+.2f} to {:+.2f} %", factor=100.0)
SPREAD: Metrics[Sequence[Evaluation]] = [
    Metric("n_draws", len),
    Metric("n_sustained", _n_sustained, View.SHOWN, "sustained"),
    Metric("f_error", partial(_ends, lambda run: run.f_error), View.SHOWN, format=_PERCENT),
    Metric("nrmse", partial(_ends, lambda run: run.nrmse), View.SHOWN, format=_range),
    Metric("amplitude", partial(_ends, _worst_amplitude), View.SHOWN, format=_range),
    Metric("waveform", partial(_ends, _worst_waveform), View.SHOWN, format=_range),
]


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


# Fits at several operating points.


@dataclass(frozen=True, eq=False)
class OverPoints:
    """One fit at every operating point, by label."""

    structure: Structure
    fits: Mapping[str, Fitted]

    @property
    def sustained(self) -> list[str]:
        return [p for p, fit in self.fits.items() if fit.from_sample.status is Status.SUSTAINED]

    @property
    def elsewhere(self) -> str:
        """What becomes of the model at the others, in words."""
        runs = [fit.from_sample for p, fit in self.fits.items() if p not in self.sustained]
        words = dict.fromkeys(str(run.status) for run in runs)
        return ", ".join(f"{word} at {sum(str(r.status) == word for r in runs)}" for word in words)

    @property
    def wrong(self) -> dict[str, int]:
        """At how many points the sign of each term contradicts the balance."""
        terms = [term for fit in self.fits.values() for term in fit.wrong]
        return {term: terms.count(term) for term in dict.fromkeys(terms)}

    def worst(self, value: Callable[[Evaluation], float]) -> float:
        """The largest modulus over the points that have a value; NaN if none has."""
        values = np.array([value(fit.from_sample) for fit in self.fits.values()])
        known = np.abs(values[np.isfinite(values)])
        return float(known.max()) if known.size else np.nan


OVER_POINTS: Metrics[OverPoints] = [
    Metric("n_free", lambda each: max(fit.n_free for fit in each.fits.values()), View.SHOWN, "free"),
    Metric("n_sustained", lambda each: len(each.sustained), View.FILES | View.HEADLINE),
    Metric("sustained", lambda each: f"{len(each.sustained)} of {len(each.fits)}", View.SCREEN),
    Metric("elsewhere", lambda each: each.elsewhere, View.SHOWN),
    Metric("f_error", lambda each: each.worst(lambda r: r.f_error), View.SHOWN, "frequency off by",
           percent(2)),
    Metric("amplitude_error", lambda each: each.worst(lambda r: _worst_amplitude(r) - 1.0),
           View.SHOWN, "amplitude off by", percent(0)),
    Metric("waveform_error", lambda each: each.worst(_worst_waveform), View.SHOWN, "waveform",
           "{:.3f}"),
    Metric("wrong_signs", lambda each: "; ".join(f"{t} at {n}" for t, n in each.wrong.items()),
           View.SHOWN, "signs wrong"),
    Metric("source", lambda each: each.structure.source),
]  # fmt: skip


def add_points(
    found: Mapping[str, Mapping[str, Fitted]], models: Mapping[str, Structure], report: Report
) -> None:
    """Every fit over all points, and the models of each point. found: by point, then by fit."""
    names = list(next(iter(found.values())))
    structures = {
        name: next(each for key, each in models.items() if name.startswith(key)) for name in names
    }
    over = {
        name: OverPoints(structures[name], {point: fits[name] for point, fits in found.items()})
        for name in names
    }
    report.section(
        f"{len(names)} fits at {len(found)} operating points",
        *(f"{key}: {each.source}" for key, each in models.items() if each.source),
    )
    report.table(
        "over_points",
        ResultTable(over, OVER_POINTS),
        heading="fit",
        note="Frequency, amplitude and waveform: the largest errors over the points that have a "
        "cycle. Signs wrong: terms whose sign contradicts the recorded balance of the same process.",
    )
    rows = {f"{name}, {p}": fit for name, each in over.items() for p, fit in each.fits.items()}
    report.section("Every point")
    report.table("fits", ResultTable(rows, METHOD), heading="fit", page_only=True)
    for number, (point, fits) in enumerate(found.items()):
        report.section(point, level=3)
        for name, fit in fits.items():
            report.add(*equations(fit.model, lead=name, on_screen=False))
            report.model(f"{name}_{number}", fit.model, shown=False)
    n_all = sum(len(each.sustained) == len(found) for each in over.values())
    lines = [
        Text(f"sustained at {n} of {len(found)}: {', '.join(names)}")
        for n in range(len(found), 0, -1)
        if (names := [name for name, each in over.items() if len(each.sustained) == n])
    ]
    report.found(
        Result(
            f"Found: {n_all} of {len(over)} fits are sustained at all of {len(found)} operating points",
            lines or [Text("none is sustained at any point")],
            load='pandas.read_csv("{}/tables/over_points.csv")',
        )
    )
