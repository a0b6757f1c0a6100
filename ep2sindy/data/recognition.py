"""Recognition of a file's arrays by their names, units and shapes, without a mapping.

A name means a quantity only beside a unit that fits it, if it says so in full, or if the user says
that all is of a plasma. What the file leaves open is asked.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count, permutations
from math import isclose
from shlex import quote

import numpy as np
import xarray as xr

from ep2sindy.data.arrays import TEXT, ArrayInfo, describe_array
from ep2sindy.data.conversion import COORDINATE_UNITS, conversion, converts
from ep2sindy.data.dimensions import fitting, time_length
from ep2sindy.data.fields import DIMS
from ep2sindy.data.mapping import Keys, Problems, Variable, in_file
from ep2sindy.data.quantities import (
    ELECTRONS,
    QUANTITIES,
    axis_of,
    axis_unit,
    is_counter_name,
    last_of,
    own_unit,
    quantity_of,
    step_said,
    words_of,
)
from ep2sindy.data.readers.source import FileSource

MAX_COLUMNS = 32  # an array of at most so many columns is split into separate signals

UNITS_OF_TIME = ("s", "ms", "us", "ns")  # those in which a step that the file says is looked for

STEP = "data.dt_s=STEP"  # what the user is asked for if there are no times


@dataclass(frozen=True)
class Recognised:
    """Mapping of a file, as far as the file says it.

    held: all arrays of the file. variables, axes: our name -> location in the file. dt_s: time
    step in s if the file gives it outside its time array. no_time: the question for the time if
    there is none. no_unit: our name of a quantity that the file gives without a unit -> the
    question for it. questions: messages about other open decisions. n_samples: number of samples
    in time, None if it cannot be determined. replaced: the file's times that dt_s stands for, in
    each unit that they may be in.
    """

    held: Sequence[ArrayInfo]
    variables: Mapping[str, Variable]
    axes: Mapping[str, Variable]
    dt_s: float | None
    no_time: str = ""
    no_unit: Mapping[str, str] = field(default_factory=dict)
    questions: Sequence[str] = ()
    n_samples: int | None = None
    replaced: Sequence[Variable] = ()

    @property
    def asked(self) -> list[str]:
        """Questions that the user must answer."""
        return [self.no_time, *self.no_unit.values()] if self.no_time else [*self.no_unit.values()]

    @property
    def doubts(self) -> list[str]:
        """What keeps this mapping from giving a field without any doubt."""
        none = [] if self.variables else ["no array of the file fits its axes"]
        return [*self.asked, *none]

    def check(self, source: FileSource) -> None:
        """Raise ValueError unless this mapping gives a field without any doubt."""
        if self.doubts:
            text = "; ".join([*self.doubts, *self.questions])
            raise ValueError(
                f"{source.path} cannot be opened without a mapping: {text}; `ep2sindy inspect "
                f"{quote(str(source.path))} --write` (in Python ep2sindy.inspect_file) shows what "
                "it holds and writes a mapping"
            )


def recognise(
    source: FileSource,
    *,
    dt_s: float | None = None,
    given: Mapping[str, Variable | Keys | None] | None = None,
    units: Mapping[str, str] | None = None,
    plasma: bool = False,
) -> Recognised:
    """Recognise the arrays of a file.

    given: coordinates that the user named. units: our name -> unit by the user, where the file
    states none. plasma: names such as Te mean quantities without a unit, and what has no unit is
    in SI.
    """
    named = _named(given, source) if given and any(given.values()) else {}
    held = [describe_array(source, name) for name in source.names]
    usable = [each for each in held if not each.problem]
    questions = _notes(held)
    axes = _axes(source, usable, named, questions)
    if dt_s is None:
        dt_s = _step_s(source, axes, usable, questions)
    replaced = axes.pop("time", None) if dt_s is not None else None
    taken = {v.name for v in (*axes.values(), replaced) if v is not None}
    rest = [e for e in usable if e.name not in taken and axis_of(e.name) != "time"]
    if "time" in axes and (one := _of(held, axes["time"].name)):
        said_s = source.step_s or _stated_step_s(usable)
        if not axes["time"].unit and said_s:
            axes["time"] = _unit_by_step(axes["time"], one, said_s)
        if one.gap or one.digits or source.step_s:
            _compare_step(axes["time"], one, source.step_s, questions)
    lengths = _lengths(axes, held, source, rest, questions)
    variables = _variables(rest, axes, held, lengths, questions, plasma=plasma)
    if not plasma and {*variables} & {*QUANTITIES} and (texts := _only_of_plasma(rest)):
        questions.append(f"data.plasma=true takes {texts}, and what has no unit for SI")
    if "n_i" not in variables:
        questions += [
            f"in a quasi-neutral plasma {e.name!r} is n_i: say so in the mapping that --write makes"
            for e in rest
            if words_of(last_of(e.name)) in ELECTRONS
        ]
    axes, variables, no_unit = _complete(axes, variables, units or {}, plasma=plasma)
    no_time = "" if dt_s is not None or "time" in axes else _no_time(source, usable)
    times = _in_units(replaced) if replaced else []
    return Recognised(
        held, variables, axes, dt_s, no_time, no_unit, questions, lengths.get("time"), times
    )


def _named(given: Mapping[str, Variable | Keys | None], source: FileSource) -> dict[str, Variable]:
    """The coordinates that the user named; raises ValueError if keys are wrong."""
    problems = Problems()
    named = in_file(given, problems)
    problems.check(source)
    return named


def _of(held: Sequence[ArrayInfo], name: str | None) -> ArrayInfo | None:
    return next((each for each in held if each.name == name), None)


def _complete(
    axes: Mapping[str, Variable],
    variables: Mapping[str, Variable],
    units: Mapping[str, str],
    *,
    plasma: bool,
) -> tuple[dict[str, Variable], dict[str, Variable], dict[str, str]]:
    """Axes and variables with the user's units, and the questions for those that still lack one."""
    if unknown := sorted({*units} - {*axes, *variables}):
        raise ValueError(f"units are of {[*axes, *variables]}: {unknown} came")
    found, no_unit = {}, {}
    for ours, variable in {**axes, **variables}.items():
        found[ours] = replace(variable, unit=units[ours]) if ours in units else variable
        if not variable.unit and ours not in units:
            usual = COORDINATE_UNITS.get(ours) or QUANTITIES[ours].unit
            found[ours] = replace(variable, unit=usual)
            if not plasma:
                no_unit[ours] = (
                    f"{ours} ({variable.name!r}) names no unit: give it, such as "
                    f"'data.units={{{ours}:{usual}}}'"
                )
        elif ours in units and variable.unit not in ("", "1"):
            raise ValueError(f"the file states the unit of {ours}, {variable.unit}: give none")
    return {axis: found[axis] for axis in axes}, {name: found[name] for name in variables}, no_unit


