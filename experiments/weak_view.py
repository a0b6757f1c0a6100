"""How the outcome of `experiments.weak` reads: tables, terminal, and the report page."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.table import Table

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.equations import equation_html, equation_text
from ep2sindy.library.units import prefixed
from ep2sindy.report.page import figure_html, page_html, table_html
from ep2sindy.report.screen import Screen
from ep2sindy.signals.spectrum import frequency_text
from ep2sindy.studies.weak_forms import Fitted
from experiments.model_view import equations_html, frequency_cell, intervals_text


@dataclass(frozen=True)
class Outcome:
    """What the tables, the figures and the page are made from.

    f_data_Hz: dominant frequency of the first state. published: state -> term -> coefficient.
    """

    title: str
    run: Trajectory
    f_data_Hz: float
    fitted: Mapping[str, Fitted]
    published: Mapping[str, Mapping[str, float]]

    @property
    def labelled(self) -> dict[str, Fitted]:
        """By what a reader calls the settings."""
        return {label(name, fitted): fitted for name, fitted in self.fitted.items()}


def label(name: str, fitted: Fitted) -> str:
    """`70 points` for random windows; other names as words."""
    boxes = fitted.setting.boxes
    return f"{boxes.n_points} points" if boxes else name.replace("_", ", ")


def window_texts(fitted: Fitted, state: str, outcome: Outcome) -> dict[str, str]:
    """Samples, length and periods of the first state in one window, from end to end."""
    boxes = fitted.setting.boxes
    steps = boxes.n_points - 1 if boxes else 2 * fitted.half_width.get(state, 0)
    if not steps:
        return dict.fromkeys(("samples", "length", "periods"), "-")
    length_s = steps * outcome.run.dt_s
    factor, prefix = prefixed(length_s)
    return {
        "samples": str(steps + 1),
        "length": f"{length_s * factor:.3g} {prefix}s",
        "periods": f"{length_s * outcome.f_data_Hz:.2f}",
    }


def settings_table(outcome: Outcome) -> pd.DataFrame:
    """One row per setting and state: windows, equation, R2, and how the model runs."""
    rows = []
    for name, fitted in outcome.fitted.items():
        integrated, boxes = fitted.integrated, fitted.setting.boxes
        for state in integrated.model.states:
            half_width = fitted.half_width.get(state)
            rows.append(
                {
                    "setting": name,
                    "state": state,
                    "n_points": boxes.n_points if boxes else None,
                    "half_width": half_width,
                    "half_width_s": None if half_width is None else half_width * outcome.run.dt_s,
                    "text": equation_text(state, integrated.model.terms(state)),
                    "r2": fitted.r2[state],
                    "f_Hz": integrated.frequency_Hz[state],
                    "f_error": fitted.f_error,
                    "nrmse": integrated.nrmse,
                    "verdict": integrated.verdict,
                }
            )
    return pd.DataFrame(rows).astype({"n_points": "Int64", "half_width": "Int64"})


def print_outcome(screen: Screen, outcome: Outcome) -> None:
    for state, terms in outcome.published.items():
        screen.print(f"thesis, Eq. 24: {equation_text(state, terms)}")
    table = Table(title=f"f, nrmse: {TITLE}", show_edge=False, padding=(0, 0))
    for heading in ("setting", "samples", "length", "periods", "R2", "model", "f", "nrmse"):
        table.add_column(heading, no_wrap=True)
    for name, fitted in outcome.labelled.items():
        integrated = fitted.integrated
        states = integrated.model.states
        for k, state in enumerate(states):
            table.add_row(
                "" if k else name,
                *window_texts(fitted, state, outcome).values(),
                f"{fitted.r2[state]:.3f}",
                equation_text(state, integrated.model.terms(state)),
                "" if k else frequency_cell(fitted.integrated, states[0], fitted.f_error),
                "" if k else ("-" if np.isnan(integrated.nrmse) else f"{integrated.nrmse:.2f}"),
                end_section=k == len(states) - 1,
            )
    screen.print(table)
    for name, fitted in outcome.labelled.items():
        model = fitted.integrated.model
        if model.covariance is not None:
            for state in model.states:
                screen.print(f"{name}: {state}' {intervals_text(model, state)}")


TITLE = "integrated from the first sample (nrmse 1: no better than a constant)"
CAPTIONS = {
    "trajectories": "Models integrated from the first sample (colour) over the data (grey).",
    "phase": "Phase portraits of the integrated models (colour) over the data (grey).",
    "derivatives": "Right-hand sides on the data (colour) over the data's derivative (grey).",
    "spectra": "Power spectra of the integrated models (colour) and of the data over the same time "
    "(grey); the dashed line marks the data's dominant frequency, the number is the model's.",
}


def page(outcome: Outcome, figures: Mapping[str, Figure]) -> str:
    body = ["<h2>Equations</h2>"]
    for state, terms in outcome.published.items():
        body.append(f'<p class="published">thesis, Eq. 24: {equation_html(state, terms)}</p>')
    models = {name: fitted.integrated.model for name, fitted in outcome.labelled.items()}
    body += equations_html(models)
    body += [
        "<p>The intervals say how far the noise of the samples moves the coefficients if these "
        "terms are the whole law; what the terms lack, they do not count.</p>",
        "<h2>Integrated</h2>",
        f"<p>Models {TITLE}; the data's first state has {frequency_text(outcome.f_data_Hz)}.</p>",
        table_html(_readable(outcome)),
        *(figure_html(name, CAPTIONS[name]) for name in CAPTIONS if name in figures),
        "<footer>All values in SI units. R2 is on each setting's own rows: windows average, so "
        "it is not comparable between settings. Config, models and tables lie beside.</footer>",
    ]
    return page_html(outcome.title, body)


def _readable(outcome: Outcome) -> pd.DataFrame:
    rows = []
    for name, fitted in outcome.labelled.items():
        for k, state in enumerate(fitted.integrated.model.states):
            rows.append(
                {
                    "setting": "" if k else name,
                    "state": state,
                    **window_texts(fitted, state, outcome),
                    "R2": fitted.r2[state],
                    "frequency": ""
                    if k
                    else frequency_cell(fitted.integrated, state, fitted.f_error),
                    "nrmse": "" if k else fitted.integrated.nrmse,
                    "verdict": "" if k else fitted.integrated.verdict,
                }
            )
    return pd.DataFrame(rows)
