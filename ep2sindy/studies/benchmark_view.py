"""How the outcome of `benchmark` reads: tables of merits, the thesis's rows among ours."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.figures.identified import MERITS, merit_table
from ep2sindy.report.document import Block, Picture, Section, Table, Text, places
from ep2sindy.synthetic.draws import DRAWS

FIGURE = (
    "Realizations in which all true equations are among the candidates (left), and are the ones "
    "selected (right), in %. A dash: the variant selects nothing, or N/A in the thesis."
)
INTRODUCTION = (
    "Each realization draws an initial state, or for the Van der Pol oscillator its parameter, at "
    "random; white noise of the given share of each state's RMS is added; the library holds ten "
    "terms. A realization counts only if the equations of all states are right at once. Every "
    "variant sees the same realizations. Italic rows: the thesis's own numbers, for 100 "
    "realizations. CPU: time of one search (all equations of one realization), on one thread."
)
TITLES = {
    "on_front": "True equations on the front, % of realizations",
    "selected": "True equations selected, % of realizations",
    "mean_correct_terms": "True terms among the selected, mean (all of them in brackets)",
}


def published_cells(thesis: Mapping[str, Any]) -> pd.DataFrame:
    """The thesis's tables in the shape of our cells; selected as a number of realizations."""
    columns = ["on_front", "selected_percent_of_those", "mean_correct_terms"]
    rows = [
        (variant, system, *values)
        for variant, systems in thesis["on_front"].items()
        for system in systems
        for values in zip(
            thesis["noises"], *(thesis[column][variant][system] for column in columns), strict=True
        )
    ]
    table = pd.DataFrame(rows, columns=["variant", "system", "noise", *columns])
    table = table.astype(dict.fromkeys(["noise", *columns], float))
    percent = table.pop("selected_percent_of_those")
    table["selected"] = (table["on_front"] * percent / 100.0).round(1)
    return table.assign(n=thesis["n"])


def sections(
    variants: Mapping[str, object], cells: pd.DataFrame, published: pd.DataFrame
) -> list[Section]:
    n = int(cells["n"].iloc[0])
    levels = "/".join(f"{100 * noise:g}" for noise in cells["noise"].unique())
    counted = f"{n} realizations of every system and noise level."
    texts: list[Block] = [Text(counted), Text(INTRODUCTION, page_only=True), Picture("benchmark")]
    tables = [
        Section(f"{TITLES[merit]}; noise {levels} %", [_readable(cells, published, merit)])
        for merit in MERITS
    ]
    described = [Text(f"{name}: {variant}", page_only=True) for name, variant in variants.items()]
    return [Section("Realizations", texts), *tables, Section("Variants", described)]


def _readable(cells: pd.DataFrame, published: pd.DataFrame, merit: str) -> Table:
    """A row per variant and per published one, a column per system, noise levels in a cell."""
    table = merit_table(cells, published, merit)
    digits = 2 if merit == "mean_correct_terms" else 0
    cpu_ms = 1e3 * cells.groupby("variant")["cpu_s_per_search"].mean()
    rows: list[dict[str, str]] = []
    italic: list[int] = []
    for name, is_published in table.index:
        values = table.loc[(name, is_published)]
        if is_published:
            italic.append(len(rows))
        elif values.isna().all():
            continue  # it leaves the selection to the user
        row = {"variant": f"{name}, thesis" if is_published else name}
        for system in cells["system"].unique():
            row[_heading(system, merit)] = "/".join(places(v, digits) for v in values[system])
        rows.append(row | {"CPU (ms)": "" if is_published else f"{cpu_ms[name]:.1f}"})
    return Table(pd.DataFrame(rows), italic=italic)


def _heading(system: str, merit: str) -> str:
    if merit != "mean_correct_terms":
        return system
    model = DRAWS[system](np.random.default_rng(0)).system.model
    return f"{system} ({np.count_nonzero(model.coef)})"
