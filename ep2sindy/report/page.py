"""Results as one self-contained HTML file that needs no other file and no network.

The file can be sent by mail. Equations are MathML, converted from the package's LaTeX, and typeset
by the browser.
"""

from __future__ import annotations

import re
from base64 import b64encode
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from ep2sindy.library.equations import equation_html
from ep2sindy.report.document import Block, Equation, Link, Result, Section, Table, Text, cell_text
from ep2sindy.runtime.files import read_bytes

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup
    from matplotlib.figure import Figure

TEMPLATES = Path(__file__).parent / "templates"

CHARACTERS = 100  # of text in a line of the page
PX_PER_INCH = 96  # of a page: letters have the same size in all figures
DPI = 150  # of figures in a run folder

LARGE = 100_000  # bytes of a PNG from which a page holds it in 256 colours, a third of its size


def page_html(
    title: str,
    sections: Sequence[Section],
    figures: Mapping[str, Drawn],
    about: About | None = None,
    *,
    result: Result | None = None,
) -> str:
    """HTML of all sections with their equations, tables and figures; the template escapes text.

    result: what was found, which comes first.
    """
    named = {f"part-{k}": each for k, each in enumerate(sections)}
    template = _environment().get_template("page.html")
    return template.render(title=title, result=result, parts=named, figures=figures, about=about)


