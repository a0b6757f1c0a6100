"""Readers of tables: text of programs and oscilloscopes, TDMS and NumPy."""

from __future__ import annotations

import codecs
import re
from pathlib import Path
from typing import TextIO

import numpy as np
import pandas as pd
import xarray as xr

from ep2sindy.data.readers.source import FileSource, Reader, column_array
from ep2sindy.data.readers.table_layout import COMMENTS, GROUPED, MISSING, PARTED, Layout, layout_of
from ep2sindy.trust.memory import check_width

N_LOOKED_AT = 2000  # lines examined to find the layout; no known preamble is longer
MAX_LOOKED_AT = 2**21  # characters of these lines, and of one line

# Times of day; dates of ISO 8601, perhaps with one; and dates that may be read in two ways.
CLOCK = r"\d\d?:\d\d(?::\d\d(?:[.,]\d+)?)?\s?(?:[AaPp][Mm])?"
DATE = rf"\d{{4}}-\d\d-\d\d(?:[ T]{CLOCK}(?:Z|[+-]\d\d:?\d\d)?)?"
SLASHED = r"\d{1,2}[/.-]\d{1,2}[/.-]\d{2,4}\b"

AT_TIMES = "@ t="  # in headers of COMSOL's exports of several times

UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def read_csv(path: Path) -> FileSource:
    """Read text with one row per sample and columns separated by , ; | tabs or blanks.

    Decimal commas, thousands separators, a preamble and a line of units are recognised from the
    content; a header is optional. A column's name is the header's without its unit, or else its
    number from 0; names that repeat become x.0, x.1. ISO dates, perhaps with the time of day in the
    next column, are counted from the first one. Columns of other text are left out, and an empty
    cell is NaN.
    """
    with path.open(encoding=_encoding(path), newline=None) as file:
        return _source(path, file)


def _source(path: Path, file: TextIO) -> FileSource:
    lines = file.readlines(MAX_LOOKED_AT)[:N_LOOKED_AT]
    check_width(max(map(len, lines), default=0), "characters in a line", MAX_LOOKED_AT)
    layout = layout_of(lines)
    if any(AT_TIMES in line for line in lines[: layout.first]):
        raise ValueError(
            f"its columns are quantities at different times ({AT_TIMES!r}), its rows places: make "
            "times the rows, as COMSOL does of a point, or a field of it in Python"
        )
    file.seek(0)
    frame = _frame(file, layout)
    header = layout.header
    numbers = [int(j) for j in frame.columns]
    columns = [j for j in numbers if j in layout.columns or _holds_numbers(frame[j])]
    others = [j for j in numbers if j not in columns]
    dates = _dates(frame, others)
    left = {header.names[j]: frame[j] for j in others if j not in dates and frame[j].notna().any()}
    kept = sorted({*columns, *dates})
    names = {header.names[j]: j for j in kept}
    places = {str(j): j for j in kept} | names

    def read(name: str) -> xr.DataArray:
        j = places[name]
        column = dates[j] if j in dates else _numbers(frame[j], name, layout)
        return column_array(column, header.units[j])

    aliases = tuple(number for number in places if number not in names)
    return FileSource(
        path, [*names], read, aliases=aliases, words=_words(layout, len(columns), len(dates), left),
        step_s=header.step_s, is_table=True,
    )  # fmt: skip


def _holds_numbers(column: pd.Series) -> bool:
    """True for a column of numbers that begins beyond the lines that determine the layout."""
    return column.dtype.kind in "fiu" and bool(column.notna().any())


def _words(layout: Layout, n_columns: int, n_dates: int, left: dict[str, pd.Series]) -> str:
    """How the table was read, in words. left: columns that are left out."""
    words = f"{n_columns} column{'s' * (n_columns > 1)} of numbers"
    words += f", {n_dates} of dates" * bool(n_dates)
    words += f" between {PARTED[layout.separator]}" * (n_columns + n_dates > 1)
    words += ", decimal commas" * (layout.decimal == ",")
    words += ", marks between thousands" * layout.has_marks
    words += f", rows from line {layout.first + 1}"
    words += f", left out: {', '.join(left)}" * bool(left)
    has_dates = any(each.astype(str).str.match(SLASHED).all() for each in left.values())
    return words + "; dates are read if written as 2024-01-31" * has_dates


def _dates(frame: pd.DataFrame, others: list[int]) -> dict[int, pd.Series]:
    """Columns of dates, with their times of day if these stand in the next column.

    others: columns of no numbers; those of times of day are taken out.
    """
    texts = {j: frame[j].dropna().astype(str).str.strip() for j in others}
    are_dates = [j for j, text in texts.items() if len(text) and text.str.fullmatch(DATE).all()]
    found = {}
    for j in are_dates:
        text, beside = texts[j], texts.get(j + 1, texts[j][:0])
        if len(beside) and beside.str.fullmatch(CLOCK).all():
            text = text + " " + beside
            others.remove(j + 1)
        form = "mixed" if text.str.contains("[AP]M$", case=False).any() else "ISO8601"
        found[j] = pd.to_datetime(text.str.replace(",", "."), format=form, utc=True).reindex(
            frame.index
        )
    return found


