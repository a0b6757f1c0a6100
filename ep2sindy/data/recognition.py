"""Recognition of a file's arrays by names, units, shapes and sizes, without a mapping."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count
from math import isclose
from shlex import quote

import numpy as np
import xarray as xr

from ep2sindy.data.arrays import TEXT, ArrayInfo, describe_array
from ep2sindy.data.conversion import SUFFIX_UNITS, conversion
from ep2sindy.data.dimensions import fitting, match_axes, time_length
from ep2sindy.data.fields import DIMS
from ep2sindy.data.mapping import Keys, Problems, Variable, in_file
from ep2sindy.data.quantities import (
    AXES,
    PLASMA,
    QUANTITIES,
    KnownQuantity,
    last_of,
    likely_time_unit,
    meant_by,
    split_unit,
    step_said,
)
from ep2sindy.data.readers.source import FileSource
from ep2sindy.library.units import is_count, time_unit_in, unit_like

MAX_COLUMNS = 32  # an array of at most so many columns is split into separate signals


@dataclass(frozen=True)
class Recognised:
    """Mapping of a file, as far as it could be recognised.

    held: all arrays of the file. variables, axes: our name -> location in the file. dt_s: time
    step in s if the file gives it outside its time array. guesses: our name -> message about a
    unit that is only likely. questions: messages about open decisions. n_samples: number of
    samples in time, None if it cannot be determined. replaced: the file's times that dt_s stands
    for, in each unit that they may be in.
    """

    held: Sequence[ArrayInfo]
    variables: Mapping[str, Variable]
    axes: Mapping[str, Variable]
    dt_s: float | None
    guesses: Mapping[str, str] = field(default_factory=dict)
    questions: Sequence[str] = ()
    n_samples: int | None = None
    replaced: list[Variable] = field(default_factory=list)

    @property
    def has_time(self) -> bool:
        return "time" in self.axes or self.dt_s is not None

    @property
    def lacks_only_time(self) -> bool:
        """True if the step between samples is all that keeps this mapping from giving a field."""
        return not self.has_time and len(self.doubts) == 1

    @property
    def doubts(self) -> list[str]:
        """What keeps this mapping from giving a field without any doubt."""
        problems = [each.problem for each in self.held if each.problem not in ("", TEXT)]
        problems += self.guesses.values()
        if not self.has_time:
            problems.insert(0, "a field needs time: give its step dt_s, or name the file's time")
        if not self.variables:
            problems.append("no array of the file fits its axes")
        return problems

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
    given: Mapping[str, Variable | Keys] | None = None,
) -> Recognised:
    """Recognise the arrays of a file. given: coordinates that the user named."""
    problems = Problems()
    named = in_file(given or {}, problems)
    problems.check(source)
    held = [describe_array(source, name) for name in source.names]
    usable = [each for each in held if not each.problem]
    questions: list[str] = []
    guesses: dict[str, str] = {}
    axes = dict(named)
    for axis in DIMS[:1] if source.is_table else DIMS:  # in a table, a column z is a state
        if axis not in axes and (found := _axis(axis, usable, source, questions)) is not None:
            axes[axis] = found
    if dt_s is None:
        dt_s = _step_s(source, axes, usable, questions)
    if not source.is_table:
        rest = [e for e in usable if not meant_by(e.name) & {*DIMS} and not e.dims]
        known = {axis: one for axis, v in axes.items() if (one := _of(held, v.name))}
        found_axes = match_axes(
            [*rest, *known.values()], known, has_step=dt_s is not None,
            questions=questions, guesses=guesses,
        )  # fmt: skip
        axes |= {axis: Variable(one.name, AXES[axis].unit) for axis, one in found_axes.items()}
    counter = axes.pop("time", None) if dt_s is not None else None
    taken = {v.name for v in (*axes.values(), *([counter] if counter else [])) if v.name}
    taken |= {each.name for each in usable if "time" in meant_by(each.name)}
    rest = [each for each in usable if each.name not in taken]
    for axis, variable in axes.items():
        if (one := _of(held, variable.name)) is not None and axis not in named:
            axes[axis] = with_unit(axis, one, AXES[axis], guesses)
    lengths = _lengths(axes, held, source, rest, questions, guesses)
    variables = _variables(rest, axes, held, lengths, questions, guesses)
    time = axes.get("time")
    if "time" not in named and time is not None and (one := _of(held, time.name)):
        said_s = source.step_s or _stated_step_s(usable)
        axes["time"] = with_time_unit(axes["time"], one, variables, said_s, guesses)
        _compare_step(axes["time"], one, source.step_s, questions)
    one = _of(held, counter.name) if counter else None
    return Recognised(
        held, variables, axes, dt_s, guesses, questions, lengths.get("time"),
        _in_units(one) if one else [],
    )  # fmt: skip


def _in_units(one: ArrayInfo) -> list[Variable]:
    """Times of a file in their unit, or in each that they may be in if they name none."""
    if one.unit not in ("", "1") or _ending("time", one.name):
        return [with_unit("time", one, AXES["time"], {})]
    units = ("s", *AXES["time"].others) if "time" in meant_by(one.name) else ()
    return [Variable(one.name, unit) for unit in units]


def _of(held: Sequence[ArrayInfo], name: str | None) -> ArrayInfo | None:
    return next((each for each in held if each.name == name), None)


def _axis(
    axis: str, held: Sequence[ArrayInfo], source: FileSource, questions: list[str]
) -> Variable | None:
    """Find the vector of one coordinate by its name; for time, also by its unit or position."""
    unit = AXES[axis].unit
    rising = [each for each in held if each.step is not None]
    options = [each for each in rising if axis in meant_by(each.name)]
    options = [e for e in options if e.unit in ("", "1") or converts(axis, e.unit)]
    if not options and axis == "time":
        options = [each for each in rising if is_of(each.unit, unit)]
        options = options or [
            e for e in rising if e.unit in ("", "1") and time_unit_in(last_of(e.name))
        ]
        if not options and source.is_table and rising and rising[0] is held[0]:
            options = rising[:1]  # an increasing first column of a table is its time
            even = ", and rises evenly" if options[0].even else ", and rises"
            questions.append(
                f"time is taken from {options[0].name!r}, which is the first column{even}, in s: "
                "name another one if that is wrong, or its unit"
            )
    if not options and axis == "time":
        questions += [
            f"{each.name!r} does not increase ({each.falls}): sort the rows, drop what repeats, or "
            "give dt_s if the steps are equal and the times rounded"
            for each in held
            if each.falls and axis in meant_by(each.name)
        ]
    exact = [each for each in options if each.name == axis] or options
    if len(exact) > 1:
        names = " or ".join(repr(each.name) for each in exact)
        questions.append(f"{axis} may be {names}: name one")
        return None
    return Variable(exact[0].name, exact[0].unit or unit) if exact else None


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
    one = _of(held, time.name) if time is not None else None
    if source.step_s is None:
        return _stated_step_s(held) if time is None else None
    if one is not None:
        return source.step_s if one.is_counter else None
    for each in held:
        if not (each.falls and "time" in meant_by(each.name)):
            continue
        span_s = (each.shape[0] - 1) * source.step_s
        if abs(each.high - each.low - span_s) > 0.01 * span_s + 10.0 * source.step_s:
            questions.append(
                f"the times of {each.name!r} run over {each.high - each.low:.6g}, and samples in "
                f"the file's steps of {source.step_s:.6g} s over {span_s:.6g} s: give dt_s if the "
                "steps are equal, or the stretches as files of their own"
            )
            return None
    return source.step_s


def _compare_step(
    time: Variable, one: ArrayInfo, step_s: float | None, questions: list[str]
) -> None:
    """Note times that the step in the file's preamble contradicts, or that leave out samples."""
    said = "" if step_s is None else f", and the file says steps of {step_s:.6g} s beside them"
    usual_s = (one.step or 0.0) * conversion("time", time.unit)[0]
    if one.gap:
        questions.append(
            f"the times of {one.name!r} have a gap: {one.gap}, in {time.unit}{said}; the times are "
            "taken as they stand"
        )
    elif step_s is not None and one.step and abs(usual_s - step_s) > 0.01 * step_s:
        questions.append(
            f"the times of {one.name!r} go in steps of {usual_s:.6g} s{said}; the times are taken"
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
    guesses: dict[str, str],
) -> dict[str, int]:
    """Number of points of each axis; without a time array, samples are counted from the others.

    If no other axis of them has a coordinate, the longest one is likely time.
    """
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
        longest = {max(each.lengths, default=0) for each in rest if len(each.lengths) > 1}
        if len(longest) == 1 and all(e.shape.count(max(longest)) < 2 for e in rest):
            lengths["time"] = longest.pop()
            guesses["time"] = (
                f"time is likely the axis of {lengths['time']} samples, the longest: give it"
            )
        else:
            questions.append(str(error))
    return lengths


