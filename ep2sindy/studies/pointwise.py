"""A search at every grid point, and the regimes found: `+exp=pointwise`."""

from __future__ import annotations

import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated

import numpy as np
import xarray as xr

from ep2sindy.data.fields import write_netcdf
from ep2sindy.discovery.method import AnyMethod, Regression
from ep2sindy.discovery.pointwise import STATUSES, PointSearch, pointwise
from ep2sindy.discovery.regimes import UNSURE, Regimes, find_regimes
from ep2sindy.figures.maps import coefficient_maps, quality_maps, regime_map, space_axes
from ep2sindy.library.library import Library, named_terms
from ep2sindy.library.terms import variables_of
from ep2sindy.report.document import Equation, Result, Table, Text
from ep2sindy.report.report import Report
from ep2sindy.runtime.parallel import Workers
from ep2sindy.studies.resume import resumed
from ep2sindy.studies.source import Step, open_prepared, report_field, report_simulation
from ep2sindy.studies.study import A_LIST, Count, Deferred, Names
from ep2sindy.thruster.parameters import Thruster

AFTERWARDS = {"max_regimes", "outline"}  # settings that do not change a point's result
FADING = (
    "It fades to grey where it says little: as the equation's R2 (held-out rows, if any), times "
    "the fraction of the bootstraps that have the term, falls to 0."
)
CAPTIONS = {
    "coefficients": "Coefficient of every term at every point: its sign says source or sink, the "
    f"colour its order of magnitude. {FADING} Grey: the term is not in the equation; blank: no "
    "equation.",
    "regimes": "Regimes: points where the same terms act, and how sure the bootstraps are.",
    "quality": "R2 on held-out rows if there are any, number of terms, and what became of the "
    "points if not all were fitted.",
}
LINE_CAPTION = (
    "Magnitude of every term's coefficient along the axis; the colour is its sign, source or sink. "
    f"{FADING} No mark: the term is not in the equation, or there is no equation."
)
MEDIANS = (
    "Below, terms that act, with medians over the regime's points that have them: not every point "
    "has all of them, and coefficients spread as the tables say, which hold the other terms as "
    "well (those that act are bold)."
)
# Columns that are shown of the table of regimes, with their headings.
HEADINGS = {
    "equation": "equation", "term": "term", "in_support": "points that have it",
    "coef": "median", "coef_low": "16 %", "coef_high": "84 %", "coef_units": "unit",
}  # fmt: skip


@dataclass(frozen=True)
class Study:
    """Search an equation at every grid point, and group the points into regimes.

    terms: those of variables_if_present are left out if the field lacks their variables.
    relations: between coefficients of the equations at a point. keep: whether a run continues with
    the finished blocks of one that was interrupted. outline: the thruster whose channel is drawn
    into the maps.
    """

    data: Deferred
    prepare: Sequence[Step]
    method: AnyMethod
    parallel: Workers
    states: Names
    terms: Annotated[Sequence[str | int], A_LIST]  # 1, the constant, is a number to YAML
    relations: Sequence[str]
    variables_if_present: Sequence[str]
    least_variation: float
    max_regimes: Count
    block_points: Count
    keep: bool
    outline: Thruster | None

    def __post_init__(self) -> None:
        self.search(self.library(lacking=()), seed=0)  # refuses settings that cannot work

    def library(self, *, lacking: Collection[str]) -> Library:
        """The library of terms, without those of variables that a field lacks."""
        factors = {name: variables_of(name) for name in map(str, self.terms)}
        terms = [name for name, variables in factors.items() if not {*lacking} & {*variables}]
        used = dict.fromkeys([*self.states, *(v for name in terms for v in factors[name])])
        return named_terms(list(used), terms).relate(*self.relations)

    def search(self, library: Library, *, seed: int) -> PointSearch:
        if not isinstance(self.method, Regression):
            raise ValueError(
                "a search of trajectories fits them whole, and a pointwise study searches rows, "
                f"got {self.method!r}; use Regression(search=BestSubset()) (search=best_subset)"
            )
        return PointSearch(self.states, library, self.method, self.least_variation, seed)

    def run(self, report: Report) -> None:
        with report.watch.stage(None, "", "data"):
            field = open_prepared(self.data, self.prepare)
        report_simulation(report, field.attrs)
        report_field(report, field)
        lacking = [name for name in self.variables_if_present if name not in field]
        search = self.search(self.library(lacking=lacking), seed=report.seed)
        left_out = [name for name in map(str, self.terms) if name not in search.library.names]
        if left_out:
            text = f"terms left out, for this field lacks their variables: {', '.join(left_out)}"
            report.say(text)
        begin = time.perf_counter()
        with resumed(self.keep, report, self.parallel, aside=AFTERWARDS) as workers:
            result = pointwise(
                field,
                search,
                workers=workers,
                block_points=self.block_points,
                progress=report.watch,
            )
        wall_s = time.perf_counter() - begin
        rng = np.random.default_rng(report.seed)
        with report.watch.stage(None, "", "regimes"):
            found = find_regimes(result, rng=rng, max_regimes=self.max_regimes)
        result = result.assign(regime=found.labels, confidence=found.confidence)
        packed = {str(name): {"zlib": True, "complevel": 4} for name in result.data_vars}
        write_netcdf(result, report.folder.file("pointwise.nc"), encoding=packed)
        report.found(found_regimes(found, count_points(report, result, wall_s)))
        self._add_regimes(report, result, found)

    def _add_regimes(self, report: Report, result: xr.Dataset, regimes: Regimes) -> None:
        """Add the regimes, and the maps of what was found at the points."""
        n_regimes, outline = regimes.n_regimes, self.outline
        report.summary |= {
            "n_regimes": n_regimes,
            "at_limit": regimes.at_limit,
            "file": "pointwise.nc",
            "no_fit": result.attrs["no_fit"] or None,
            "equations": [regimes.equations(k) for k in range(n_regimes)],
        }
        report.headline["n_regimes"] = float(n_regimes)
        apart = "A regime need not be connected: the same terms may act in places far apart."
        report.section("Regimes", MEDIANS, Text(apart, page_only=True))
        report.table("regimes", regimes.table, shown=False)
        draw = partial(regime_map, regimes, outline=outline)
        report.figure("regimes", draw, CAPTIONS["regimes"])
        for k in range(n_regimes):
            _add_regime(report, regimes, k)
        report.section("Maps")
        if (result["n_terms"] > 0).any():
            caption = LINE_CAPTION if result["status"].ndim == 1 else CAPTIONS["coefficients"]
            draw = partial(coefficient_maps, result, outline=outline)
            report.figure("coefficients", draw, caption)
        draw = partial(quality_maps, result, outline=outline)
        report.figure("quality", draw, CAPTIONS["quality"])


