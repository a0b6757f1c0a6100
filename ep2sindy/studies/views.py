"""Views that studies share: figures and samples of runs, forecasts, and what was found."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures import series
from ep2sindy.forecasting.baselines import AUTOREGRESSION
from ep2sindy.forecasting.evaluation import Evaluation, size_text
from ep2sindy.forecasting.skill import MODEL, ForecastSkill, forecast_skill
from ep2sindy.library.relations import Constraint
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Block, Result, Table, Text
from ep2sindy.report.models import equations
from ep2sindy.report.report import Report
from ep2sindy.report.results import Metric, Metrics, View
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.studies.source import LEAST_SAMPLES, is_short
from ep2sindy.studies.study import PositiveOrAll

if TYPE_CHECKING:
    from matplotlib.figure import Figure

CAPTIONS = {
    "data": "States (start of the record) and their power spectra; the line marks the peak.",
    "trajectories": "Models integrated from the first sample (colour) over the data (grey).",
    "trajectories_started": "The same from a start fitted to the first one and a half periods.",
    "trajectories_thesis": "The same with the thesis's terms, fitted to these data.",
    "phase": "Phase portraits of the integrated models (colour) over the data (grey), dots where "
    "they start.",
    "forecast": "Forecast of the last part of the record, its start estimated from the past "
    "alone, with the band that is to hold 90 % of the samples. Last panel: error of forecasts from "
    "starts all over that part, by horizon (1: no better than the mean); persistence: the last "
    "sample stays; harmonics: the mean cycle continues; autoregression: linear in the samples or "
    "in their logarithms, its order by AIC; neighbours: what followed the most similar moments.",
}


@dataclass(frozen=True)
class PlotRange:
    """The range that figures show: the start of a record."""

    duration_s: PositiveOrAll

    def span_s(self, data: Trajectory) -> float:
        return self.duration_s or float(data.t[-1] - data.t[0])


def add_samples(report: Report, data: Trajectory, runs: Mapping[str, Evaluation]) -> None:
    """Model and data, sample by sample, so that the figures can be redrawn."""
    for name, run in runs.items():
        rollout, states = run.rollout, run.model.states
        samples = data.columns(states)[: len(rollout.t)]
        columns: dict[str, Any] = {"t_s": rollout.t}
        for k, state in enumerate(states):
            columns |= {f"{state}_data": samples[:, k], f"{state}_model": rollout.states[:, k]}
        report.samples(f"rollout_{name.replace(' ', '_')}", pd.DataFrame(columns))


def add_figures(
    report: Report,
    names: Sequence[str],
    data: Trajectory,
    runs: Mapping[str, Evaluation],
    shown: PlotRange,
    *,
    since: str = series.SINCE_START,
    suffix: str = "",
) -> None:
    """Add the named figures of CAPTIONS; phase portraits need two states or more.

    since: the origin of the time axis of runs, in words. suffix: to the names, for runs of another
    kind, which CAPTIONS describes by such a name.
    """
    span = shown.span_s(data)
    rollouts = {name: run.rollout for name, run in runs.items()}
    how = {"statuses": {name: run.status for name, run in runs.items()}}
    drawn: dict[str, Callable[[], Figure]] = {
        "data": partial(series.data_figure, data, duration_s=span),
        "trajectories": partial(
            series.trajectory_figure, data, rollouts, duration_s=span, since=since, **how
        ),
    }
    if len(data.state_names) > 1:
        drawn["phase"] = partial(series.phase_figure, data, rollouts, duration_s=span, **how)
    for name in names:
        if name in drawn:
            report.figure(f"{name}{suffix}", drawn[name], CAPTIONS[f"{name}{suffix}"])


def terms_text(terms: Mapping[str, Sequence[str]]) -> str:
    """`x: x, x*y; y: y`: the terms of every equation or role."""
    return "; ".join(f"{part}: {', '.join(names)}" for part, names in terms.items())


def best_run(runs: Mapping[str, Evaluation]) -> str:
    """Name of the run of the best status, and of these the nearest to the data."""
    distances = {name: np.nan_to_num(run.nrmse, nan=np.inf) for name, run in runs.items()}
    return min(runs, key=lambda name: (runs[name].rank, distances[name]))


def found_model(
    name: str,
    run: Evaluation,
    *,
    file: str,
    picture: str,
    more: Sequence[Block] = (),
    where: str,
    seen: bool = False,
    lack_of_fit: str = "",
    held: Constraint | None = None,
) -> Result:
    """A model as what was found: the verdict, its equations, and the figures behind the verdict.

    name: of what it was found from or by, a word. file: its name among the run's models. where:
    what it was run over, in words, such as `held-out time`. seen: whether it was fitted to that.
    lack of fit: why it does not explain the data, a warning; may be empty. held: that its
    coefficients obey, if it was found under roles.
    """
    heading = f"{name}: {run.heading}"
    if not run.model.coef.any():
        return Result(heading, [*more], picture=picture)
    fitted = ", where it was fitted" if seen else ""
    rows = pd.DataFrame(run.table, columns=["", "data", "model"])
    notes = [run.missing, *run.rest_texts]
    return Result(
        heading,
        [
            *equations(run.model, run.rollout.clock, held=held),
            Text(f"run freely from one sample over {where}{fitted}: {run.text}"),
            *([Table(rows)] if run.table else []),
            *([] if run.forecast is None else [errors_table(run.forecast)]),
            *(Text(note) for note in notes if note),
            *([Text(lack_of_fit, warning=True)] if lack_of_fit else []),
            *more,
        ],
        load=f'ep.SparseModel.load("{{}}/models/{file}.json")',
        picture=picture,
    )


def errors_table(skill: ForecastSkill) -> Table:
    """Errors of the model and of the baselines at a few horizons, in standard deviations."""
    last = len(skill.horizons_s) - 1
    places = sorted({round(k / 16 * last) for k in (0, 1, 2, 4, 8, 16)})
    ahead = [f"{h / skill.unit_s:.2g}" for h in skill.horizons_s[places].tolist()]
    names = dict.fromkeys([AUTOREGRESSION], f"AR({skill.order})")
    columns = {names.get(name, name): each[places] for name, each in skill.nrmse.items()}
    rows = pd.DataFrame({f"{skill.unit} ahead": ahead, **columns})
    title = "errors of forecasts, in standard deviations of the samples (1: the mean)"
    return Table(rows, title=title, note=skill.nearest_text)


def _size(ratio: float) -> str:
    """A ratio of sizes in a table; a dash if it is not known."""
    return size_text(ratio, ".3f") if ratio == ratio else "-"


COMPARED = View.FILES | View.HEADLINE
# How a model runs next to a record: of every model, in every study.
EVALUATION: Metrics[Evaluation] = [
    Metric("from_s", lambda run: float(run.record.t[0])),
    Metric("to_s", lambda run: float(run.record.t[-1])),
    Metric("frequency", lambda run: run.frequency_text, View.SCREEN),
    Metric("frequency_Hz", lambda run: run.frequency_Hz),
    Metric("f_kHz", lambda run: 1e-3 * run.frequency_Hz[run.model.states[0]], View.HEADLINE),
    Metric("f_error", lambda run: run.f_error, COMPARED),
    Metric("amplitude_ratio", lambda run: run.amplitude_ratio, View.ALL, "amplitude {}", _size),
    Metric("waveform_error", lambda run: run.waveform_error, View.ALL, "waveform {}", "{:.3f}"),
    Metric("nrmse", lambda run: run.nrmse, View.ALL, format=_size),
    Metric("distance", lambda run: run.distance),
    Metric("periods", lambda run: run.periods, View.SHOWN, "periods in phase", "{:.0f}"),
    Metric("status", lambda run: run.text, View.SHOWN),
]
# Its cycle, which takes many runs: of models that are to sustain their oscillation.
CYCLE: Metrics[Evaluation] = [
    Metric("stability", lambda run: run.cycle and run.cycle.stability),
    Metric("multiplier", lambda run: run.multiplier, COMPARED),
]
EVALUATED = (
    "Amplitude: standard deviation over the data's. Waveform: RMS difference of one period, in "
    "standard deviations. nrmse: RMS error of the trajectory, in standard deviations; 1 is no "
    "better than a constant. Periods in phase: until it is a quarter of a period off."
)


def largest(values: Mapping[str, float]) -> float:
    """The largest of the values by state; NaN if one is not known."""
    return float(np.max(list(values.values())))


def why_none(run: Trajectory, n_fitted: int) -> str:
    """Why a record is too short for forecasts; empty if it is not."""
    if not is_short(run, n_fitted):
        return ""
    return (
        f"no forecasts: they need {LEAST_SAMPLES} samples or more to fit and as many to test; the "
        f"record has {run.n_samples}, {n_fitted} to fit and {run.n_samples - n_fitted} to test"
    )


def skill_of(
    model: SparseModel, run: Trajectory, *, n_fitted: int, starts: int, seen: bool,
    progress: Progress = SILENT,
) -> ForecastSkill | None:  # fmt: skip
    """Skill of a model of measured states; None for an empty model, or a short record.

    seen: whether the model was fitted to all of the record.
    """
    if not starts or is_short(run, n_fitted) or not model.coef.any():
        return None
    skill = forecast_skill(model, run, n_fitted=n_fitted, starts=starts, progress=progress)
    return replace(skill, seen=seen)


def add_forecasts(
    report: Report, name: str, run: Trajectory, skill: ForecastSkill, *, title: str = "Forecasts"
) -> None:
    """Add how far ahead a model forecasts, next to baselines: a part of the section before.

    name: of the model, which names the files.
    """
    report.section(title, f"forecasts: {skill.text}", _note(skill), level=3)
    report.figure(
        f"forecast_{name}", partial(series.forecast_figure, run, skill), CAPTIONS["forecast"]
    )
    errors = pd.DataFrame({"horizon_s": skill.horizons_s, **skill.nrmse})
    report.samples(f"forecast_{name}", errors)
    report.summary.setdefault("forecasts", {})[name] = skill.summary()


def _note(skill: ForecastSkill) -> str:
    """How many forecasts there are, and how far their bands can be trusted."""
    held = f"the bands of 90 % hold {100.0 * skill.coverage_90:.0f} % of the samples"
    if not np.isfinite(skill.coverage_90):
        held = (
            "there are no bands: what the model was fitted to is too short, grows or decays "
            "throughout, or forecasts of it diverge"
        )
    steps = " Baselines take the samples interpolated onto equal steps." if skill.resampled else ""
    fitted = ", although the model was fitted to all of the record" if skill.seen else ""
    n = len(skill.squared[MODEL])
    return f"{n} starts, whose states are estimated from the past alone{fitted}; {held}.{steps}"
