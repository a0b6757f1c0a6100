"""What the arrays of a file are, told by their names, units, shapes and sizes, without a mapping.

Holds the description of one array (`ArrayInfo`) and the choice of its unit.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import isclose

import numpy as np
import xarray as xr

from ep2sindy.data.conversion import SUFFIX_UNITS, conversion, counted_in
from ep2sindy.data.dimensions import fitting, time_length
from ep2sindy.data.fields import DIMS
from ep2sindy.data.mapping import Keys, Problems, Variable, in_file, read_array
from ep2sindy.data.quantities import (
    AXES,
    QUANTITIES,
    KnownQuantity,
    likely_time_unit,
    meant_by,
    split_unit,
    step_said,
    typical,
)
from ep2sindy.data.readers.source import FileSource
from ep2sindy.library.units import unit_like

MAX_COLUMNS = 32  # of an array whose columns are taken as signals of their own


@dataclass(frozen=True)
class Recognised:
    """A mapping of a file as far as it can be told.

    variables, axes: our name -> where it is. guesses: our name -> a unit that is only likely, in
    words. questions: what is left open, in words. n_samples: None where they cannot be counted.
    """

    held: Sequence[ArrayInfo]
    variables: Mapping[str, Variable]
    axes: Mapping[str, Variable]
    dt_s: float | None
    guesses: Mapping[str, str] = field(default_factory=dict)
    questions: Sequence[str] = ()
    n_samples: int | None = None

    def check(self, source: FileSource) -> None:
        """Raise ValueError unless a field can be made of it without doubt."""
        problems = [each.problem for each in self.held if each.problem not in ("", TEXT)]
        problems += self.guesses.values()
        if "time" not in self.axes and self.dt_s is None:
            problems.insert(0, "a field needs time: give its step dt_s, or name the file's time")
        if not self.variables:
            problems.append("no array of the file fits its axes")
        if problems:
            text = "; ".join([*problems, *self.questions])
            raise ValueError(
                f"{source.path} cannot be opened without a mapping: {text}; ep2sindy.inspect_file "
                "shows what it holds"
            )


def recognise(
    source: FileSource,
    *,
    dt_s: float | None = None,
    given: Mapping[str, Variable | Keys] | None = None,
) -> Recognised:
    """What the arrays of a file are. given: coordinates that the user names."""
    problems = Problems()
    named = in_file(given or {}, problems)
    problems.check(source)
    held = [describe_array(source, name) for name in source.names]
    usable = [each for each in held if not each.problem]
    questions: list[str] = []
    guesses: dict[str, str] = {}
    axes = dict(named)
    for axis in DIMS[:1] if source.is_table else DIMS:  # a column z is a state of one's own
        if axis not in axes and (found := _axis(axis, usable, source, questions)) is not None:
            axes[axis] = found
    if dt_s is None:
        dt_s = _step_s(source, axes, usable)
    counter = axes.pop("time", None) if dt_s is not None else None
    taken = {v.name for v in (*axes.values(), *([counter] if counter else [])) if v.name}
    taken |= {each.name for each in usable if "time" in meant_by(each.name)}
    rest = [each for each in usable if each.name not in taken]
    for axis, variable in axes.items():
        if (one := _of(held, variable.name)) is not None and axis not in named:
            axes[axis] = with_unit(axis, one, AXES[axis], guesses)
    lengths = _lengths(axes, held, source, rest, dt_s, questions)
    variables = _variables(source, rest, axes, held, lengths, questions, guesses)
    time = axes.get("time")
    if "time" not in named and time is not None and (one := _of(held, time.name)):
        said_s = _stated_step_s(usable)
        axes["time"] = with_time_unit(axes["time"], one, variables, said_s, guesses)
    return Recognised(held, variables, axes, dt_s, guesses, questions, lengths.get("time"))


def _of(held: Sequence[ArrayInfo], name: str | None) -> ArrayInfo | None:
    return next((each for each in held if each.name == name), None)


def _axis(
    axis: str, held: Sequence[ArrayInfo], source: FileSource, questions: list[str]
) -> Variable | None:
    """The vector that is this coordinate: by its name, for time also by its unit or its place."""
    unit = AXES[axis].unit
    rising = [each for each in held if each.step is not None]
    options = [each for each in rising if axis in meant_by(each.name)]
    options = [e for e in options if e.unit in ("", "1") or is_of(e.unit, unit)]
    if not options and axis == "time":
        options = [each for each in rising if is_of(each.unit, unit)]
        if not options and source.is_table and rising and rising[0] is held[0]:
            options = rising[:1]  # the first column of a table, where it rises, is its time
    exact = [each for each in options if each.name == axis] or options
    if len(exact) > 1:
        names = " or ".join(repr(each.name) for each in exact)
        questions.append(f"{axis} may be {names}: name one")
        return None
    return Variable(exact[0].name, exact[0].unit or unit) if exact else None


def _step_s(
    source: FileSource, axes: Mapping[str, Variable], held: Sequence[ArrayInfo]
) -> float | None:
    """The time step that a preamble says, unless the time has a unit: a count of samples has none.

    Without a time, that of a scalar such as dt or fs.
    """
    time = axes.get("time")
    one = _of(held, time.name) if time is not None else None
    if source.step_s is not None:
        return None if one is not None and is_of(one.unit, "s") else source.step_s
    return _stated_step_s(held) if time is None else None


def _stated_step_s(held: Sequence[ArrayInfo]) -> float | None:
    """The time step that scalars such as dt or fs say, if they say one."""
    scalars = [step_said(e.name, e.low) for e in held if not e.lengths and not e.dims]
    said = {step for step in scalars if step is not None}
    return said.pop() if len(said) == 1 else None


def _lengths(
    axes: Mapping[str, Variable],
    held: Sequence[ArrayInfo],
    source: FileSource,
    rest: Sequence[ArrayInfo],
    dt_s: float | None,
    questions: list[str],
) -> dict[str, int]:
    """Points of the axes; without a time, its samples are what is left of the arrays."""
    found = {axis: one.shape for axis, v in axes.items() if (one := _of(held, v.name))}
    lengths = {axis: int(np.prod(shape)) for axis, shape in found.items()}
    if "time" in axes or not rest:
        return lengths
    points = {axis: xr.DataArray(np.empty(n), dims=_dim(axes[axis], held, axis))
              for axis, n in lengths.items()}  # fmt: skip
    arrays = {e.name: xr.DataArray(np.broadcast_to(0.0, e.shape), dims=e.dims or None)
              for e in rest if e.lengths}  # fmt: skip
    try:
        plain = {name: Variable(name, "1") for name in arrays}
        lengths["time"] = time_length(source, arrays, plain, points)[0]
    except ValueError as error:
        questions.append(str(error))
    return lengths


def _dim(variable: Variable, held: Sequence[ArrayInfo], axis: str) -> str:
    one = _of(held, variable.name)
    return one.dims[0] if one is not None and one.dims else axis


def _variables(
    source: FileSource,
    rest: Sequence[ArrayInfo],
    axes: Mapping[str, Variable],
    held: Sequence[ArrayInfo],
    lengths: Mapping[str, int],
    questions: list[str],
    guesses: dict[str, str],
) -> dict[str, Variable]:
    """Arrays that fit the axes in one way, under our names where theirs are known."""
    fit = [each for each in rest if _fits(each, axes, held, lengths, questions)]
    found: dict[str, Variable] = {}
    meant = {each.name: meant_by(each.name) for each in fit}
    for ours, quantity in QUANTITIES.items():
        options = [each for each in fit if ours in meant[each.name] and _may_be(ours, each)]
        exact = [each for each in options if each.name == ours] or options
        if len(exact) == 1:
            found[ours] = with_unit(ours, exact[0], quantity, guesses)
        elif exact:
            names = " or ".join(repr(each.name) for each in exact)
            questions.append(f"{ours} may be {names}: name one")
    taken, used = {variable.name for variable in found.values()}, {*found, *lengths, "time"}
    for each in fit:
        if each.name not in taken:
            ours = _own_name(each.name, used)
            found[ours] = Variable(each.name, own_unit(ours, each))
            used.add(ours)
    for each in rest:
        columns = _columns(each, lengths, used)
        found |= columns
        used |= columns.keys()
    return found


def _may_be(ours: str, one: ArrayInfo) -> bool:
    return one.unit in ("", "1") or converts(ours, one.unit)


def _fits(
    one: ArrayInfo,
    axes: Mapping[str, Variable],
    held: Sequence[ArrayInfo],
    lengths: Mapping[str, int],
    questions: list[str],
) -> bool:
    """Whether an array has one place on the axes; asks where it might have several, or none."""
    if not one.lengths or one.low != one.low:
        return False
    known = {_dim(variable, held, axis) for axis, variable in axes.items()}
    if one.dims and set(one.dims) <= known:
        return True
    ways = fitting(one.shape, lengths)
    if len(ways) > 1:
        texts = " or ".join(f"[{','.join(way)}]" for way in ways)
        questions.append(f"{one.name!r} of shape {one.shape} may be {texts}: give its dims")
    if not ways and len(one.lengths) > 1 and not _has_columns(one, lengths):
        part = ", ".join([":", *["0"] * (len(one.shape) - 1)])
        questions.append(
            f"{one.name!r} of shape {one.shape} has an axis without a coordinate: name it, or take "
            f"part of the array, such as {one.name}[{part}]"
        )
    return len(ways) == 1


def _has_columns(one: ArrayInfo, lengths: Mapping[str, int]) -> bool:
    """Whether an array is a few signals side by side."""
    n = lengths.get("time", 0)
    return len(one.shape) == 2 and sorted(one.shape)[-1] == n and min(one.shape) <= MAX_COLUMNS


def _columns(one: ArrayInfo, lengths: Mapping[str, int], taken: set[str]) -> dict[str, Variable]:
    """The signals of such an array, one by one."""
    if fitting(one.shape, lengths) or not _has_columns(one, lengths) or len(one.lengths) < 2:
        return {}
    samples_first = one.shape[0] == lengths["time"]
    found = {}
    for k in range(min(one.shape)):
        part = f"[:, {k}]" if samples_first else f"[{k}, :]"
        ours = _own_name(f"{one.name}_{k}", taken)
        found[ours] = Variable(one.name + part, own_unit(ours, one))
    return found


def _own_name(name: str, taken: set[str]) -> str:
    """A name in a file as one of ours."""
    *_, last = re.split(r"[/.]", name)
    ours = re.sub(r"\W+", "_", name if last.isdigit() and last != name else last).strip("_")
    ours = f"column_{ours}" if not ours or ours[0].isdigit() else ours
    while ours in taken:
        ours += "_"
    return ours


# The unit that an array's numbers count: stated, named, ours, or only likely.


def is_of(unit: str, like: str) -> bool:
    return bool(unit) and unit != "1" and unit_like(unit, like=like)


def with_unit(
    ours: str, one: ArrayInfo, quantity: KnownQuantity, guesses: dict[str, str]
) -> Variable:
    """The unit that the file says, its name's ending, ours, or else the likely one."""
    stated = one.unit if is_of(one.unit, quantity.unit) or converts(ours, one.unit) else ""
    stated = stated or _ending(ours, one.name)
    if not stated and not quantity.fits(one.size):
        likely = [
            unit for unit in quantity.others if quantity.fits(one.size, conversion(ours, unit)[0])
        ]
        if likely:
            guesses[ours] = (
                f"{ours} ({one.name!r}) is about {one.size:.2g}, as if the file counted in "
                f"{' or '.join(likely)}, and it names no unit: give it"
            )
            stated = likely[0]
    return Variable(one.name, stated or quantity.unit)


