"""Runs from files, and their operating points: by the names of the files, or as these say."""

from __future__ import annotations

import re
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from glob import escape, glob
from itertools import product
from pathlib import Path

import xarray as xr

from ep2sindy.data.inspection import Inspection
from ep2sindy.data.mapping import ArrayInfo
from ep2sindy.data.open import inspect_file, open_field
from ep2sindy.data.quantities import (
    COUNTERS,
    NAMED_UNITS,
    is_counter_name,
    last_of,
    own_unit,
    to_si,
)
from ep2sindy.data.readers.source import file_named
from ep2sindy.data.steps import files_of, open_record
from ep2sindy.data.trajectory import ConstantStateError, Trajectory
from ep2sindy.data.zones import Zone, zone_average
from ep2sindy.runtime.values import check_list

NUMBER = r"[+-]?(?:\d+(?:\.\d*|[p,]\d+)?|\.\d+)(?:[eE][+-]?\d+)?"
_PLACEHOLDER = re.compile(r"\{([^{}]*)\}")
_DATE = (
    r"(?<!\d)(?:19|20)\d\d[-_.]?(?:0\d|1[0-2])[-_.]?[0-3]\d"
    r"(?:[-_ T]?\d\d[-_.:]?\d\d(?:[-_.:]?\d\d)?)?(?![^\W_])"
)
# A date or a number in a name. A sign counts only behind `_`, `=`, `/` or `(`, for `-` also
# separates.
_IN_NAME = re.compile(_DATE + r"|(?:(?<=[_=/(])[+-])?\d+(?:[.p]\d+)?(?:[eE][+-]?\d+)?")
_LETTERS = r"[^\W\d_]+"
DATA = "data"  # key of a point's data, and so no name of a quantity
# Words before a number that names a file, and is no quantity.
LABELS = COUNTERS | {"shot", "run", "rec", "file", "test", "trial", "num", "meas", "date", DATA}
MOST_SHOWN = 3  # names of files in an error


@dataclass(frozen=True)
class FilePattern:
    """Pattern of the names of files that hold one operating point each.

    text: a path in which `{NAME}` stands for the number that the quantity NAME has at the point.
    `*` and `?` stand for any characters, as in a shell, but for `/`. A `p` between digits is a
    decimal point, `m4p5`, and so is a comma, unless the pattern holds a comma itself.
    Raises ValueError for a pattern without a placeholder, or one that is no word.

    >>> FilePattern("runs/V{V_D_V}_m{mdot_mg_s}.csv").names
    ('V_D_V', 'mdot_mg_s')
    """

    text: str

    def __post_init__(self) -> None:
        example = "'runs/V{V_D_V}_m{mdot_mg_s}.csv'"
        if not self.names or re.search(r"[{}]", _PLACEHOLDER.sub("", self.text)):
            raise ValueError(
                "the files of operating points need a pattern with a placeholder for each "
                f"quantity, like {example}, got {self.text!r}"
            )
        if wrong := [name for name in self.names if not name.isidentifier() or name == DATA]:
            raise ValueError(
                "a placeholder must be the name of a quantity, of letters, digits and _, and not "
                f"{DATA!r}, like {example}, got {wrong[0]!r} in {self.text!r}"
            )

    @cached_property
    def names(self) -> tuple[str, ...]:
        """The quantities, in the order of their placeholders."""
        return tuple(dict.fromkeys(_PLACEHOLDER.findall(self.text)))

    def points(self) -> tuple[dict[str, dict[str, float]], list[str]]:
        """Files by the pattern, each with its quantities, in their order; and the other files.

        The others fit the pattern with some text in the place of a number.
        Raises ValueError if no file fits.
        """
        parts = _PLACEHOLDER.split(self.text)
        # For a glob, `*` and `?` keep their meaning.
        shape = "".join("*" if k % 2 else part.replace("[", "[[]") for k, part in enumerate(parts))
        number = NUMBER.replace("[p,]", "p") if "," in self.text else NUMBER
        reads = re.compile(_expression(parts, number), re.DOTALL)
        files = {file: reads.fullmatch(file) for file in sorted(glob(shape))}
        found = {
            file: {name: float(re.sub("[p,]", ".", match[name])) for name in self.names}
            for file, match in files.items()
            if match
        }
        others = [file for file, match in files.items() if not match]
        if not found:
            near = others or sorted(glob(str(Path(escape(str(Path(self.text).parent)), "*"))))
            shown = f": {', '.join(near[:MOST_SHOWN])} ..." if near else ""
            raise ValueError(
                f"no file fits the pattern {self.text!r} in {Path.cwd()}, a number in the place "
                f"of each {{NAME}}; there are {len(near)} files next to it{shown}"
            )
        ordered = sorted(found.items(), key=lambda pair: tuple(pair[1].values()))
        return dict(ordered), others