def _notes(held: Sequence[ArrayInfo]) -> list[str]:
    """Which arrays cannot be read, and which samples count as missing."""
    bad = [f"{e.name!r} is left out: {e.problem}" for e in held if e.problem not in ("", TEXT)]
    marked = [
        f"{e.name!r}: {e.n_marks} samples are marks of an overload or of absence, and left out"
        for e in held
        if e.n_marks
    ]
    return bad + marked


def _no_time(source: FileSource, held: Sequence[ArrayInfo]) -> str:
    """The question for the time of a file that says none."""
    text = f"a field needs time: give the step between samples, {STEP} in s"
    if source.steps:
        return (
            f"a field needs time: give the time of one step, of those numbered {source.steps[0]} "
            f"to {source.steps[-1]}, {STEP} in s"
        )
    if source.is_table and (long := _long_table(source, held)):
        return long
    rising = [each.name for each in held if each.step is not None and not each.is_counter]
    if not source.is_table or not rising or is_counter_name(rising[0]):
        return text
    return f"{text}, or, if {rising[0]!r} is time, 'data.time={{name:{rising[0]},unit:UNIT}}'"


def _long_table(source: FileSource, held: Sequence[ArrayInfo]) -> str:
    """That a column runs through its values and starts anew at each value of another, in words."""
    columns = {each.name: source.read(each.name).values for each in held if each.falls}
    for inner, outer in permutations(columns, 2):
        starts = np.flatnonzero(np.diff(columns[outer])) + 1
        n = int(starts[0]) if starts.size else 0
        blocks, runs = (np.split(columns[name], range(n, len(columns[name]), n or 1))
                        for name in (outer, inner))  # fmt: skip
        stays = n > 1 and all(np.ptp(block) == 0.0 for block in blocks)
        if stays and all(np.array_equal(run, runs[0]) for run in runs):
            return (
                f"the table is long: {inner!r} runs through {n} values and starts anew at each "
                f"{outer!r}; make a field of it in Python, table.set_index(['{outer}', '{inner}'])"
                ".to_xarray().to_netcdf('field.nc')"
            )
    return ""


# Time, z and r.


def _axes(
    source: FileSource,
    held: Sequence[ArrayInfo],
    named: Mapping[str, Variable],
    questions: list[str],
) -> dict[str, Variable]:
    """The coordinates; the unit is "" where neither the file nor the user says it."""
    axes = dict(named)
    for axis in DIMS[:1] if source.is_table else DIMS:  # in a table, a column z is a state
        if axis not in axes and (one := _axis(axis, held, questions)) is not None:
            axes[axis] = Variable(one.name, axis_unit(axis, one.name, one.unit))
    return axes


