"""Inspection of a file: its arrays, the quantities recognised in them, and what is missing."""

from __future__ import annotations

import html
import re
import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import isclose
from pathlib import Path

from ep2sindy.data.arrays import ArrayInfo
from ep2sindy.data.conversion import KNOWN_UNITS
from ep2sindy.data.mapping import Variable
from ep2sindy.data.quantities import MADE_FROM, is_counter_name
from ep2sindy.data.readers.registry import reader_of
from ep2sindy.data.readers.source import FileSource
from ep2sindy.data.recognition import Recognised, recognise
from ep2sindy.data.steps import files_of, open_record
from ep2sindy.runtime.screen import WIDTH, html_table, in_line, one_screen, text_table

N_ROWS, N_NOTES = 60, 20  # largest numbers of arrays and notes that are listed

HEADER = ["", "shape", "unit", "from", "to", "missing", "taken as"]


@dataclass(frozen=True, eq=False)
class Inspection:
    """Result of inspecting a file, with the mapping by which `open_field` opens it.

    kind: kind of file. source: its arrays, and notes on how it was read. found: the recognised
    mapping.
    """

    kind: str
    source: FileSource
    found: Recognised

    @property
    def path(self) -> Path:
        """The file; of several that are joined, their pattern."""
        return self.source.path

    @property
    def words(self) -> str:
        """Notes on how the file was read."""
        return self.source.words

    @property
    def channel_m(self) -> float | None:
        """Length of the channel in m, if the file gives one."""
        return self.source.channel_m

    @property
    def is_certain(self) -> bool:
        """True if `open_field` opens the file without a mapping."""
        return not self.found.doubts

    @property
    def variables(self) -> dict[str, Variable]:
        """Mapping of the recognised variables."""
        return dict(self.found.variables)

    @property
    def time(self) -> Variable | None:
        return self.found.axes.get("time")

    @property
    def z(self) -> Variable | None:
        return self.found.axes.get("z")

    @property
    def r(self) -> Variable | None:
        return self.found.axes.get("r")

    @property
    def dt_s(self) -> float | None:
        """Time step in s that the file gives outside its time array, or None."""
        return self.found.dt_s

    @property
    def prepare(self) -> dict[str, str]:
        """Variables that the file lacks but a step of `prepare` can compute: name -> step."""
        have = self._quantities
        return {
            name: step
            for name, (source, step) in MADE_FROM.items()
            if source in have and name not in have
        }

    @property
    def _quantities(self) -> set[str]:
        """Variables that are what their names say: `n_i` without a unit is a name like others."""
        return {n for n, v in self.variables.items() if n not in KNOWN_UNITS or v.unit != "1"}

    def lacking(self, needed: Iterable[str]) -> tuple[str, ...]:
        """Names in `needed` that the file lacks and that no step of `prepare` can compute."""
        have = {*self._quantities, *self.prepare}
        return tuple(name for name in needed if name not in have)

    @property
    def signals(self) -> list[str]:
        """Variables that vary, count nothing, and do not increase throughout as coordinates do."""
        held = {each.name: each for each in self.found.held}
        arrays = {n: held[self._array_of(v)] for n, v in self.variables.items()}
        return [n for n, one in arrays.items() if _is_signal(one)]

    def _array_of(self, variable: Variable) -> str:
        """Name of the array in the file that a variable is, or is a part of."""
        name = str(variable.name)
        whole = any(each.name == name for each in self.found.held)
        return name if whole else name.rpartition("[")[0]

    def is_trace(self, variable: Variable) -> bool:
        """True if a variable depends on time alone, and is one of the signals."""
        name = self._array_of(variable)
        one = next(each for each in self.found.held if each.name == name)
        n_axes = 1 + len(re.findall(r"\d+", str(variable.name)[len(one.name) :]))
        of_time = len(one.lengths) == n_axes and self.found.n_samples in one.lengths
        return of_time and _is_signal(one)

    def notes(self) -> list[str]:
        """Messages about what is asked, other open decisions, and missing information."""
        texts = [*self.found.asked]
        if self.dt_s is not None:
            how = "is the number of a step times" if self.source.steps else "in steps of"
            texts.append(f"time {how} {self.dt_s:.6g} s, as the file says beside its arrays")
        texts += self.found.questions
        texts += [
            f"{n} is made by {step} from {MADE_FROM[n][0]}" for n, step in self.prepare.items()
        ]
        if self.z is not None and self.channel_m is None:
            texts.append(
                "no length of the channel: give it, data.channel_m=LENGTH in m, or a zone, "
                "'trajectory.zone.z=[FROM,TO]' in m, for experiments that average over one"
            )
        return texts

    def lines(self, more_notes: Sequence[str] = ()) -> list[str]:
        """Summary of the file, its arrays and the notes on them, in lines of a screen's width."""
        words = f"; {self.words}" if self.words else ""
        own, rows = self.notes(), self._rows()
        hidden = [f"... {len(own) - N_NOTES} more notes"] * (len(own) > N_NOTES)
        texts = map(in_line, (*own[:N_NOTES], *hidden, *more_notes))
        notes = [
            line
            for text in texts
            for line in textwrap.wrap(text, WIDTH, initial_indent="- ", subsequent_indent="  ",
                                      break_long_words=False, break_on_hyphens=False)
        ]  # fmt: skip
        head = f"{self.path}: {self.kind}{words}"
        table = text_table(HEADER, rows[:N_ROWS])
        more = [f"... {len(rows) - N_ROWS} more arrays"] * (len(rows) > N_ROWS)
        return [in_line(head), *table, *more, *notes]

    def differences(self, first: Inspection) -> list[str]:
        """In what this file differs from another of its kind: all but ranges and samples."""
        own, other = ({e.name: e for e in file.found.held} for file in (self, first))
        lacks, more = [n for n in other if n not in own], [n for n in own if n not in other]
        each = [self._difference(one, first, other[n]) for n, one in own.items() if n in other]
        texts = [
            self.kind if self.kind != first.kind else "",
            self.words if self.words != first.words else "",
            f"without {', '.join(lacks)}" if lacks else "",
            f"also {', '.join(more)}" if more else "",
            f"steps of {self.dt_s:.6g} s" if self.dt_s and self.dt_s != first.dt_s else "",
            *each,
            *(text for text in self.found.questions if text not in first.found.questions),
        ]
        return [text for text in texts if text]

    def _difference(self, one: ArrayInfo, first: Inspection, other: ArrayInfo) -> str:
        """In what an array differs from that of its name in another file; "" for nothing."""
        if one.problem or other.problem:
            return f"{one.name}: {one.problem or 'numbers'}" * (one.problem != other.problem)
        unit, role = one.unit or "no unit", self._role(one)
        words = [
            f"shape {one.shape}" * (self._axes_of(one) != first._axes_of(other)),
            unit * (one.unit != other.unit),
            f"taken as {role}" * (role != first._role(other)),
            f"{one.n_missing} missing" * (one.n_missing != other.n_missing),
        ]
        if one.step and other.step and not isclose(one.step, other.step, rel_tol=1e-2):
            words.append(f"{one.step:.4g} apart")
        text = ", ".join(word for word in words if word)
        return f"{one.name}: {text}" if text else ""

    def _axes_of(self, one: ArrayInfo) -> list[int | str]:
        return ["time" if n == self.found.n_samples else n for n in one.shape]

    def __repr__(self) -> str:
        return one_screen(self.lines(), n_lines=60)

    def _repr_html_(self) -> str:
        rows = [list(map(html.escape, row)) for row in self._rows()]
        items = "".join(f"<li>{html.escape(text)}</li>" for text in self.notes())
        head = html.escape(f"{self.path}: {self.kind}")
        return f"<div>{head}</div>{html_table(HEADER, rows)}<ul>{items}</ul>"

    def _rows(self) -> list[list[str]]:
        return [self._row(each) for each in self.found.held]

    def _row(self, one: ArrayInfo) -> list[str]:
        shape = f"({', '.join(map(str, one.shape))})"
        if one.problem:
            return [one.name, "", "", "", "", "", one.problem]
        step = "" if one.step is None else f", {'' if one.even else 'about '}{one.step:.4g} apart"
        missing = str(one.n_missing) if one.n_missing else ""
        return [one.name, shape, one.unit, f"{one.low:.4g}", f"{one.high:.4g}", missing,
                self._role(one) + step]  # fmt: skip

    def _role(self, one: ArrayInfo) -> str:
        return ", ".join(self._roles.get(one.name, [])) or "-"

    @cached_property
    def _roles(self) -> dict[str, list[str]]:
        """Our names and units for the arrays of the file and their parts: file name -> texts."""
        roles: dict[str, list[str]] = {}
        for ours, variable in {**self.found.axes, **self.found.variables}.items():
            name = str(variable.name)
            is_open = ours in self.found.no_unit
            text = f"{ours}, in what unit?" if is_open else f"{ours} in {variable.unit}"
            for each in {name, name.partition("[")[0]}:
                roles.setdefault(each, []).append(text)
        return roles