def count_points(report: Report, result: xr.Dataset, wall_s: float) -> str:
    """Count points by status, and those without a term by equation; returns both in words."""
    statuses = {name: int((result["status"] == k).sum()) for k, name in enumerate(STATUSES)}
    n_points, n_valid = int(result["status"].size), statuses[STATUSES[0]]
    without = (result["n_terms"] == 0).sum(space_axes(result)).to_series()
    empty = {str(state): int(n) for state, n in without.items() if n}
    known = {name: n for name, n in statuses.items() if n}
    counts = {"n_points": n_points, "n_valid": n_valid}
    speed = {"wall_s": wall_s, "points_per_s": n_points / wall_s}
    report.summary |= counts | speed | {"status": known, "no_terms": empty}
    counts |= {f"points/{name}": n for name, n in statuses.items()}
    report.headline |= {name: float(n) for name, n in counts.items()}
    became = ", ".join(f"{n} {name.replace('_', ' ')}" for name, n in known.items())
    text = f"{n_points} points in {wall_s:.1f} s ({n_points / wall_s:.0f} per s): {became}"
    lacking = ", ".join(f"in {state}' at {n}" for state, n in empty.items())
    return f"{text}; no term {lacking}" if empty else text


def found_regimes(regimes: Regimes, points: str) -> Result:
    """The regimes, their certainty, and the equations of the largest."""
    lead = f"in the largest, {int((regimes.labels == 0).sum())} points"
    largest = [Equation(s, t, lead=lead, on_screen=True) for s, t in regimes.equations(0).items()]
    count = f"{regimes.n_regimes} regime{'s' if regimes.n_regimes > 1 else ''}"
    limit = (
        [Text("as many regimes as max_regimes allows: the points may bear more")]
        if regimes.at_limit
        else []
    )
    unsure = float((regimes.confidence < UNSURE).sum() / regimes.confidence.count())
    return Result(
        f"{count}; confidence below {UNSURE:g} at {100.0 * unsure:.0f} % of points",
        [*largest, *limit, Text(points)],
        load='xarray.open_dataset("{}/pointwise.nc")',
        picture="regimes",
    )


def _add_regime(report: Report, regimes: Regimes, regime: int) -> None:
    """Add a part on one regime: its equations, and the spread of coefficients over its points."""
    rows = regimes.table[regimes.table["regime"] == regime]
    first = rows.iloc[0]
    unsure = f"below {UNSURE:g} at {100.0 * first['unsure']:.0f} %"
    report.section(
        f"Regime {regime}: {first['n_points']} point{'s' if first['n_points'] > 1 else ''}, "
        f"confidence {first['confidence']:.2f}, {unsure}",
        *(Equation(s, terms, on_screen=True) for s, terms in regimes.equations(regime).items()),
        level=3,
    )
    held = rows[rows["in_support"] > 0.0]
    fractions = [f"{100.0 * fraction:.0f} %" for fraction in held["in_support"]]
    shown = held.assign(equation=held["equation"] + "'", in_support=fractions)
    shown = shown[[*HEADINGS]].rename(columns=HEADINGS)
    report.add(Table(shown, bold=np.flatnonzero(held["acts"]).tolist()))
