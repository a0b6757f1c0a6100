"""How the outcome of `experiments.libraries` reads: tables, terminal, and the report page."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.table import Table

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.equations import equation_html, equation_text
from ep2sindy.model.integrated import Integrated
from ep2sindy.report.page import figure_html, page_html, table_html
from ep2sindy.report.screen import Screen
from ep2sindy.signals.spectrum import dominant_frequency, frequency_text
from ep2sindy.studies.libraries import LibraryResult, candidate_text, front_table


@dataclass(frozen=True)
class Outcome:
    """What the tables, the figures and the page are made from."""

    title: str
    run: Trajectory
    results: Mapping[str, LibraryResult]

    @property
    def models(self) -> dict[str, Integrated]:
        """Selected models by library, then those of published terms."""
        selected = {name: r.selected for name, r in self.results.items()}
        published = {
            f"{name}, thesis's terms": r.published
            for name, r in self.results.items()
            if r.published is not None
        }
        return selected | published


def front_tables(result: LibraryResult) -> pd.DataFrame:
    return pd.concat([_front_table(result, state) for state in result.discovery.fronts])


def _front_table(result: LibraryResult, state: str) -> pd.DataFrame:
    found = result.discovery
    return front_table(found.fronts[state], found.scores[state], label=result.case.selection.label)


def comparison(outcome: Outcome) -> pd.DataFrame:
    """One row per model: frequencies in Hz, trajectory error, and a word on the trajectory."""
    run = outcome.run
    rows = []
    for name, model in outcome.models.items():
        row: dict[str, Any] = {"model": name}
        for state, column in zip(run.state_names, run.states.T, strict=True):
            row[f"f_data_{state}_Hz"] = dominant_frequency(run.t, column)
            row[f"f_model_{state}_Hz"] = model.frequency_Hz[state]
        rows.append(row | {"nrmse": model.nrmse, "verdict": model.verdict})
    return pd.DataFrame(rows)


def print_data(screen: Screen, run: Trajectory, attributes: Mapping[str, Any]) -> None:
    if "status" in attributes:  # ours, from a simulation
        screen.print(
            f"simulation: {attributes['status']}; discharge current "
            f"{attributes['I_d_mean']:.2f} A, standard deviation {attributes['I_d_std']:.2f} A; "
            f"mass out/in {attributes['mass_balance']:.4f}"
        )
        if attributes["status"] != "oscillating":
            screen.print("[bold red]this case does not sustain its oscillation[/bold red]")
    frequencies = ", ".join(
        f"{name} {frequency_text(dominant_frequency(run.t, column))}"
        for name, column in zip(run.state_names, run.states.T, strict=True)
    )
    screen.print(
        f"data: {run.n_samples} samples of {run.dt_s:.4g} s; dominant frequency {frequencies}"
    )


def print_outcome(screen: Screen, outcome: Outcome) -> None:
    for name, result in outcome.results.items():
        library = result.case.library
        screen.print(
            f"\n[bold]{name}[/bold]: {len(library)} terms in {', '.join(library.variables)}; "
            f"selection: {result.case.selection}"
        )
        for ambiguity in result.discovery.ambiguities:
            if ambiguity.exact:
                screen.print(f"  note: {ambiguity.message}")
        n_alike = sum(not a.exact for a in result.discovery.ambiguities)
        if n_alike:
            screen.print(
                f"  note: nearly proportional terms: {n_alike}, see tables/ambiguities_{name}.csv"
            )
        for state in result.discovery.fronts:
            screen.print(_rich_front(result, state))
    screen.print(_rich_comparison(outcome))


def _rich_front(result: LibraryResult, state: str) -> Table:
    label = result.case.selection.label
    held_out = result.discovery.fronts[state].problem.test.any()
    r2, r2_header = ("r2_test", "R2 test") if held_out else ("r2_train", "R2 train")
    table = Table("terms", r2_header, label, "share", "model", show_edge=False)
    for row in _front_table(result, state).to_dict("records"):
        table.add_row(
            str(row["n_terms"]),
            f"{row[r2]:.3f}",
            f"{row[label]:.3f}",
            "-" if np.isnan(row["share"]) else f"{row['share']:.2f}",
            row["text"],
            style="bold green" if row["selected"] else None,
        )
    terms = result.discovery.model.terms(state)
    if terms != result.discovery.chosen[state].coef_by_term:
        table.add_row("", "", "", "", f"weighted: {equation_text(state, terms)}", style="green")
    if state in result.refitted:
        published = equation_text(state, result.case.published[state])
        here = result.refitted[state]
        table.add_row("", "", "", "", f"thesis: {published}", style="italic")
        table.add_row(
            str(here.n_terms),
            f"{here.r2_test if held_out else here.r2_train:.3f}",
            "",
            "",
            f"its terms here: {candidate_text(here)}",
            style="italic",
            end_section=True,
        )
    return table


def _rich_comparison(outcome: Outcome) -> Table:
    table = Table("model", "state", "f data", "f model", "nrmse", "verdict", title=TITLE)
    for row in comparison(outcome).to_dict("records"):
        for k, state in enumerate(outcome.run.state_names):
            table.add_row(
                "" if k else row["model"],
                state,
                frequency_text(row[f"f_data_{state}_Hz"]),
                frequency_text(row[f"f_model_{state}_Hz"]),
                "" if k else ("-" if np.isnan(row["nrmse"]) else f"{row['nrmse']:.3f}"),
                "" if k else row["verdict"],
            )
    return table


TITLE = "integrated from the first sample (nrmse 1: no better than a constant)"
CAPTIONS = {
    "data": "States (start of the record) and their power spectra; the line marks the peak.",
    "trajectories": "Models integrated from the first sample (colour) over the data (grey).",
    "trajectories_thesis": "The same with the thesis's terms, fitted to these data.",
    "derivatives": "Right-hand sides on the data (colour) over the data's derivative (grey).",
    "phase": "Phase portraits of the integrated models (colour) over the data (grey).",
}


def page(outcome: Outcome, figures: Mapping[str, Figure]) -> str:
    body = ["<h2>Equations</h2>"]
    for name, result in outcome.results.items():
        body.append(f"<h3>{name}</h3>")
        for state in result.discovery.fronts:
            terms = result.discovery.model.terms(state)
            body.append(f'<p class="equation">{equation_html(state, terms)}</p>')
            if state in result.refitted:
                there = equation_html(state, result.case.published[state])
                here = equation_html(state, result.refitted[state].coef_by_term)
                r2 = result.refitted[state].r2_test
                body.append(f'<p class="published">thesis: {there}</p>')
                body.append(f'<p class="published">its terms here: {here} (R2 {r2:.2f})</p>')
    body += ["<h2>Integrated</h2>", f"<p>Models {TITLE}.</p>", table_html(comparison(outcome))]
    body += [figure_html(n, CAPTIONS[n]) for n in CAPTIONS if n in figures]
    body.append("<h2>Pareto fronts</h2>")
    for name, result in outcome.results.items():
        frame = front_tables(result)
        body += [
            f"<h3>{name}</h3>",
            figure_html(f"front_{name}", "Error against number of terms; the star is selected."),
            table_html(frame.drop(columns="selected"), bold=frame["selected"].tolist()),
        ]
    body.append("<footer>All values in SI units. Config, models and tables lie beside.</footer>")
    return page_html(outcome.title, body)
