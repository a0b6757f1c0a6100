"""How runs read side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path
from typing import Any

import pandas as pd

from ep2sindy.app.read_run import ReadRun, link_to
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Block, Link, Picture, Section, Table, Text, cell_text
from ep2sindy.report.picture import Drawn, read_png
from ep2sindy.report.results import in_words, value_text
from ep2sindy.studies.views import shown_equation

NOTE = (
    "Apart: the 95 % intervals of two runs have no value in common; overlap: all have. A dash: "
    "the term is not in the model, or its interval is not known."
)


def compared(runs: Sequence[ReadRun], *, beside: Path) -> list[Section]:
    """Runs, settings that differ, headline figures, equations, figures. beside: of the page."""
    return [
        Section("Runs", [_runs(runs, beside), *_versions(runs)]),
        Section("Settings that differ", [_differing(_settings(runs), "setting", "the same")]),
        Section("Headline figures", [_headlines(runs)]),
        *_models(runs),
        *_pictures(runs),
    ]


def _runs(runs: Sequence[ReadRun], beside: Path) -> Table:
    rows = [
        {
            "run": run.label,
            "experiment": run.summary["experiment"],
            "folder": Link(str(run.folder), link_to(run, beside)),
            "seed": str(run.summary["seed"]),
            "code": str(run.provenance.get("commit", "-"))[:12],
            "warnings": str(len(run.summary.get("warnings", []))),
        }
        for run in runs
    ]
    return Table(pd.DataFrame(rows))


def _versions(runs: Sequence[ReadRun]) -> list[Block]:
    """Of packages, where they differ."""
    versions = {run.label: run.provenance.get("versions", {}) for run in runs}
    table = _differing(versions, "package", "")
    return [table] if isinstance(table, Table) else []


def _settings(runs: Sequence[ReadRun]) -> dict[str, Mapping[str, Any]]:
    return {run.label: {k: v for k, v in run.settings.items() if k != "output"} for run in runs}


def _differing(values: Mapping[str, Mapping[str, Any]], heading: str, none: str) -> Block:
    """A row per name whose value is not everywhere the same; a word where there is none."""
    names = dict.fromkeys(name for each in values.values() for name in each)
    rows = []
    for name in names:
        row = {label: cell_text(each.get(name)) for label, each in values.items()}
        if len(set(row.values())) > 1:
            rows.append({heading: name, **row})
    return Table(pd.DataFrame(rows)) if rows else Text(f"None: they are {none}." if none else "")


def _headlines(runs: Sequence[ReadRun]) -> Table:
    """In words; of two runs also by how much the second is off the first."""
    names = dict.fromkeys(name for run in runs for name in run.headline)
    rows = []
    for name in names:
        found = [run.headline.get(name, float("nan")) for run in runs]
        row: dict[str, Any] = {"figure": in_words(name)}
        texts = [value_text(name, v, run.clock) for run, v in zip(runs, found, strict=True)]
        row |= dict(zip((run.label for run in runs), texts, strict=True))
        if any(value == value for value in found):
            rows.append(row | ({"change": _change(*found)} if len(found) == 2 else {}))
    return Table(pd.DataFrame(rows))


def _change(before: float, after: float) -> str:
    """`+2.1 %`, or the difference of what is small or changes sign; a dash for what is unknown."""
    change = after - before
    if change != change or change == 0.0:
        return "0" if change == 0.0 else "-"
    if before * after > 0.0 and abs(change) < abs(before):
        return f"{100.0 * change / before:+.2g} %"
    return f"{change:+.3g}"


def _models(runs: Sequence[ReadRun]) -> list[Section]:
    """Of every name, the equations of all runs, and their coefficients beside each other."""
    found, clocks = [], {run.clock for run in runs}
    clock = clocks.pop() if len(clocks) == 1 else SECONDS
    for name in dict.fromkeys(name for run in runs for name in run.models):
        models = {run.label: run.models[name] for run in runs if name in run.models}
        blocks: list[Block] = [
            shown_equation(model, state, clock, lead=label)
            for label, model in models.items()
            for state in model.states
        ]
        if len(models) < len(runs):
            blocks.append(Text(f"Only in {', '.join(models)}."))
        else:
            table = _coefficients(models, clock)
            known = not table["intervals"].eq("-").all()
            blocks.append(Table(table, note=NOTE) if known else Table(table.iloc[:, :-1]))
        found.append(Section(f"Model: {name.replace('_', ' ')}", blocks))
    return found


def _coefficients(models: Mapping[str, SparseModel], clock: Clock) -> pd.DataFrame:
    """A row per state and term that any of the models has, per unit of the clock."""
    rows = []
    for state in dict.fromkeys(s for model in models.values() for s in model.states):
        own = {n: m.terms(state) if state in m.states else {} for n, m in models.items()}
        ends = {n: _intervals(m, state) for n, m in models.items()}
        for term in dict.fromkeys(t for terms in own.values() for t in terms):
            row = {"equation": f"{state}'", "term": term.replace("*", " ")}
            for label in models:
                value, known = own[label].get(term), ends[label].get(term)
                text = "-" if value is None else f"{clock.seconds * value:.4g}"
                reach = (
                    "" if known is None else f" ±{0.5 * clock.seconds * (known[1] - known[0]):.2g}"
                )
                row[label] = text + reach
            rows.append(row | {"intervals": _overlap([ends[n].get(term) for n in models])})
    return pd.DataFrame(rows)


def _intervals(model: SparseModel, state: str) -> dict[str, tuple[float, float]]:
    if model.covariance is None or state not in model.states:
        return {}
    return model.intervals(state)


def _overlap(ends: Sequence[tuple[float, float] | None]) -> str:
    known = [each for each in ends if each is not None]
    if len(known) < len(ends):
        return "-"
    common = all(a[0] <= b[1] and b[0] <= a[1] for a, b in combinations(known, 2))
    return "overlap" if common else "apart"


def _pictures(runs: Sequence[ReadRun]) -> list[Section]:
    """Figures that all runs have, each under its name."""
    return [
        Section(f"Figure: {name.replace('_', ' ')}", [Picture(f"{r.label}-{name}") for r in runs])
        for name in _shared_figures(runs)
    ]


def figures_of(runs: Sequence[ReadRun]) -> dict[str, Drawn]:
    """As their folders have them."""
    return {
        f"{run.label}-{name}": read_png(run.folder / "figures" / f"{name}.png", f"Run {run.label}.")
        for name in _shared_figures(runs)
        for run in runs
    }


def _shared_figures(runs: Sequence[ReadRun]) -> list[str]:
    names = [{path.stem for path in (r.folder / "figures").glob("[!.]*.png")} for r in runs]
    return sorted(set.intersection(*names))
