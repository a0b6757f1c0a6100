"""A search at every grid point, and the regimes found: `+exp=pointwise`."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any

import numpy as np
import pandas as pd
import xarray as xr

from ep2sindy.data.fields import SPACE, write_netcdf
from ep2sindy.discovery.method import AnyMethod, Regression
from ep2sindy.discovery.pointwise import STATUSES, PointSearch, pointwise
from ep2sindy.discovery.regimes import UNSURE, Regimes, find_regimes, spread
from ep2sindy.figures.maps import coefficient_maps, quality_maps, regime_map
from ep2sindy.library.library import Library, named_terms
from ep2sindy.library.terms import variables_of
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import (
    Block,
    Captioned,
    Equation,
    Result,
    Section,
    Table,
    Text,
    pictures,
)
from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Workers
from ep2sindy.runtime.progress import Advance
from ep2sindy.studies.resume import resumed
from ep2sindy.studies.source import Step, open_prepared, say_field, say_simulation
from ep2sindy.studies.study import A_LIST, Count, Deferred, Names
from ep2sindy.thruster.parameters import Thruster

AFTERWARDS = {"max_regimes", "outline"}  # settings that do not change a point's result
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
# Captions for a field with a single axis.
LINE_CAPTIONS = CAPTIONS | {
    "coefficients": "Magnitude of every term's coefficient along the axis; the colour is its sign, "
    f"source or sink. {FADING} No mark: the term is not in the equation, or there is no equation.",
}


@dataclass(frozen=True)
class Study:
    """Search an equation at every grid point, and group the points into regimes.

    terms: those of variables_if_present are left out if the field lacks their variables.
    relations: between coefficients of the equations at a point. keep: whether a run goes on with
    the finished blocks of one that was broken off. outline: the thruster whose channel is drawn
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
                "a search of trajectories fits them whole, and a pointwise study searches rows: "
                f"{self.method!r} came; use Regression(search=BestSubset()) (search=best_subset)"
            )
        return PointSearch(self.states, library, self.method, self.least_variation, seed)

    def compute(self, run: Run) -> Outcome:
        with run.progress(None, "", "data"):
            field = open_prepared(self.data, self.prepare)
        say_simulation(run, field.attrs)
        say_field(run, field)
        lacking = [name for name in self.variables_if_present if name not in field]
        search = self.search(self.library(lacking=lacking), seed=run.seed)
        left_out = [name for name in map(str, self.terms) if name not in search.library.names]
        if left_out:
            run.say(f"terms left out, for this field lacks their variables: {', '.join(left_out)}")
        begin = time.perf_counter()
        with resumed(self.keep, run, self.parallel, aside=AFTERWARDS) as workers:
            result = pointwise(
                field,
                search,
                workers=workers,
                block_points=self.block_points,
                progress=Rates(run),
            )
        wall_s = time.perf_counter() - begin
        rng = np.random.default_rng(run.seed)
        with run.progress(None, "", "regimes"):
            found = find_regimes(result, rng=rng, max_regimes=self.max_regimes)
        result = result.assign(regime=found.labels, confidence=found.confidence)
        packed = {str(name): {"zlib": True, "complevel": 4} for name in result.data_vars}
        write_netcdf(result, run.folder.path / "pointwise.nc", encoding=packed)
        return Outcome(result, found, self.outline, wall_s=wall_s)


@dataclass(frozen=True, eq=False)
class Rates:
    """Progress of the run, and points per second in TensorBoard during the run."""

    run: Run

    @contextmanager
    def stage(self, total: int | None, unit: str, label: str = "") -> Iterator[Advance]:
        begin, done = time.perf_counter(), 0
        with self.run.progress(total, unit, label) as advance:

            def count(n_more: int) -> None:
                nonlocal done
                done += n_more
                advance(n_more)
                per_s = done / max(time.perf_counter() - begin, 1e-9)
                rates = {"points/done": float(done), "points/per_s": per_s}
                self.run.board.scalars(rates, step=done)

            yield count


@dataclass(frozen=True, eq=False)
class Outcome:
    """Equations found at the grid points; `pointwise.nc` holds the full result.

    wall_s: duration of the search.
    """

    result: xr.Dataset
    regimes: Regimes
    outline: Thruster | None
    wall_s: float

    @property
    def n_points(self) -> int:
        return int(self.result["status"].size)

    @property
    def points_per_s(self) -> float:
        return self.n_points / self.wall_s

    @property
    def status_counts(self) -> dict[str, int]:
        """Number of points by status."""
        return {name: int((self.result["status"] == k).sum()) for k, name in enumerate(STATUSES)}

    @property
    def empty_counts(self) -> dict[str, int]:
        """Number of fitted points without a term, for the equations that have such points."""
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

    def in_short(self) -> Result:
        """The regimes, with the equations of the largest."""
        sizes = self.regimes.table.groupby("regime")["n_points"].first()
        blocks: list[Block] = [Text(self._points_text())]
        if len(sizes):
            largest = int(sizes.to_numpy().argmax())
            lead = f"in the largest, {sizes[largest]} points"
            equations = self.regimes.equations(largest)
            blocks += [
                Equation(state, terms, lead=lead, on_screen=True)
                for state, terms in equations.items()
            ]
        return Result(
            f"Found: {regimes_text(self.regimes)}",
            blocks,
            load='xarray.open_dataset("{}/pointwise.nc")',
            picture="regimes",
        )

    def sections(self) -> list[Section]:
        about = [
            Text(f"{regimes_text(self.regimes)}."),
            Text(
                "Below, terms that act, with medians over the regime's points that have them: not "
                "every point has all of them, and coefficients spread as "
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
        """Text with the number of points, the speed, and the statuses."""
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
    """How often each term is selected and how large it is, over all fitted points.

    selected: share of the points. inclusion: share of the bootstraps that have the term, averaged
    over the points. coef, low, high: median, 16 % and 84 % over the points that have the term.
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
    """Text with the number of regimes and their certainty."""
    count = f"{regimes.n_regimes} regime{'s' if regimes.n_regimes > 1 else ''}"
    limit = ", as many as max_regimes allows: the points may bear more" if regimes.at_limit else ""
    known = regimes.confidence.values[np.isfinite(regimes.confidence.values)]
    return f"{count}{limit}; confidence below {UNSURE:g} at {(known < UNSURE).mean():.0%} of points"


def _regime_section(regimes: Regimes, regime: int) -> Section:
    """Section on one regime: its equations, and the spread of coefficients over its points."""
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
    """The spread of the terms' coefficients over a regime's points."""
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