def with_time_unit(
    time: Variable,
    one: ArrayInfo,
    variables: Mapping[str, Variable],
    said_s: float | None,
    guesses: dict[str, str],
) -> Variable:
    """The unit of time where the file names none: that in which its steps are those it says.

    Else a plasma's record shows it in its steps. said_s: the step that a scalar such as fs says.
    """
    if one.unit not in ("", "1") or _ending("time", one.name) or one.step is None:
        return time
    for unit in ("s", *AXES["time"].others):
        if said_s and isclose(one.step * conversion("time", unit)[0], said_s, rel_tol=1e-3):
            return replace(time, unit=unit)
    likely = likely_time_unit(one.step, variables)
    if likely is None:
        return time
    guesses["time"] = (
        f"time ({one.name!r}) goes in steps of {one.step:.2g}, as if the file counted in {likely}, "
        "and it names no unit: give it"
    )
    return replace(time, unit=likely)


def _ending(ours: str, name: str) -> str:
    """The unit at the end of a name, if our name can have it."""
    unit = split_unit(re.split(r"[/.]", name)[-1])[1]
    return unit if unit and converts(ours, unit) else ""


def converts(ours: str, unit: str, *, is_variable: bool = False) -> bool:
    if unit in ("", "1"):
        return False
    try:
        conversion(ours, unit, is_variable=is_variable)
    except ValueError:
        return False
    return True


