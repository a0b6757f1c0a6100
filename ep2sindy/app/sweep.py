"""Index of a sweep: every job with its overrides, outcome, headline figures and folder.

Each job writes its own record, so that jobs may run in parallel or on a cluster. The index and its
page are rebuilt from all records.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from io import BytesIO, StringIO
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table as Grid

from ep2sindy.figures.trends import sweep_figure
from ep2sindy.report.document import Block, Link, Picture, Section, Table, Text
from ep2sindy.report.folder import freeze_layout
from ep2sindy.report.page import page_html
from ep2sindy.report.picture import DPI, Drawn, draw
from ep2sindy.report.results import in_words, value_text
from ep2sindy.runtime.files import read_json, write_json, write_text
from ep2sindy.runtime.screen import in_line

RECORDS = "jobs"
MAX_PANELS = 12
CAPTION = "Headline figures of the jobs that came to their end."

Records = Sequence[Mapping[str, Any]]


def note_end(sweep: Path, record: Mapping[str, Any]) -> None:
    """Write how a job ended, and update the index."""
    write_json(sweep / RECORDS / f"{record['job']}.json", record)
    write_index(sweep)


def records_of(sweep: Path) -> list[dict[str, Any]]:
    """Records of all jobs, in order."""
    paths = (sweep / RECORDS).glob("[!.]*.json")  # without files that are being written
    return sorted((read_json(path.read_text("utf-8")) for path in paths), key=lambda r: r["job"])


def write_index(sweep: Path) -> None:
    """Write `index.csv` and `index.html`: one row per job, one column per headline figure.

    They are written again if another job ended meanwhile, so that the last writer includes all
    jobs.
    """
    records: list[dict[str, Any]] = []
    while len(now := records_of(sweep)) > len(records):
        records = now
        write_text(sweep / "index.csv", _index(records))
        write_sweep_page(sweep, records)


def _index(records: Records) -> str:
    rows = [
        {
            "job": record["job"],
            "overrides": " ".join(record["overrides"]),
            "status": record["status"],
            **record.get("headline", {}),
            "folder": record.get("folder", ""),
            "error": record.get("error", ""),
        }
        for record in records
    ]
    table = pd.DataFrame(rows)
    last = ["folder", "error"]
    ordered = [*(name for name in table.columns if name not in last), *last]
    return table[ordered].to_csv(index=False)


def write_sweep_page(sweep: Path, records: Records) -> None:
    """Write `index.html` beside `index.csv`, with relative links to the jobs' pages."""
    varied, shared = split_varied(records)
    jobs = [Table(_jobs(sweep, records, varied), note=f"In all jobs: {' '.join(shared) or '-'}.")]
    figures = _figures(records, varied)
    errors: list[Block] = [
        Text(f"Job {record['job']}: {record['error']}", warning=True)
        for record in records
        if record.get("error")
    ]
    sections = [Section("Jobs", [*jobs, *errors])]
    if figures:
        sections.append(Section("What they found", [Picture(name) for name in figures]))
    write_text(sweep / "index.html", page_html(f"Sweep of {len(records)} jobs", sections, figures))


def split_varied(records: Records) -> tuple[dict[str, list[str]], list[str]]:
    """Settings that differ between jobs, as values by key, one per job; and the common settings."""
    everywhere = set.intersection(*(set(record["overrides"]) for record in records))
    keys = dict.fromkeys(
        text.partition("=")[0] for r in records for text in r["overrides"] if text not in everywhere
    )
    values = [dict(text.partition("=")[::2] for text in record["overrides"]) for record in records]
    shared = [text for text in records[0]["overrides"] if text in everywhere]
    return {key: [value.get(key, "") for value in values] for key in keys}, shared


def _jobs(sweep: Path, records: Records, varied: Mapping[str, Sequence[str]]) -> pd.DataFrame:
    """One row per job; headline figures have readable headings."""
    figures = _headlines(records)
    rows = []
    for k, record in enumerate(records):
        page = Path(record.get("folder", "")) / "report.html"
        name = str(record["job"])
        link = Link(name, os.path.relpath(page, sweep)) if "folder" in record else name
        found = record.get("headline", {})
        values = {in_words(n): value_text(n, _number(found.get(n))) for n in figures}
        given = {key: texts[k] for key, texts in varied.items()}
        rows.append({"job": link, **given, "status": record["status"], **values})
    return pd.DataFrame(rows)


def _headlines(records: Records) -> list[str]:
    return list(dict.fromkeys(name for record in records for name in record.get("headline", {})))


def _figures(records: Records, varied: Mapping[str, Sequence[str]]) -> dict[str, Drawn]:
    """Figures over the one number that was varied, or over the jobs."""
    values = {
        in_words(name) + (" (kHz)" if name.endswith("f_kHz") else ""): np.array(
            [_number(record.get("headline", {}).get(name)) for record in records]
        )
        for name in _headlines(records)
    }
    shown = {name: v for name, v in values.items() if np.isfinite(v).sum() > 1}
    if not shown:
        return {}
    label, x = "job", np.array([float(record["job"]) for record in records])
    if len(varied) == 1:
        ((key, texts),) = varied.items()
        numbers = np.array([_number(text) for text in texts])
        if np.isfinite(numbers).all():
            label, x = key, numbers
    jobs = [
        f"job {record['job']}: {', '.join(f'{key}={v[k]}' for key, v in varied.items())}"
        for k, record in enumerate(records)
    ]
    chosen = dict(list(shown.items())[:MAX_PANELS])
    figure = sweep_figure(x, chosen, x_label=label, jobs=jobs)
    freeze_layout(figure)
    png = BytesIO()
    figure.savefig(png, format="png", dpi=DPI)
    return {"headline": draw(figure, png.getvalue(), CAPTION)}


def _number(value: Any) -> float:
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")


def index_text(sweep: Path, *, n_figures: int = 4) -> str:
    """The index for the terminal: differing settings, and the first headline figures."""
    records = records_of(sweep)
    if not records:
        return f"no job of the sweep noted its end in {sweep}"
    varied, _ = split_varied(records)
    figures = _headlines(records)
    table = Grid(title=f"sweep of {len(records)} jobs", title_justify="left", show_edge=False)
    for name in ("job", "overrides", "status", *figures[:n_figures], "folder or error"):
        table.add_column(in_line(name), overflow="fold")
    for record in records:
        headline = record.get("headline", {})
        own = [text for text in record["overrides"] if text.partition("=")[0] in varied]
        values = [headline.get(name) for name in figures[:n_figures]]
        texts = ["-" if value is None else f"{value:.4g}" for value in values]
        where = record.get("folder") or record.get("error", "")
        cells = [str(record["job"]), " ".join(own), record["status"], *texts, where]
        table.add_row(*map(in_line, cells))
    text = StringIO()  # not a terminal: no colours, whose codes `say` would print
    console = Console(file=text, width=120, force_terminal=False, markup=False, emoji=False)
    console.print(table)
    return f"{text.getvalue()}{sweep / 'index.html'}\n{sweep / 'index.csv'}"
