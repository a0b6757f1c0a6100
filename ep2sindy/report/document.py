"""What a study says, written once: sections that the terminal and the page both show."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import pandas as pd

from ep2sindy.library.equations import equation_text

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Text:
    """A paragraph. warning: it says that something is amiss. page_only: too long for a screen."""

    text: str
    warning: bool = False
    page_only: bool = False


@dataclass(frozen=True)
class Equation:
    """One equation: state -> terms. lead: words before it, mark: behind. aside: beside the point.

    unit: of the derivative, as the terms are written; where they stand in SI it may be left out.
    On the page alone, unless on_screen. As a cell of a table it is always shown.
    """

    state: str
    terms: Mapping[str, float]
    lead: str = ""
    mark: str = ""
    unit: str = ""
    aside: bool = False
    on_screen: bool = False

    @property
    def text(self) -> str:
        """`thesis: n_i' = -2 n_i [m^-3 s^-1]`."""
        lead = f"{self.lead}: " if self.lead else ""
        unit = f" [{self.unit}]" if self.unit else ""
        return f"{lead}{equation_text(self.state, self.terms)}{unit}{self.mark}"


@dataclass(frozen=True, eq=False)
class Table:
    """Rows to read: text as it is, numbers to three digits, NaN as a dash, an `Equation` written.

    page_only: too long for a screen. bold, italic: numbers of the rows so set. breaks: of those
    that a rule follows.
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
    """A figure of the outcome, by its name; on the page alone."""

    name: str


@dataclass(frozen=True)
class Link:
    """A cell that leads to another page. to: a relative address."""

    text: str
    to: str


Block: TypeAlias = Text | Equation | Table | Picture


@dataclass(frozen=True, eq=False)
class Section:
    """Blocks under a heading; level 3 is a part of the section before it."""

    title: str
    blocks: Sequence[Block]
    level: int = 2


@dataclass(frozen=True)
class Captioned:
    """A figure that is drawn when it is written, and what it shows."""

    draw: Callable[[], Figure]
    caption: str


def cell_text(value: object) -> str:
    """A cell as text: numbers to three digits, NaN and None as a dash."""
    if isinstance(value, Equation):
        return value.text
    if value is None or (isinstance(value, float) and value != value):
        return "-"
    if isinstance(value, Link):
        return value.text
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def places(value: float, n: int) -> str:
    """A number to so many places, NaN as a dash."""
    return "-" if value != value else f"{value:.{n}f}"


def pictures(names: Iterable[str]) -> list[Picture]:
    return [Picture(name) for name in names]
