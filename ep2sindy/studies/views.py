"""Views shared by several studies: figures and tables of runs, equations and tables of models."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures import series
from ep2sindy.forecasting.evaluation import Evaluation
from ep2sindy.library.equations import equation_text
from ep2sindy.library.relations import Constraint
from ep2sindy.library.units import SECONDS, Clock, unit_product
from ep2sindy.model.comparison import Status
from ep2sindy.model.display import grouped
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Block, Captioned, Equation, Result, Section, Table, Text
from ep2sindy.report.results import Metric, Metrics, View
from ep2sindy.signals.smoothers import Smoother
from ep2sindy.studies.study import PositiveOrAll

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INTEGRATED = "integrated from the first sample (nrmse 1: no better than a constant)"
NO_ENDS = (np.nan, np.nan)  # of an interval that is not known
FROM_DERIVATIVES = (
    "These are the equations that fits of the derivatives select; the models that live, which are "
    "selected by free runs, stand above."
)
MARKS = "Carets: the model leaves the panel; cross: a run that diverged stops."
CAPTIONS = {
    "data": "States (start of the record) and their power spectra; the line marks the peak.",
    "trajectories": "Models integrated from the first sample (colour) over the data (grey). "
    f"{MARKS}",
    "derivatives": "Right-hand sides on the data (colour) over the data's derivative (grey); "
    "carets: a curve leaves the panel.",
    "phase": "Phase portraits of the integrated models (colour) over the data (grey), dots where "
    f"they start. {MARKS}",
    "spectra": "Power spectra of the integrated models (colour) and of the data over the same time "
    "(grey); the dashed line marks the data's dominant frequency, the number is the model's.",
}


@dataclass(frozen=True)
class PlotRange:
    """The range that figures show: the start of a record, and the low end of spectra."""

    duration_s: PositiveOrAll
    f_max_Hz: PositiveOrAll

    def span_s(self, data: Trajectory) -> float:
        return self.duration_s or float(data.t[-1] - data.t[0])

    def up_to_Hz(self, data: Trajectory) -> float:
        return self.f_max_Hz or 0.5 / data.dt_s


def rollout_tables(data: Trajectory, models: Mapping[str, Evaluation]) -> dict[str, pd.DataFrame]:
    """Model and data, sample by sample, so that the figures can be redrawn."""
    found = {}
    for name, integrated in models.items():
        rollout, states = integrated.rollout, integrated.model.states
        samples = data.columns(states)[: len(rollout.t)]
        columns: dict[str, Any] = {"t_s": rollout.t}
        for k, state in enumerate(states):
            columns |= {f"{state}_data": samples[:, k], f"{state}_model": rollout.states[:, k]}
        found[f"rollout_{name.replace(' ', '_')}"] = pd.DataFrame(columns)
    return found


def run_figures(
    names: Sequence[str],
    data: Trajectory,
    models: Mapping[str, Evaluation],
    shown: PlotRange,
    *,
    smoother: Smoother | None = None,
    since: str = series.SINCE_START,
) -> dict[str, Captioned]:
    """The named figures of CAPTIONS; phase portraits need two states or more.

    smoother: gives the data's derivative; without one there are no derivative figures.
    since: the origin of the time axis of runs, in words.
    """
    span, f_max_Hz = shown.span_s(data), shown.up_to_Hz(data)
    rollouts = {name: integrated.rollout for name, integrated in models.items()}
    statuses = {name: integrated.status for name, integrated in models.items()}
    drawn: dict[str, Callable[[], Figure]] = {
        "data": partial(series.data_figure, data, duration_s=span, f_max_Hz=f_max_Hz),
        "trajectories": partial(
            series.trajectory_figure, data, rollouts, duration_s=span, statuses=statuses,
            since=since,
        ),
        "spectra": partial(
            series.spectrum_figure, data, rollouts, f_max_Hz=f_max_Hz, statuses=statuses
        ),
    }  # fmt: skip
    if smoother is not None:
        sides = {name: integrated.model for name, integrated in models.items()}
        drawn["derivatives"] = partial(
            series.derivative_figure, data, sides, smoother=smoother, duration_s=span
        )
    if len(data.state_names) > 1:
        drawn["phase"] = partial(
            series.phase_figure, data, rollouts, duration_s=span, statuses=statuses
        )
    return {name: Captioned(drawn[name], CAPTIONS[name]) for name in names if name in drawn}


def trajectories(
    data: Trajectory,
    models: Mapping[str, Evaluation],
    shown: PlotRange,
    caption: str,
    *,
    since: str = series.SINCE_START,
) -> Captioned:
    """Trajectories of other models, or from other initial states."""
    (figure,) = run_figures(["trajectories"], data, models, shown, since=since).values()
    return replace(figure, caption=caption)


def terms_text(terms: Mapping[str, Sequence[str]]) -> str:
    """`x: x, x*y; y: y`: the terms of every equation or role."""
    return "; ".join(f"{part}: {', '.join(names)}" for part, names in terms.items())


def intervals(model: SparseModel) -> dict[str, dict[str, tuple[float, float]]] | None:
    """95 % intervals by state and term; None if they are not known."""
    if model.covariance is None:
        return None
    return {state: model.intervals(state) for state in model.states}


MODEL: Metrics[SparseModel] = [
    Metric("text", lambda model: model.text(), View.JSON),
    Metric(
        "text",
        lambda model: {state: equation_text(state, model.terms(state)) for state in model.states},
        View.CSV,
    ),
    Metric(
        "equations", lambda model: {state: model.terms(state) for state in model.states}, View.JSON
    ),
]


def coefficients(models: Mapping[str, SparseModel], *, heading: str) -> pd.DataFrame:
    """One row per model, state and term, in SI, with 95 % intervals if they are known.

    heading: heading of the column with the models' names.
    """
    rows = [
        (name, state, term, value, *(intervals(model) or {}).get(state, {}).get(term, NO_ENDS))
        for name, model in models.items()
        for state in model.states
        for term, value in model.terms(state).items()
    ]
    return pd.DataFrame(rows, columns=[heading, "state", "term", "coef", "lower", "upper"])


def display_equation(
    model: SparseModel,
    state: str,
    clock: Clock = SECONDS,
    *,
    held: Constraint | None = None,
    lead: str = "",
    on_screen: bool = True,
) -> Equation:
    """One equation of a model with its unit, per time unit of the clock; held: see `grouped`."""
    terms = grouped(model, held, clock)[state]
    unit = clock.rate_unit(model.units[state])
    return Equation(state, terms, lead=lead, unit=unit, on_screen=on_screen)


def interval_table(
    model: SparseModel,
    states: Sequence[str] | None = None,
    clock: Clock = SECONDS,
    *,
    page_only: bool = False,
    words: str = "95 %",
    note: str = "",
) -> list[Block]:
    """Coefficients of some or all equations with 95 % intervals; empty if these are not known.

    words: what the intervals are called. note: what they mean.
    """
    if model.covariance is None:
        return []
    units = {term.name: term.unit(model.units) for term in model.library.terms}
    rows = []
    for state in model.states if states is None else states:
        for term, ends in model.intervals(state).items():
            numbers = [model.terms(state)[term], *ends]
            unit = unit_product([(model.units[state], 1), (units[term], -1)])
            row = [f"{state}'", term.replace("*", " ")]
            shown = [f"{clock.seconds * number:.4g}" for number in numbers]
            row += shown if ends[0] < ends[1] else [shown[0], "exact", ""]  # known, or a relation
            rows.append([*row, clock.rate_unit(unit)])
    columns = ["equation", "term", "coefficient", f"{words} from", "to", "unit"]
    table = pd.DataFrame(rows, columns=columns)
    return [Table(table, note=note, page_only=page_only)] if rows else []


def equation_sections(
    models: Mapping[str, SparseModel], clock: Clock = SECONDS, *, page_only: bool = False
) -> list[Section]:
    """One section per model with its equations, and intervals if they are known.

    page_only: whether the intervals are left off the screen.
    """
    return [
        Section(
            name,
            [
                *(display_equation(model, state, clock) for state in model.states),
                *interval_table(model, clock=clock, page_only=page_only),
            ],
            level=3,
        )
        for name, model in models.items()
    ]


def best_run(runs: Mapping[str, Evaluation]) -> str:
    """Name of the run of the best status, and of these the nearest to the data."""

    def rank(name: str) -> tuple[tuple[bool, int], float]:
        nrmse = runs[name].nrmse
        return runs[name].rank, nrmse if np.isfinite(nrmse) else np.inf

    return min(runs, key=rank)


def worst_run(runs: Sequence[Evaluation]) -> Evaluation:
    """The first run of the worst status."""
    return max(runs, key=lambda run: run.rank)


def found_model(
    found: str,
    run: Evaluation,
    *,
    file: str,
    picture: str,
    more: Sequence[Block] = (),
    where: str,
    seen: bool = False,
    misfit: str = "",
    held: Constraint | None = None,
) -> Result:
    """A model as what was found: its equations, and how it runs.

    found: how it was found, such as `Found from I_d`. file: its name among the run's models. where:
    what it was run over, in words, such as `held-out time`. seen: whether it was fitted to that.
    misfit: why it does not explain the data, a warning; may be empty. held: that its coefficients
    obey, if it was found under roles.
    """
    clock, model = run.rollout.clock, run.model
    return Result(
        f"{found}: a model that {_fate(run, seen=seen, misfit=misfit)}",
        [
            *(display_equation(model, state, clock, held=held) for state in model.states),
            Text(f"run freely from one sample over {where}: {run_words(run)}"),
            *([Text(misfit, warning=True)] if misfit else []),
            *more,
        ],
        load=f'ep.SparseModel.load("{{}}/models/{file}.json")',
        picture=picture,
    )


def _fate(run: Evaluation, *, seen: bool, misfit: str) -> str:
    """`sustains the oscillation`, `has the wrong cycle`, `diverges after 12 us`."""
    words = {
        Status.SUSTAINED: "sustains the oscillation",
        Status.WRONG_FREQUENCY: "has the wrong frequency",
        Status.WRONG_CYCLE: "has the wrong cycle",
        Status.NO_CYCLE: "is unlike the data",
    }
    if not run.is_similar:
        return words.get(run.status, run.text)
    if run.status is Status.NO_CYCLE:
        if misfit:
            return "does not explain the data"
        words[Status.NO_CYCLE] = "has the statistics of the data"
    return f"{words[run.status]}{' where it was fitted' if seen else ''}"


def frequency_words(run: Evaluation, form: str = "+.1f") -> str:
    """`20 kHz (+1.2 %)`: the first state's frequency and its error; a dash if it has none.

    form: of the error in percent.
    """
    frequency_Hz = run.frequency_Hz[run.model.states[0]]
    if not np.isfinite(frequency_Hz):
        return "-"
    error = f" ({100 * run.f_error:{form}} %)" if np.isfinite(run.f_error) else ""
    return f"{run.rollout.clock.frequency_text(frequency_Hz)}{error}"


def run_words(run: Evaluation) -> str:
    """Frequency, amplitude and waveform of a run beside the data's, as far as they are known."""
    found = []
    if (frequency := frequency_words(run, "+.2g")) != "-":
        found.append(f"frequency {frequency}")
    ratios = [value for value in run.amplitude_ratio.values() if np.isfinite(value)]
    if ratios:
        ends = dict.fromkeys(f"{value:.3g}" for value in (min(ratios), max(ratios)))
        found.append(f"amplitude {' to '.join(ends)} times the data's")
    waveforms = [value for value in run.waveform_error.values() if np.isfinite(value)]
    if waveforms:
        found.append(f"waveform within {max(waveforms):.2g} standard deviations")
    if np.isfinite(run.periods):
        found.append(f"in phase for {round(run.periods)} periods")
    if not found and np.isfinite(run.nrmse):
        found.append(f"{run.nrmse:.2g} standard deviations off")
    return "; ".join(found) or run.text


def with_error(value: float, reach: float) -> str:
    """`0.03640 ±2e-05`: the value to the digit of its error, with at least three digits.

    An error that is not known (NaN) is left out.
    """
    digits = 3
    if np.isfinite(reach) and reach > 0.0 and value != 0.0:
        # Digits of the error as it is printed: 9.6e-05 reads 1e-04.
        places = np.floor(np.log10([abs(value), float(f"{reach:.1g}")]))
        digits = int(np.clip(places[0] - places[1] + 1, 3, 8))
    text = f"{value:#.{digits}g}".removesuffix(".")
    return text if np.isnan(reach) else f"{text} ±{reach:.1g}"