def _environment() -> Environment:
    """Jinja2 environment with the package's templates, and functions for equations."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(TEMPLATES),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals.update(
        equation=shown_html,
        cell=cell_html,
        classes=_classes,
        kind_of=lambda block: type(block).__name__,
        lines=_lines,
        math_font=b64encode((TEMPLATES / "math.woff2").read_bytes()).decode(),
    )
    environment.filters.update(numeric=numeric_columns, raised=powers_html)
    return environment


def shown_html(block: Equation) -> Markup:
    """An equation with its lead, unit and mark; its text is escaped here."""
    from markupsafe import Markup, escape

    lead = escape(f"{block.lead}: ") if block.lead else ""
    unit = f' <span class="unit">{powers_html(block.unit)}</span>' if block.unit else ""
    mark = escape(block.mark.replace("<-", "←"))
    equation = equation_html(block.state, block.terms, rate=block.rate)
    return Markup(f'{lead}<span class="math">{equation}</span>{unit}{mark}')


def cell_html(value: object) -> Markup:
    """A cell of a table; its text is escaped here."""
    from markupsafe import Markup

    if isinstance(value, Equation):
        return shown_html(value)
    if isinstance(value, Link):
        return Markup('<a href="{}">{}</a>').format(value.to, value.text)
    return powers_html(re.sub(r"(?<![\w.)^])-(?=\d)", "−", cell_text(value)))


def powers_html(text: str) -> Markup:
    """Text with powers as superscripts, and all else escaped: `m^-3`, `2e-5` as 2·10^-5."""
    from markupsafe import Markup, escape

    tens = re.sub(r"(?<![\w.])(\d+(?:\.\d+)?)e\+?(-?)0*(\d+)\b", r"\1·10^\2\3", str(escape(text)))
    return Markup(
        re.sub(r"(?<=\w)\^(-?[\d.]*\d)", lambda m: f"<sup>{m[1].replace('-', '−')}</sup>", tens)
    )


def numeric_columns(table: Table) -> list[bool]:
    """For each column, True if it is aligned right: its cells are all numbers or empty."""
    columns = (table.rows.iloc[:, k] for k in range(table.rows.shape[1]))
    texts = ([each for each in column if cell_text(each)] for column in columns)
    return [bool(column) and all(map(_is_number, column)) for column in texts]


def _is_number(value: Any) -> bool:
    """True for a number, perhaps with a unit, or for the dash of a missing one."""
    return bool(re.fullmatch(r"-|[+-]?\d[\d.e+-]*( ?[%µ\w/^-]{1,5})?", cell_text(value)))


def _lines(blocks: Sequence[Block]) -> int:
    """How many lines these texts, equations and tables take on a wide page.

    Tables stand side by side, with four rows in the height of three lines.
    """
    texts = [block.text for block in blocks if isinstance(block, (Text, Equation))]
    rows = max((len(block.rows) + 2 for block in blocks if isinstance(block, Table)), default=0)
    return sum(-(-len(text) // CHARACTERS) for text in texts) + 3 * rows // 4


def _classes(table: Table, row: int) -> str:
    kinds = {"bold": table.bold, "italic": table.italic, "break": table.breaks}
    return " ".join(name for name, rows in kinds.items() if row in rows)


@dataclass(frozen=True)
class Drawn:
    """A figure as HTML.

    html: an element that needs no other file. width_px: intended width.
    """

    html: str
    caption: str
    width_px: int


def draw(figure: Figure, png: bytes, caption: str) -> Drawn:
    """A figure for a page, by its PNG."""
    width = round(figure.get_size_inches()[0] * PX_PER_INCH)
    return Drawn(png_html(in_few_colours(png) if len(png) > LARGE else png), caption, width)


def in_few_colours(png: bytes) -> bytes:
    """The image in its 256 most distinct colours, of which others differ by a few percent."""
    from PIL import Image  # comes with matplotlib

    buffer = BytesIO()
    image = Image.open(BytesIO(png)).convert("RGB")
    image.quantize(256, method=Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(
        buffer, "PNG"
    )
    return buffer.getvalue()


def read_png(path: Path, caption: str) -> Drawn:
    """A figure written by an earlier run. Raises ValueError for a file that is no PNG."""
    png = read_bytes(path)
    if not png.startswith(b"\x89PNG\r\n"):
        raise ValueError(f"{path} must be a PNG, got {png[:8]!r}; take it out of the run's figures")
    width = int.from_bytes(png[16:20], "big")  # width in the PNG header
    return Drawn(png_html(png), caption, round(width / DPI * PX_PER_INCH))


def png_html(png: bytes) -> str:
    return f'<img alt="" src="data:image/png;base64,{b64encode(png).decode()}">'


DATA = "data: "  # begins the message on what was read

ASIDE = ("experiment", "study", "output", "figures", "thesis", "parallel")


@dataclass(frozen=True)
class About:
    """Description of a run, for its page.

    purpose: of the experiment, in a sentence. asked: settings in words, by name. messages: those
    about the data and the steps of the run. provenance: as in provenance.json. config: the resolved
    config, as text.
    """

    purpose: str
    asked: Mapping[str, str]
    messages: Sequence[str]
    warnings: Sequence[str]
    provenance: Mapping[str, Any]
    config: str

    @property
    def data(self) -> str:
        """What was read, in a line; empty if the run did not say it."""
        return next((text for text in self.messages if text.startswith(DATA)), "")

    @property
    def notes(self) -> list[str]:
        """All other messages."""
        return [text for text in self.messages if text != self.data]

    @property
    def command(self) -> str:
        """The command as typed in a shell, arguments quoted if necessary."""
        from shlex import join

        return join(self.provenance["command"])


def settings_used(settings: Mapping[str, Any], keys: Collection[str]) -> dict[str, str]:
    """The settings that a study uses, in words; unset ones are left out."""
    used = {key: setting_text(settings[key]) for key in settings if key in {*keys} - {*ASIDE}}
    return {key.replace("_", " "): text for key, text in used.items() if text}


def setting_text(value: Any) -> str:
    """Text of a setting, such as `BestSubset (max_terms 4, n_best 2)`; empty if it is not set."""
    placed = by_place("", value)
    name = placed.pop("", "")
    parts = ", ".join(f"{at[1:]} {_number_text(each)}" for at, each in placed.items())
    return f"{name} ({parts})" if name and parts else parts or _number_text(name)


def _number_text(value: object) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def by_place(place: str, value: Any) -> dict[str, Any]:
    """Settings by dotted key, `search: BestSubset, search.max_terms: 4`; without unset ones."""
    if isinstance(value, Mapping):
        if "name" in value and value["name"] is None:  # a variable missing in the file
            return {}
        name = str(value.get("_target_", "")).rpartition(".")[2]
        found = {place: name} if name else {}
        for key, each in value.items():
            found |= by_place(f"{place}.{key}", each) if key != "_target_" else {}
        return found
    if isinstance(value, list):
        between = "; " if any(isinstance(each, Mapping) for each in value) else ", "
        return {place: between.join(map(setting_text, value))} if value else {}
    return {place: value} if isinstance(value, int | float | str | bool) else {}


def by_places(settings: Mapping[str, Any], keys: Collection[str]) -> dict[str, Any]:
    """The settings of these keys, each by its dotted key, groups by their name."""
    used = sorted({*keys} & {*settings} - {*ASIDE})
    return {at: value for key in used for at, value in by_place(key, settings[key]).items()}
