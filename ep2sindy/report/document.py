"""Sections of a report, written once and shown both in the terminal and on the page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import pandas as pd

from ep2sindy.library.equations import Sum, equation_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Text:
    """A paragraph. warning: it tells of a problem. page_only: too long for a terminal."""

    text: str
    warning: bool = False
    page_only: bool = False


@dataclass(frozen=True)
class Equation:
    """One equation: state -> terms, or their groups by process.

    rate: the terms make the time derivative of the state; if False, they make its value, as in a
    law. lead: text before it; mark: text after it. unit: of the left side, consistent with the
    terms; may be left out if they are in SI.
    Shown only on the page, unless on_screen. As a cell of a table it is always shown.
    """

    state: str
    terms: Sum
    lead: str = ""
    mark: str = ""
    unit: str = ""
    on_screen: bool = False
    rate: bool = True

    @property
    def text(self) -> str:
        """The equation as text, such as `thesis: n_i' = -2 n_i [m^-3 s^-1]`."""
        lead = f"{self.lead}: " if self.lead else ""
        unit = f" [{self.unit}]" if self.unit else ""
        text = equation_text(self.state, self.terms)
        text = text if self.rate else text.replace("'", "", 1)
        return f"{lead}{text}{unit}{self.mark}"

    def __str__(self) -> str:
        return self.text  # in CSV files


@dataclass(frozen=True, eq=False)
class Table:
    """A table for reading: numbers to three digits, NaN as a dash, an `Equation` written out.

    page_only: too long for a terminal.
    bold, italic: indices of rows in that style. breaks: indices of rows followed by a line.
    """

    rows: pd.DataFrame
    title: str = ""
    bold: Sequence[int] = ()
    italic: Sequence[int] = ()
    breaks: Sequence[int] = ()
    note: str = ""
    page_only: bool = False


@dataclass(frozen=True)
class Picture:
    """A figure of the outcome, by its name; shown only on the page."""

    name: str


@dataclass(frozen=True)
class Link:
    """A table cell that links to another page. to: a relative address."""

    text: str
    to: str


Block: TypeAlias = Text | Equation | Table | Picture


@dataclass(frozen=True, eq=False)
class Section:
    """Blocks under a heading; a level 3 section is a part of the one before it."""

    title: str
    blocks: list[Block]
    level: int = 2


@dataclass(frozen=True, eq=False)
class Result:
    """What a run has found, in a few lines: the end of its screen, and the beginning of its page.

    title: what was found, and how it does. blocks: the model, law or map in short, and the
    figures that say how good it is. load: Python expression that loads it, with `{}` for the run's
    folder. picture: name of the figure that shows it; empty if none does.
    """

    title: str
    blocks: Sequence[Block]
    load: str = ""
    picture: str = ""


@dataclass(frozen=True)
class Captioned:
    """A figure with its caption, drawn only when it is written."""

    draw: Callable[[], Figure]
    caption: str


def cell_text(value: object) -> str:
    """A cell as text: numbers to three digits, NaN and None as a dash."""
    if isinstance(value, Equation | Link):
        return value.text
    if value is None or (isinstance(value, float) and value != value):
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def places(value: float, n: int) -> str:
    """A number to `n` decimal places, NaN as a dash."""
    return "-" if value != value else f"{value:.{n}f}"
