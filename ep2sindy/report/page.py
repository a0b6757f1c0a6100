"""The page of a run, in HTML that needs no network: figures lie beside it in figures/."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from ep2sindy.library.equations import equation_html
from ep2sindy.report.document import Captioned, Equation, Section, Table, cell_text

FOOTER = "All values in SI units. Config, models and tables lie beside."


def page_html(title: str, sections: Sequence[Section], figures: Mapping[str, Captioned]) -> str:
    """Every section with its equations, tables and figures; text is escaped by the template."""
    from jinja2 import Environment, PackageLoader, StrictUndefined  # only when a page is written
    from markupsafe import Markup

    template = Environment(
        loader=PackageLoader("ep2sindy.report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    ).get_template("page.html")

    def equation(block: Equation) -> str:
        return Markup(equation_html(block.state, block.terms))  # it escapes names itself

    return template.render(
        title=title,
        sections=sections,
        figures=figures,
        equation=equation,
        cell=cell_text,
        classes=_classes,
        footer=FOOTER,
    )


def _classes(table: Table, row: int) -> str:
    kinds = {"bold": table.bold, "italic": table.italic, "break": table.breaks}
    return " ".join(name for name, rows in kinds.items() if row in rows)
