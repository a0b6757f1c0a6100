"""How the outcome of `benchmark` reads: tables of merits, the thesis's rows among ours."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.figures.attractors import attractor_figure
from ep2sindy.figures.identified import COUNTS, MERITS, benchmark_figure, merit_table
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import (
    Block,
    Captioned,
    Picture,
    Section,
    Table,
    Text,
    pictures,
    places,
)
from ep2sindy.studies.identified import FirstRealizations
from ep2sindy.studies.variants import Variant
from ep2sindy.systems.draws import DRAWS

FIGURE = (
    "Realizations in which all true equations are among the candidates (left), and are the ones "
    "selected (right), in %. A dash: the variant selects nothing, or N/A in the thesis."
)
EXAMPLE_FIGURES = {"attractors": False, "trajectories": True}  # over time
EXAMPLES = (
    "The first realization of every system and noise level: samples, truth, and the model that "
    "{variant} selects, integrated from where the truth starts. True terms need not follow a "
    "chaotic trajectory for long."
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


@dataclass(frozen=True, eq=False)
class Outcome:
    """Every outcome, and counts of them.

    published: the thesis's cells, as `cells` without the time. first: what is drawn of
    the first realizations; None where no variant makes models.
    """

    variants: Mapping[str, Variant]
    outcomes: pd.DataFrame
    cells: pd.DataFrame
    published: pd.DataFrame
    first: FirstRealizations | None

    def models(self) -> dict[str, SparseModel]:
        return {}

    def tables(self) -> dict[str, pd.DataFrame]:
        """Outcomes, and our cells beside what the thesis found in the same ones."""
        columns = {merit: f"thesis_{merit}" for merit in MERITS}
        keys = ["system", "noise", "variant"]
        beside = self.published.rename(columns=columns)[[*keys, *columns.values()]]
        return {"outcomes": self.outcomes, "cells": self.cells.merge(beside, how="left", on=keys)}

    def figures(self) -> dict[str, Captioned]:
        draw = partial(benchmark_figure, self.cells, thesis=self.published)
        found = {"benchmark": Captioned(draw, FIGURE)}
        if self.first:
            caption = EXAMPLES.format(variant=self.first.variant)
            for name, over_time in EXAMPLE_FIGURES.items():
                draw = partial(attractor_figure, self.first.found, over_time=over_time)
                found[name] = Captioned(draw, caption)
        return found

    def sections(self) -> list[Section]:
        n = int(self.cells["n"].iloc[0])
        levels = "/".join(f"{100 * noise:g}" for noise in self.cells["noise"].unique())
        counted = f"{n} realizations of every system and noise level."
        about: list[Block] = [Text(counted), Text(INTRODUCTION, page_only=True)]
        drawn = []
        if self.first:
            drawn = [
                Section(f"Identified by {self.first.variant}", pictures(list(EXAMPLE_FIGURES)))
            ]
        tables = [
            Section(f"{TITLES[m]}; noise {levels} %", [_readable(self.cells, self.published, m)])
            for m in MERITS
        ]
        variants = [Text(f"{n}: {v}", page_only=True) for n, v in self.variants.items()]
        return [
            Section("Realizations", [*about, Picture("benchmark")]),
            *drawn,
            *tables,
            Section("Variants", variants),
        ]

    def summary(self) -> dict[str, Any]:
        """Counts as whole numbers; null where a variant selects nothing."""
        rows = self.cells.astype({"on_front": int}).to_dict("records")
        return {
            "cells": [
                row | {"selected": None if np.isnan(row["selected"]) else int(row["selected"])}
                for row in rows
            ]
        }

    def headline(self) -> dict[str, float]:
        """Means over systems and noise levels; what selects nothing has 0 % selected, NaN terms."""
        scalars = {}
        for name, rows in self.cells.groupby("variant", sort=False):
            for merit in COUNTS:
                percent = 100.0 * rows[merit].sum() / rows["n"].sum()
                scalars[f"{name}/{merit}_percent"] = float(percent)
            scalars[f"{name}/mean_correct_terms"] = float(rows["mean_correct_terms"].mean())
            scalars[f"{name}/cpu_ms"] = float(1e3 * rows["cpu_s_per_search"].mean())
        return scalars


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
