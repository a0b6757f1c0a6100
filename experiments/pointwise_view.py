"""How the outcome of `experiments.pointwise` reads: tables, terminal, report page, summary."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.figure import Figure
from rich.table import Table

from ep2sindy.data.fields import SPACE
from ep2sindy.discovery.pointwise import STATUSES
from ep2sindy.discovery.regimes import UNSURE, Regimes
from ep2sindy.figures.maps import MEDIANS
from ep2sindy.library.equations import equation_html
from ep2sindy.report.page import figure_html, page_html, table_html
from ep2sindy.report.screen import Screen


@dataclass(frozen=True)
class Outcome:
    """What the tables and the page are made from."""

    title: str
    result: xr.Dataset
    regimes: Regimes
    wall_s: float
    n_before: int

    @property
    def points_per_s(self) -> float:
        """Of this run: without the points that a broken run before it had done."""
        return (self.n_points - self.n_before) / self.wall_s

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
        "points_per_s": outcome.points_per_s,
        "regimes": regimes.n_regimes,
        "at_limit": regimes.at_limit,
        "file": "pointwise.nc",
        "status": status_counts(outcome),
        "no_terms": empty_counts(outcome.result),
        "no_fit": outcome.result.attrs["no_fit"] or None,
        "equations": [regimes.equations(k) for k in range(regimes.n_regimes)],
    }


def status_counts(outcome: Outcome) -> dict[str, int]:
    """Points by what became of them; only what occurred."""
    counts = {name: int((outcome.result["status"] == k).sum()) for k, name in enumerate(STATUSES)}
    return {name: count for name, count in counts.items() if count}


def empty_counts(result: xr.Dataset) -> dict[str, int]:
    """Fitted points by the equation that has no term there; only where there are any."""
    counts = (result["n_terms"] == 0).sum([axis for axis in SPACE if axis in result.dims])
    return {str(e): int(n) for e, n in zip(counts["equation"].values, counts, strict=True) if n}


def points_text(outcome: Outcome) -> str:
    """What became of the points, in a few words."""
    counts = {name.replace("_", " "): n for name, n in status_counts(outcome).items()}
    empty = [f"in {state}' at {n}" for state, n in empty_counts(outcome.result).items()]
    words = [f"{n} {name}" for name, n in counts.items()]
    return ", ".join(words) + (f"; no term {', '.join(empty)}" if empty else "")


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
    screen.print(
        f"{outcome.n_points} points in {outcome.wall_s:.1f} s ({outcome.points_per_s:.0f} per s): "
        f"{points_text(outcome)}"
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
    screen.print(regimes_text(outcome.regimes))
    screen.print(_regimes_rich(outcome.regimes))


def _regimes_rich(regimes: Regimes) -> Table:
    """A row per regime, equation and term that acts."""
    table = Table(title=f"regimes: {MEDIANS}", show_edge=False, padding=(0, 1))
    table.caption = "in: share of the regime's points that have the term"
    for heading in (
        "regime", "points", "confidence", f"below\n{UNSURE:g}", "", "term", "in", "median",
        "16 to 84 %", "unit",
    ):  # fmt: skip
        table.add_column(heading)
    for _, rows in regimes.table.groupby("regime"):
        first = rows.iloc[0]
        name = [
            f"{first['regime']}", f"{first['n_points']}", f"{first['confidence']:.2f}",
            f"{first['unsure']:.0%}",
        ]  # fmt: skip
        for state, terms in rows.groupby("equation", sort=False):
            acting = terms[terms["acts"]]
            cells = [_term_cells(row) for row in acting.to_dict("records")] or [["0"]]
            for j, row in enumerate(cells):
                table.add_row(*name, "" if j else f"{state}' =", *row)
                name = [""] * len(name)
        table.add_section()
    return table


def _term_cells(row: Mapping[Any, Any]) -> list[str]:
    """Term, share of points that have it, median, spread, unit."""
    between = f"{_number(row['coef_low'])} to {_number(row['coef_high'])}"
    share = f"{row['in_support']:.0%}"
    return [row["term"], share, _number(row["coef"]), between, row["coef_units"]]


def regimes_text(regimes: Regimes) -> str:
    """How many there are, and how sure."""
    count = f"{regimes.n_regimes} regime{'s' if regimes.n_regimes > 1 else ''}"
    limit = ", as many as max_regimes allows: the points may bear more" if regimes.at_limit else ""
    known = regimes.confidence.values[np.isfinite(regimes.confidence.values)]
    return f"{count}{limit}; confidence below {UNSURE:g} at {(known < UNSURE).mean():.0%} of points"


def _number(value: float) -> str:
    return "-" if np.isnan(value) else f"{value:.3g}"


CAPTIONS = {
    "coefficients": "Coefficient of every term at every point: its sign says source or sink, the "
    "colour its order of magnitude. Grey: the term is not in the equation; blank: no equation.",
    "regimes": "Regimes: points where the same terms act, and how sure the bootstraps are.",
    "quality": "R2 on held-out rows if there are any, number of terms, and what became of the "
    "points if not all were fitted.",
}
# Over one axis.
LINE_CAPTIONS = CAPTIONS | {
    "coefficients": "Magnitude of every term's coefficient along the axis; the colour is its sign, "
    "source or sink. No mark: the term is not in the equation, or there is no equation.",
}


def page(outcome: Outcome, figures: Mapping[str, Figure]) -> str:
    captions = LINE_CAPTIONS if outcome.result["status"].ndim == 1 else CAPTIONS
    body = [
        f"<p>{outcome.n_points} points: {points_text(outcome)}.</p>",
        "<h2>Regimes</h2>",
        *_regimes_html(outcome.regimes),
        "<h2>Maps</h2>",
        *(figure_html(name, caption) for name, caption in captions.items() if name in figures),
        "<h2>Terms</h2>",
        table_html(terms_table(outcome.result)),
        "<footer>Median, 16 and 84 % over the points that have the term, in the unit named. "
        "selected: share of the fitted points; inclusion: share of the bootstraps. All values by "
        "point, term and equation lie in pointwise.nc; config and tables lie beside.</footer>",
    ]
    return page_html(outcome.title, body)


def _regimes_html(regimes: Regimes) -> list[str]:
    body = [
        f"<p>{regimes_text(regimes)}.</p>",
        f"<p>Below, {MEDIANS}: not every point has all of them, and coefficients spread as the "
        "tables say, which hold the other terms as well (those that act are bold). A regime need "
        "not be connected: the same terms may act in places far apart.</p>",
    ]
    for k, rows in regimes.table.groupby("regime"):
        first = rows.iloc[0]
        points = f"{first['n_points']} point{'s' if first['n_points'] > 1 else ''}"
        body.append(
            f"<h3>Regime {k}: {points}, confidence {first['confidence']:.2f}, "
            f"below {UNSURE:g} at {first['unsure']:.0%}</h3>"
        )
        body += [
            f'<p class="equation">{equation_html(state, terms)}</p>'
            for state, terms in regimes.equations(int(str(k))).items()
        ]
        held = rows[rows["in_support"] > 0.0]
        if len(held):
            body.append(table_html(_spread(held), bold=held["acts"].tolist()))
    return body


def _spread(rows: pd.DataFrame) -> pd.DataFrame:
    """Terms of a regime's points, as the page shows them."""
    return pd.DataFrame(
        {
            "equation": rows["equation"] + "'",
            "term": rows["term"],
            "points that have it": [f"{share:.0%}" for share in rows["in_support"]],
            "median": rows["coef"],
            "16 %": rows["coef_low"],
            "84 %": rows["coef_high"],
            "unit": rows["coef_units"],
        }
    )