def _axis(axis: str, held: Sequence[ArrayInfo], questions: list[str]) -> ArrayInfo | None:
    """Find the increasing vector of one coordinate by its name; for time, also by its unit."""
    rising = [each for each in held if each.step is not None]
    named = [each for each in held if axis_of(each.name) == axis]
    options = [e for e in named if e in rising and (e.unit in ("", "1") or converts(axis, e.unit))]
    if axis == "time" and not options:
        options = [e for e in rising if converts(axis, e.unit)]
        questions += [] if options else [
            f"{each.name!r} does not increase ({each.falls}): sort the rows and drop what repeats, "
            "or give dt_s if no sample is one too many and the steps are equal"
            for each in named
            if each.falls
        ]  # fmt: skip
    exact = [each for each in options if each.name == axis] or options
    if len(exact) > 1:
        names = " or ".join(repr(each.name) for each in exact)
        questions.append(f"{axis} may be {names}: name one, data.{axis}.name={exact[0].name}")
    return exact[0] if len(exact) == 1 else None


def _in_units(time: Variable) -> list[Variable]:
    """Times of a file in their unit, or in each that they may be in if they name none."""
    return [replace(time, unit=unit) for unit in ([time.unit] if time.unit else UNITS_OF_TIME)]


def _unit_by_step(time: Variable, one: ArrayInfo, said_s: float) -> Variable:
    """Times without a unit, in that in which their step is the one that the file says beside."""
    steps = {unit: (one.step or 0.0) * conversion("time", unit)[0] for unit in UNITS_OF_TIME}
    fit = [unit for unit, step in steps.items() if isclose(step, said_s, rel_tol=1e-3)]
    return replace(time, unit=fit[0]) if fit else time


def _step_s(
    source: FileSource,
    axes: Mapping[str, Variable],
    held: Sequence[ArrayInfo],
    questions: list[str],
) -> float | None:
    """Time step in s from outside the time array, or None.

    A time array comes first, unless it merely numbers the samples. Without one, the step of a
    preamble counts, or a scalar such as dt or fs. Times that do not increase must still span what
    the step says, as rounded ones do.
    """
    time = axes.get("time")
    said_s = source.step_s or _stated_step_s(held)
    if time is not None or said_s is None:
        one = _of(held, time.name) if time is not None else None
        if time is None or one is None or said_s is None:
            return None
        usual_s = (one.step or 0.0) * conversion("time", time.unit or "s")[0]
        is_rounded = one.digits is not None and isclose(usual_s, said_s, rel_tol=0.2)
        return said_s if one.is_counter or is_rounded else None
    for each in held:
        if not (each.falls and axis_of(each.name) == "time"):
            continue
        span_s = (each.shape[0] - 1) * said_s
        if abs(each.high - each.low - span_s) > 0.01 * span_s + 10.0 * said_s:
            questions.append(
                f"the times of {each.name!r} run over {each.high - each.low:.6g}, and samples in "
                f"the file's steps of {said_s:.6g} s over {span_s:.6g} s: give dt_s if the "
                "steps are equal, or the stretches as files of their own"
            )
            return None
    return said_s


def _compare_step(
    time: Variable, one: ArrayInfo, step_s: float | None, questions: list[str]
) -> None:
    """Note times that the step in the file's preamble contradicts, or that leave out samples."""
    said = "" if step_s is None else f", and the file says steps of {step_s:.6g} s beside them"
    if one.digits is not None:
        questions.append(
            f"the times of {one.name!r} were rounded to {one.digits} digits, so that some repeat: "
            "equal steps are taken"
        )
    if one.gap:
        unit = f", in {time.unit}" if time.unit else ""
        questions.append(
            f"the times of {one.name!r} have a gap: {one.gap}{unit}{said}; the times are "
            "taken as they stand"
        )
    elif step_s is not None and one.step and time.unit:
        usual_s = one.step * conversion("time", time.unit)[0]
        if abs(usual_s - step_s) > 0.01 * step_s:
            questions.append(
                f"the times of {one.name!r} go in steps of {usual_s:.6g} s{said}; the times are "
                "taken"
            )


def _stated_step_s(held: Sequence[ArrayInfo]) -> float | None:
    """Time step in s given by scalars such as dt or fs; None if there is none or they disagree."""
    scalars = [
        step_said(
            e.name, e.low * (conversion("time", e.unit)[0] if converts("time", e.unit) else 1)
        )
        for e in held
        if not e.lengths and not e.dims
    ]
    said = {step for step in scalars if step is not None}
    return said.pop() if len(said) == 1 else None


