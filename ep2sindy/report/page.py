"""The page of a run, in HTML."""

from __future__ import annotations

import html
import math
from collections.abc import Sequence

import pandas as pd


def table_html(table: pd.DataFrame, *, bold: Sequence[bool] = ()) -> str:
    """A table with numbers to three digits; cells may hold HTML of our own."""
    head = "".join(f"<th>{html.escape(str(c))}</th>" for c in table.columns)
    rows = []
    for k, row in enumerate(table.itertuples(index=False)):
        cells = "".join(f"<td>{_cell(value)}</td>" for value in row)
        style = ' class="selected"' if k < len(bold) and bold[k] else ""
        rows.append(f"<tr{style}>{cells}</tr>")
    return f"<table><tr>{head}</tr>{''.join(rows)}</table>"


def _cell(value: object) -> str:
    if isinstance(value, float):
        return "&ndash;" if math.isnan(value) else f"{value:.3g}"
    return str(value)


def page_html(title: str, body: Sequence[str]) -> str:
    """A page that needs no network: figures lie beside it in figures/."""
    return (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{html.escape(title)}</title>'
        f"<style>{_STYLE}</style><body><h1>{html.escape(title)}</h1>{''.join(body)}</body></html>\n"
    )


def figure_html(name: str, caption: str) -> str:
    return (
        f'<figure><img src="figures/{name}.png" alt="{html.escape(caption)}">'
        f"<figcaption>{html.escape(caption)}</figcaption></figure>"
    )


_STYLE = """
body { font: 16px/1.5 Georgia, serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }
h1, h2, h3 { font-family: Helvetica, Arial, sans-serif; line-height: 1.2; }
table { border-collapse: collapse; margin: 1rem 0; font-size: 0.92rem; }
th, td { padding: 0.2rem 0.8rem; text-align: left; border-bottom: 1px solid #ddd; }
tr.selected { font-weight: bold; background: #fdf3e1; }
figure { margin: 1.5rem 0; } img { max-width: 100%; }
figcaption, footer { color: #555; font-size: 0.9rem; }
.published { margin: 0.1rem 1.5rem; color: #555; }
.equation { font-size: 1.15rem; margin: 0.4rem 1.5rem; }
"""