def _encoding(path: Path) -> str:
    """Detect the text encoding; raise ValueError for a file that is not text."""
    with path.open("rb") as file:
        head = file.read(2**16)
    if head.startswith(UTF_16):
        return "utf-16"
    if b"\0" in head:
        raise ValueError("it holds bytes that are no text, as a binary file by another name does")
    try:
        codecs.getincrementaldecoder("utf-8")().decode(head)
    except UnicodeDecodeError:
        return "latin-1"
    return "utf-8-sig"


def _frame(file: TextIO, layout: Layout) -> pd.DataFrame:
    """Read the rows; raise ValueError for a row with more cells than the header."""
    missing = sorted({*MISSING, *map(str.upper, MISSING), "NaN", "Inf", "-Inf"} - {""})
    for _ in range(layout.first):  # skipped here: pandas would pair quotes in a preamble
        file.readline()
    try:
        frame = pd.read_csv(
            file,
            sep=layout.separator or r"\s+",
            decimal=layout.decimal,
            header=None,
            comment=COMMENTS[0],
            skipinitialspace=True,
            na_values=missing,
            low_memory=False,
        )
    except pd.errors.ParserError as error:
        found = re.search(r"Expected (\d+) fields in line (\d+), saw (\d+)", str(error))
        if not found:
            raise
        raise ValueError(
            f"every row must have as many cells as the first, {found[1]}: row {found[2]} has "
            f"{found[3]}"
        ) from error
    frame = frame.dropna(how="all").reset_index(drop=True)  # a line of commas is no sample
    return frame.reindex(columns=range(len(layout.header.names)))


def _numbers(column: pd.Series, name: str, layout: Layout) -> pd.Series:
    """Convert a column to numbers; raise ValueError with the row of a cell that is not a number."""
    if column.dtype.kind in "fiu":
        return column
    text = column.astype("string").str.strip(" \t\"'")
    is_grouped = text.str.fullmatch(GROUPED[layout.decimal]).fillna(value=False)
    text = text.mask(is_grouped, text.str.replace(f"[^-+\\d{layout.decimal}]", "", regex=True))
    text = text.str.replace(layout.decimal, ".", regex=False)
    text = text.str.replace(r"[dD](?=[+-]?\d+$)", "e", regex=True)  # Fortran's exponents
    values = pd.to_numeric(text, errors="coerce")
    wrong = np.flatnonzero(values.isna() & text.notna() & ~text.str.lower().isin(MISSING))
    if wrong.size:
        raise ValueError(
            f"column {name!r} must hold numbers: row {wrong[0] + 1} holds {column.iloc[wrong[0]]!r}"
        )
    return values


CSV = Reader(
    "text", read_csv, form="other", endings=(".csv", ".tsv", ".txt", ".dat", ".asc", ".prn", ".lvm")
)

# Tables that are no text.


def read_npy(path: Path) -> FileSource:
    """Read an array saved with `numpy.save`: its fields if it is structured, or else "array".

    The columns of an array of two axes are called by their numbers, from 0, as those of a table
    without a header.
    """
    array = np.load(path, allow_pickle=False)
    if array.dtype.names:
        arrays = {name: array[name] for name in array.dtype.names}
    elif array.ndim == 2:
        arrays = {str(j): column for j, column in enumerate(array.T)}
    else:
        arrays = {"array": array}
    return FileSource(
        path, [*arrays], lambda name: xr.DataArray(arrays[name]), is_table=array.ndim < 3
    )


NPY = Reader("npy", read_npy, first_bytes=(b"\x93NUMPY",))

# TDMS, which LabVIEW writes.


STEP, UNIT = "wf_increment", "unit_string"  # properties of a channel: its step in s, its unit


def read_tdms(path: Path) -> FileSource:
    """Read the channels of a TDMS file; a name is "group/channel", or "channel" in a single group.

    The time step is the increment of the waveforms, if all of them have the same. Times of day are
    counted from the first one.
    """
    from nptdms import TdmsFile

    with TdmsFile.open(path) as file:
        groups = [group for group in file.groups() if group.channels()]
        channels = {
            channel.name if len(groups) == 1 else f"{group.name}/{channel.name}": channel
            for group in groups
            for channel in group.channels()
        }
        values = {name: np.asarray(channel[:]) for name, channel in channels.items()}
        properties = {name: dict(channel.properties) for name, channel in channels.items()}

    def read(name: str) -> xr.DataArray:
        return column_array(pd.Series(values[name]), str(properties[name].get(UNIT, "")))

    steps = {float(of[STEP]) for of in properties.values() if of.get(STEP)}
    return FileSource(
        path, [*values], read, words=f"{len(values)} channels", is_table=True,
        step_s=steps.pop() if len(steps) == 1 else None,
    )  # fmt: skip


TDMS = Reader("TDMS", read_tdms, first_bytes=(b"TDSm",), package="nptdms")
