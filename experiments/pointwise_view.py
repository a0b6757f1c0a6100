"""How the outcome of `experiments.pointwise` reads: tables, terminal, report page, summary."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure
from rich.table import Table

from ep2sindy.model import equation_text
from ep2sindy.report import Screen, equation_html, figure_html, page_html, table_html
from ep2sindy.studies.pointwise import STATUSES
from ep2sindy.studies.regimes import Regimes


@dataclass(frozen=True)
class Outcome:
    """What the tables and the page are made from."""

    title: str
    result: xr.Dataset
    regimes: Regimes
    wall_s: float

    @property
    def n_points(self) -> int:
        return int(self.result["status"].size)

    @property
    def n_valid(self) -> int:
        return int((self.result["status"] == 0).sum())


def summary(outcome: Outcome) -> dict[str, Any]:
    regimes = outcome.regimes
    return {
        "n_points": outcome.n_points,
        "n_valid": outcome.n_valid,
        "wall_s": outcome.wall_s,
        "points_per_s": outcome.n_points / outcome.wall_s,
        "regimes": regimes.n_regimes,
        "file": "pointwise.nc",
        "status": status_counts(outcome),
        "no_fit": outcome.result.attrs["no_fit"] or None,
        "equations": [regimes.equations(k) for k in range(regimes.n_regimes)],
    }


def status_counts(outcome: Outcome) -> dict[str, int]:
    """Points by what became of them; only what occurred."""
    counts = {name: int((outcome.result["status"] == k).sum()) for k, name in enumerate(STATUSES)}
    return {name: count for name, count in counts.items() if count}


def terms_table(result: xr.Dataset) -> pd.DataFrame:
    """How often each term acts and how large it is, over all fitted points.

    selected: share of the points. inclusion: mean over the points of its share of the bootstraps.
    coef, low, high: median, 16 % and 84 % of the points that have the term.
    """
    fitted = (result["status"] == 0).values
    rows: list[dict[str, Any]] = []
    for equation in result["equation"].values:
        for term in result["term"].values:
            here = result.sel(equation=equation, term=term)
            coef = here["coef"].values[fitted]
            held = coef[coef != 0.0]
            low, middle, high = np.percentile(held, [16, 50, 84]) if held.size else [np.nan] * 3
            rows.append(
                {
                    "equation": f"{equation}'",
                    "term": str(term),
                    "selected": held.size / max(coef.size, 1),
                    "inclusion": float(here["inclusion"].values[fitted].mean()),
                    "coef": middle,
                    "low": low,
                    "high": high,
                    "unit": str(here["coef_units"].values),
                }
            )
    return pd.DataFrame(rows)


def print_outcome(screen: Screen, outcome: Outcome) -> None:
    counts = ", ".join(
        f"{n} {name.replace('_', ' ')}" for name, n in status_counts(outcome).items()
    )
    per_s = outcome.n_points / outcome.wall_s
    screen.print(
        f"{outcome.n_points} points in {outcome.wall_s:.1f} s ({per_s:.0f} per s): {counts}"
    )
    table = Table(title="terms over all fitted points", show_edge=False, padding=(0, 1))
    for heading in ("equation", "term", "selected", "median", "16 to 84 %", "unit"):
        table.add_column(heading)
    for row in terms_table(outcome.result).to_dict("records"):
        between = f"{_number(row['low'])} to {_number(row['high'])}" if row["selected"] else "-"
        share = f"{row['selected']:.0%}"
        table.add_row(
            row["equation"], row["term"], share, _number(row["coef"]), between, row["unit"]
        )
    screen.print(table)
    screen.print(_regimes_rich(outcome.regimes))


def _regimes_rich(regimes: Regimes) -> Table:
    table = Table(title="regimes", show_edge=False, padding=(0, 1))
    for heading in ("regime", "points", "confidence", "median equations"):
        table.add_column(heading)
    for k in range(regimes.n_regimes):
        n_points, confidence = size_of(regimes, k)
        for j, (state, terms) in enumerate(regimes.equations(k).items()):
            name = ["", "", ""] if j else [str(k), str(n_points), f"{confidence:.2f}"]
            table.add_row(*name, equation_text(state, terms))
    return table


def size_of(regimes: Regimes, regime: int) -> tuple[int, float]:
    """Number of points, and their mean confidence."""
    inside = regimes.labels == regime
    return int(inside.sum()), float(regimes.confidence.where(inside).mean())


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.3g}"


CAPTIONS = {
    "coefficients": "Coefficient of every term at every point: its sign says source or sink, the "
    "colour its order of magnitude. Grey: the term is not in the equation; blank: no equation.",
    "regimes": "Regimes: points where the same terms act, and how sure the bootstraps are.",
    "quality": "R2 on held-out rows, number of terms, and what became of every point.",
}


def page(outcome: Outcome, figures: Mapping[str, Figure]) -> str:
    counts = ", ".join(
        f"{n} {name.replace('_', ' ')}" for name, n in status_counts(outcome).items()
    )
    body = [
        f"<p>{outcome.n_points} points: {counts}.</p>",
        "<h2>Regimes</h2>",
        *_regimes_html(outcome.regimes),
        "<h2>Maps</h2>",
        *(figure_html(name, caption) for name, caption in CAPTIONS.items() if name in figures),
        "<h2>Terms</h2>",
        table_html(terms_table(outcome.result)),
        "<footer>Median, 16 and 84 % over the points that have the term, in the unit named. "
        "selected: share of the fitted points; inclusion: share of the bootstraps. All values by "
        "point, term and equation lie in pointwise.nc; config and tables lie beside.</footer>",
    ]
    return page_html(outcome.title, body)


def _regimes_html(regimes: Regimes) -> list[str]:
    body = []
    for k in range(regimes.n_regimes):
        n_points, confidence = size_of(regimes, k)
        body.append(f"<h3>Regime {k}: {n_points} points, confidence {confidence:.2f}</h3>")
        body += [
            f'<p class="equation">{equation_html(state, terms)}</p>'
            for state, terms in regimes.equations(k).items()
        ]
    return body
