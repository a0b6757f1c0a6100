"""How models run over every record where there are several."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import pandas as pd

from ep2sindy.report.document import Section, Table, places
from ep2sindy.studies.library_result import LibraryResult

TITLE = "the selected models, integrated from the first sample of every record"


def records_tables(
    results: Mapping[str, LibraryResult], files: Sequence[str]
) -> dict[str, pd.DataFrame]:
    """A row per model and record: file, trajectory error, verdict; none for one record."""
    if len(files) < 2:
        return {}
    rows = [
        {"model": name, "record": file, "nrmse": each.nrmse, "verdict": each.text}
        for name, result in results.items()
        for file, each in zip(files, [result.selected, *result.elsewhere], strict=True)
    ]
    return {"records": pd.DataFrame(rows)}


def records_sections(results: Mapping[str, LibraryResult], files: Sequence[str]) -> list[Section]:
    return [
        Section("Every record", [Table(table.assign(nrmse=[places(e, 3) for e in table["nrmse"]]),
                                       title=TITLE)])
        for table in records_tables(results, files).values()
    ]  # fmt: skip
