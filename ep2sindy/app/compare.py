"""`ep2sindy compare RUN RUN ...`: compare run folders on the terminal and on a page.

The module first reads each run folder: its summary, provenance, settings and models.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import isnan, nan
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import pandas as pd
from omegaconf import OmegaConf

from ep2sindy.app.arguments import JOBS
from ep2sindy.app.config_files import check_config
from ep2sindy.data.readers.source import damage_named
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Block, Link, Picture, Section, Table, Text, cell_text
from ep2sindy.report.models import equations, intervals
from ep2sindy.report.page import by_place, page_html, read_png
from ep2sindy.report.results import in_words, value_text
from ep2sindy.report.screen import Screen
from ep2sindy.runtime.files import read_bytes, read_json, write_text
from ep2sindy.runtime.screen import say

ABOUT = """Compares runs: settings that differ, headline figures, equations with their intervals.
A run is the folder that it printed last, such as outputs/breathing/2025-01-31_101500. Of a sweep,
outputs/multirun/2025-01-31_101500, all jobs that came to their end are compared."""
NOTE = (
    "Apart: the 95 % intervals of two runs have no value in common; overlap: all have. A dash: "
    "the term is not in the model, or its interval is not known."
)


def main(arguments: Sequence[str]) -> None:
    """Compare the run folders, and the jobs of sweeps, named on the command line.

    Raises ValueError for a folder that holds no run.
    """
    parser = argparse.ArgumentParser("ep2sindy compare", description=ABOUT)
    parser.add_argument("run", nargs="+", help="run folder, two or more; or a sweep")
    parser.add_argument("--page", default="compare.html", help="where the page goes")
    given = parser.parse_args(arguments)
    folders = [folder for path in given.run for folder in folders_of(Path(path))]
    if len(folders) < 2:
        raise ValueError(f"to compare takes two runs or more, got {list(map(str, folders))}")
    runs = [read_run(folder, k) for k, folder in enumerate(folders)]
    page = Path(given.page)
    names = sorted(set.intersection(*({*run.figures} for run in runs)))
    figures = {
        f"{run.label}-{name}": read_png(run.figures[name], f"Run {run.label}.")
        for name in names
        for run in runs
    }
    sections = compare_runs(runs, names, beside=page.parent)
    html = page_html("Runs compared", sections, figures)
    Screen().show(sections)
    write_text(page, html)
    say(str(page))


@dataclass(frozen=True, eq=False)
class ReadRun:
    """The contents of a run folder.

    label: the run's name in tables. about: experiment, seed, number of warnings and the verdict on
    what was found. clock: the time unit in which it is shown. headline: the headline figures; null
    in the file is NaN. settings: by dotted place. figures: their files.
    """

    folder: Path
    label: str
    about: dict[str, str]
    clock: Clock
    headline: dict[str, float]
    provenance: dict[str, Any]
    settings: dict[str, Any]
    models: dict[str, SparseModel]
    figures: dict[str, Path]


def folders_of(path: Path) -> list[Path]:
    """The run folder at a path; of a sweep, those of its jobs, saying which of them failed."""
    records = sorted((path / JOBS).glob("[!.]*.json"), key=lambda each: (len(each.stem), each.stem))
    found = []
    for place in records:
        with damage_named(place):
            record = {"error": "", "folder": "", **read_json(read_bytes(place))}
            folder = Path(record["folder"])
        if record["error"] or not record["folder"]:
            why = f"failed: {record['error']}" if record["error"] else "has no result of its own"
            say(f"left out: job {place.stem} {why}")
        else:
            found.append(folder)
    return found if records else [path]


def read_run(folder: Path, number: int) -> ReadRun:
    """Read a completed run. number: from zero; it gives the label A, B, ..., Z, AA, BB, ...

    Raises ValueError for a folder that is not a run, or a run that ended early.
    """
    if not folder.is_dir():
        raise ValueError(f"a run must be a folder: there is no {folder}; {_nearby(folder)}")
    if not (folder / "summary.json").is_file():
        reason = "it ended early, see its run.log" if (folder / "run.log").is_file() else "no run"
        raise ValueError(f"{folder} has no summary.json: {reason}; {_nearby(folder)}")
    with damage_named(folder / "summary.json"):
        summary = read_json(read_bytes(folder / "summary.json"))
        about = {"experiment": str(summary["experiment"]), "seed": str(summary["seed"])}
        about["warnings"] = str(len(summary.get("warnings", [])))
        about["found"] = str(summary.get("found", "-"))
        headline = {
            n: nan if v is None else float(v) for n, v in summary.get("headline", {}).items()
        }
        clock = Clock.of(summary.get("data", {}).get("time_unit", "s"))
    with damage_named(folder / "provenance.json"):
        loaded = read_json(read_bytes(folder / "provenance.json"))
        provenance = {"commit": "-", **loaded, "versions": {**loaded.get("versions", {})}}
    with damage_named(folder / "config.yaml"):
        check_config(folder / "config.yaml")
        config: Any = OmegaConf.to_container(OmegaConf.load(folder / "config.yaml"))
        placed = [by_place(str(key), each) for key, each in config.items() if key != "output"]
    models = sorted((folder / "models").glob("[!.]*.json"))
    return ReadRun(
        folder=folder,
        label=ascii_uppercase[number % 26] * (1 + number // 26),
        about=about,
        clock=clock,
        headline=headline,
        provenance=provenance,
        settings={place: value for each in placed for place, value in each.items()},
        models={path.stem: SparseModel.load(path) for path in models},
        figures={path.stem: path for path in (folder / "figures").glob("[!.]*.png")},
    )


def _nearby(folder: Path) -> str:
    """Runs found below the folder, next to it, or in the output folder, for an error message."""
    for place in (folder, folder.parent, Path("outputs")):
        found = sorted(p.parent for d in ("*", "*/*") for p in place.glob(f"{d}/summary.json"))
        if found:
            return f"there are runs such as {', '.join(map(str, found[-3:]))}"
    return "the folder of a run is the one that it prints last"


def compare_runs(runs: Sequence[ReadRun], figures: Sequence[str], *, beside: Path) -> list[Section]:
    """Sections on runs, differing settings, headline figures, equations and figures.

    figures: names of those that all runs have. next to: folder of the page.
    """
    rows = [
        {
            "run": run.label,
            "folder": Link(str(run.folder), os.path.relpath(run.folder / "report.html", beside)),
            "code": str(run.provenance["commit"])[:12],
            **run.about,
        }
        for run in runs
    ]
    versions = _differing({run.label: run.provenance["versions"] for run in runs}, "package")
    settings = _differing({run.label: run.settings for run in runs}, "setting")
    pictures: dict[str, list[Block]] = {
        name: [Picture(f"{run.label}-{name}") for run in runs] for name in figures
    }
    return [
        Section("Runs", [Table(pd.DataFrame(rows)), *versions]),
        Section("Settings that differ", settings or [Text("None: they are the same.")]),
        Section("Headline figures", [_headlines(runs)]),
        *_models(runs),
        *(Section(f"Figure: {name.replace('_', ' ')}", shown) for name, shown in pictures.items()),
    ]


def _differing(values: Mapping[str, Mapping[str, Any]], heading: str) -> list[Block]:
    """A table with one row per name whose value differs between runs; none if no value does."""
    rows = []
    for name in dict.fromkeys(name for each in values.values() for name in each):
        row = {label: cell_text(each.get(name)) for label, each in values.items()}
        if len(set(row.values())) > 1:
            rows.append({heading: name, **row})
    return [Table(pd.DataFrame(rows))] if rows else []


def _headlines(runs: Sequence[ReadRun]) -> Table:
    """Headline figures by name; for two runs also the second's difference from the first."""
    rows = []
    for name in dict.fromkeys(name for run in runs for name in run.headline):
        found = [run.headline.get(name, nan) for run in runs]
        row = {"figure": in_words(name)}
        row |= {r.label: value_text(name, v, r.clock) for r, v in zip(runs, found, strict=True)}
        row |= {"change": _change(*found)} if len(found) == 2 else {}
        if not all(map(isnan, found)):
            rows.append(row)
    return Table(pd.DataFrame(rows))


