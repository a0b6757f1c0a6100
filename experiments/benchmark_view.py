"""How the outcome of `experiments.benchmark` reads: terminal, and the report page."""

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from rich.table import Table

from ep2sindy.figures.identified import MERITS, merit_table
from ep2sindy.report.page import figure_html, page_html, table_html
from ep2sindy.report.screen import Screen
from ep2sindy.studies.benchmark import Variant
from ep2sindy.synthetic.draws import DRAWS


@dataclass(frozen=True)
class Outcome:
    """What the tables, the figure and the page are made from.

    published: the thesis's cells, as `ep2sindy.studies.benchmark.cells` without the time.
    """

    title: str
    variants: Mapping[str, Variant]
    cells: pd.DataFrame
    published: pd.DataFrame

    @property
    def n(self) -> int:
        return int(self.cells["n"].iloc[0])

    @property
    def systems(self) -> list[str]:
        return list(self.cells["system"].unique())

    @property
    def noises(self) -> str:
        return "/".join(f"{100 * noise:g}" for noise in self.cells["noise"].unique())

    def cpu_ms(self, variant: str) -> float:
        """Time of one search: the median of every cell, averaged over the cells."""
        rows = self.cells[self.cells["variant"] == variant]
        return float(1e3 * rows["cpu_s_per_search"].mean())


def title_of(merit: str, outcome: Outcome) -> str:
    what = {
        "on_front": "true equations on the front, % of realizations",
        "selected": "true equations selected, % of realizations",
        "mean_correct_terms": "true terms among the selected, mean (all of them in brackets)",
    }[merit]
    return f"{what}; noise {outcome.noises} %"


def merit_rows(outcome: Outcome, merit: str) -> pd.DataFrame:
    """A row per variant and per published one, a column per system, noise levels in a cell."""
    table = merit_table(outcome.cells, outcome.published, merit)
    digits = 2 if merit == "mean_correct_terms" else 0
    rows = []
    for name, published in table.index:
        values = table.loc[(name, published)]
        if values.isna().all() and not published:
            continue  # it leaves the selection to the user
        row: dict[str, object] = {
            "variant": f"{name}, thesis" if published else name,
            "published": published,
        }
        for system in outcome.systems:
            row[_heading(system, merit)] = "/".join(_number(v, digits) for v in values[system])
        rows.append(row | {"CPU (ms)": "" if published else f"{outcome.cpu_ms(name):.1f}"})
    return pd.DataFrame(rows)


def _heading(system: str, merit: str) -> str:
    if merit != "mean_correct_terms":
        return system
    model = DRAWS[system](np.random.default_rng(0)).system.model
    return f"{system} ({np.count_nonzero(model.coef)})"


def _number(value: float, digits: int) -> str:
    return "-" if np.isnan(value) else f"{value:.{digits}f}"


def print_outcome(screen: Screen, outcome: Outcome) -> None:
    screen.print(f"{outcome.n} realizations of every system and noise level")
    for merit in MERITS:
        rows = merit_rows(outcome, merit)
        shown = rows.drop(columns="published")
        table = Table(title=title_of(merit, outcome), title_justify="left", show_edge=False)
        for k, column in enumerate(shown.columns):
            table.add_column(column, justify="right" if k else "left", no_wrap=True)
        for values, published in zip(shown.to_numpy(), rows["published"], strict=True):
            table.add_row(*values, style="italic" if published else None)
        screen.print("", table)


def page(outcome: Outcome, figures: Mapping[str, Figure]) -> str:
    body = [
        f"<p>{outcome.n} realizations of every system and noise level. Each draws an initial "
        "state, or for the Van der Pol oscillator its parameter, at random; white noise of the "
        "given share of each state's RMS is added; the library holds ten terms. A realization "
        "counts only if the equations of all states are right at once. Every variant sees the "
        "same realizations. Italic rows: the thesis's own numbers, for 100 realizations.</p>"
    ]
    caption = (
        "Realizations in which all true equations are among the candidates (left), and are the "
        "ones selected (right), in %. A dash: the variant selects nothing, or N/A in the thesis."
    )
    body += [figure_html(name, caption) for name in figures]
    for merit in MERITS:
        rows = merit_rows(outcome, merit)
        shown = rows.drop(columns="published")
        italic = shown.map(lambda text: f"<i>{text}</i>")
        title = title_of(merit, outcome)
        body += [
            f"<h2>{title[0].upper()}{title[1:]}</h2>",
            table_html(shown.where(~rows["published"], italic)),
        ]
    body.append("<h2>Variants</h2><dl>")
    for name, variant in outcome.variants.items():
        body.append(f"<dt><b>{escape(name)}</b></dt><dd><code>{escape(str(variant))}</code></dd>")
    body.append("</dl><footer>CPU time of one search (all equations of one realization), on one ")
    body.append("thread. Config, every outcome and these tables lie beside.</footer>")
    return page_html(outcome.title, body)