def _lengths(
    axes: Mapping[str, Variable],
    held: Sequence[ArrayInfo],
    source: FileSource,
    rest: Sequence[ArrayInfo],
    questions: list[str],
) -> dict[str, int]:
    """Number of points of each axis; without a time array, samples are counted from the others."""
    if source.is_table:
        return {"time": max((e.shape[0] for e in (*rest, *held) if e.shape), default=0)}
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


# Variables.


def _variables(
    rest: Sequence[ArrayInfo],
    axes: Mapping[str, Variable],
    held: Sequence[ArrayInfo],
    lengths: Mapping[str, int],
    questions: list[str],
    *,
    plasma: bool,
) -> dict[str, Variable]:
    """Arrays that fit the axes in exactly one way, under our names if theirs mean a quantity."""
    fit = [each for each in rest if _fits(each, axes, held, lengths, questions)]
    meant: dict[str, dict[str, str]] = {}  # our name -> names in the file, with their units
    for each in fit:
        stated = "" if each.unit == "1" else each.unit
        if (quantity := quantity_of(each.name, stated, plasma=plasma)) is not None:
            meant.setdefault(quantity[0], {})[each.name] = quantity[1]
    found: dict[str, Variable] = {}
    for ours, options in meant.items():
        if len(options) == 1 or ours in options:
            name = ours if ours in options else next(iter(options))
            found[ours] = Variable(name, options[name])
        else:
            questions.append(f"{ours} may be {' or '.join(map(repr, options))}: name one")
    named, used = {variable.name for variable in found.values()}, {*found, *lengths, "time"}
    for each in fit:
        if each.name not in named:
            ours = _own_name(each.name, used)
            found[ours] = Variable(each.name, own_unit(ours, each.unit))
            used.add(ours)
    for each in rest:
        parts = _columns(each, lengths, used) if len(each.lengths) > 1 else {}
        found |= parts
        used |= parts.keys()
    return found


def _only_of_plasma(held: Sequence[ArrayInfo]) -> str:
    """Which names without a unit would mean quantities if all is of a plasma, in words."""
    bare = [each.name for each in held if each.unit in ("", "1")]
    meant = {name: quantity_of(name, "", plasma=True) for name in bare
             if quantity_of(name, "", plasma=False) is None}  # fmt: skip
    return ", ".join(f"{name!r} for {q[0]}" for name, q in meant.items() if q)


def _fits(
    one: ArrayInfo,
    axes: Mapping[str, Variable],
    held: Sequence[ArrayInfo],
    lengths: Mapping[str, int],
    questions: list[str],
) -> bool:
    """True if an array fits the axes in exactly one way.

    Adds a question for an array that fits in several ways, or has an axis without a coordinate.
    """
    if not one.lengths or one.low != one.low:
        return False
    if lengths == {"time": one.shape[0]} and len(one.shape) == 1:
        return True
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
            f"{one.name!r} of shape {one.shape} has an axis without a coordinate: name it, such as "
            f"data.z.name=NAME, or take part of the array, such as {one.name}[{part}]"
        )
    return len(ways) == 1


def _has_columns(one: ArrayInfo, lengths: Mapping[str, int]) -> bool:
    """True if an array consists of a few signals side by side."""
    n = lengths.get("time", 0)
    fewer = min(one.shape, default=0)
    return len(one.shape) == 2 and fewer < max(one.shape) == n and fewer <= MAX_COLUMNS


def _columns(one: ArrayInfo, lengths: Mapping[str, int], taken: set[str]) -> dict[str, Variable]:
    """Separate variables for the signals of an array that holds several side by side."""
    if fitting(one.shape, lengths) or not _has_columns(one, lengths):
        return {}
    samples_first = one.shape[0] == lengths["time"]
    found = {}
    for k in range(min(one.shape)):
        part = f"[:, {k}]" if samples_first else f"[{k}, :]"
        ours = _own_name(f"{one.name}_{k}", taken)
        found[ours] = Variable(one.name + part, own_unit(ours, one.unit))
    return found


def _own_name(name: str, taken: set[str]) -> str:
    """Turn a name in a file into a valid variable name that is not yet taken."""
    last = last_of(name)
    ours = re.sub(r"\W+", "_", name if last.isdigit() and last != name else last).strip("_")
    ours = f"column_{ours}" if not ours or ours[0].isdigit() else ours
    numbers = (f"{ours}_{k}" for k in count(2))
    return ours if ours not in taken else next(name for name in numbers if name not in taken)
