"""Results as one self-contained HTML file that needs no other file and no network.

The file can be sent by mail. Equations are MathML, converted from the package's LaTeX, and typeset
by the browser.
"""

from __future__ import annotations

import html
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

from ep2sindy.library.equations import latex_name, sum_latex
from ep2sindy.report.about import About
from ep2sindy.report.document import Equation, Link, Result, Section, Table, cell_text
from ep2sindy.report.picture import Drawn

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

TEMPLATES = Path(__file__).parent / "templates"


def page_html(
    title: str,
    sections: Sequence[Section],
    figures: Mapping[str, Drawn],
    about: About | None = None,
    *,
    result: Result | None = None,
    template: Path = TEMPLATES / "page.html",
) -> str:
    """HTML of all sections with their equations, tables and figures; the template escapes text.

    result: what was found, which comes first. template: a Jinja2 file that is given the title, the
    result, the sections by part, the figures and `about`; see the package's own.
    Raises ValueError for a template that is missing or invalid.
    """
    from jinja2 import TemplateError

    if not template.is_file():
        raise ValueError(
            f"a template must be a file of HTML for Jinja2: {template} is none; leave it out for "
            "the package's own"
        )
    named = {f"part-{k}": each for k, each in enumerate(sections)}
    try:
        return (
            _environment(template)
            .get_template(template.name)
            .render(title=title, result=result, parts=named, figures=figures, about=about)
        )
    except TemplateError as error:
        raise ValueError(f"the template {template} cannot be filled: {error}") from error


def _environment(template: Path) -> Environment:
    """Jinja2 environment with the template's folder, the package's, and functions for equations.

    It is sandboxed: a template from someone else can read the data it is given, but run no code.
    """
    from jinja2 import FileSystemLoader, StrictUndefined
    from jinja2.sandbox import ImmutableSandboxedEnvironment

    environment = ImmutableSandboxedEnvironment(
        loader=FileSystemLoader([template.parent, TEMPLATES]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals.update(
        equation=equation_html, cell=cell_html, classes=_classes, kind_of=_kind
    )
    environment.filters.update(numeric=numeric_columns, raised=powers_html)
    return environment


def equation_html(block: Equation) -> Markup:
    """An equation with its lead, unit and mark; its text is escaped here."""
    from markupsafe import Markup, escape

    lead = escape(f"{block.lead}: ") if block.lead else ""
    unit = f' <span class="unit">{powers_html(block.unit)}</span>' if block.unit else ""
    mark = escape(block.mark.replace("<-", "←"))
    return Markup(f'{lead}<span class="math">{equation_mathml(block)}</span>{unit}{mark}')


def cell_html(value: object) -> Markup:
    """A cell of a table; its text is escaped here."""
    from markupsafe import Markup

    if isinstance(value, Equation):
        return equation_html(value)
    if isinstance(value, Link):
        return Markup('<a href="{}">{}</a>').format(value.to, value.text)
    if _is_number(value):
        text = re.sub(r"e([+-])0*(\d+)", r"·10^\1\2", cell_text(value))
        return powers_html(text.replace("^+", "^"))
    return powers_html(cell_text(value))


def powers_html(text: str) -> Markup:
    """Text with powers such as `m^-3 s^-1` as superscripts, and all else escaped."""
    from markupsafe import Markup, escape

    escaped = str(escape(text))
    minus = re.sub(r"(?<![\w.)])-(?=\d)", "−", escaped)
    return Markup(re.sub(r"(?<=\w)\^([\d.−]+)", r"<sup>\1</sup>", minus))


def numeric_columns(table: Table) -> list[bool]:
    """For each column, True if it is aligned right: its cells are all numbers or empty."""
    columns = (table.rows.iloc[:, k] for k in range(table.rows.shape[1]))
    texts = ([each for each in column if cell_text(each)] for column in columns)
    return [bool(column) and all(map(_is_number, column)) for column in texts]


def _is_number(value: Any) -> bool:
    """True for a number, perhaps with a unit, or for the dash of a missing one."""
    return bool(re.fullmatch(r"-|[+-]?\d[\d.e+-]*( ?[%µ\w/^-]{1,5})?", cell_text(value)))


def _kind(block: object) -> str:
    return type(block).__name__


def _classes(table: Table, row: int) -> str:
    kinds = {"bold": table.bold, "italic": table.italic, "break": table.breaks}
    return " ".join(name for name, rows in kinds.items() if row in rows)


def equation_mathml(equation: Equation) -> str:
    """The equation as MathML, without lead, unit and mark."""
    slope = rf"\mathrm{{d}} {latex_name(equation.state)} / \mathrm{{d}} t"
    return mathml(f"{slope} = {sum_latex(equation.terms)}")


def mathml(latex: str) -> str:
    """LaTeX as a `math` element; names in it end as text, never as markup."""
    from latex2mathml.converter import convert_to_element  # only when a page is written

    element = convert_to_element(latex)
    for each in element.iter():
        if each.text:
            each.text = html.unescape(each.text)  # signs come as entities, as in `&#x02212;`
    return ElementTree.tostring(element, encoding="unicode")
