"""`ep2sindy inspect PATH ...`: contents of files, and a config of the data group for them."""

from __future__ import annotations

import argparse
import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from ep2sindy.app.config_files import conf_folder
from ep2sindy.data.fields import SPACE, channel_length_m
from ep2sindy.data.inspection import STEP, Inspection, compare_files, unlike
from ep2sindy.data.mapping import Variable, read_array
from ep2sindy.data.open import inspect_file
from ep2sindy.data.quantities import COORDINATE_UNITS, converts, last_of
from ep2sindy.data.recognition import recognise
from ep2sindy.data.run_files import FilePattern, parameters_stated, propose_pattern
from ep2sindy.data.steps import records_of
from ep2sindy.data.trajectory import point_label
from ep2sindy.runtime.files import write_text
from ep2sindy.runtime.screen import in_line, say
from ep2sindy.signals.driving import propose_inputs

ABOUT = """Says what files hold: variables, shapes, units, ranges, what looks like time, z and r,
and what is missing for which experiment. Several files, or a pattern in quotes, are several
records of one kind; if their names differ in numbers, they may be operating points."""

# Variables that experiments on files need besides time; generic experiments need none.
DENSITIES, FLOWS = ("n_i", "n_n"), ("n_i", "n_n", "R_ion", "u_iz")
NEEDS: Mapping[str, tuple[str, ...]] = {
    **dict.fromkeys(("breathing", "weak", "ils", "zones"), DENSITIES),
    **dict.fromkeys(("constrained", "theories", "parametric", "pointwise"), FLOWS),
    **dict.fromkeys(("predict", "trace", "discover"), ()),
}

NOT_STATES = ("R_ion", "V_d")  # what drives a model
MOST_STATED = 3  # more numbers that differ from file to file describe results
# Columns and samples that are looked at for inputs: bounds of their number.
MAX_LOOKED_AT, MIN_LOOKED_AT, MAX_SAMPLES = 20, 50, 50_000


def main(arguments: Sequence[str]) -> None:
    """Inspect files and write a config for them.

    Raises ValueError as `ep2sindy.inspect_file` does, and for a config that exists already.
    """
    parser = argparse.ArgumentParser("ep2sindy inspect", description=ABOUT)
    parser.add_argument("path", nargs="+", help="file, folder.zarr or pattern")
    parser.add_argument(
        "--write", nargs="?", const="", metavar="NAME",
        help="write conf/data/NAME.yaml for data=NAME; by default the name of the first file",
    )  # fmt: skip
    parser.add_argument(
        "--plasma", action="store_true",
        help="names such as Te are quantities without a unit, too; what has no unit is in SI",
    )  # fmt: skip
    given = parser.parse_args(arguments)
    paths = records_of(given.path[0] if len(given.path) == 1 else given.path)
    found = [inspect_file(path, plasma=given.plasma) for path in paths]
    if axes := axes_of(found[0]):
        found = [recognise(each.source, given=axes, plasma=given.plasma) for each in found]
    drives = inputs_of(found[0])
    notes = [f"{name} looks set ({how}): an input, if it drives the rest" for name, how in drives]
    notes += [f"{v.name!r} is {n} if you say so, as the command does" for n, v in axes.items()]
    say("\n".join(found[0].lines([*experiments(found[0]), *notes])) + "\n")
    if len(found) > 1:
        say("\n".join(compare_files(found[0], found[1:])) + "\n")
    if pattern := propose_pattern([path for path in paths if isinstance(path, str)]):
        say("\n".join(point_lines(pattern)))
    points = point_settings(found, pattern, given.path)
    name = re.sub(r"\W+", "_", given.write or _word_for(found[0].source.path)).strip("_")
    differing, flat = unlike(found), ["+trajectory.axisymmetric=false"] * ("r" in axes)
    if differing and given.write is not None:
        raise ValueError(f"no mapping is written: {differing}")
    if differing:
        lines, end = [], differing
    elif given.write is None:
        path = _hydra(given.path)
        first, is_plasma = as_plasma(found[0], axes)
        more = [*settings_of(axes, plasma=given.plasma or is_plasma), *flat]
        found = [first, *found[1:]]
        lines = commands(found, "recognised", points, path=path, more=more, drives=drives)
        end = f"--write writes this to conf/data/{name}.yaml, for data={name}"
    else:
        file = own_config(name)
        write_text(file, config_text(found, paths))
        lines, end = commands(found, name, points, more=flat, drives=drives), f"written: {file}"
    header = ["next, for example:"] if lines else []
    say("\n".join([*header, *(f"  {line}" for line in lines), end]))


def point_lines(pattern: FilePattern) -> list[str]:
    """The operating points that the names of files tell, and their pattern."""
    points, _ = pattern.points()
    return [
        f"{len(points)} operating points, if the numbers in the names are such:",
        *(in_line(f"  {point_label(values)}: {file}") for file, values in points.items()),
        in_line(f"their pattern: points.files={pattern.text}, in Python ep.read_runs"),
        "a name in braces may be replaced by any name with its unit, as {V_D_V} for a voltage in V",
        "and {mdot_mg_s} for a flow in mg/s",
        "",
    ]


