"""Inspection of a file: its arrays, the quantities recognised in them, and what is missing."""

from __future__ import annotations

import html
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from shlex import quote

from ep2sindy.data.fields import channel_length_m
from ep2sindy.data.mapping import TEXT, ArrayInfo, Variable
from ep2sindy.data.quantities import KNOWN_UNITS, MADE_FROM, is_counter_name
from ep2sindy.data.readers.source import FileSource
from ep2sindy.runtime.screen import WIDTH, html_table, in_line, one_screen, text_table

N_ROWS, N_NOTES = 60, 20  # largest numbers of arrays and notes that are listed

STEP = "data.dt_s=STEP"  # what the user is asked for if there are no times

HEADER = ["", "shape", "unit", "from", "to", "missing", "taken as"]


@dataclass(frozen=True, eq=False)
class Inspection:
    """Result of inspecting a file: a mapping by which `open_field` opens it, and what is open.

    source: its arrays, and notes on how it was read. held: summaries of all its arrays. variables,
    axes: our name -> location in the file. dt_s: time step in s if the file gives it outside its
    time array. no_time: the question for the time if there is none. no_unit: our name of a quantity
    that the file gives without a unit -> the question for it. questions: messages about other open
    decisions. n_samples: number of samples in time, None if it cannot be determined. replaced: the
    file's times that dt_s stands for, in each unit that they may be in.
    """

    source: FileSource
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
        return [*filter(None, [self.no_time]), *self.no_unit.values()]

    def checked(self) -> Inspection:
        """This mapping, if it gives a field without any doubt; else raises ValueError."""
        none = [] if self.variables else ["no array of the file fits its axes"]
        if doubts := [*self.asked, *none]:
            raise ValueError(
                f"{self.source.path} cannot be opened without a mapping: "
                f"{'; '.join([*doubts, *self.questions])}; `ep2sindy inspect "
                f"{quote(str(self.source.path))} --write` (in Python ep2sindy.inspect_file) shows "
                "what it holds and writes a mapping"
            )
        return self

    @property
    def time(self) -> Variable | None:
        return self.axes.get("time")

    @property
    def z(self) -> Variable | None:
        return self.axes.get("z")

    @property
    def r(self) -> Variable | None:
        return self.axes.get("r")

    @cached_property
    def _quantities(self) -> set[str]:
        """Variables that are what their names say: `n_i` without a unit is a name like others."""
        found = self.variables.items()
        return {name for name, v in found if name not in KNOWN_UNITS or v.unit != "1"}

    @cached_property
    def prepare(self) -> dict[str, str]:
        """Variables that the file lacks but a step of `prepare` can compute: name -> step."""
        have = self._quantities
        return {
            name: step
            for name, (source, step) in MADE_FROM.items()
            if source in have and name not in have
        }

    def lacking(self, needed: Iterable[str]) -> tuple[str, ...]:
        """Names in `needed` that the file lacks and that no step of `prepare` can compute."""
        have = {*self._quantities, *self.prepare}
        return tuple(name for name in needed if name not in have)

    @cached_property
    def _arrays(self) -> dict[str, ArrayInfo]:
        """The array of the file that each variable is, or is a part of."""
        held = {each.name: each for each in self.held}
        names = {ours: str(variable.name) for ours, variable in self.variables.items()}
        return {n: held.get(name) or held[name.rpartition("[")[0]] for n, name in names.items()}

    @cached_property
    def signals(self) -> list[str]:
        """Variables that vary, count nothing, and do not increase throughout as coordinates do."""
        return [
            name
            for name, one in self._arrays.items()
            if one.step is None and name in self.varying and not is_counter_name(one.name)
        ]

    @cached_property
    def varying(self) -> list[str]:
        """Variables that do not stay at one value."""
        return [name for name, one in self._arrays.items() if one.low < one.high]

    @property
    def traces(self) -> list[str]:
        """The signals that depend on time alone: vectors of its length, and columns of arrays."""
        vectors = [n for n, one in self._arrays.items() if one.lengths == (self.n_samples,)]
        parts = [n for n, one in self._arrays.items() if self.variables[n].name != one.name]
        return [name for name in self.signals if name in {*vectors, *parts}]

    def notes(self) -> list[str]:
        """Messages about what is asked, other open decisions, and missing information."""
        texts = [*self.asked]
        if self.dt_s is not None:
            how = "is the number of a step times" if self.source.steps else "in steps of"
            texts.append(f"time {how} {self.dt_s:.6g} s, as the file says next to its arrays")
        texts += self.questions
        texts += [
            f"{n} is made by {step} from {MADE_FROM[n][0]}" for n, step in self.prepare.items()
        ]
        if "z" in self.axes and channel_length_m(self.source.attributes) is None:
            texts.append(
                "no length of the channel: give it, data.channel_m=LENGTH in m, or a zone, "
                "'trajectory.zone.z=[FROM,TO]' in m, for experiments that average over one"
            )
        return texts

    def lines(self, more_notes: Sequence[str] = ()) -> list[str]:
        """Summary of the file, its arrays and the notes on them, in lines of a screen's width."""
        words = f"; {self.source.words}" if self.source.words else ""
        own = _first(self.notes(), N_NOTES, "notes")
        wrapped = textwrap.TextWrapper(
            WIDTH, initial_indent="- ", subsequent_indent="  ", break_long_words=False,
            break_on_hyphens=False,
        )  # fmt: skip
        head = f"{self.source.path}: {self.source.kind}{words}"
        table = text_table(HEADER, self._rows)
        notes = [line for text in (*own, *more_notes) for line in wrapped.wrap(in_line(text))]
        return [in_line(head), table[0], *_first(table[1:], N_ROWS, "arrays"), *notes]

    def differences(self, first: Inspection) -> list[str]:
        """In what this file differs from another of its kind: all but ranges and samples."""
        own, other = self._kept_alike(), first._kept_alike()
        differing = [name for name in {**other, **own} if own.get(name) != other.get(name)]
        return [
            *(f"{name}: {', '.join(own.get(name, ['absent']))}" for name in differing),
            *(text for text in self.questions if text not in first.questions),
        ]

    def _kept_alike(self) -> dict[str, list[str]]:
        """What files of a kind have in common: how they are read, and each array but its range."""
        found = {"read as": [self.source.kind, self.source.words]}
        for one in self.held:
            found[one.name] = [
                one.problem or "numbers",
                f"shape {['time' if n == self.n_samples else n for n in one.shape]}",
                one.unit or "no unit",
                f"taken as {', '.join(self._roles.get(one.name, ['-']))}",
                f"{one.n_missing} missing",
                *([f"{one.step:.3g} apart"] if one.step else []),
            ]
        return found

    def __repr__(self) -> str:
        return one_screen(self.lines(), n_lines=60)

    def _repr_html_(self) -> str:
        rows = [list(map(html.escape, row)) for row in self._rows]
        items = "".join(f"<li>{html.escape(text)}</li>" for text in self.notes())
        head = html.escape(f"{self.source.path}: {self.source.kind}")
        return f"<div>{head}</div>{html_table(HEADER, rows)}<ul>{items}</ul>"

    @cached_property
    def _rows(self) -> list[list[str]]:
        rows = []
        for one in self.held:
            about = "" if one.even else "about "
            step = f", {about}{one.step:.4g} apart" if one.step else ""
            role = ", ".join(self._roles.get(one.name, ["-"])) + step
            span = [f"{one.low:.4g}", f"{one.high:.4g}", str(one.n_missing or "")]
            cells = [f"({', '.join(map(str, one.shape))})", one.unit, *span, role]
            unused = [*[""] * 5, TEXT if one.problem == TEXT else "left out"]
            rows.append([one.name, *(unused if one.problem else cells)])
        return rows

    @cached_property
    def _roles(self) -> dict[str, list[str]]:
        """Our names and units for the arrays of the file and their parts: file name -> texts."""
        roles: dict[str, list[str]] = {}
        for ours, variable in {**self.axes, **self.variables}.items():
            name = str(variable.name)
            is_open = ours in self.no_unit
            text = f"{ours}, in what unit?" if is_open else f"{ours} in {variable.unit}"
            for each in {name, name.partition("[")[0]}:
                roles.setdefault(each, []).append(text)
        return roles