def _expression(parts: Sequence[str], number: str) -> str:
    """Regular expression of the pattern that texts and names make by turns."""
    found = ""
    for k, part in enumerate(parts):
        if k % 2:
            found += f"(?P={part})" if part in parts[1:k:2] else f"(?P<{part}>{number})"
        else:
            found += re.escape(part).replace(r"\*", "[^/]*").replace(r"\?", "[^/]")
    return found


def propose_pattern(paths: Sequence[str]) -> FilePattern | None:
    """The pattern of which files are operating points; None if their names tell none.

    Names must differ in numbers alone. Each number that differs is a quantity, called as the
    letters before it, or else behind it. Dates, numbers without letters and those that name a file
    (`#103`, `run_7`) are none: `*` stands for them. `4,5` may be one number or two, and tells none.

    >>> propose_pattern(["a/V200_m4.5.csv", "a/V300_m5.csv"]).text
    'a/V{V}_m{m}.csv'
    """
    if len({_IN_NAME.sub("0", path) for path in paths}) != 1 or len(paths) < 2:
        return None
    if any(re.search(r"[{}*?[]|\d,\d", path) for path in paths):
        return None
    numbers = [[match[0] for match in _IN_NAME.finditer(path)] for path in paths]
    texts = _IN_NAME.split(paths[0])
    inner, names = numbers[0], list[str]()
    for k, column in enumerate(zip(*numbers, strict=True)):
        if len({*column}) > 1:
            is_date = re.fullmatch(_DATE, column[0])
            name = "" if is_date else _quantity(texts[k], texts[k + 1], taken=names)
            inner[k] = f"{{{name}}}" if name else "*"
            names += [name] * bool(name)
    pieces = [piece for pair in zip(texts, [*inner, ""], strict=True) for piece in pair]
    pattern = FilePattern("".join(pieces)) if names else None
    return pattern if pattern and len(pattern.points()[0]) == len(paths) else None


def _quantity(before: str, after: str, *, taken: Sequence[str]) -> str:
    """A name for the quantity of a number between two texts; "" for a number that is a label."""
    name = before.rpartition("/")[2].rstrip()
    ahead = re.search(rf"({_LETTERS})([-_= (]*)$", name)
    words = [*([ahead[1]] if ahead else []), *re.findall(rf"^{_LETTERS}", after)]
    if name.endswith("#") or (ahead and not ahead[2] and ahead[1].lower() in LABELS):
        return ""
    if "=" not in name:  # `tek300V` says a voltage
        words = sorted(words, key=lambda word: word not in NAMED_UNITS)
    base = next((word for word in words if word.lower() not in LABELS), "")
    free = (f"{base}{k}" if k else base for k in range(len(taken) + 1))
    return next(name for name in free if name not in taken)