def point_settings(
    found: Sequence[Inspection], pattern: FilePattern | None, paths: Sequence[str]
) -> list[str]:
    """Settings of files that are operating points: by their names, or by what they state."""
    if pattern is not None:
        return [f"points.files={pattern.text}"]
    names = parameters_stated(found)
    if not 0 < len(names) <= MOST_STATED:
        return []
    stated = ",".join(f"{name}:null" for name in names)
    return [f"points.files={_hydra(paths)}", f"+parameters={{{stated}}}"]


def commands(
    found: Sequence[Inspection],
    group: str,
    points: Sequence[str] = (),
    *,
    path: str = "",
    more: Sequence[str] = (),
    drives: Sequence[tuple[str, str]] = (),
) -> list[str]:
    """Commands that can be run with the data; placeholders in capitals are for the user.

    group: name in the data group. points: settings of files that are operating points, which are
    studied as such where an experiment has all that it needs. path: for the group `recognised`,
    which names no file, and in which units are given too. more: settings. drives: see `inputs_of`.
    """
    first, inputs = found[0], [name for name, _ in drives]
    units = ",".join(f"{name}:UNIT" for name in first.no_unit if name not in SPACE)
    asked = [f"data.units={{{units}}}"] * bool(units and group == "recognised")
    data = [f"data={group}", *[STEP] * bool(first.no_time), *more, *asked]
    lines: list[list[str]] = []
    if points:
        lines = point_commands(first, [*data, *points], inputs)
    if not lines:
        data = [*data[:1], *([f"data.path={path}"] if path else []), *data[1:]]
        lines = record_commands(first, data, inputs, are_several=len(found) > 1)
    return [f"ep2sindy {' '.join(map(shlex.quote, line))}" for line in lines]


def point_commands(
    found: Inspection, data: Sequence[str], inputs: Sequence[str]
) -> list[list[str]]:
    """Commands that study the files as operating points: two densities, or else one signal."""
    lines = breathing_commands(found, data)
    if not found.lacking(NEEDS["parametric"]):
        lines.append(["+exp=parametric", *data, "thesis=null", *field_settings(found)])
    signals = signals_of(found, [*NOT_STATES, *inputs])
    states = signals[:1] if "I_d" in signals else signals or list(found.signals)
    if lines or not states:
        return lines
    anything = ["sustained=none"] * (len(states) > 1)  # no roles of densities
    return [["+exp=predict", *data, f"trajectory.states=[{','.join(states)}]", *anything]]


def signals_of(found: Inspection, inputs: Sequence[str]) -> list[str]:
    """Signals of time alone that are no inputs, the discharge current first."""
    return sorted((name for name in found.traces if name not in inputs), key="I_d".__ne__)


def axes_of(found: Inspection) -> dict[str, Variable]:
    """The axes next to time, at most two, that may be z and r: lengths, or x and y without unit."""
    lengths = {n for one in found.held if len(one.shape) > 1 for n in one.shape}
    alike = [
        Variable(one.name, one.unit)
        for one in found.held
        if one.step is not None
        and one.shape[0] in lengths - {found.n_samples}
        and (converts("z", one.unit) or (not one.unit and last_of(one.name) in ("x", "y")))
    ]
    is_free = found.z is None and found.r is None and len(alike) <= len(SPACE)
    return dict(zip(SPACE, alike, strict=False)) if is_free else {}


def as_plasma(found: Inspection, axes: Mapping[str, Variable]) -> tuple[Inspection, bool]:
    """The file with its names taken for a plasma's, if it then holds both densities, and whether.

    Units that the file does not state are asked for.
    """
    needed = NEEDS["breathing"]
    if not found.lacking(needed):
        return found, False
    plasma = recognise(found.source, given=axes, plasma=True)
    if plasma.lacking(needed):
        return found, False
    bare = {one.name for one in plasma.held if one.unit in ("", "1")}
    places = {**plasma.axes, **plasma.variables}.items()
    asked = {n: "" for n, v in places if v.name in bare and v.unit != "1"}
    return replace(plasma, no_unit=asked), True


def settings_of(axes: Mapping[str, Variable], *, plasma: bool) -> list[str]:
    """Settings of the group `recognised` for axes by hand, and for names of a plasma."""
    of_axes = [f"data.{n}={{name:{v.name},unit:{v.unit or 'UNIT'}}}" for n, v in axes.items()]
    return [*["data.plasma=true"] * plasma, *of_axes]


def inputs_of(found: Inspection) -> list[tuple[str, str]]:
    """Columns that look set by somebody, and how: proposals, of which the user decides."""
    names = found.traces
    if not 1 < len(names) <= MAX_LOOKED_AT or (found.n_samples or 0) < MIN_LOOKED_AT:
        return []
    places = {name: str(found.variables[name].name) for name in names}
    columns = {n: read_array(found.source, n, p).values for n, p in places.items()}
    columns = {n: values[:MAX_SAMPLES].astype(float) for n, values in columns.items()}
    t = np.arange(len(next(iter(columns.values()))), dtype=float)
    return [*propose_inputs(t, columns).items()]


