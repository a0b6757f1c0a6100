"""Recognition of a file's arrays by their names, units and shapes, without a mapping.

A name means a quantity only next to a unit that fits it, if it says so in full, or if the user says
that all is of a plasma. What the file leaves open is asked.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count, product
from math import isclose, prod
from types import MappingProxyType

import numpy as np

from ep2sindy.data.fields import DIMS
from ep2sindy.data.inspection import STEP, Inspection
from ep2sindy.data.mapping import TEXT, ArrayInfo, Variable, describe_array, fitting, time_length
from ep2sindy.data.quantities import (
    COORDINATE_UNITS,
    ELECTRONS,
    KNOWN_UNITS,
    axis_of,
    axis_unit,
    conversion,
    converts,
    is_counter_name,
    last_of,
    own_unit,
    quantity_of,
    split_unit,
    step_given_by,
    words_of,
)
from ep2sindy.data.readers.source import FileSource
from ep2sindy.trust.memory import check_width

MAX_COLUMNS = 32  # an array of at most so many columns is split into separate signals

UNITS_OF_TIME = ("s", "ms", "us", "ns")  # those in which a step that the file says is looked for


def recognise(
    source: FileSource,
    *,
    dt_s: float | None = None,
    given: Mapping[str, Variable] = MappingProxyType({}),
    units: Mapping[str, str] | None = None,
    plasma: bool = False,
) -> Inspection:
    """Recognise the arrays of a file.

    given: coordinates that the user named. units: our name -> unit by the user, where the file
    states none. plasma: names such as Te mean quantities without a unit, and what has no unit is
    in SI.
    """
    check_width(len(source.names), "arrays")
    arrays = _Arrays(source, [describe_array(source, name) for name in source.names], plasma)
    axes = arrays.axes(given)
    dt_s = arrays.step_s(axes.get("time")) if dt_s is None else dt_s
    times = [axes.pop("time")] if dt_s is not None and "time" in axes else []
    if "time" in axes:
        axes["time"] = arrays.checked_time(axes["time"])
    taken = {variable.name for variable in (*axes.values(), *times)}
    rest = [e for e in arrays.usable if e.name not in taken and axis_of(e.name) != "time"]
    lengths = arrays.lengths(axes, rest)
    found = {**axes, **arrays.variables(axes, rest, lengths)}
    found, no_unit = _with_units(found, units or {}, plasma=plasma)
    return Inspection(
        source,
        arrays.held,
        {ours: variable for ours, variable in found.items() if ours not in axes},
        {axis: found[axis] for axis in axes},
        dt_s,
        "" if dt_s is not None or "time" in axes else arrays.no_time(),
        no_unit,
        arrays.questions,
        lengths.get("time"),
        # In each unit that they may be in if the file names none.
        [replace(t, unit=u) for t in times for u in ([t.unit] if t.unit else UNITS_OF_TIME)],
    )


def _with_units(
    found: Mapping[str, Variable], units: Mapping[str, str], *, plasma: bool
) -> tuple[dict[str, Variable], dict[str, str]]:
    """Locations with the user's units, and the questions for those that still lack one."""
    if unknown := sorted({*units} - {*found}):
        raise ValueError(f"units are of {[*found]}, got {unknown}")
    complete, no_unit = {}, {}
    for ours, variable in found.items():
        if ours in units and variable.unit not in ("", "1"):
            raise ValueError(f"the file states the unit of {ours}, {variable.unit}: give none")
        unit = units.get(ours, variable.unit)
        if not unit:
            unit = COORDINATE_UNITS.get(ours) or KNOWN_UNITS[ours]
            if not plasma:
                counts = ", or 'data.units={time:step}' if it counts samples" * (ours == "time")
                no_unit[ours] = (
                    f"{ours} ({variable.name!r}) names no unit: give it, such as "
                    f"'data.units={{{ours}:{unit}}}'{counts}"
                )
        complete[ours] = replace(variable, unit=unit)
    return complete, no_unit


