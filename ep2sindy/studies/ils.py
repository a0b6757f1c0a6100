"""Integral least squares compared to base, weak and constrained models: `+exp=ils`.

The study also measures how far the result of a refinement depends on the windows drawn.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from time import process_time
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.method import Regression
from ep2sindy.figures.windows import loss_against_window_figure
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.library.library import polynomial
from ep2sindy.library.relations import Constraint, constraint
from ep2sindy.model.comparison import Status
from ep2sindy.model.model import SparseModel
from ep2sindy.refinement.windows import MIN_SAMPLES
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.document import Captioned, Section, Table
from ep2sindy.report.results import Metric, Metrics, ResultTable, View, facts
from ep2sindy.report.run import Run
from ep2sindy.runtime.progress import Progress, count_pieces
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.fits import (
    COMPARED,
    METHOD,
    RUN,
    EvaluatedFit,
    Outcome,
    Relations,
    Terms,
    fit_and_evaluate,
    held_out_outcome,
    runs_of,
    split_in_time,
    terms_of,
)
from ep2sindy.studies.living import LivingSearch, two_periods
from ep2sindy.studies.source import Source, Zones, zones_of
from ep2sindy.studies.study import Count, Counts, Share
from ep2sindy.studies.views import PlotRange

if TYPE_CHECKING:
    from ep2sindy.refinement.problem import Iteration
    from ep2sindy.refinement.refine import Refinement


LABELS = {
    "base": "base",
    "weak": "weak",
    "constrained": "constrained",
    "ils": "ILS",
    "ils_constrained": "ILS, constrained",
    "living": "living",
}
CAPTION = (
    "Refinement with windows of several lengths: loss on the fitted part, where each window has a "
    "start of its own; frequency error and nrmse on held-out time, from its first sample (full) "
    "and from a fitted start (dashed). The dotted line marks one period, the grey one 1 %."
)


@dataclass(frozen=True)
class Study:
    """Base, weak and constrained least squares, and refinements of the base and constrained models.

    Beside them stands the living model, from a library of the degree of `living`, or of 2, refined
    in the same way.
    model: the terms of every state. relations: those of the constrained fits. living: settings of
    the search for the living model. window: samples in each window; None takes two periods.
    windows: lengths for the plot of loss against window length. n_draws: number of draws of
    windows, for the spread of the refinements' results.
    """

    source: Source
    formulation: Formulation
    weak: Formulation
    model: Terms
    relations: Relations
    held_out: Share
    n_windows: Count
    window: Count | None
    windows: Counts
    n_draws: Count
    living: LivingSearch
    figures: PlotRange

    def compute(self, run: Run) -> Outcome:
        library, terms = terms_of(self.model, states=self.source.states)
        free, tied = constraint(library, terms), constraint(library, terms, self.relations)
        field, data = self.source.opened([library], run)
        train, held = split_in_time(data, self.held_out)
        self._check_windows(train)
        window = two_periods(train) if self.window is None else self.window
        rng, sweep_rng, draws_rng = np.random.default_rng(run.seed).spawn(3)
        streams = iter(rng.spawn(7))
        fits = (
            ("base", free, self.formulation),
            ("weak", free, self.weak),
            ("constrained", tied, self.formulation),
        )
        judged = {
            name: fit_and_evaluate(train, held, library, each, form, rng=next(streams))
            for name, each, form in count_pieces(run.watch, fits, "fit")
        }
        zones = zones_of(self.source, field, run)
        lives, own = self._living(train, zones, rng=next(streams), progress=run.watch)
        starts = {
            "ils": (judged["base"].model, free),
            "ils_constrained": (judged["constrained"].model, tied),
            "living": (lives, own),
        }
        again = {name: self._refinement(*start, train, window) for name, start in starts.items()}
        for name, (_, each) in count_pieces(run.watch, starts.items(), "refinement"):
            watch = watcher(run.board.scalars, name, each)
            refinement = partial(again[name], callback=watch, progress=run.watch)
            judged[name] = refine_and_judge(refinement, held, seed=next(streams))
        by_window = {
            name: {
                length: refine_and_judge(
                    partial(again[name], window=length, progress=run.watch), held, seed=stream
                )
                for length in count_pieces(run.watch, self.windows, "window length", name)
            }
            for name, stream in zip(("ils", "ils_constrained"), sweep_rng.spawn(2), strict=True)
        }
        draws = {
            name: [
                evaluate(again[name](seed=each).model, held)
                for each in count_pieces(run.watch, stream.spawn(self.n_draws), "draw", name)
            ]
            for name, stream in zip(starts, draws_rng.spawn(3), strict=True)
        }
        return self._outcome(train, held, judged, by_window, draws)

    def _living(
        self, train: Trajectory, zones: Zones, *, rng: np.random.Generator, progress: Progress
    ) -> tuple[SparseModel, Constraint]:
        """The model that oscillates on its own, and what its coefficients obey."""
        rows = Regression(self.formulation)
        library = polynomial(train.state_names, degree=2)
        found = self.living.found(train, library, rows, zones, rng=rng, progress=progress)
        model = found.model
        support = {state: list(model.terms(state)) for state in model.states}
        return model, found.constraint or constraint(model.library, support)

    def _check_windows(self, train: Trajectory) -> None:
        """Raise ValueError for windows that are longer than the fitted part of the data."""
        asked = {"window": [self.window or MIN_SAMPLES], "windows": self.windows}
        for key, lengths in asked.items():
            for length in lengths:
                if not MIN_SAMPLES <= length <= train.n_samples:
                    raise ValueError(
                        f"{key} must hold {MIN_SAMPLES} samples or more and fit the first part of "
                        f"the data, {train.n_samples} samples: {length} came"
                    )

    def _refinement(
        self, start: SparseModel, relations: Constraint, train: Trajectory, window: int | None
    ) -> Callable[..., Refinement]:
        """The refinement from a start, as a function of its seed and the remaining arguments."""
        from ep2sindy.refinement.problem import RefinementSettings
        from ep2sindy.refinement.refine import refine  # PyTorch takes seconds to load

        settings = RefinementSettings(self.n_windows, window, constraint=relations)
        return partial(refine, start, [train], settings)

    def _outcome(
        self,
        train: Trajectory,
        held: Trajectory,
        judged: Mapping[str, EvaluatedFit],
        by_window: Mapping[str, Mapping[int, EvaluatedFit]],
        draws: Mapping[str, Sequence[Evaluation]],
    ) -> Outcome:
        period_s = 1.0 / dominant_frequency(train.t, train.states[:, 0])
        windows = window_table(by_window, dt_s=train.dt_s, period_s=period_s)
        labelled = windows.replace({"method": LABELS})
        draw = partial(loss_against_window_figure, labelled, period=period_s / train.dt_s)
        methods = {
            name: facts(each, METHOD)
            | ({"spread": facts(of, SPREAD)} if (of := draws.get(name)) else {})
            for name, each in judged.items()
        }
        findings = {"methods": methods, "loss_against_window": windows.to_dict("records")}
        fits = held_out_outcome(train, held, judged, LABELS, self.relations, self.figures, findings)
        return replace(
            fits,
            drawn={**fits.drawn, "loss_against_window": Captioned(draw, CAPTION)},
            more_tables={"loss_against_window": windows, "draws": draws_table(draws)},
            more_sections=[spread_section(draws)],
        )


def refine_and_judge(
    refinement: Callable[..., Refinement], held: Trajectory, *, seed: np.random.Generator
) -> EvaluatedFit:
    begun = process_time()
    found = refinement(seed=seed)
    cpu_s = process_time() - begun
    runs = runs_of(found.model, held)
    return EvaluatedFit(found.model, *runs, cpu_s, found.status, found.loss)


def window_table(
    by_window: Mapping[str, Mapping[int, EvaluatedFit]], *, dt_s: float, period_s: float
) -> pd.DataFrame:
    """One row per method and window length; columns in _started are for a fitted initial state."""
    rows = []
    for method, judgements in by_window.items():
        for window, each in judgements.items():
            row = {
                "method": method,
                "window": window,
                "periods": (window - 1) * dt_s / period_s,
                "loss": each.loss,
                "status": each.status,
                "text": each.model.text(),
            }
            for run, suffix in ((each.from_sample, ""), (each.from_fit, "_started")):
                numbers = facts(run, RUN)
                row |= {f"{key}{suffix}": numbers[key] for key in COMPARED}
            rows.append(row)
    return pd.DataFrame(rows)


def watcher(
    tell: Callable[..., None], method: str, constraint: Constraint
) -> Callable[[Iteration], None]:
    """A callback that logs every iteration of a refinement as scalars; the step is its number.

    At step zero are the scalings before the first iteration, which are one.
    """
    free = [constraint.coefficients[k] for k in constraint.free]
    names = [f"{method}/scaling/{state}/{term.replace('*', '.')}" for state, term in free]
    tell(dict.fromkeys(names, 1.0), step=0)
    steps = count(1)

    def watch(iteration: Iteration) -> None:
        scalars = {
            f"{method}/loss": iteration.loss,
            f"{method}/step": iteration.step,
            f"{method}/defect": iteration.defect,
            f"{method}/window_stage": iteration.memory,
        }
        scalars |= dict(zip(names, iteration.scaling.tolist(), strict=True))
        tell(scalars, step=next(steps))

    return watch


# How far the result of a refinement depends on the windows that were drawn.


def _of_worst(run: Evaluation) -> dict[str, float]:
    """Numbers of one free run; amplitude and waveform error are those of the worst state."""
    ratios = np.array(list(run.amplitude_ratio.values()))
    return {
        "f_error": run.f_error,
        "nrmse": run.nrmse,
        "amplitude": float(ratios[np.argmax(np.abs(ratios - 1.0))]),
        "waveform": max(run.waveform_error.values()),
    }


def draws_table(draws: Mapping[str, Sequence[Evaluation]]) -> pd.DataFrame:
    """One row per method and draw of windows: the model's run over the held-out part."""
    rows = [
        {"method": name, "draw": k, "status": str(run.status), **_of_worst(run)}
        for name, runs in draws.items()
        for k, run in enumerate(runs)
    ]
    return pd.DataFrame(rows)


