"""Fits of known terms to the first part of a record, all tested alike on the rest.

Shared by the experiments that fit known terms: the config entry for terms, the fits, and their
tables and figures.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from operator import add
from time import process_time
from typing import Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.optimize import least_squares

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.library.library import Library, named_terms
from ep2sindy.library.relations import Constraint
from ep2sindy.library.terms import variables_of
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.windows import dominant_window
from ep2sindy.regression.constrained import constrained_fit
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.document import Block, Captioned, Result, Section, Table, Text, pictures
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, facts
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.forecasts import LEAST_SAMPLES, is_short
from ep2sindy.studies.source import data_summary
from ep2sindy.studies.study import Check
from ep2sindy.studies.views import (
    MARKS,
    MODEL,
    PlotRange,
    best_run,
    coefficients,
    equation_sections,
    found_model,
    frequency_words,
    intervals,
    rollout_tables,
    run_figures,
    trajectories,
)

Terms = Mapping[str, Sequence[int | str]]  # by state; the constant term 1 may be a number
Relations = Annotated[
    Sequence[str],
    Check(
        "a list of relations, such as ['x: x*y == -1 * y: x*y']",
        lambda value: isinstance(value, list) and bool(value),
    ),
]
DIVERGED = 10.0  # residual, in std, at samples that a run diverges before
TITLE = "integrated over held-out time from its first sample (nrmse 1: no better than a constant)"
INTERVALS = (
    "The intervals say how far the windows' residuals move the coefficients; starts are fitted "
    "with them."
)
CAPTIONS = {
    "trajectories": "Models integrated over held-out time from its first sample (colour) over the "
    f"data (grey). {MARKS}",
    "trajectories_started": "The same from a start fitted to the first one and a half periods.",
}
NOTE = (
    "Data, held out: {}. Amplitude: standard deviation against the data's. Start fitted: frequency "
    "error and nrmse from a start fitted to the first one and a half periods."
)
SINCE = "time since start of held-out part"
FIGURES = ("phase", "spectra")
COMPARED = ("f_error", "nrmse", "amplitude_ratio")


def terms_of(
    given: Terms, *, states: Sequence[str], key: str = "model"
) -> tuple[Library, dict[str, list[str]]]:
    """The terms of every state, and a library that holds each of them once.

    key: the config's key for this model, for error messages.
    """
    if set(given) != set(states) or not all(given.values()):
        came = {state: list(names) for state, names in given.items()}
        raise ValueError(
            f"{key} must list the terms of every state of {list(states)}, such as "
            f"{{x: [x, x*y]}}: {came} came"
        )
    terms = {state: [str(name) for name in given[state]] for state in states}
    factors = [
        variable for names in terms.values() for name in names for variable in variables_of(name)
    ]
    variables = list(dict.fromkeys([*states, *factors]))
    named = reduce(add, (named_terms(variables, names) for names in terms.values()))
    return named.take(np.argsort(named.degrees, kind="stable")), terms


@dataclass(frozen=True, eq=False)
class EvaluatedFit:
    """A fit and its performance on the held-out part.

    from_sample: the run started at the first sample. from_fit: the run started at an initial state
    fitted to the first samples, because a single sample may lie off every orbit of the model.
    cpu_s: time of the fit, without the time of the model that it starts from. status, loss: those
    of a refinement; None and NaN for least squares.
    """

    model: SparseModel
    from_sample: Evaluation
    from_fit: Evaluation
    cpu_s: float
    status: str | None = None
    loss: float = float("nan")


def n_before(run: Trajectory, held_out: float) -> int:
    """Number of samples before the last `held_out` share of a record."""
    return round(run.n_samples * (1.0 - held_out))


def split_in_time(run: Trajectory, held_out: float) -> tuple[Trajectory, Trajectory]:
    """The first part of a record, and the last `held_out` share of its samples.

    Raises ValueError if either part would have fewer than LEAST_SAMPLES samples.
    """
    n_train = n_before(run, held_out)
    if is_short(run, n_train):
        raise ValueError(
            f"held_out={held_out} must leave {LEAST_SAMPLES} samples on either side: the data have "
            f"{run.n_samples}"
        )
    return run.window(0, n_train), run.window(n_train, run.n_samples)


def fit_and_evaluate(
    train: Trajectory,
    held: Trajectory,
    library: Library,
    constraint: Constraint,
    formulation: Formulation,
    *,
    rng: np.random.Generator,
) -> EvaluatedFit:
    """Fit by least squares under the constraint, in one form of the regression.

    There is no covariance: smoothed rows and overlapping windows are not independent, and intervals
    that assume independence would be too narrow.
    """
    begun = process_time()
    model = constrained_fit(
        formulation.assemble([train], library, rng=rng),
        constraint,
        units=train.units,
        provenance={"formulation": repr(formulation), "trajectories": train.label},
    )
    cpu_s = process_time() - begun
    model = replace(model, covariance=None)
    return EvaluatedFit(model, *runs_of(model, held), cpu_s)


def runs_of(model: SparseModel, held: Trajectory) -> tuple[Evaluation, Evaluation]:
    """Free runs over the held-out part, from its first sample and from a fitted start."""
    return evaluate(model, held), evaluate(model, held, initial=_fitted_start(model, held))


def _fitted_start(model: SparseModel, run: Trajectory) -> Float[np.ndarray, " n_states"]:
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


@dataclass(frozen=True, eq=False)
class Outcome:
    """Fits of known terms, each run freely over the same samples.

    data: these samples. seen: whether they were fitted. runs: by name of the fit. labels: readable
    names. kind: what a fit is called, such as `method`. fits: one row per fit and state. shown: the
    same for reading. about: blocks before the equations. drawn: figures, of which the first shows
    what was found. findings: the summary. numbers: the headline. of_best: what is said of the fit
    that runs best, by name. more_tables, more_sections: what the study itself adds.
    """

    data: Trajectory
    seen: bool
    runs: Mapping[str, Evaluation]
    labels: Mapping[str, str]
    kind: str
    fits: pd.DataFrame
    shown: Table
    about: Sequence[Block]
    drawn: Mapping[str, Captioned]
    findings: dict[str, Any]
    numbers: Mapping[str, float]
    of_best: Mapping[str, str] = field(default_factory=dict)
    more_tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    more_sections: Sequence[Section] = ()

    def models(self) -> dict[str, SparseModel]:
        return {name: run.model for name, run in self.runs.items()}

    def tables(self) -> dict[str, pd.DataFrame]:
        return {
            **rollout_tables(self.data, self.runs),
            f"{self.kind}s": self.fits,
            "coefficients": coefficients(self.models(), heading=self.kind),
            **self.more_tables,
        }

    def figures(self) -> Mapping[str, Captioned]:
        return self.drawn

    def in_short(self) -> Result:
        """The model that runs best."""
        best = best_run(self.runs)
        return found_model(
            f"Found by the {self.kind} {self.labels[best]}",
            self.runs[best],
            file=best,
            picture=next(iter(self.drawn)),
            more=[Text(f"{self.of_best.get(best, '')}the best of {len(self.runs)} {self.kind}s")],
            where="the record" if self.seen else "held-out time",
            seen=self.seen,
        )

    def sections(self) -> list[Section]:
        models = {self.labels[name]: model for name, model in self.models().items()}
        shown: list[Block] = [self.shown, *pictures(self.drawn)]
        return [
            Section("Equations", self.about),
            *equation_sections(models, self.data.clock, page_only=not self.seen),
            Section("Integrated" if self.seen else "Held-out time", shown),
            *self.more_sections,
        ]

    def summary(self) -> dict[str, Any]:
        return self.findings

    def headline(self) -> Mapping[str, float]:
        return self.numbers


def held_out_outcome(
    train: Trajectory,
    held: Trajectory,
    judged: Mapping[str, EvaluatedFit],
    labels: Mapping[str, str],
    relations: Sequence[str],
    shown: PlotRange,
    findings: Mapping[str, Any],
) -> Outcome:
    """The outcome of models that were fitted to `train` and tested on `held`.

    relations: those that the constrained models obey. findings: what the study itself adds.
    """
    f_data_Hz = dominant_frequency(held.t, held.states[:, 0])
    n_samples = {"n_samples": train.n_samples + held.n_samples, "n_held_out": held.n_samples}
    data = data_summary(train) | n_samples | {"f_kHz": 1e-3 * f_data_Hz}
    fits = ResultTable(judged, METHOD)
    labelled = {labels[name]: each for name, each in judged.items()}
    rows = ResultTable(labelled, METHOD).screen("method")
    if rows["status"].isna().all():  # least squares has no status
        del rows["status"]
    known = any(each.model.covariance is not None for each in judged.values())
    relation_lines = [Text(f"relation: {text}") for text in relations]
    return Outcome(
        data=held,
        seen=False,
        runs={name: each.from_sample for name, each in judged.items()},
        labels=labels,
        kind="method",
        fits=fits.csv("method", by_state=True),
        shown=Table(rows, title=TITLE, note=NOTE.format(held.clock.frequency_text(f_data_Hz))),
        about=[*relation_lines, *([Text(INTERVALS, page_only=True)] if known else [])],
        drawn=held_out_figures(held, labelled, shown),
        findings={"data": data, **findings},
        numbers=fits.headline(),
    )


def held_out_figures(
    held: Trajectory, labelled: Mapping[str, EvaluatedFit], shown: PlotRange
) -> dict[str, Captioned]:
    """Runs from the first sample and from a fitted start, phase portraits and spectra."""
    sample = {name: each.from_sample for name, each in labelled.items()}
    fit = {name: each.from_fit for name, each in labelled.items()}
    runs = {
        name: trajectories(held, models, shown, caption, since=SINCE)
        for (name, caption), models in zip(CAPTIONS.items(), (sample, fit), strict=True)
    }
    return runs | run_figures(FIGURES, held, sample, shown)


# Metrics of a free run. CSV has values by state; JSON and headlines have the first state's.
RUN: Metrics[Evaluation] = [
    Metric("f", frequency_words, View.SCREEN),
    Metric("f_Hz", lambda run: run.frequency_Hz, View.CSV),
    Metric("f_kHz", lambda run: 1e-3 * run.frequency_Hz[run.model.states[0]], View.JSON),
    Metric("f_error", lambda run: run.f_error, View.FILES | View.HEADLINE),
    Metric("nrmse", lambda run: run.nrmse, View.ALL),
    Metric("amplitude_ratio", lambda run: run.amplitude_ratio, View.CSV),
    Metric(
        "amplitude_ratio", lambda run: run.amplitude_ratio[run.model.states[0]],
        View.JSON | View.HEADLINE,
    ),
    Metric("amplitude", lambda run: run.amplitude_ratio, View.SCREEN, "amplitude {}"),
    Metric("waveform_error", lambda run: run.waveform_error[run.model.states[0]], View.JSON),
    Metric("periods", lambda run: run.periods, View.JSON),
    Metric("status", lambda run: run.text, View.JSON | View.SCREEN),
]  # fmt: skip
METHOD: Metrics[EvaluatedFit] = [
    *(metric.of(lambda judged: judged.model) for metric in MODEL),
    *(metric.of(lambda judged: judged.from_sample) for metric in RUN),
    *(metric.of(lambda judged: judged.from_fit, "{}_started", View.CSV) for metric in RUN),
    Metric("start fitted", lambda judged: _started_text(judged.from_fit), View.SCREEN),
    Metric("fitted_start", lambda judged: facts(judged.from_fit, RUN), View.JSON),
    Metric("ci95", lambda judged: intervals(judged.model), View.JSON),
    Metric("loss", lambda judged: judged.loss),
    Metric("status", lambda judged: judged.status, View.SHOWN),
    Metric("cpu_s", lambda judged: judged.cpu_s, View.ALL, "CPU s"),
]


def _started_text(run: Evaluation) -> str:
    """Frequency error and nrmse; the verdict of a run without a frequency."""
    has_none = np.isnan(run.f_error)
    return run.text if has_none else f"{100 * run.f_error:+.1f} %, {run.nrmse:.2f}"
