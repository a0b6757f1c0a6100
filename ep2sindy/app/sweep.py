"""A sweep's index: every job with its overrides, how it ended, its headline figures and folder.

Each job writes a record of its own, so that jobs may run side by side or on a cluster, and the
index is made anew from all records there are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from io import StringIO
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from hydra.types import RunMode

from ep2sindy.runtime.files import read_json, write_json, write_text
from ep2sindy.runtime.screen import in_line, say

RECORDS = "jobs"


@contextmanager
def noted_job() -> Iterator[
    tuple[Callable[[Path, Mapping[str, float]], None], Callable[[BaseException], None]]
]:
    """In a sweep: say which job begins, and note how it ended; otherwise do nothing.

    The first of what comes is told the run folder and the headline figures of a job that came to
    its end, the second the error of one that did not.
    """
    if HydraConfig.get().mode != RunMode.MULTIRUN:
        yield (lambda folder, headline: None), (lambda error: None)
        return
    job, overrides = HydraConfig.get().job.num, list(HydraConfig.get().overrides.task)
    sweep = Path(HydraConfig.get().sweep.dir)
    record: dict[str, Any] = {"job": job, "overrides": overrides, "status": "failed"}
    say(f"job {job}: {' '.join(overrides)}")

    def done(folder: Path, headline: Mapping[str, float]) -> None:
        record.update(status="done", folder=str(folder), headline=dict(headline))

    def ended_early(error: BaseException) -> None:
        record["error"] = f"{error}" or type(error).__name__
        say(f"job {job} failed: {record['error']}")

    try:
        yield done, ended_early
    except BaseException as error:
        ended_early(error)
        raise
    finally:
        write_json(sweep / RECORDS / f"{job}.json", record)
        write_index(sweep)


def records_of(sweep: Path) -> list[dict[str, Any]]:
    """What every job noted, in their order."""
    paths = (sweep / RECORDS).glob("[!.]*.json")  # not what is being written
    return sorted((read_json(path.read_text("utf-8")) for path in paths), key=lambda r: r["job"])


def write_index(sweep: Path) -> None:
    """`index.csv` of a sweep's folder: a row per job, a column per headline figure; `index.html`.

    Written again if another job has noted its end meanwhile: the last to write knows them all.
    """
    from ep2sindy.app.sweep_page import write_sweep_page  # pandas and more, when a job has ended

    records: list[dict[str, Any]] = []
    while len(now := records_of(sweep)) > len(records):
        records = now
        write_text(sweep / "index.csv", _index(records))
        write_sweep_page(sweep, records)


def _index(records: Sequence[Mapping[str, Any]]) -> str:
    import pandas as pd

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


def index_text(sweep: Path, *, n_figures: int = 4) -> str:
    """The index for the terminal: what differs between jobs, and the first headline figures."""
    from rich.console import Console
    from rich.table import Table

    records = records_of(sweep)
    if not records:
        return f"no job of the sweep noted its end in {sweep}"
    everywhere = set.intersection(*(set(record["overrides"]) for record in records))
    figures = list(dict.fromkeys(name for r in records for name in r.get("headline", {})))
    table = Table(title=f"sweep of {len(records)} jobs", title_justify="left", show_edge=False)
    for name in ("job", "overrides", "status", *figures[:n_figures], "folder or error"):
        table.add_column(in_line(name), overflow="fold")
    for record in records:
        headline = record.get("headline", {})
        varied = [text for text in record["overrides"] if text not in everywhere]
        values = [headline.get(name) for name in figures[:n_figures]]
        texts = ["-" if value is None else f"{value:.4g}" for value in values]
        where = record.get("folder") or record.get("error", "")
        cells = [str(record["job"]), " ".join(varied), record["status"], *texts, where]
        table.add_row(*map(in_line, cells))
    text = StringIO()  # of no terminal: without colours, which `say` would write out
    console = Console(file=text, width=120, force_terminal=False, markup=False, emoji=False)
    console.print(table)
    return f"{text.getvalue()}{sweep / 'index.html'}\n{sweep / 'index.csv'}"
