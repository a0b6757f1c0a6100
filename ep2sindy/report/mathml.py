"""Equations as browsers typeset them: MathML, from the LaTeX that the package writes."""

from __future__ import annotations

import html
from xml.etree import ElementTree

from ep2sindy.library.equations import latex_name, sum_latex
from ep2sindy.report.document import Equation


def equation_mathml(equation: Equation) -> str:
    """The equation alone, without what stands before and behind it."""
    slope = rf"\mathrm{{d}} {latex_name(equation.state)} / \mathrm{{d}} t"
    return mathml(f"{slope} = {sum_latex(equation.terms)}")


def mathml(latex: str) -> str:
    """LaTeX as a `math` element; whatever names it holds end as text, never as markup."""
    from latex2mathml.converter import convert_to_element  # only when a page is written

    element = convert_to_element(latex)
    for each in element.iter():
        if each.text:
            each.text = html.unescape(each.text)  # it writes signs as entities, as in `&#x02212;`
    return ElementTree.tostring(element, encoding="unicode")