@dataclass(frozen=True)
class _Arrays:
    """The arrays of a file, what they are decided to be, and the questions that this leaves."""

    source: FileSource
    held: Sequence[ArrayInfo]
    plasma: bool
    questions: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        bad = [each for each in self.held if each.problem not in ("", TEXT)]
        self.questions.extend(f"{each.name!r} is left out: {each.problem}" for each in bad)
        self.questions.extend(
            f"{e.name!r}: {e.n_marks} samples are marks of an overload or of absence, and left out"
            for e in self.held
            if e.n_marks
        )

    @cached_property
    def usable(self) -> list[ArrayInfo]:
        return [each for each in self.held if not each.problem]

    def at(self, variable: Variable) -> ArrayInfo | None:
        """The array at a place in the file; None for a part of one."""
        return next((each for each in self.held if each.name == variable.name), None)

    # Time, z and r.

    def axes(self, named: Mapping[str, Variable]) -> dict[str, Variable]:
        """The coordinates; the unit is "" where neither the file nor the user says it."""
        axes = dict(named)
        for axis in DIMS[:1] if self.source.is_table else DIMS:  # in a table, a column z is a state
            if axis not in axes and (one := self._axis(axis)) is not None:
                axes[axis] = Variable(one.name, axis_unit(axis, one.name, one.unit))
        return axes

    def _axis(self, axis: str) -> ArrayInfo | None:
        """Find the increasing vector of one coordinate by its name; for time, also by its unit."""
        rising = [each for each in self.usable if each.step is not None]
        named = [each for each in self.usable if axis_of(each.name) == axis]
        fit = [e for e in named if e in rising and (e.unit in ("", "1") or converts(axis, e.unit))]
        if axis == "time" and not fit:
            fit = [each for each in rising if converts(axis, each.unit)]
            for each in named if not fit else []:
                if each.falls:
                    self.questions.append(
                        f"{each.name!r} does not increase ({each.falls}): sort the rows and drop "
                        "what repeats, or give dt_s if no sample is one too many and the steps are "
                        "equal"
                    )
        exact = [each for each in fit if each.name == axis] or fit
        if len(exact) > 1:
            names = " or ".join(repr(each.name) for each in exact)
            self.questions.append(
                f"{axis} may be {names}: name one, data.{axis}.name={fit[0].name}"
            )
        return exact[0] if len(exact) == 1 else None

    @cached_property
    def given_s(self) -> float | None:
        """Time step in s that a preamble says, or scalars such as dt or fs if they agree."""
        scalars = [each for each in self.usable if not each.lengths and not each.dims]
        values = {
            e.name: e.low * (conversion("time", e.unit)[0] if converts("time", e.unit) else 1)
            for e in scalars
        }
        steps = {step_given_by(name, value) for name, value in values.items()} - {None}
        return self.source.step_s or (steps.pop() if len(steps) == 1 else None)

    def step_s(self, time: Variable | None) -> float | None:
        """Time step in s from outside the time array, or None.

        A time array comes first, unless it merely numbers the samples. Without one, the step that
        the file gives counts. Times that do not increase must still span what the step says, as
        rounded ones do.
        """
        given_s = self.given_s
        if given_s is None:
            return None
        if time is None:
            return given_s if self._spans(given_s) else None
        one = self.at(time)
        if one is None:
            return None
        usual_s = _step_in_s(one, time.unit)
        is_rounded = one.digits is not None and isclose(usual_s, given_s, rel_tol=0.2)
        return given_s if one.is_counter or is_rounded else None

    def _spans(self, given_s: float) -> bool:
        """True unless times that do not increase span something else than steps of this length."""
        for each in self.usable:
            span_s = (max(each.shape, default=1) - 1) * given_s
            differs = abs(each.high - each.low - span_s) > 0.01 * span_s + 10.0 * given_s
            if each.falls and axis_of(each.name) == "time" and differs:
                self.questions.append(
                    f"the times of {each.name!r} run over {each.high - each.low:.6g}, and samples "
                    f"in the file's steps of {given_s:.6g} s over {span_s:.6g} s: give dt_s if the "
                    "steps are equal, or the segments as files of their own"
                )
                return False
        return True

    def checked_time(self, time: Variable) -> Variable:
        """Times, in the unit in which their step is the one that the file says, if it names none.

        Notes times that the step in the file's preamble contradicts, or that leave out samples.
        """
        if (one := self.at(time)) is None:
            return time
        if not time.unit and (step_s := self.given_s) is not None:
            fit = [u for u in UNITS_OF_TIME if isclose(_step_in_s(one, u), step_s, rel_tol=1e-3)]
            time = replace(time, unit=fit[0] if fit else "")
        times, given_s = f"the times of {one.name!r}", self.source.step_s
        beside = f", and the file says steps of {given_s:.6g} s next to them" if given_s else ""
        usual_s = _step_in_s(one, time.unit)
        if one.digits is not None:
            self.questions.append(
                f"{times} were rounded to {one.digits} digits, so that some repeat: equal steps "
                "are taken"
            )
        if one.gap:
            unit = f", in {time.unit}" if time.unit else ""
            self.questions.append(
                f"{times} have a gap: {one.gap}{unit}{beside}; the times are taken as they stand"
            )
        elif given_s and usual_s and time.unit and abs(usual_s - given_s) > 0.01 * given_s:
            self.questions.append(
                f"{times} go in steps of {usual_s:.6g} s{beside}; the times are taken"
            )
        return time

    def no_time(self) -> str:
        """The question for the time of a file that says none."""
        numbers = self.source.steps
        if numbers:
            return (
                "a field needs time: give the time of one step, of those numbered "
                f"{numbers[0]} to {numbers[-1]}, {STEP} in s"
            )
        if self.source.is_table and (long := self._long_table()):
            return long
        text = f"a field needs time: give the step between samples, {STEP} in s"
        rising = [e.name for e in self.usable if e.step is not None and not e.is_counter]
        if not self.source.is_table or not rising or is_counter_name(rising[0]):
            return text
        return f"{text}, or, if {rising[0]!r} is time, 'data.time={{name:{rising[0]},unit:UNIT}}'"

    def _long_table(self) -> str:
        """That a column runs through its values and starts anew at each value of another."""
        columns = {e.name: self.source.read(e.name).values for e in self.usable if e.falls}
        lengths: dict[int, str] = {}  # of the blocks in which a column stays -> the first such one
        for outer, values in columns.items():
            starts = np.flatnonzero(np.diff(values)) + 1
            if starts.size and starts[0] > 1 and not (starts % starts[0]).any():
                lengths.setdefault(int(starts[0]), outer)
        for (inner, values), (n, outer) in product(columns.items(), lengths.items()):
            if values.size % n == 0 and np.array_equal(values[n:], values[:-n]):
                return (
                    f"the table is long: {inner!r} runs through {n} values and starts anew at each "
                    f"{outer!r}; make a field of it in Python, table.set_index(['{outer}', "
                    f"'{inner}']).to_xarray().to_netcdf('field.nc')"
                )
        return ""

    def lengths(self, axes: Mapping[str, Variable], rest: Sequence[ArrayInfo]) -> dict[str, int]:
        """Number of points of each axis; without times, samples are counted from the others."""
        if self.source.is_table:
            return {"time": max((e.shape[0] for e in (*rest, *self.held) if e.shape), default=0)}
        points = {axis: one for axis, v in axes.items() if (one := self.at(v))}
        lengths = {axis: prod(one.shape) for axis, one in points.items()}
        if "time" not in axes and rest:
            arrays = {each.name: each for each in rest if each.lengths}
            try:
                lengths["time"] = time_length(arrays, points, named=self.source.dims_named)[0]
            except ValueError as error:
                self.questions.append(str(error))
        return lengths

    # Variables.

    def variables(
        self, axes: Mapping[str, Variable], rest: Sequence[ArrayInfo], lengths: Mapping[str, int]
    ) -> dict[str, Variable]:
        """Arrays that fit the axes in one way alone, under our names if theirs mean a quantity."""
        known = {
            dim for variable in axes.values() if (one := self.at(variable)) for dim in one.dims
        }
        fit = [each for each in rest if self._fits(each, known, lengths)]
        meant: dict[str, dict[str, str]] = {}  # our name -> names in the file, with their units
        electrons: dict[str, str] = {}  # which have the density of the ions
        for each in fit:
            unit = "" if each.unit == "1" else each.unit
            if (quantity := quantity_of(each.name, unit, plasma=self.plasma)) is not None:
                meant.setdefault(quantity[0], {})[each.name] = quantity[1]
            base, ending = split_unit(last_of(each.name))
            unit = unit or ending
            if words_of(base) in ELECTRONS and (converts("n_i", unit) if unit else self.plasma):
                electrons[each.name] = unit
        if "n_n" in meant and "n_i" not in meant and len(electrons) == 1:
            meant = {"n_i": electrons, **meant}
            self.questions.append(f"{next(iter(electrons))!r} is taken as n_i, by quasi-neutrality")
        found: dict[str, Variable] = {}
        for ours, options in meant.items():
            if len(options) == 1 or ours in options:
                name = ours if ours in options else next(iter(options))
                found[ours] = Variable(name, options[name])
            else:
                self.questions.append(f"{ours} may be {' or '.join(map(repr, options))}: name one")
        named, taken = {variable.name for variable in found.values()}, {*lengths, "time"}
        for each in fit:
            if each.name not in named:
                ours = _own_name(each.name, {*found, *taken})
                found[ours] = Variable(each.name, own_unit(ours, each.unit))
        for each in rest:
            if _has_columns(each, lengths):
                for k in range(min(each.shape)):
                    part = f"[:, {k}]" if each.shape[0] == lengths["time"] else f"[{k}, :]"
                    ours = _own_name(f"{each.name}_{k}", {*found, *taken})
                    found[ours] = Variable(each.name + part, own_unit(ours, each.unit))
        self._offer(rest, found)
        return found

    def _fits(self, one: ArrayInfo, known: set[str], lengths: Mapping[str, int]) -> bool:
        """True if an array fits the axes in exactly one way. known: the file's names of these.

        Adds a question for an array that fits in several ways, or has an axis without a coordinate.
        """
        if not one.lengths or one.low != one.low:
            return False
        if one.dims and set(one.dims) <= known:
            return True
        ways = fitting(one.shape, lengths)
        if len(ways) > 1:
            texts = " or ".join(f"[{','.join(way)}]" for way in ways)
            self.questions.append(
                f"{one.name!r} of shape {one.shape} may be {texts}: give its dims"
            )
        if not ways and len(one.lengths) > 1 and not _has_columns(one, lengths):
            part = ", ".join([":", *["0"] * (len(one.shape) - 1)])
            self.questions.append(
                f"{one.name!r} of shape {one.shape} has an axis without a coordinate: name it, "
                "such as data.z.name=NAME, or points.axes=[NAME] if it is of operating points, or "
                f"take part of the array, such as {one.name}[{part}]"
            )
        return len(ways) == 1

    def _offer(self, rest: Sequence[ArrayInfo], found: Mapping[str, Variable]) -> None:
        """Say which names without a unit would mean quantities if all is of a plasma."""
        bare = [e.name for e in rest if e.unit in ("", "1") and not quantity_of(e.name, "")]
        meant = {name: quantity_of(name, "", plasma=True) for name in bare}
        texts = ", ".join(f"{name!r} for {q[0]}" for name, q in meant.items() if q)
        if texts and not self.plasma and {*found} & {*KNOWN_UNITS}:
            self.questions.append(f"data.plasma=true takes {texts}, and what has no unit for SI")


def _step_in_s(times: ArrayInfo, unit: str) -> float:
    """Median step of times in a unit, seconds by default; zero if they do not increase."""
    return (times.step or 0.0) * conversion("time", unit or "s")[0]


def _has_columns(one: ArrayInfo, lengths: Mapping[str, int]) -> bool:
    """True if an array consists of a few signals side by side, and is on no grid."""
    n = lengths.get("time", 0)
    fewer = min(one.shape, default=0)
    is_wide = len(one.lengths) == len(one.shape) == 2 and fewer < max(one.shape) == n
    return is_wide and fewer <= MAX_COLUMNS and not fitting(one.shape, lengths)


def _own_name(name: str, taken: set[str]) -> str:
    """Turn a name in a file into a valid variable name that is not yet taken."""
    last = last_of(name)
    ours = re.sub(r"\W+", "_", name if last.isdigit() and last != name else last).strip("_")
    ours = f"column_{ours}" if not ours or ours[0].isdigit() else ours
    numbers = (f"{ours}_{k}" for k in count(2))
    return ours if ours not in taken else next(name for name in numbers if name not in taken)
