"""What a study says, written once: sections that the terminal and the page both show."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import pandas as pd

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
    """One equation: state -> terms in SI. lead: words before it. aside: beside the point.

    On the page alone, unless on_screen: tables of fronts and methods show equations as text.
    """

    state: str
    terms: Mapping[str, float]
    lead: str = ""
    aside: bool = False
    on_screen: bool = False


@dataclass(frozen=True, eq=False)
class Table:
    """Rows to read: text as it is, numbers to three digits, NaN as a dash.

    bold, italic: numbers of the rows so set. breaks: numbers of the rows that a rule follows.
    """

    rows: pd.DataFrame
    title: str = ""
    bold: Sequence[int] = ()
    italic: Sequence[int] = ()
    breaks: Sequence[int] = ()
    note: str = ""


@dataclass(frozen=True)
class Picture:
    """A figure of the outcome, by its name; on the page alone."""

    name: str


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
    if value is None or (isinstance(value, float) and value != value):
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def places(value: float, n: int) -> str:
    """A number to so many places, NaN as a dash."""
    return "-" if value != value else f"{value:.{n}f}"


def pictures(names: Iterable[str]) -> list[Picture]:
    return [Picture(name) for name in names]
