"""How models judged on held-out data read: tables, figures, sections, summary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.equations import equation_text
from ep2sindy.model.free_run import FreeRun
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Captioned, Section, Table, Text, pictures
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.held_out import Judged
from ep2sindy.studies.source import data_summary
from ep2sindy.studies.views import (
    MARKS,
    PlotRange,
    coefficients,
    equation_sections,
    intervals,
    model_summary,
    rollout_tables,
    run_figures,
    trajectories,
)

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
SINCE = "time since start of held-out part"
FIGURES = ("phase", "spectra")
COMPARED = ("f_error", "nrmse", "amplitude_ratio")


@dataclass(frozen=True, eq=False)
class Outcome:
    """Models by name, fitted to `train` and judged on `held`.

    labels: what a reader calls the models. relations: that the constrained ones obey. findings,
    more_tables, more_figures, more_sections: what the study itself adds.
    """

    train: Trajectory
    held: Trajectory
    judged: Mapping[str, Judged]
    labels: Mapping[str, str]
    relations: Sequence[str]
    shown: PlotRange
    findings: Mapping[str, Any]
    more_tables: Mapping[str, pd.DataFrame] = field(default_factory=dict)
    more_figures: Mapping[str, Captioned] = field(default_factory=dict)
    more_sections: Sequence[Section] = ()

    @property
    def f_data_Hz(self) -> float:
        """Of the first state on the held-out part, as models are held against it."""
        return dominant_frequency(self.held.t, self.held.states[:, 0])

    @property
    def labelled(self) -> dict[str, Judged]:
        return {self.labels[name]: each for name, each in self.judged.items()}

    def models(self) -> dict[str, SparseModel]:
        return {name: each.model for name, each in self.judged.items()}

    def tables(self) -> dict[str, pd.DataFrame]:
        integrated = {name: each.from_sample for name, each in self.judged.items()}
        rows = [row for name, each in self.judged.items() for row in _rows(name, each)]
        return {
            **rollout_tables(self.held, integrated),
            "methods": pd.DataFrame(rows),
            "coefficients": coefficients(self.models(), heading="method"),
            **self.more_tables,
        }

    def figures(self) -> dict[str, Captioned]:
        sample = {name: each.from_sample for name, each in self.labelled.items()}
        fit = {name: each.from_fit for name, each in self.labelled.items()}
        runs = {
            name: trajectories(self.held, models, self.shown, caption, since=SINCE)
            for (name, caption), models in zip(CAPTIONS.items(), (sample, fit), strict=True)
        }
        more = run_figures(FIGURES, self.held, sample, self.shown)
        return {**runs, **more, **self.more_figures}

    def sections(self) -> list[Section]:
        models = {label: each.model for label, each in self.labelled.items()}
        known = any(model.covariance is not None for model in models.values())
        relations = [Text(f"relation: {text}") for text in self.relations]
        intervals = [Text(INTERVALS, page_only=True)] if known else []
        shown = pictures([*CAPTIONS, *FIGURES, *self.more_figures])
        return [
            Section("Equations", [*relations, *intervals]),
            *equation_sections(models, self.held.clock, page_only=True),
            Section("Held-out time", [self._table(), *shown]),
            *self.more_sections,
        ]

    def _table(self) -> Table:
        """A row per model: how it runs."""
        rows = pd.DataFrame(
            [_readable(name, each, self.f_data_Hz) for name, each in self.labelled.items()]
        )
        if rows["status"].isna().all():  # least squares has none
            del rows["status"]
        return Table(
            rows,
            title=TITLE,
            note=f"Data, held out: {self.held.clock.frequency_text(self.f_data_Hz)}. Amplitude: "
            "standard deviation against the data's. Start fitted: frequency error and nrmse from "
            "a start fitted to the first one and a half periods.",
        )

    def summary(self) -> dict[str, Any]:
        n_held_out = self.held.n_samples
        data = data_summary(self.train) | {
            "n_samples": self.train.n_samples + n_held_out,
            "n_held_out": n_held_out,
            "f_kHz": 1e-3 * self.f_data_Hz,
        }
        return {"data": data, **self.findings}

    def headline(self) -> dict[str, float]:
        found: dict[str, float] = {}
        for name, each in self.judged.items():
            numbers = run_summary(each.from_sample)
            found |= {f"{name}/{key}": numbers[key] for key in COMPARED}
            found[f"{name}/cpu_s"] = each.cpu_s
        return found


def _rows(name: str, judged: Judged) -> list[dict[str, Any]]:
    """One row per state; _started: from a start fitted to the first samples."""
    rows = []
    for state in judged.model.states:
        text = equation_text(state, judged.model.terms(state))
        row: dict[str, Any] = {"method": name, "state": state, "text": text}
        for run, suffix in ((judged.from_sample, ""), (judged.from_fit, "_started")):
            row |= {
                f"f_Hz{suffix}": run.frequency_Hz[state],
                f"f_error{suffix}": run.f_error,
                f"nrmse{suffix}": run.nrmse,
                f"amplitude_ratio{suffix}": run.amplitude_ratio[state],
            }
        rows.append(row | {"loss": judged.loss, "status": judged.status, "cpu_s": judged.cpu_s})
    return rows


def _readable(label: str, judged: Judged, f_data_Hz: float) -> dict[str, Any]:
    sample, fit = judged.from_sample, judged.from_fit
    frequency = sample.rollout.clock.frequency_text(f_data_Hz * (1.0 + sample.f_error))
    return {
        "method": label,
        "f": _or_verdict(sample, f"{frequency} ({100 * sample.f_error:+.1f} %)"),
        "nrmse": sample.nrmse,
        **{f"amplitude {state}": ratio for state, ratio in sample.amplitude_ratio.items()},
        "verdict": str(sample.verdict),
        "start fitted": _or_verdict(fit, f"{100 * fit.f_error:+.1f} %, {fit.nrmse:.2f}"),
        "status": judged.status,
        "CPU s": judged.cpu_s,
    }


def _or_verdict(run: FreeRun, text: str) -> str:
    """The text, or what became of a model that has no frequency."""
    return run.text if np.isnan(run.f_error) else text


def judged_summary(judged: Judged) -> dict[str, Any]:
    """f_kHz, f_error, nrmse, amplitude_ratio: of the first state, from the first sample."""
    return {
        **model_summary(judged.model),
        **run_summary(judged.from_sample),
        "fitted_start": run_summary(judged.from_fit),
        "status": judged.status,
        "loss": judged.loss,
        "ci95": intervals(judged.model),
        "cpu_s": judged.cpu_s,
    }


def run_summary(run: FreeRun) -> dict[str, Any]:
    first = run.model.states[0]
    return {
        "f_kHz": 1e-3 * run.frequency_Hz[first],
        "f_error": run.f_error,
        "nrmse": run.nrmse,
        "amplitude_ratio": run.amplitude_ratio[first],
        "waveform_error": run.waveform_error[first],
        "periods": run.periods,
        "verdict": run.text,
    }
