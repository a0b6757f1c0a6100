"""Several libraries on the same data, side by side: `+exp=breathing`, `+exp=discover`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd
import xarray as xr

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.recipe import Recipe
from ep2sindy.library.library import Library, polynomial
from ep2sindy.model.integrated import Integrated
from ep2sindy.model.model import SparseModel
from ep2sindy.report.document import Captioned, Section
from ep2sindy.report.run import Run
from ep2sindy.studies.kinds import Coefficients, PositiveOrAll
from ep2sindy.studies.libraries_view import comparison, drawings, front_tables, sections, summary
from ep2sindy.studies.library_result import LibraryResult, result_of
from ep2sindy.studies.shown import Shown, rollout_tables
from ep2sindy.studies.source import Source


@dataclass(frozen=True)
class LibraryCase:
    """A polynomial library; variables_if_present are left out where the field lacks them.

    n_norm: what a knee takes for this library, if not what the recipe says.
    """

    variables: Sequence[str]
    degree: int
    variables_if_present: Sequence[str] = ()
    products: Sequence[str] = ()
    n_norm: str | None = None

    def library(self, data: xr.Dataset) -> Library:
        optional = [name for name in self.variables_if_present if name in data]
        names = [*self.variables, *optional]
        return polynomial(names, degree=self.degree, products=list(self.products))

    def recipe(self, recipe: Recipe) -> Recipe:
        """The recipe that all libraries share, with this one's norm where the rule has one."""
        if self.n_norm is None or not hasattr(recipe.selection, "n_norm"):
            return recipe
        rule: Any = recipe.selection
        return replace(recipe, selection=replace(rule, n_norm=self.n_norm))


@dataclass(frozen=True)
class Study:
    """Discover a model with every library, integrate it from the first sample, compare.

    rollout_s: how far to integrate; None, or more than there is, means to the data's end.
    thesis: by library, published equations: state -> term -> SI coefficient; where the library
    has the terms, and the data can tell them from others, they are fitted as well.
    """

    source: Source
    recipe: Recipe
    libraries: Mapping[str, LibraryCase]
    rollout_s: PositiveOrAll
    figures: Shown
    thesis: Mapping[str, Coefficients] = field(default_factory=dict)

    def compute(self, run: Run) -> Outcome:
        recipes = {name: case.recipe(self.recipe) for name, case in self.libraries.items()}
        opened = self.source.field()
        libraries = {name: case.library(opened) for name, case in self.libraries.items()}
        data = self.source.sampled(opened, libraries.values(), run)
        # Each case draws from its own stream, so that adding a case changes no other.
        streams = np.random.default_rng(run.seed).spawn(len(libraries))
        results = {
            name: result_of(
                data, library, recipes[name], self.thesis.get(name, {}), self.rollout_s, rng=rng
            )
            for (name, library), rng in zip(libraries.items(), streams, strict=True)
        }
        return Outcome(self, data, results)


@dataclass(frozen=True, eq=False)
class Outcome:
    """What every library found in the same data."""

    study: Study
    data: Trajectory
    results: Mapping[str, LibraryResult]

    @property
    def integrated(self) -> dict[str, Integrated]:
        """Selected models by library, then those of published terms."""
        selected = {name: r.selected for name, r in self.results.items()}
        published = {
            f"{name}, thesis's terms": r.published
            for name, r in self.results.items()
            if r.published is not None
        }
        return selected | published

    def models(self) -> dict[str, SparseModel]:
        return {name: result.discovery.model for name, result in self.results.items()}

    def tables(self) -> dict[str, pd.DataFrame]:
        found = {}
        for name, result in self.results.items():
            found[f"front_{name}"] = front_tables(result)
            found[f"ambiguities_{name}"] = pd.DataFrame(
                [(a.exact, " ".join(a.terms), a.message) for a in result.discovery.ambiguities],
                columns=["exact", "terms", "message"],
            )
        files = {
            name.replace(", ", "_").replace("'s ", "_").replace(" ", "_"): each
            for name, each in self.integrated.items()
        }
        found |= rollout_tables(self.data, files)
        return found | {"comparison": comparison(self.data, self.integrated)}

    def figures(self) -> dict[str, Captioned]:
        return drawings(self.data, self.results, self.study.figures)

    def sections(self) -> list[Section]:
        return sections(self.data, self.results, self.integrated)

    def summary(self) -> dict[str, Any]:
        return summary(self.data, self.results)

    def headline(self) -> dict[str, float]:
        scalars = {}
        for name, result in self.results.items():
            first = self.data.state_names[0]
            scalars[f"{name}/f_kHz"] = 1e-3 * result.selected.frequency_Hz[first]
            scalars[f"{name}/nrmse"] = result.selected.nrmse
            for state, chosen in result.discovery.chosen.items():
                scalars[f"{name}/{state}/r2_test"] = chosen.r2_test
                scalars[f"{name}/{state}/n_terms"] = float(chosen.n_terms)
                score = float(result.discovery.scores[state].min())
                scalars[f"{name}/{state}/{result.recipe.selection.label}"] = score
        return scalars
