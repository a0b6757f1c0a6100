"""`ep2sindy compare RUN RUN ...`: compare run folders on the terminal and on a page.

The module first reads each run folder: its summary, provenance, settings and models.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from string import ascii_uppercase
from typing import Any

import pandas as pd
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from ep2sindy.app.arguments import JOBS
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.model import SparseModel
from ep2sindy.report.about import by_place
from ep2sindy.report.document import Block, Link, Picture, Section, Table, Text, cell_text
from ep2sindy.report.page import TEMPLATES, page_html
from ep2sindy.report.picture import Drawn, read_png
from ep2sindy.report.results import in_words, value_text
from ep2sindy.report.screen import Screen
from ep2sindy.runtime.files import read_json, write_text
from ep2sindy.runtime.screen import say
from ep2sindy.studies.views import display_equation

ABOUT = """Compares runs: settings that differ, headline figures, equations with their intervals.
A run is the folder that it printed last, such as outputs/breathing/2025-01-31_101500. Of a sweep,
outputs/multirun/2025-01-31_101500, all jobs that came to their end are compared."""
NOTE = (
    "Apart: the 95 % intervals of two runs have no value in common; overlap: all have. A dash: "
    "the term is not in the model, or its interval is not known."
)

# Entries of the files that a page needs, with their types.
SUMMARY = {"experiment": str, "seed": int, "headline": dict, "warnings": list, "data": dict}
PROVENANCE = {"commit": str, "versions": dict}
REQUIRED = {"experiment", "seed"}
JOB = {"folder": str, "error": str}


def main(arguments: Sequence[str]) -> None:
    """Compare the run folders, and the jobs of sweeps, named on the command line.

    Raises ValueError for a folder that holds no run, or a template that is missing.
    """
    parser = argparse.ArgumentParser("ep2sindy compare", description=ABOUT)
    parser.add_argument("run", nargs="+", help="run folder, two or more; or a sweep")
    parser.add_argument("--page", default="compare.html", help="where the page goes")
    parser.add_argument("--template", help="a Jinja2 template of your own for the page")
    given = parser.parse_args(arguments)
    folders = [folder for path in given.run for folder in folders_of(Path(path))]
    if len(folders) < 2:
        raise ValueError(f"to compare takes two runs or more: {list(map(str, folders))} came")
    runs = [read_run(folder, k) for k, folder in enumerate(folders)]
    page = Path(given.page)
    template = Path(given.template) if given.template else TEMPLATES / "page.html"
    sections = compare_runs(runs, beside=page.parent)
    html = page_html("Runs compared", sections, figures_of(runs), template=template)
    Screen().show(sections)
    write_text(page, html)
    say(str(page))


@dataclass(frozen=True, eq=False)
class ReadRun:
    """The contents of a run folder. settings: by dotted place. label: the run's name in tables."""

    folder: Path
    label: str
    summary: dict[str, Any]
    provenance: dict[str, Any]
    settings: dict[str, Any]
    models: dict[str, SparseModel]

    @property
    def clock(self) -> Clock:
        """The time unit in which the run is shown."""
        return Clock.of(self.summary.get("data", {}).get("time_unit", "s"))

    @property
    def headline(self) -> dict[str, float]:
        """The headline figures; null in the file becomes NaN."""
        found = self.summary.get("headline", {})
        return {name: float("nan") if v is None else float(v) for name, v in found.items()}


def folders_of(path: Path) -> list[Path]:
    """The run folder at a path; of a sweep, those of its jobs, saying which of them failed."""
    records = sorted((path / JOBS).glob("[!.]*.json"), key=lambda each: (len(each.stem), each.stem))
    found = []
    for place in records:
        record = _checked(place, JOB)
        if record["error"] or not record["folder"]:
            say(f"left out: job {place.stem} failed: {record['error']}")
        else:
            found.append(Path(record["folder"]))
    return found if records else [path]