def _first(lines: Sequence[str], n: int, what: str) -> list[str]:
    """The first lines of many, and how many more there are."""
    more = [f"... {len(lines) - n} more {what}"] if len(lines) > n else []
    return [*lines[:n], *more]


def compare_files(first: Inspection, others: Sequence[Inspection]) -> list[str]:
    """Lines on the files after the first: one for each that differs, and one for all the rest."""
    differing = {each.source.path: texts for each in others if (texts := each.differences(first))}
    same = [each for each in others if each.source.path not in differing]
    lines = [f"{path}: {'; '.join(texts)}" for path, texts in differing.items()]
    if same:
        counts = sorted({each.n_samples or 0 for each in same})
        span = " to ".join(map(str, dict.fromkeys((counts[0], counts[-1]))))
        which = f"the other {len(same)} files" if len(same) > 1 else str(same[0].source.path)
        lines.append(f"{which}: the same arrays{f'; {span} samples' * bool(counts[0])}")
    return [in_line(line) for line in lines]


def unlike(found: Sequence[Inspection]) -> str:
    """Why one mapping does not fit all files, which hold different names; "" if it does."""
    names = [{v.name for v in each.variables.values()} for each in found]
    for each, held in zip(found, names, strict=True):
        if held != names[0]:
            return (
                f"files of one mapping must hold the same names: {each.source.path} differs from "
                f"{found[0].source.path} in {sorted(map(str, held ^ names[0]))}; give each its own"
            )
    return ""