def read_runs(
    files: str | Path | Sequence[str | Path],
    *,
    parameters: Sequence[str] = (),
    states: Sequence[str] | None = None,
    inputs: Sequence[str] = (),
    zone: Zone | None = None,
    units: Mapping[str, str] | None = None,
    dt_s: float | None = None,
    plasma: bool = False,
) -> list[Trajectory]:
    """Read runs with their operating points, one from each file.

    The values that vary from run to run, such as a voltage, become the `parameters` of each
    trajectory.

    Parameters
    ----------
    files : str, Path or sequence of these
        A pattern such as "runs/V{V_D_V}_m{mdot_mg_s}.csv", whose placeholders are parameters and in
        which `m4p5` stands for 4.5; or a pattern without placeholders such as "runs/*.nc"; or a
        list of files.
    parameters : sequence of str, default ()
        Names of the parameters that each file states itself: as a column or variable that is
        constant, or as an attribute.
    states : sequence of str, optional
        Names of the states. None takes all variables that vary in a file, except the parameters,
        the inputs and counters.
    inputs : sequence of str, default ()
        Names of the inputs.
    zone : Zone, optional
        Part of the grid that is averaged over, if the files hold fields over z or r.
    units : mapping of str to str, optional
        Unit by variable or parameter where the file states none. A time without a unit is in s.
    dt_s, plasma : float, optional; bool, default False
        As for `open_field`, which opens the files.

    Returns
    -------
    list of Trajectory
        One trajectory per file, in the order of the files.

    Raises
    ------
    ValueError
        If a file is listed twice, a parameter is missing or not constant, a field has no zone, a
        state stays constant, or `open_field` refuses a file. The error names the file.

    Warns
    -----
    UserWarning
        If files are left out because a placeholder matches something that is not a number.

    Examples
    --------
    >>> runs = ep.read_runs("run*.nc", states=["n_i", "n_n"], zone=ep.Zone(z=(0.01, 0.02)))
    >>> [run.label for run in runs]
    ['run.nc']
    """
    for what, names in {"parameters": parameters, "states": states, "inputs": inputs}.items():
        check_list(what, names)
    units = units or {}
    points, others = points_of(files)
    if others:
        words = f"left out, for their names hold no number there: {', '.join(others)}"
        warnings.warn(words, stacklevel=2)
    opened, varied = [], dict[str, None]()
    for file, named in points.items():
        with file_named(Path(file)):
            found = inspect_file(file, plasma=plasma)
            aside = {*named, *parameters} - {*found.variables}
            given = {"time": "s"} if dt_s is None and "time" in found.no_unit else {}
            given |= {name: unit for name, unit in units.items() if name not in aside}
            field = open_field(file, units=given, dt_s=dt_s, plasma=plasma)
            point = {name: _in_si(name, xr.DataArray(named[name]), units) for name in named}
            asked = [name for name in parameters if name not in named]
            point |= parameters_in(found, asked, {**units, **given})
        used = {n for n, v in found.variables.items() if {n, v.name} & {*point, *inputs}}
        free = (n for n in found.varying if n not in used and "time" in field[n].dims)
        varied |= dict.fromkeys(name for name in free if not is_counter_name(name))
        opened.append((file, field, point))
    runs = []
    for file, field, point in opened:
        chosen = [name for name in varied if name in field] if states is None else states
        with file_named(Path(file)):
            run = _average(field, zone, chosen, inputs, file)
        values = {name: float(value) for name, value in point.items()}
        of_point = {name: value.attrs["units"] for name, value in point.items()}
        runs.append(replace(run, parameters=values, units={**run.units, **of_point}))
    return runs


def _average(
    field: xr.Dataset, zone: Zone | None, states: Sequence[str], inputs: Sequence[str], file: str
) -> Trajectory:
    """The run of a file. Raises ValueError for a field without a zone, and for a steady one."""
    axes = {axis for n in (*states, *inputs) if n in field for axis in field[n].dims}
    if zone is None and (space := sorted(map(str, axes - {"time"}))):
        raise ValueError(
            f"a field over {' and '.join(space)} needs a zone to be averaged over: give "
            "zone=ep.Zone(z=(FROM, TO)) in m, or ep.Zone() for all of it"
        )
    try:
        return zone_average(field, zone, states=states, inputs=inputs, label=file)
    except ConstantStateError as error:
        raise ConstantStateError(
            f"{file}: {error}; a steady point is no run: leave the file out, or take +exp=predict, "
            "which counts it among the points"
        ) from error