def own_unit(ours: str, one: ArrayInfo) -> str:
    """The unit that the file says, if numbers can be converted from it; else none."""
    suffixes = [unit for suffix, unit in SUFFIX_UNITS.items() if ours.endswith(f"_{suffix}")]
    options = (one.unit, split_unit(ours)[1] or "", *suffixes)
    return next((unit for unit in options if converts(ours, unit, is_variable=True)), "1")


# One array of a file as it is looked at: shape, unit, range, what is missing, and its steps.


TEXT = "text or objects"  # what is not even tried


@dataclass(frozen=True)
class ArrayInfo:
    """One array of a file. unit: "" where the file says none. n_missing: NaN or infinite.

    step: mean step of a vector that increases, else None. even: whether its steps are equal.
    problem: why it cannot be used.
    """

    name: str
    shape: tuple[int, ...] = ()
    kind: str = ""
    unit: str = ""
    dims: tuple[str, ...] = ()
    low: float = np.nan
    high: float = np.nan
    size: float = 0.0
    n_missing: int = 0
    step: float | None = None
    even: bool = False
    problem: str = ""

    @property
    def lengths(self) -> tuple[int, ...]:
        """Of its axes, without those of one point."""
        return tuple(n for n in self.shape if n > 1)


def describe_array(source: FileSource, name: str) -> ArrayInfo:
    """What one array holds; reads it."""
    try:
        array = read_array(source, name, name)
    except ValueError as error:
        return ArrayInfo(name, problem=_short(str(error)))
    values = np.asarray(array.values, dtype=np.float64)
    finite = values[np.isfinite(values)]
    stated = counted_in(str(array.attrs.get("units", "") or source.units.get(name, "")))
    dims = tuple(map(str, array.dims)) if source.dims_named else ()
    step, even = _step(values.ravel()) if values.size in values.shape else (None, False)
    return ArrayInfo(
        name, values.shape, str(array.dtype), stated, dims,
        float(finite.min()) if finite.size else np.nan,
        float(finite.max()) if finite.size else np.nan,
        typical(values), int(values.size - finite.size), step, even,
    )  # fmt: skip


def _short(text: str) -> str:
    return TEXT if "real numbers" in text else text


def _step(points: np.ndarray) -> tuple[float | None, bool]:
    steps = np.diff(points)
    if len(steps) < 2 or not (steps > 0).all():
        return None, False
    return float(steps.mean()), bool(np.ptp(steps) <= 1e-3 * steps.mean())