def _is_signal(one: ArrayInfo) -> bool:
    return one.step is None and one.low < one.high and not is_counter_name(one.name)


def inspect_file(path: str | Path | Sequence[str | Path], *, plasma: bool = False) -> Inspection:
    """List the arrays of a file and recognise quantities by names, units and shapes.

    path: a file, or a pattern or a list of the files of the steps of one run. plasma: names such as
    Te mean quantities where the file states no unit, too, and what has no unit is in SI.
    Reads every array once. The result prints as a table, followed by notes on what must be given
    and on missing information. `ep2sindy.open_field(path, variables=found.variables,
    time=found.time, z=found.z, r=found.r, dt_s=found.dt_s)` opens the recognised field.
    Raises ValueError for a file that is missing, empty, damaged or of an unknown kind.

    >>> found = ep.inspect_file("run.nc")
    >>> found.variables["n_i"].unit
    'm^-3'
    """
    source = open_record(path)
    found = recognise(source, plasma=plasma)
    kind = reader_of(Path(files_of(path)[0])).name
    return Inspection(kind, source, found)


def compare_files(first: Inspection, others: Sequence[Inspection]) -> list[str]:
    """Lines on the files after the first: one for each that differs, and one for all the rest."""
    differing = {each.path: texts for each in others if (texts := each.differences(first))}
    same = [each for each in others if each.path not in differing]
    lines = [in_line(f"{path}: {'; '.join(texts)}") for path, texts in differing.items()]
    if same:
        counts = sorted({each.found.n_samples or 0 for each in same})
        span = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
        which = f"the other {len(same)} files" if len(same) > 1 else str(same[0].path)
        lines.append(in_line(f"{which}: the same arrays{f'; {span} samples' * bool(counts[0])}"))
    return lines


def unlike(found: Sequence[Inspection]) -> str:
    """Why one mapping does not fit all files, which hold different names; "" if it does."""
    names = [{v.name for v in each.variables.values()} for each in found]
    for each, held in zip(found, names, strict=True):
        if held != names[0]:
            return (
                f"files of one mapping must hold the same names: {each.path} differs from "
                f"{found[0].path} in {sorted(map(str, held ^ names[0]))}; give each its own"
            )
    return ""