def read_run(folder: Path, number: int) -> ReadRun:
    """Read a completed run. number: from zero; it gives the label A, B, ..., Z, AA, BB, ...

    Raises ValueError for a folder that is not a run, or a run that ended early.
    """
    if not folder.is_dir():
        raise ValueError(f"a run is a folder: {folder} is not there; {_nearby(folder)}")
    if not (folder / "summary.json").is_file():
        said = "it ended early, see its run.log" if (folder / "run.log").is_file() else "no run"
        raise ValueError(f"{folder} has no summary.json: {said}; {_nearby(folder)}")
    paths = sorted((folder / "models").glob("[!.]*.json"))
    return ReadRun(
        folder=folder,
        label=ascii_uppercase[number % 26] * (1 + number // 26),
        summary=_checked(folder / "summary.json", SUMMARY),
        provenance=_checked(folder / "provenance.json", PROVENANCE),
        settings=_read_settings(folder / "config.yaml"),
        models={path.stem: SparseModel.load(path) for path in paths},
    )


def _checked(path: Path, kinds: Mapping[str, Any]) -> dict[str, Any]:
    """A JSON object, checked for the keys and types that a page needs."""
    with _damage_named(path):
        found = read_json(path.read_text("utf-8"))
        if not isinstance(found, dict) or not REQUIRED & {*kinds} <= {*found}:
            raise ValueError(f"an object with {sorted(REQUIRED & {*kinds})} must stand there")
        for name, kind in kinds.items():
            if not isinstance(found.setdefault(name, kind()), kind):
                raise ValueError(f"{name} cannot be {found[name]!r:.80}")
        figures = found.get("headline", {})
        if not all(isinstance(each, int | float | None) for each in figures.values()):
            raise ValueError(f"headline must be of numbers: {figures!r:.80} came")
        Clock.of(found.get("data", {}).get("time_unit", "s"))
    return found


def _read_settings(path: Path) -> dict[str, Any]:
    """The run's settings by dotted place."""
    with _damage_named(path):
        config: Any = OmegaConf.to_container(OmegaConf.load(path))
        if not isinstance(config, dict):
            raise ValueError("a mapping must stand there")
        return {k: v for key, each in config.items() for k, v in by_place(str(key), each).items()}


@contextmanager
def _damage_named(path: Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, RecursionError, OmegaConfBaseException, YAMLError) as error:
        raise ValueError(f"{path} cannot be read ({error}): the run's folder is damaged") from error


def _nearby(folder: Path) -> str:
    """Runs found below the folder, beside it, or in the output folder, for an error message."""
    for place in (folder, folder.parent, Path("outputs")):
        found = sorted(path.parent for path in place.glob("**/summary.json"))[-3:]
        if found:
            return f"runs there are, for example {', '.join(map(str, found))}"
    return "a run's folder is the one that it prints last"


def link_to(run: ReadRun, beside: Path) -> str:
    """Link to the run's page, relative to this folder."""
    return os.path.relpath(run.folder / "report.html", beside)


def compare_runs(runs: Sequence[ReadRun], *, beside: Path) -> list[Section]:
    """Sections on runs, differing settings, headline figures, equations and figures.

    beside: folder of the page.
    """
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
    """Versions of packages, if they differ."""
    versions = {run.label: run.provenance.get("versions", {}) for run in runs}
    table = _differing(versions, "package", "")
    return [table] if isinstance(table, Table) else []


def _settings(runs: Sequence[ReadRun]) -> dict[str, Mapping[str, Any]]:
    return {run.label: {k: v for k, v in run.settings.items() if k != "output"} for run in runs}


def _differing(values: Mapping[str, Mapping[str, Any]], heading: str, none: str) -> Block:
    """One row per name whose value differs between runs; a sentence if none differs."""
    names = dict.fromkeys(name for each in values.values() for name in each)
    rows = []
    for name in names:
        row = {label: cell_text(each.get(name)) for label, each in values.items()}
        if len(set(row.values())) > 1:
            rows.append({heading: name, **row})
    return Table(pd.DataFrame(rows)) if rows else Text(f"None: they are {none}." if none else "")


def _headlines(runs: Sequence[ReadRun]) -> Table:
    """Headline figures by name; for two runs also the second's difference from the first."""
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
            display_equation(model, state, clock, lead=label)
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
    """One row per state and term of any of the models, per time unit of the clock."""
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
    """Figures by name, from the runs' folders."""
    return {
        f"{run.label}-{name}": read_png(run.folder / "figures" / f"{name}.png", f"Run {run.label}.")
        for name in _shared_figures(runs)
        for run in runs
    }


def _shared_figures(runs: Sequence[ReadRun]) -> list[str]:
    names = [{path.stem for path in (r.folder / "figures").glob("[!.]*.png")} for r in runs]
    return sorted(set.intersection(*names))
