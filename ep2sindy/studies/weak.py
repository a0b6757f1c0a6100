"""Known terms in the weak form, with windows of several lengths: `+exp=weak`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.equations import equation_text
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.document import Captioned, Equation, Section, Table, Text, pictures, places
from ep2sindy.report.run import Run
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.kinds import Coefficients, Count, Counts, Deferred, PositiveOrAll
from ep2sindy.studies.known_terms import Terms, terms_of
from ep2sindy.studies.shown import (
    INTEGRATED,
    Shown,
    coefficients,
    equation_sections,
    intervals,
    model_summary,
    rollout_tables,
    run_figures,
)
from ep2sindy.studies.source import Source, data_summary
from ep2sindy.studies.weak_forms import Fitted, fit_settings, settings_of

FIGURES = ("trajectories", "phase", "derivatives", "spectra")
INTERVALS = (
    "The intervals say how far the noise of the samples moves the coefficients if these terms are "
    "the whole law; what the terms lack, they do not count."
)


@dataclass(frozen=True)
class Study:
    """Fit the same terms in every form, integrate each model, compare.

    formulation: the differential form; its smoother shows the data's derivative. boxes: random
    windows. automatic: smooth windows. model: the terms of every state. rollout_s: how far to
    integrate; None means to the data's end. thesis: published equations to stand beside.
    """

    source: Source
    formulation: Formulation
    boxes: Deferred
    automatic: Formulation
    model: Terms
    n_windows: Count
    n_points: Counts
    rollout_s: PositiveOrAll
    figures: Shown
    thesis: Coefficients = field(default_factory=dict)

    def compute(self, run: Run) -> Outcome:
        settings = settings_of(
            self.formulation,
            self.boxes,
            self.automatic,
            n_windows=[self.n_windows],
            n_points=self.n_points,
        )
        library, terms = terms_of(self.model, states=self.source.states)
        with run.progress(None, "", "data"):
            record = self.source.field()
        data = self.source.sampled(record, [library], run)
        f_data_Hz = dominant_frequency(data.t, data.states[:, 0])
        fitted = fit_settings(
            data,
            library,
            terms,
            settings,
            f_data_Hz=f_data_Hz,
            rollout_s=self.rollout_s,
            rng=np.random.default_rng(run.seed),
            progress=run.watch,
        )
        return Outcome(self, data, f_data_Hz, fitted)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What every setting makes of the data; f_data_Hz: dominant frequency of the first state."""

    study: Study
    data: Trajectory
    f_data_Hz: float
    fitted: Mapping[str, Fitted]

    @property
    def labelled(self) -> dict[str, Fitted]:
        """By what a reader calls the settings."""
        return {_label(name, fitted): fitted for name, fitted in self.fitted.items()}

    def models(self) -> dict[str, SparseModel]:
        return {name: fitted.integrated.model for name, fitted in self.fitted.items()}

    def tables(self) -> dict[str, pd.DataFrame]:
        models = {name: fitted.integrated for name, fitted in self.fitted.items()}
        return {
            **rollout_tables(self.data, models),
            "settings": settings_table(self.fitted, self.data.dt_s),
            "coefficients": coefficients(self.models(), heading="setting"),
        }

    def figures(self) -> dict[str, Captioned]:
        models = {name: fitted.integrated for name, fitted in self.labelled.items()}
        shown, smoother = self.study.figures, self.study.formulation.smoother
        return run_figures(FIGURES, self.data, models, shown, smoother=smoother)

    def sections(self) -> list[Section]:
        published = [
            Equation(state, terms, lead="thesis, Eq. 24", aside=True, on_screen=True)
            for state, terms in self.study.thesis.items()
        ]
        models = {name: fitted.integrated.model for name, fitted in self.labelled.items()}
        return [
            Section("Equations", [*published, Text(INTERVALS, page_only=True)]),
            *equation_sections(models, self.data.clock),
            Section("Integrated", [self._table(), *pictures(FIGURES)]),
        ]

    def _table(self) -> Table:
        rows = []
        for name, fitted in self.labelled.items():
            integrated, states = fitted.integrated, self.data.state_names
            f_text = self.data.clock.frequency_text(integrated.frequency_Hz[states[0]])
            steady = not np.isnan(fitted.f_error)
            of_model = {
                "f": f"{f_text} ({100 * fitted.f_error:+.0f} %)" if steady else "-",
                "nrmse": places(integrated.nrmse, 2),
                "verdict": integrated.text,
            }
            for k, state in enumerate(states):
                windows, score = self._windows(fitted, state), f"{fitted.r2[state]:.3f}"
                row = {"setting": "" if k else name, "state": state, **windows, "R2": score}
                rows.append(row if k else row | of_model)
        n = len(self.data.state_names)
        return Table(
            pd.DataFrame(rows).fillna(""),
            title=f"Models {INTEGRATED}",
            breaks=range(n - 1, len(rows), n),
            note=f"The data's first state has {self.data.clock.frequency_text(self.f_data_Hz)}. "
            "R2 is on each setting's own rows: windows average, so it is not comparable between "
            "settings.",
        )

    def _windows(self, fitted: Fitted, state: str) -> dict[str, str]:
        """Samples, length and periods of the first state in one window, from end to end."""
        boxes = fitted.setting.boxes
        steps = boxes.n_points - 1 if boxes else 2 * fitted.half_width.get(state, 0)
        if not steps:
            return dict.fromkeys(("samples", "length", "periods"), "-")
        length_s = steps * self.data.dt_s
        return {
            "samples": str(steps + 1),
            "length": self.data.clock.duration_text(length_s),
            "periods": f"{length_s * self.f_data_Hz:.2f}",
        }

    def summary(self) -> dict[str, Any]:
        dt_s = self.data.dt_s
        settings = {name: _summary(fitted, dt_s) for name, fitted in self.fitted.items()}
        return {"data": data_summary(self.data), "settings": settings}

    def headline(self) -> dict[str, float]:
        scalars = {"data/f_kHz": 1e-3 * self.f_data_Hz}
        for name, fitted in self.fitted.items():
            scalars[f"{name}/f_error"] = fitted.f_error
            scalars[f"{name}/nrmse"] = fitted.integrated.nrmse
            scalars |= {f"{name}/{state}/r2": value for state, value in fitted.r2.items()}
        return scalars


