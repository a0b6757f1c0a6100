"""Readers of tables that are no text: workbooks of Excel, Parquet, and arrays of NumPy."""

from __future__ import annotations

import csv
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr

from ep2sindy.data.readers.csv import text_source
from ep2sindy.data.readers.source import FileSource, Reader, counted_dates
from ep2sindy.data.readers.table_layout import split_names

OLD_EXCEL = b"\xd0\xcf\x11\xe0"

# What Excel shows in a cell whose formula has no value.
FAULTS = frozenset({"#DIV/0!", "#N/A", "#NAME?", "#NULL!", "#NUM!", "#REF!", "#VALUE!"})


def read_excel(path: Path) -> FileSource:
    """Read a workbook of Excel as text of the same cells would be read; see `read_csv`.

    If several sheets hold tables, a column is called "sheet/column". Sheets without rows of numbers
    are left out.
    """
    with path.open("rb") as file:
        if file.read(len(OLD_EXCEL)) == OLD_EXCEL:
            raise ValueError("it is of Excel up to 2003: save it as .xlsx or as CSV")
    sheets = pd.read_excel(path, sheet_name=None, header=None, na_filter=False, engine="openpyxl")
    found: dict[str, FileSource] = {}
    faults: dict[str, str] = {}
    for name, frame in sheets.items():
        try:
            found[str(name)] = text_source(path, _as_text(frame))
        except ValueError as error:
            faults[str(name)] = str(error)
    if not found:
        said = "; ".join(f"sheet {name!r}: {text}" for name, text in faults.items())
        raise ValueError(f"no sheet of it holds a table: {said}")
    words = [
        f"sheet {name!r}: {source.words.replace(' between tabs', '')}"
        for name, source in found.items()
    ]
    words += [f"left out: sheet {name!r}, {text}" for name, text in faults.items()]
    if len(found) == 1:  # the columns keep their names
        return replace(*found.values(), words="; ".join(words))
    places = {f"{sheet}/{name}": (s, name) for sheet, s in found.items() for name in s.names}

    def read(name: str) -> xr.DataArray:
        source, column = places[name]
        return source.read(column)

    return FileSource(path, [*places], read, words="; ".join(words), is_table=True)


def _as_text(frame: pd.DataFrame) -> StringIO:
    """Cells of a sheet as text separated by tabs."""
    text = StringIO()
    writer = csv.writer(text, delimiter="\t", lineterminator="\n")
    for row in frame.itertuples(index=False):
        writer.writerow("" if str(cell) in FAULTS else " ".join(str(cell).split()) for cell in row)
    text.seek(0)
    return text


def read_parquet(path: Path) -> FileSource:
    """Read a table of Parquet.

    Its index, if it has a name or holds dates or durations, is its first column. Units may stand in
    names, as in `read_csv`. Dates are counted from the first one.
    """
    frame = pd.read_parquet(path, engine="pyarrow")
    if frame.index.name is not None or frame.index.dtype.kind in "mM":
        frame = frame.reset_index()
    header = split_names([str(name) for name in frame.columns])
    places = {name: k for k, name in enumerate(header.names)}

    def read(name: str) -> xr.DataArray:
        column = frame.iloc[:, places[name]]
        if column.dtype.kind in "mM":
            return counted_dates(column)
        attrs = {"units": header.units[places[name]]}
        if column.dtype.kind in "iufb":  # with masked ones, whose missing values become NaN
            return xr.DataArray(column.to_numpy(dtype=np.float64, na_value=np.nan), attrs=attrs)
        return xr.DataArray(column.to_numpy(dtype=object), attrs=attrs)

    n_rows, n_columns = frame.shape
    return FileSource(
        path, [*places], read, words=f"{n_columns} columns of {n_rows} rows", is_table=True
    )


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


EXCEL = Reader("Excel", read_excel, first_bytes=(OLD_EXCEL,), form="workbook", package="openpyxl")
PARQUET = Reader("Parquet", read_parquet, first_bytes=(b"PAR1",), package="pyarrow")
NPY = Reader("npy", read_npy, first_bytes=(b"\x93NUMPY",))
