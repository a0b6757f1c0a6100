"""Mapping from our quantities to the arrays of a file: names, units, dimensions, and reading."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import xarray as xr

from ep2sindy.data.numbers import without_marks
from ep2sindy.data.readers.source import FileSource, damage_named
from ep2sindy.library.names import check_variable
from ep2sindy.runtime.screen import near_words

N_MARKS = "n_marks"  # attribute of an array: number of samples that were marks of overload

N_LISTED = 100  # largest number of names listed in an error

# `probe[:, 1]`: part of an array, counted from 0.
PART = re.compile(r"(.+?)\s*\[([\d:,\s-]+)\]")


@dataclass(frozen=True)
class Variable:
    """Location and unit of one quantity in a file.

    name: name in the file. It may be a path in HDF5 ("group/n_i"), a struct field in MATLAB
        ("data.n_i"), a column's number in a table ("2") or part of an array ("probe[:, 1]"); both
        count from 0. None: the file does not hold the quantity.
    unit: unit of the numbers in the file: "cm^-3", "km/s", "degC"; with a factor, "1e19 m^-3".
    dims: dimensions in the file's order, such as ("r", "z", "time"). None: as the file names
        them, or else the only order that fits the lengths.
    """

    name: str | None
    unit: str
    dims: Sequence[str] | None = None


Keys = Mapping[str, Any]


@dataclass(frozen=True)
class Problems:
    """Errors found in a mapping, collected so that one message names them all."""

    found: list[str] = field(default_factory=list)

    @contextmanager
    def noted(self) -> Iterator[None]:
        try:
            yield
        except ValueError as error:
            self.found.append(str(error))

    def check(self, source: FileSource) -> None:
        """Raise ValueError if there are errors; if a name is missing, list the file's arrays."""
        if not self.found:
            return
        one, held = len(self.found) == 1, ""
        if any(" no variable " in each for each in self.found):
            held = f"{'; it' if one else '. It'} holds {list_arrays(source)}; set the name, or null"
            held += " if the file has it not"
        if one:
            raise ValueError(f"the mapping must be put right: {self.found[0]}{held}")
        lines = "".join(f"\n  - {each}" for each in self.found)
        raise ValueError(
            f"{len(self.found)} things must be put right for {source.path}:{lines}{held}"
        )


def in_file(
    variables: Mapping[str, Variable | Keys | None], problems: Problems
) -> dict[str, Variable]:
    """Select the variables that the file holds; keys from a config become a `Variable`."""
    found = {}
    for ours, value in variables.items():
        with problems.noted():
            check_variable(ours)
        if isinstance(value, Mapping):
            if not {"name", "unit"} <= set(value) <= {"name", "unit", "dims"}:
                problems.found.append(
                    f"{ours} needs a name, a unit, perhaps dims: {dict(value)} came"
                )
                continue
            value = Variable(value["name"], str(value["unit"]), value.get("dims"))
        if value is not None and value.name is not None:
            found[ours] = replace(value, name=str(value.name))
    return found


def read_array(source: FileSource, ours: str, name: str) -> xr.DataArray:
    """Read one array of the file, or part of one, as real numbers in the file's unit and shape."""
    whole, part = _split_selection(source, name)
    if whole is None:
        near = near_words(name, source.names, form="{!r}")
        raise ValueError(f"{source.path} has no variable {name!r} (wanted as {ours}){near}")
    with damage_named(source.path):
        array = source.read(whole)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{name!r} in {source.path} must be real numbers, not {array.dtype}")
    try:
        array = array[part] if part else array
    except IndexError as error:
        raise ValueError(
            f"{name!r} (wanted as {ours}) must lie inside its array: {whole!r} has shape "
            f"{array.shape}, counted from 0"
        ) from error
    if (unit := source.units.get(whole)) and not array.attrs.get("units"):
        array = array.assign_attrs(units=unit)
    array = array if array.dtype in (np.float32, np.float64) else array.astype(np.float64)
    if not source.is_table:
        return array
    values = without_marks(array.values)
    n_marks = int(np.isnan(values).sum() - np.isnan(array.values).sum())
    return array.copy(data=values).assign_attrs({N_MARKS: n_marks} if n_marks else {})


def _split_selection(source: FileSource, name: str) -> tuple[str | None, tuple[int | slice, ...]]:
    """Split a name into an array of the file and an index; the array is None if there is none."""
    if name in source.known:
        return name, ()
    found = PART.fullmatch(name)
    if found is None or found[1] not in source.known:
        return None, ()
    parts = [part.strip() for part in found[2].split(",")]
    if not all(re.fullmatch(r":|-?\d+", part) for part in parts):
        raise ValueError(f"part of an array is written like [:, 1]: {name!r} came")
    return found[1], tuple(slice(None) if part == ":" else int(part) for part in parts)


def list_arrays(source: FileSource) -> str:
    """List the file's arrays with shapes and units: `ni (6, 4, 3) cm^-3, t (6)`."""
    texts = []
    for name in source.names[:N_LISTED]:
        try:
            array = source.read(name)
        except Exception:  # raised by a library for a damaged array; list its name all the same
            texts.append(name)
            continue
        unit = array.attrs.get("units") or source.units.get(name, "")
        shape = f"({', '.join(map(str, array.shape))})"
        texts.append(f"{name} {shape} {unit}".rstrip())
    n_more = len(source.names) - len(texts)
    texts += [f"and {n_more} more"] if n_more else []
    return ", ".join(texts) or "nothing"