def record_commands(
    found: Inspection, data: list[str], inputs: Sequence[str], *, are_several: bool
) -> list[list[str]]:
    """Commands that study one record, or several of one system. inputs: proposed ones."""
    given = [f"inputs=[{','.join(inputs)}]"] * bool(inputs)
    lines = breathing_commands(found, data)
    signals = signals_of(found, inputs)
    if signals and not are_several:
        lines.append(["+exp=trace", *data, f"signal={signals[0]}", *given])
    # One state alone cannot oscillate.
    for names in (found.traces, ["n_i", "n_n"], found.signals):
        states = [n for n in names if n in found.signals and n not in (*NOT_STATES, *inputs)]
        if len(states) > 1 or given:
            break
    if len(states) > 1 or given:
        lines.append(["+exp=discover", *data, f"trajectory.states=[{','.join(states)}]", *given])
    return lines


def breathing_commands(found: Inspection, data: Sequence[str]) -> list[list[str]]:
    """The command that studies two densities; none if the file lacks one."""
    line = ["+exp=breathing", *data, *field_settings(found)]
    return [] if found.lacking(NEEDS["breathing"]) else [line]


def field_settings(found: Inspection) -> list[str]:
    """Settings of the channel's length and of steps that make variables, as the file lacks them."""
    is_known = found.z is None or channel_length_m(found.source.attributes)
    steps = ",".join(f"{{_target_:{step}}}" for step in found.prepare.values())
    return [*["data.channel_m=LENGTH"] * (not is_known), *[f"prepare=[{steps}]"] * bool(steps)]


def _word_for(path: Path) -> str:
    """Name of a config for a file; for a pattern without a name of its own, that of its folder."""
    words = (
        re.sub(r"\W+", "_", text).strip("_") for text in (path.stem, path.absolute().parent.name)
    )
    return next(filter(None, words), "own")


def _hydra(paths: Sequence[str]) -> str:
    """One path as it is typed, or a list of several as Hydra reads it."""
    quoted = ("'" + path.replace("'", "\\'") + "'" for path in paths)
    return paths[0] if len(paths) == 1 else f"[{','.join(quoted)}]"


def experiments(found: Inspection) -> list[str]:
    """One line on the experiments that can be run, and one for each set of missing variables."""
    groups: dict[tuple[str, ...], list[str]] = {}
    for name, needed in NEEDS.items():
        lacking = found.lacking(needed) or (() if found.signals else ("a signal",))
        groups.setdefault(lacking, []).append(f"+exp={name}")
    ready = "all but what is asked is there" if found.asked else "all there"
    return [
        f"{'missing ' + ', '.join(lacking) if lacking else ready} for {', '.join(names)}"
        for lacking, names in groups.items()
    ]


def own_config(name: str) -> Path:
    """Path for a new config of the data group that is found from here; no file is overwritten."""
    conf, path = conf_folder(), Path("conf") / "data" / f"{name}.yaml"
    if (conf / "data" / path.name).is_file() and conf.resolve() != Path("conf").resolve():
        raise ValueError(f"the package has data={name} itself: choose another, --write NAME")
    if path.exists():
        raise ValueError(f"{path} is there already: delete it, or choose another, --write NAME")
    return path


def config_text(found: Sequence[Inspection], paths: Sequence[str | list[str]]) -> str:
    """The config of the data group; its first lines name the units that the file does not name."""
    first = found[0]
    axes = {
        name: first.axes.get(name, Variable(None, unit)) for name, unit in COORDINATE_UNITS.items()
    }
    content = {
        "_target_": "ep2sindy.open_field",
        "path": _literal(paths[0] if len(paths) == 1 else [*paths]),
        "variables": {name: _entry(variable) for name, variable in first.variables.items()},
        **{name: _entry(variable) for name, variable in axes.items()},
        "dt_s": first.dt_s,
        "channel_m": None,
    }
    path = in_line(str(first.source.path)) + " ..." * (len(paths) > 1)
    lines = [
        f"# {path}, as `ep2sindy inspect` found it; correct it if needed.",
        "# A name is the one in the file; null: the file has it not. dt_s: step in s, instead of",
        "# time. channel_m: length of the channel from z = 0 in m; null: as the file says.",
    ]
    if first.no_unit:
        names = ", ".join(map(in_line, first.no_unit))
        lines.append(f"# The file names no unit for {names}: put these right.")
    return "\n".join([*lines, OmegaConf.to_yaml(OmegaConf.create(content))])


def _entry(variable: Variable) -> dict[str, Any]:
    dims = {"dims": list(variable.dims)} if variable.dims else {}
    return {"name": _literal(variable.name), "unit": _literal(variable.unit), **dims}


def _literal(value: Any) -> Any:
    """Text, or lists of it, in which `${` interpolates nothing."""
    if isinstance(value, list):
        return [_literal(each) for each in value]
    return value and re.sub(r"(\\*)\$\{", r"\1\1\\${", value)