def _n_living(runs: Sequence[Evaluation]) -> int:
    return sum(run.status is Status.SUSTAINED for run in runs)


def _ends(runs: Sequence[Evaluation], name: str) -> list[float]:
    """Lowest and highest value of a number over the draws that have it; NaN if none has it."""
    values = np.array([_of_worst(run)[name] for run in runs])
    known = values[np.isfinite(values)]
    return [float(known.min()), float(known.max())] if known.size else [np.nan, np.nan]


def _range_text(ends: Sequence[float], form: str = "{:.3f} to {:.3f}", factor: float = 1.0) -> str:
    low, high = (factor * value for value in ends)
    return "-" if np.isnan(low) else form.format(low, high)


_RELATIVE = partial(_range_text, form="{:+.2f} to {:+.2f} %", factor=100.0)
BOTH = View.JSON | View.SCREEN
SPREAD: Metrics[Sequence[Evaluation]] = [
    Metric("n_draws", len, View.JSON),
    Metric("n_living", _n_living, View.JSON),
    Metric("live", lambda runs: f"{_n_living(runs)} of {len(runs)}", View.SCREEN),
    Metric("f_error", partial(_ends, name="f_error"), BOTH, "frequency error", _RELATIVE),
    *(
        Metric(name, partial(_ends, name=name), BOTH, format=_range_text)
        for name in ("nrmse", "amplitude", "waveform")
    ),
]


def spread_section(draws: Mapping[str, Sequence[Evaluation]]) -> Section:
    """One row per method: the range of its numbers over the draws."""
    rows = ResultTable({LABELS[name]: runs for name, runs in draws.items()}, SPREAD)
    table = Table(
        rows.screen("method"),
        title="lowest and highest, over held-out time from its first sample",
        note="Amplitude and waveform are those of the state that is farthest off.",
    )
    return Section(f"Over {max(map(len, draws.values()))} draws of windows", [table])