def _dim(variable: Variable, held: Sequence[ArrayInfo], axis: str) -> str:
    one = _of(held, variable.name)
    return one.dims[0] if one is not None and one.dims else axis


def _variables(
    rest: Sequence[ArrayInfo],
    axes: Mapping[str, Variable],
    held: Sequence[ArrayInfo],
    lengths: Mapping[str, int],
    questions: list[str],
    guesses: dict[str, str],
) -> dict[str, Variable]:
    """Arrays that fit the axes in exactly one way, under our names if theirs are known."""
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
        parts = _middle(each, lengths, used, guesses) or _columns(each, lengths, used)
        found |= parts
        used |= parts.keys()
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
    """True if an array fits the axes in exactly one way.

    Adds a question for an array that fits in several ways, or has an axis without a coordinate.
    """
    if not one.lengths or one.low != one.low:
        return False
    known = {_dim(variable, held, axis) for axis, variable in axes.items()}
    if one.dims and set(one.dims) <= known:
        return True
    ways = fitting(one.shape, lengths)
    if len(ways) > 1:
        texts = " or ".join(f"[{','.join(way)}]" for way in ways)
        questions.append(f"{one.name!r} of shape {one.shape} may be {texts}: give its dims")
    is_apart = _has_columns(one, lengths) or one.shape.count(lengths.get("time", 0)) == 1
    if not ways and len(one.lengths) > 1 and not is_apart:
        part = ", ".join([":", *["0"] * (len(one.shape) - 1)])
        questions.append(
            f"{one.name!r} of shape {one.shape} has an axis without a coordinate: name it, or take "
            f"part of the array, such as {one.name}[{part}]"
        )
    return len(ways) == 1


