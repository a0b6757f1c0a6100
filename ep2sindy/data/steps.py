"""Runs that a code wrote step by step, in a group or a file for each, joined along time.

A record is a file with all its samples, or the files of the steps of one run.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from glob import glob
from pathlib import Path

import numpy as np
import xarray as xr

from ep2sindy.data.quantities import axis_of, step_given_by
from ep2sindy.data.readers.registry import open_source
from ep2sindy.data.readers.source import FileSource, damage_named

# Words before the number of a step in the name of a group; "": the number alone.
STEP_WORDS = frozenset({
    "", "step", "timestep", "iteration", "iter", "it", "cycle", "dump", "frame", "snapshot", "snap",
    "time", "t",
})  # fmt: skip
NUMBERED = re.compile(r"(?P<word>[A-Za-z]*)[\s_#=-]*(?P<number>\d+)")
NUMBER = re.compile(r"(\d+)")
LEAST_UNNAMED = 3  # numbers without such a word; two may be kinds of particles

Place = tuple[FileSource, str]
Places = Mapping[str, Place]


def open_record(path: str | Path | Sequence[str | Path]) -> FileSource:
    """Open a file, or the files of the steps of one run: a pattern, or a list of them.

    Raises ValueError for several files that are records of their own.
    """
    files = files_of(path)
    if len(files) == 1:
        return join_groups(open_source(Path(files[0])))
    if not are_steps(files):
        raise ValueError(
            f"one record must come: {path} names {len(files)} files that are records of their own, "
            f"from {files[0]} on; open each by itself. Files of the steps of one run have one name "
            "but for a number, and a single time each"
        )
    return join_files(files)


def records_of(path: object) -> list[str | list[str]]:
    """One entry for every record that a path, a pattern or a list names; see `open_record`.

    Raises ValueError as `files_of` does.
    """
    files = files_of(path)
    if not are_steps(files):
        return list(files)
    return [str(path) if isinstance(path, str | Path) else files]


def files_of(path: object) -> list[str]:
    """Expand a path, a pattern such as `runs/*.csv`, or a list of either, to a list of files.

    Raises ValueError for a pattern that matches no file, and for any other value.
    """
    if isinstance(path, list | tuple) and path:
        return [file for each in path for file in files_of(each)]
    if not isinstance(path, str | Path):
        raise ValueError(f"a path must be a file, a pattern or a list of them, got {path!r}")
    if not any(sign in str(path) for sign in "*?[") or Path(path).exists():
        return [str(path)]
    found = sorted(glob(str(path), recursive=True))
    if not found:
        raise ValueError(f"no file fits the pattern {str(path)!r} in {Path.cwd()}")
    return found


# Groups of one file.


def join_groups(source: FileSource) -> FileSource:
    """Join the groups of steps of a file along time; a file without such groups stays as it is."""
    if source.is_table:
        return source
    arrays, words = step_groups(source.names)
    numbers = _usual_numbers(arrays)
    inside = {name for places in arrays.values() for name in places.values()}
    shared = {name: (source, name) for name in source.names if name not in inside}
    firsts = [places[min(places)] for places in arrays.values()]
    times = [name for name in (*shared, *firsts) if axis_of(name) == "time"]
    if len(numbers) < (2 if words - {""} else LEAST_UNNAMED):
        return source
    with damage_named(source.path):
        if any(source.read(name).size > 1 for name in times):  # the groups are no steps then
            return source
    steps = {
        number: {n: (source, places[number]) for n, places in arrays.items() if number in places}
        for number in numbers
    }
    return _joined(source, steps, shared, "groups")


def step_groups(names: Sequence[str]) -> tuple[dict[str, dict[int, str]], set[str]]:
    """Find the arrays of numbered groups: `data/100/n_i` is `data/n_i` at step 100.

    Returns joined name -> number of the step -> name in the file, and the words before the numbers.
    """
    arrays: dict[str, dict[int, str]] = defaultdict(dict)
    words = set()
    for name in names:
        parts = name.split("/")
        for k, part in enumerate(parts):
            found = NUMBERED.fullmatch(part) if len(parts) > 1 else None
            if found and found["word"].lower() in STEP_WORDS:
                joined = "/".join([*parts[:k], *parts[k + 1 :]])
                arrays[joined][int(found["number"])] = name
                words.add(found["word"].lower())
                break
    return dict(arrays), words


def _usual_numbers(arrays: Mapping[str, Mapping[int, str]]) -> tuple[int, ...]:
    """Numbers of the steps: those that most arrays have."""
    counts = Counter(tuple(sorted(places)) for places in arrays.values())
    return counts.most_common(1)[0][0] if counts else ()


# Files of one run.


def are_steps(files: Sequence[str]) -> bool:
    """True if files are steps of one run: named alike but for one number, one time in each.

    A file without times is a step if its arrays have no axis besides those of z and r.
    """
    if len(files) < 2 or len(_numbers(files)) < len(files):
        return False
    source = open_source(Path(files[0]))
    groups, _ = step_groups(source.names)
    if source.is_table or source.step_s is not None or len(_usual_numbers(groups)) > 1:
        return False
    with damage_named(source.path):
        arrays = {name: source.read(name) for name in source.names}
    axes = {name: axis_of(name) for name in arrays}
    times = [array for name, array in arrays.items() if axes[name] == "time"]
    if times:
        return all(array.size == 1 for array in times)
    grid = {n for name, array in arrays.items() if axes[name] in ("z", "r") for n in array.shape}
    lengths = {n for array in arrays.values() for n in array.shape if n > 1}
    return bool(grid) and lengths <= grid


def _numbers(files: Sequence[str]) -> dict[int, str]:
    """Number of the step -> file, if the names of the files differ in one number alone."""
    parts = [NUMBER.split(Path(file).name) for file in files]
    if len({len(each) for each in parts}) != 1:
        return {}
    differing = [column for column in zip(*parts, strict=True) if len(set(column)) > 1]
    if len(differing) != 1 or not all(map(str.isdecimal, differing[0])):
        return {}
    return dict(sorted((int(n), file) for n, file in zip(differing[0], files, strict=True)))


def join_files(files: Sequence[str]) -> FileSource:
    """Join the files of the steps of one run along time; its path has a `*` for their number."""
    sources = {number: open_source(Path(file)) for number, file in _numbers(files).items()}
    steps = {}
    for number, source in sources.items():
        groups, _ = step_groups(source.names)
        inside = {place: name for name, places in groups.items() for place in places.values()}
        steps[number] = {inside.get(name, name): (source, name) for name in source.names}
    first, *_, last = sources.values()
    parts = zip(*(NUMBER.split(source.path.name) for source in (first, last)), strict=True)
    name = "".join(one if one == other else "*" for one, other in parts)
    return _joined(replace(first, path=first.path.with_name(name)), steps, {}, "files")


# Both.


def _joined(
    first: FileSource, steps: Mapping[int, Places], shared: Places, kind: str
) -> FileSource:
    """Source of arrays joined over steps. first: gives all else. shared: arrays next to the steps.

    Each array is read once, for it may take thousands of files.
    Arrays that some steps lack, and lists of particles, whose lengths change, are left out.
    """
    numbers = sorted(steps)
    everywhere = [n for n in steps[numbers[0]] if all(n in step for step in steps.values())]
    shapes = [{n: source.read(inside).shape for n, (source, inside) in steps[k].items()
               if n in everywhere} for k in (numbers[0], numbers[-1])]  # fmt: skip
    kept = [name for name in everywhere if shapes[0][name] == shapes[1][name]]
    left = sorted({name for step in steps.values() for name in step} - set(kept))
    places = {name if name not in shared else f"step/{name}": name for name in kept}

    def read(name: str) -> xr.DataArray:
        if name in shared:
            source, inside = shared[name]
            return source.read(inside)
        return _stack([steps[k][places[name]] for k in numbers], name, numbers, first.dims_named)

    words = f"{len(numbers)} {kind} joined along time, steps {numbers[0]} to {numbers[-1]}"
    words += f"; left out, not in every step or of changing size: {', '.join(left)}" * bool(left)
    return replace(
        first, names=[*places, *shared], read=cache(read), aliases=(), words=words,
        steps=tuple(numbers),
    )  # fmt: skip


def _stack(places: Sequence[Place], name: str, numbers: Sequence[int], named: bool) -> xr.DataArray:
    """The arrays of all steps as one; what is the same in all of them, as a grid, stands once."""
    arrays = [source.read(inside).squeeze() for source, inside in places]
    first = arrays[0]
    for number, array in zip(numbers, arrays, strict=True):
        if array.shape != first.shape:
            raise ValueError(
                f"{name!r} must have one shape in all steps: {first.shape} at step {numbers[0]}, "
                f"{array.shape} at step {number}; leave out the files or groups that differ"
            )
    values = np.stack([array.values for array in arrays])
    is_step = not first.ndim and step_given_by(name, float(values[0])) is not None
    if (first.ndim or is_step) and (values == values[0]).all():
        return first
    dims = ["steps", *map(str, first.dims)] if named else None
    return xr.DataArray(values, dims=dims, attrs=first.attrs)
