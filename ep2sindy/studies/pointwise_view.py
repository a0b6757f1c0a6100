"""How the outcome of `pointwise` reads: maps, regimes, and the terms of all points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from ep2sindy.data.fields import SPACE
from ep2sindy.discovery.pointwise import STATUSES
from ep2sindy.discovery.regimes import UNSURE, Regimes, spread
from ep2sindy.figures.maps import MEDIANS, coefficient_maps, quality_maps, regime_map
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Block, Captioned, Equation, Section, Table, Text, pictures
from ep2sindy.thruster.parameters import Thruster

FADING = (
    "It fades to grey where it says little: as the equation's R2 (held-out rows, if any), times "
    "the share of the bootstraps that have the term, falls to 0."
)
CAPTIONS = {
    "coefficients": "Coefficient of every term at every point: its sign says source or sink, the "
    f"colour its order of magnitude. {FADING} Grey: the term is not in the equation; blank: no "
    "equation.",
    "regimes": "Regimes: points where the same terms act, and how sure the bootstraps are.",
    "quality": "R2 on held-out rows if there are any, number of terms, and what became of the "
    "points if not all were fitted.",
}
# Over one axis.
LINE_CAPTIONS = CAPTIONS | {
    "coefficients": "Magnitude of every term's coefficient along the axis; the colour is its sign, "
    f"source or sink. {FADING} No mark: the term is not in the equation, or there is no equation.",
}


@dataclass(frozen=True, eq=False)
class Outcome:
    """What was found at the points: `pointwise.nc` holds all of it.

    wall_s: of the search. n_before: points that a broken run before this one had done.
    """

    result: xr.Dataset
    regimes: Regimes
    outline: Thruster | None
    wall_s: float
    n_before: int

    @property
    def n_points(self) -> int:
        return int(self.result["status"].size)

    @property
    def points_per_s(self) -> float:
        """Of this run: without the points that a broken run before it had done."""
        return (self.n_points - self.n_before) / self.wall_s

    @property
    def status_counts(self) -> dict[str, int]:
        """Points by what became of them."""
        return {name: int((self.result["status"] == k).sum()) for k, name in enumerate(STATUSES)}

    @property
    def empty_counts(self) -> dict[str, int]:
        """Fitted points by the equation that has no term there; only where there are any."""
        axes = [axis for axis in SPACE if axis in self.result.dims]
        counts = (self.result["n_terms"] == 0).sum(axes)
        return {str(e): int(n) for e, n in zip(counts["equation"].values, counts, strict=True) if n}

    def models(self) -> dict[str, SparseModel]:
        return {}

    def tables(self) -> dict[str, pd.DataFrame]:
        return {"terms": terms_table(self.result), "regimes": self.regimes.table}

    def figures(self) -> dict[str, Captioned]:
        captions = LINE_CAPTIONS if self.result["status"].ndim == 1 else CAPTIONS
        drawn = {
            "regimes": partial(regime_map, self.regimes, outline=self.outline),
            "quality": partial(quality_maps, self.result, outline=self.outline),
        }
        if (self.result["n_terms"] > 0).any():
            drawn["coefficients"] = partial(coefficient_maps, self.result, outline=self.outline)
        return {name: Captioned(draw, captions[name]) for name, draw in drawn.items()}

    def sections(self) -> list[Section]:
        about = [
            Text(f"{regimes_text(self.regimes)}."),
            Text(
                f"Below, {MEDIANS}: not every point has all of them, and coefficients spread as "
                "the tables say, which hold the other terms as well (those that act are bold)."
            ),
            Text(
                "A regime need not be connected: the same terms may act in places far apart.",
                page_only=True,
            ),
        ]
        return [
            Section("Points", [Text(f"{self._points_text()}.")]),
            Section("Regimes", about),
            *(_regime_section(self.regimes, k) for k in range(self.regimes.n_regimes)),
            Section("Maps", pictures(list(CAPTIONS))),
            Section("Terms over all fitted points", [_readable_terms(terms_table(self.result))]),
        ]

    def _points_text(self) -> str:
        """How many, how fast, and what became of them."""
        counts = {name.replace("_", " "): n for name, n in self.status_counts.items() if n}
        became = ", ".join(f"{n} {name}" for name, n in counts.items())
        empty = ", ".join(f"in {state}' at {n}" for state, n in self.empty_counts.items())
        return (
            f"{self.n_points} points in {self.wall_s:.1f} s ({self.points_per_s:.0f} per s): "
            f"{became}" + (f"; no term {empty}" if empty else "")
        )

    def summary(self) -> dict[str, Any]:
        found, counts = self.regimes, self.status_counts
        return {
            "n_points": self.n_points,
            "n_valid": counts[STATUSES[0]],
            "wall_s": self.wall_s,
            "points_per_s": self.points_per_s,
            "regimes": found.n_regimes,
            "at_limit": found.at_limit,
            "file": "pointwise.nc",
            "status": {name: count for name, count in counts.items() if count},
            "no_terms": self.empty_counts,
            "no_fit": self.result.attrs["no_fit"] or None,
            "equations": [found.equations(k) for k in range(found.n_regimes)],
        }

    def headline(self) -> dict[str, float]:
        counts = self.status_counts
        numbers = {
            "n_points": self.n_points,
            "n_valid": counts[STATUSES[0]],
            "regimes": self.regimes.n_regimes,
            **{f"points/{name}": count for name, count in counts.items()},
        }
        return {name: float(number) for name, number in numbers.items()}


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
            low, middle, high = spread(coef)
            rows.append(
                {
                    "equation": f"{equation}'",
                    "term": str(term),
                    "selected": np.count_nonzero(coef) / max(coef.size, 1),
                    "inclusion": float(here["inclusion"].values[fitted].mean()),
                    "coef": middle,
                    "low": low,
                    "high": high,
                    "unit": str(here["coef_units"].values),
                }
            )
    return pd.DataFrame(rows)


def _readable_terms(table: pd.DataFrame) -> Table:
    return Table(
        table.assign(
            selected=_percent(table["selected"]), inclusion=_percent(table["inclusion"])
        ).rename(columns={"coef": "median", "low": "16 %", "high": "84 %"}),
        note="selected: share of the fitted points; inclusion: share of the bootstraps. Median, 16 "
        "and 84 % over the points that have the term, in the unit named. All values by point, term "
        "and equation lie in pointwise.nc.",
    )


def regimes_text(regimes: Regimes) -> str:
    """How many there are, and how sure."""
    count = f"{regimes.n_regimes} regime{'s' if regimes.n_regimes > 1 else ''}"
    limit = ", as many as max_regimes allows: the points may bear more" if regimes.at_limit else ""
    known = regimes.confidence.values[np.isfinite(regimes.confidence.values)]
    return f"{count}{limit}; confidence below {UNSURE:g} at {(known < UNSURE).mean():.0%} of points"


def _regime_section(regimes: Regimes, regime: int) -> Section:
    """Its equations, and how they spread over its points."""
    rows = regimes.table[regimes.table["regime"] == regime]
    first = rows.iloc[0]
    points = f"{first['n_points']} point{'s' if first['n_points'] > 1 else ''}"
    blocks: list[Block] = [
        Equation(state, terms, on_screen=True) for state, terms in regimes.equations(regime).items()
    ]
    held = rows[rows["in_support"] > 0.0]
    if len(held):
        blocks.append(Table(_spread(held), bold=np.flatnonzero(held["acts"]).tolist()))
    title = (
        f"Regime {regime}: {points}, confidence {first['confidence']:.2f}, "
        f"below {UNSURE:g} at {first['unsure']:.0%}"
    )
    return Section(title, blocks, level=3)


def _spread(rows: pd.DataFrame) -> pd.DataFrame:
    """Terms of a regime's points."""
    return pd.DataFrame(
        {
            "equation": rows["equation"] + "'",
            "term": rows["term"],
            "points that have it": _percent(rows["in_support"]),
            "median": rows["coef"],
            "16 %": rows["coef_low"],
            "84 %": rows["coef_high"],
            "unit": rows["coef_units"],
        }
    )


def _percent(shares: pd.Series) -> Sequence[str]:
    return [f"{share:.0%}" for share in shares]