def points_of(
    files: str | Path | Sequence[str | Path],
) -> tuple[Mapping[str, Mapping[str, float]], Sequence[str]]:
    """The files, each with the parameters that its name says; and those that nearly fit a pattern.

    Raises ValueError if no file fits, or one is listed twice.
    """
    if isinstance(files, str | Path) and "{" in str(files):
        return FilePattern(str(files)).points()
    listed = files_of(files)
    places = Counter(Path(file).resolve() for file in listed)
    if twice := [str(place) for place, n in places.items() if n > 1]:
        raise ValueError(f"every file may come once: {twice[0]} comes again; leave one out")
    return {file: {} for file in listed}, []


def parameters_in(
    found: Inspection, names: Sequence[str], units: Mapping[str, str]
) -> dict[str, xr.DataArray]:
    """Parameters that a file states, in SI: as attributes, scalars or columns that are constant.

    units: by name, where the file states none. The last part of a path, `set/Ud`, is a name, too.
    Raises ValueError for a parameter that the file lacks, and for one that varies.
    """
    held, point = _held_in(found), {}
    for name in names:
        places = [v.name for n, v in found.variables.items() if n == name]
        places += [name, *(n for n in held if last_of(n) == name)]
        one = next((held[place] for place in places if place in held), None)
        if one is None:
            constant = [each.name for each in held.values() if each.low == each.high]
            raise ValueError(
                "a parameter must be an attribute, a scalar or a constant column of each file: "
                f"{name!r} is none of its {constant}"
            )
        if one.low < one.high:
            raise ValueError(
                f"a parameter must be constant: {name!r} runs from {one.low:g} to {one.high:g}; "
                "take it as an input, or leave it out"
            )
        point[name] = _in_si(name, xr.DataArray(one.low, attrs={"units": one.unit}), units)
    return point


def parameters_stated(files: Sequence[Inspection]) -> list[str]:
    """Names of what every one of several files states as constant, and not all alike."""
    points = [
        {last_of(name): one.low for name, one in _held_in(each).items() if one.low == one.high}
        for each in files
    ]
    shared = [name for name in points[0] if all(name in point for point in points)]
    differ = [name for name in shared if len({point[name] for point in points}) > 1]
    return [name for name in differ if name.isidentifier() and not is_counter_name(name)]


def _held_in(found: Inspection) -> dict[str, ArrayInfo]:
    """What a file holds of numbers, attributes among them."""
    attributes = found.source.attributes.items()
    numbers = {n: float(v) for n, v in attributes if not isinstance(v, str)}
    held = {one.name: one for one in found.held if one.low <= one.high}
    return held | {n: ArrayInfo(n, low=v, high=v) for n, v in numbers.items()}


def points_on_axes(
    path: str | Path, names: Sequence[str], units: Mapping[str, str]
) -> list[list[dict[str, float]]]:
    """Every combination of the values of some axes of a file: as the file says them, and in SI.

    Raises ValueError for a name that is no vector of the file.
    """
    source = open_record(path)
    own = {name: source.axis(name) for name in names}
    in_si = {name: _in_si(name, points, units) for name, points in own.items()}
    return [
        [{n: float(v[at[n]]) for n, v in axes.items()} for axes in (own, in_si)]
        for ks in product(*(range(points.size) for points in own.values()))
        for at in [dict(zip(names, ks, strict=True))]
    ]


def _in_si(name: str, value: xr.DataArray, units: Mapping[str, str]) -> xr.DataArray:
    """Values in SI, or in the unit of their name's suffix, by the unit given or the file's."""
    unit = units.get(name) or own_unit(name, str(value.attrs.get("units", "")))
    return to_si(value, name, unit, is_variable=True)
