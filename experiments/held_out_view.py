"""How models judged on held-out data read: tables, terminal, report page, summary."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.table import Table

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.series import rollout_figures, trajectory_figure
from ep2sindy.library.equations import equation_text
from ep2sindy.model.model import SparseModel
from ep2sindy.report.page import figure_html, page_html, table_html
from ep2sindy.report.screen import Screen
from ep2sindy.signals.spectrum import dominant_frequency, frequency_text
from ep2sindy.studies.held_out import HeldOutRun, Judged
from experiments.model_view import equations_html


@dataclass(frozen=True)
class Outcome:
    """What the tables, the figures and the page are made from.

    judged: by name. labels: what a reader calls them. relations: as the config has them.
    """

    title: str
    train: Trajectory
    held: Trajectory
    judged: Mapping[str, Judged]
    labels: Mapping[str, str]
    relations: Sequence[str]

    @property
    def f_data_Hz(self) -> float:
        """Of the first state on the held-out part, as models are held against it."""
        return dominant_frequency(self.held.t, self.held.states[:, 0])

    @property
    def models(self) -> dict[str, SparseModel]:
        return {name: each.model for name, each in self.judged.items()}

    @property
    def labelled(self) -> dict[str, Judged]:
        return {self.labels[name]: each for name, each in self.judged.items()}


def data_summary(outcome: Outcome) -> dict[str, Any]:
    run = outcome.train
    return {
        "n_samples": run.n_samples + outcome.held.n_samples,
        "n_held_out": outcome.held.n_samples,
        "dt_s": run.dt_s,
        "f_kHz": 1e-3 * outcome.f_data_Hz,
        "variables": list(run.names),
        "units": dict(run.units),
    }


def judged_summary(judged: Judged) -> dict[str, Any]:
    """f_kHz, f_error, nrmse, amplitude_ratio: of the first state, from the first sample."""
    model = judged.model
    known = model.covariance is not None
    return {
        "text": model.text(),
        "equations": {state: model.terms(state) for state in model.states},
        **run_summary(judged.from_sample),
        "fitted_start": run_summary(judged.from_fit),
        "status": judged.status,
        "loss": judged.refinement.loss if judged.refinement else None,
        "ci95": {state: model.intervals(state) for state in model.states} if known else None,
        "cpu_s": judged.cpu_s,
    }


def run_summary(run: HeldOutRun) -> dict[str, Any]:
    first = run.integrated.model.states[0]
    return {
        "f_kHz": 1e-3 * run.integrated.frequency_Hz[first],
        "f_error": run.f_error,
        "nrmse": run.integrated.nrmse,
        "amplitude_ratio": run.amplitude_ratio[first],
        "verdict": run.integrated.verdict,
    }


def methods_table(outcome: Outcome) -> pd.DataFrame:
    """One row per method and state; _started: from a start fitted to the first samples."""
    rows = []
    for name, each in outcome.judged.items():
        for state in each.model.states:
            row: dict[str, Any] = {
                "method": name,
                "state": state,
                "text": equation_text(state, each.model.terms(state)),
            }
            for run, suffix in ((each.from_sample, ""), (each.from_fit, "_started")):
                row |= {
                    f"f_Hz{suffix}": run.integrated.frequency_Hz[state],
                    f"f_error{suffix}": run.f_error,
                    f"nrmse{suffix}": run.integrated.nrmse,
                    f"amplitude_ratio{suffix}": run.amplitude_ratio[state],
                }
            loss = each.refinement.loss if each.refinement else np.nan
            rows.append(row | {"loss": loss, "status": each.status, "cpu_s": each.cpu_s})
    return pd.DataFrame(rows)


def print_outcome(screen: Screen, outcome: Outcome) -> None:
    for relation in outcome.relations:
        screen.print(f"relation: {relation}")
    table = Table(title=TITLE, show_edge=False, padding=(0, 0))
    for heading in ("method", "model", "f", "nrmse", "amplitude", "start fitted", "status"):
        table.add_column(heading)
    for name, each in outcome.labelled.items():
        states = each.model.states
        for k, state in enumerate(states):
            table.add_row(
                "" if k else name,
                equation_text(state, each.model.terms(state)),
                "" if k else _frequency(each.from_sample, state),
                "" if k else _number(each.from_sample.integrated.nrmse),
                _number(each.from_sample.amplitude_ratio[state]),
                _numbers(each.from_fit) if not k else "",
                "" if k else each.status or "-",
                end_section=k == len(states) - 1,
            )
    screen.print(table)
    screen.print(f"data, held out: {frequency_text(outcome.f_data_Hz)}. {STARTED}")


def _frequency(run: HeldOutRun, state: str) -> str:
    """`15.1 kHz (+7.1 %)`, or what became of the model instead."""
    frequency_Hz = run.integrated.frequency_Hz[state]
    if np.isnan(frequency_Hz):
        return run.integrated.verdict
    return f"{frequency_text(frequency_Hz)} ({100 * run.f_error:+.1f} %)"


def _numbers(run: HeldOutRun) -> str:
    """Frequency error and nrmse in one cell."""
    if np.isnan(run.f_error):
        return run.integrated.verdict
    return f"{100 * run.f_error:+.1f} %, {_number(run.integrated.nrmse)}"


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.2f}"


TITLE = "integrated over held-out time from its first sample (nrmse 1: no better than a constant)"
STARTED = (
    "Start fitted: frequency error and nrmse from a start fitted to the first one and a half "
    "periods."
)
CAPTIONS = {
    "trajectories": "Models integrated over held-out time from its first sample (colour) over the "
    "data (grey).",
    "trajectories_started": "The same from a start fitted to the first one and a half periods.",
    "phase": "Phase portraits of the integrated models (colour) over the data (grey).",
    "spectra": "Power spectra of the integrated models (colour) and of the data over the same time "
    "(grey); the dashed line marks the data's dominant frequency, the number is the model's.",
    "loss_against_window": "Refinement with windows of several lengths: loss on the fitted part, "
    "where each window has a start of its own; frequency error and nrmse on held-out time, from "
    "its first sample (full) and from a fitted start (dashed). The dotted line marks one period, "
    "the grey one 1 %.",
}


def figures_of(
    outcome: Outcome, *, duration_s: float | None, f_max_Hz: float | None
) -> dict[str, Figure]:
    held = outcome.held
    shown_s = duration_s or float(held.t[-1] - held.t[0])
    rollouts = {name: j.from_sample.integrated.rollout for name, j in outcome.labelled.items()}
    started = {name: j.from_fit.integrated.rollout for name, j in outcome.labelled.items()}
    return {
        **rollout_figures(held, rollouts, duration_s=shown_s, f_max_Hz=f_max_Hz),
        "trajectories_started": trajectory_figure(held, started, duration_s=shown_s),
    }


def page(outcome: Outcome, figures: Mapping[str, Figure]) -> str:
    labelled = {name: each.model for name, each in outcome.labelled.items()}
    known = any(model.covariance is not None for model in labelled.values())
    body = ["<h2>Equations</h2>"]
    body += [f'<p class="published">relation: {text}</p>' for text in outcome.relations]
    body += equations_html(labelled)
    if known:
        body.append(
            "<p>The intervals say how far the windows' residuals move the coefficients; starts "
            "are fitted with them.</p>"
        )
    body += [
        "<h2>Held-out time</h2>",
        f"<p>Models {TITLE}; the data's first state has {frequency_text(outcome.f_data_Hz)}. "
        f"{STARTED}</p>",
        table_html(_readable(outcome)),
        *(figure_html(name, CAPTIONS[name]) for name in CAPTIONS if name in figures),
        "<footer>All values in SI units; amplitude: standard deviation against the data's. Config, "
        "models and tables lie beside.</footer>",
    ]
    return page_html(outcome.title, body)


def _readable(outcome: Outcome) -> pd.DataFrame:
    rows = []
    for name, each in outcome.labelled.items():
        for k, state in enumerate(each.model.states):
            rows.append(
                {
                    "method": "" if k else name,
                    "state": state,
                    "frequency": "" if k else _frequency(each.from_sample, state),
                    "nrmse": "" if k else each.from_sample.integrated.nrmse,
                    "amplitude": each.from_sample.amplitude_ratio[state],
                    "start fitted": "" if k else _numbers(each.from_fit),
                    "status": "" if k else each.status or "&ndash;",
                    "CPU s": "" if k else each.cpu_s,
                }
            )
    return pd.DataFrame(rows)