def _has_columns(one: ArrayInfo, lengths: Mapping[str, int]) -> bool:
    """True if an array consists of a few signals side by side."""
    n = lengths.get("time", 0)
    fewer = min(one.shape, default=0)
    return len(one.shape) == 2 and fewer < max(one.shape) == n and fewer <= MAX_COLUMNS


def _middle(
    one: ArrayInfo, lengths: Mapping[str, int], taken: set[str], guesses: dict[str, str]
) -> dict[str, Variable]:
    """The signal in the middle of an array on a grid without coordinates, which is only likely."""
    n = lengths.get("time", 0)
    if len(one.lengths) < 2 or fitting(one.shape, lengths) or one.shape.count(n) != 1 or one.dims:
        return {}
    meant = meant_by(one.name) & {*QUANTITIES} - taken
    if _has_columns(one, lengths) and not meant & PLASMA:
        return {}
    ours = meant.pop() if len(meant) == 1 else _own_name(one.name, taken)
    part = ", ".join(":" if size == n else str(size // 2) for size in one.shape)
    name = f"{one.name}[{part}]"
    guesses[ours] = f"{ours} is taken at the middle, {name}, as an axis has no coordinate: give it"
    known = QUANTITIES.get(ours)
    unit = with_unit(ours, one, known, guesses).unit if known else own_unit(ours, one)
    return {ours: Variable(name, unit)}


def _columns(one: ArrayInfo, lengths: Mapping[str, int], taken: set[str]) -> dict[str, Variable]:
    """Separate variables for the signals of an array that holds several side by side."""
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
    """Turn a name in a file into a valid variable name that is not yet taken."""
    last = last_of(name)
    ours = re.sub(r"\W+", "_", name if last.isdigit() and last != name else last).strip("_")
    ours = f"column_{ours}" if not ours or ours[0].isdigit() else ours
    numbers = (f"{ours}_{k}" for k in count(2))
    return ours if ours not in taken else next(name for name in numbers if name not in taken)


# Unit of an array's numbers: stated by the file, in its name, our usual one, or only likely.


def is_of(unit: str, like: str) -> bool:
    return bool(unit) and unit != "1" and unit_like(unit, like=like)


def _guess(guesses: dict[str, str], ours: str, text: str) -> None:
    """Add a message about one of our names to those that there are."""
    before = guesses.get(ours, "").removesuffix(": give it")
    guesses[ours] = f"{before}; {text}" if before else text


def with_unit(
    ours: str, one: ArrayInfo, quantity: KnownQuantity, guesses: dict[str, str]
) -> Variable:
    """Variable with its unit: the stated one, the one in its name, or ours.

    If neither is given and the size does not fit our unit, the likely unit is taken and a message
    is added to `guesses`.
    """
    stated = one.unit if is_of(one.unit, quantity.unit) or converts(ours, one.unit) else ""
    stated = stated or _ending(ours, one.name)
    if not stated and not quantity.fits(one.size):
        likely = [
            unit for unit in quantity.others if quantity.fits(one.size, conversion(ours, unit)[0])
        ]
        if likely:
            _guess(
                guesses,
                ours,
                f"{ours} ({one.name!r}) is about {one.size:.2g}, as if the file counted in "
                f"{' or '.join(likely)}, and it names no unit: give it",
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
    """Time variable with its unit, for a file that names none.

    The unit is the one in which the array's step equals `said_s`, the step in s that a scalar such
    as fs gives. Otherwise a plasma's record suggests a likely unit by its step; that unit comes
    with a message in `guesses`.
    """
    if one.unit not in ("", "1") or _ending("time", one.name) or one.step is None:
        return time
    for unit in ("s", *AXES["time"].others):
        if (
            said_s
            and one.step
            and isclose(one.step * conversion("time", unit)[0], said_s, rel_tol=1e-3)
        ):
            return replace(time, unit=unit)
    likely = likely_time_unit(one.step, variables)
    if likely is None:
        return time
    _guess(
        guesses,
        "time",
        f"time ({one.name!r}) goes in steps of {one.step:.2g}, as if the file counted in {likely}, "
        "and it names no unit: give it",
    )
    return replace(time, unit=likely)


def _ending(ours: str, name: str) -> str:
    """Unit at the end of a name, if it converts to the unit of our name; else ""."""
    unit = (time_unit_in(last_of(name)) if ours == "time" else None) or split_unit(last_of(name))[1]
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
    """Unit that the file states, or that a name's ending gives, if it converts; else "1".

    A count of named things that the file states, such as `animals/ml`, stays as it is.
    """
    if is_count(one.unit):
        return one.unit
    suffixes = [unit for suffix, unit in SUFFIX_UNITS.items() if ours.endswith(f"_{suffix}")]
    options = (one.unit, split_unit(ours)[1] or "", *suffixes)
    return next((unit for unit in options if converts(ours, unit, is_variable=True)), "1")