def _label(name: str, fitted: Fitted) -> str:
    """`70 points` for random windows; other names as words."""
    boxes = fitted.setting.boxes
    return f"{boxes.n_points} points" if boxes else name.replace("_", ", ")


def settings_table(fitted: Mapping[str, Fitted], dt_s: float) -> pd.DataFrame:
    """One row per setting and state: windows, equation, R2, and how the model runs."""
    rows = []
    for name, each in fitted.items():
        integrated, boxes = each.integrated, each.setting.boxes
        for state in integrated.model.states:
            half_width = each.half_width.get(state)
            rows.append(
                {
                    "setting": name,
                    "state": state,
                    "n_points": boxes.n_points if boxes else None,
                    "half_width": half_width,
                    "half_width_s": None if half_width is None else half_width * dt_s,
                    "text": equation_text(state, integrated.model.terms(state)),
                    "r2": each.r2[state],
                    "f_Hz": integrated.frequency_Hz[state],
                    "f_error": each.f_error,
                    "nrmse": integrated.nrmse,
                    "verdict": integrated.text,
                }
            )
    return pd.DataFrame(rows).astype({"n_points": "Int64", "half_width": "Int64"})


def _summary(fitted: Fitted, dt_s: float) -> dict[str, Any]:
    integrated = fitted.integrated
    model, boxes = integrated.model, fitted.setting.boxes
    windows: dict[str, Any] = {}
    if boxes:
        windows = {"n_points": boxes.n_points, "n_windows": boxes.n_windows}
    if fitted.half_width:
        windows = {
            "half_width": dict(fitted.half_width),
            "half_width_s": {state: n * dt_s for state, n in fitted.half_width.items()},
        }
    if (known := intervals(model)) is not None:
        windows["intervals"] = known
    return {
        **model_summary(model),
        **windows,
        "r2": dict(fitted.r2),
        "f_kHz": 1e-3 * integrated.frequency_Hz[model.states[0]],
        "f_error": fitted.f_error,
        "nrmse": integrated.nrmse,
        "verdict": integrated.text,
    }