def _change(before: float, after: float) -> str:
    """`+2.1 %`, or the difference for large changes and changes of sign; a dash if unknown."""
    change = after - before
    if change != change or change == 0.0:
        return "0" if change == 0.0 else "-"
    if before * after > 0.0 and abs(change) < abs(before):
        return f"{100.0 * change / before:+.2g} %"
    return f"{change:+.3g}"


def _models(runs: Sequence[ReadRun]) -> list[Section]:
    """For every model name, the equations of all runs and their coefficients side by side."""
    found, clocks = [], {run.clock for run in runs}
    clock = clocks.pop() if len(clocks) == 1 else SECONDS
    for name in dict.fromkeys(name for run in runs for name in run.models):
        models = {run.label: run.models[name] for run in runs if name in run.models}
        blocks: list[Block] = [
            equation
            for label, model in models.items()
            for equation in equations(model, clock, lead=label)
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
    """One row per state and term of any of the models, per time unit of the clock."""
    rows = []
    for state in dict.fromkeys(s for model in models.values() for s in model.states):
        own = {n: m.terms(state) if state in m.states else {} for n, m in models.items()}
        ends = {n: (intervals(m) or {}).get(state, {}) for n, m in models.items()}
        for term in dict.fromkeys(t for terms in own.values() for t in terms):
            row = {"equation": f"{state}'", "term": term.replace("*", " ")}
            for label in models:
                value, known = own[label].get(term), ends[label].get(term)
                row[label] = "-" if value is None else f"{clock.seconds * value:.4g}"
                if known is not None:
                    reach = 0.5 * clock.seconds * (known[1] - known[0])
                    row[label] += f" ±{reach:.2g}" if reach else " (known)"
            rows.append(row | {"intervals": _overlap([ends[n].get(term) for n in models])})
    return pd.DataFrame(rows)


def _overlap(ends: Sequence[tuple[float, float] | None]) -> str:
    known = [each for each in ends if each is not None]
    if len(known) < len(ends):
        return "-"
    common = all(a[0] <= b[1] and b[0] <= a[1] for a, b in combinations(known, 2))
    return "overlap" if common else "apart"
