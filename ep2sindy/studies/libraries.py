"""Several libraries on the same data, side by side: `+exp=breathing`, `+exp=discover`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.method import AnyMethod, Regression
from ep2sindy.library.library import Library, polynomial
from ep2sindy.machine.progress import counted
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.run import Run
from ep2sindy.search.bootstraps import Bootstraps
from ep2sindy.selection.criteria import Knee
from ep2sindy.signals.attractor import find_cycle
from ep2sindy.studies.functions import registered
from ep2sindy.studies.kinds import Coefficients, PositiveOrAll, Share
from ep2sindy.studies.libraries_view import Outcome
from ep2sindy.studies.library_result import result_of
from ep2sindy.studies.living import LivingSearch
from ep2sindy.studies.shown import Shown
from ep2sindy.studies.source import Source, zone_length_m
from ep2sindy.studies.term_roles import Compared


@dataclass(frozen=True)
class LibraryCase:
    """A polynomial library; variables_if_present are left out where the field lacks them.

    functions, function_degree: as `ep.polynomial` takes them; `my_module.tanh` is the function that
    my_module registers by that name. n_norm: what a knee takes for this library, if not what the
    recipe says.
    """

    variables: Sequence[str]
    degree: int
    variables_if_present: Sequence[str] = ()
    products: Sequence[str] = ()
    functions: Sequence[str] = ()
    function_degree: int = 1
    n_norm: str | None = None

    def library(self, data: xr.Dataset) -> Library:
        optional = [name for name in self.variables_if_present if name in data]
        names = [*self.variables, *optional]
        return polynomial(
            names,
            degree=self.degree,
            products=list(self.products),
            functions=registered(self.functions),
            function_degree=self.function_degree,
        )

    def recipe(self, recipe: AnyMethod) -> AnyMethod:
        """The recipe that all libraries share, with this one's norm where the rule has one."""
        if self.n_norm is None or not isinstance(recipe.selection, Knee):
            return recipe
        return replace(recipe, selection=replace(recipe.selection, n_norm=self.n_norm))


@dataclass(frozen=True)
class Study:
    """Discover a model with every library, integrate it from the first sample, compare.

    formulation, bootstraps: of rows, also where the recipe searches trajectories. rollout_s: how
    far to integrate; None, or more than there is, means to the data's end.
    thesis: by library, published equations: state -> term -> SI coefficient; where the library
    has the terms, and the data can tell them from others, they are fitted as well. living: how
    libraries without inputs are searched for a model that lives; None leaves that out. held_out:
    the last share of the record, which judges such a model. compared: what its terms are held
    against.
    """

    source: Source
    recipe: AnyMethod
    formulation: Formulation
    bootstraps: Bootstraps
    libraries: Mapping[str, LibraryCase]
    rollout_s: PositiveOrAll
    figures: Shown
    thesis: Mapping[str, Coefficients] = field(default_factory=dict)
    living: LivingSearch | None = None
    held_out: Share = 0.25
    compared: Compared | None = None

    def compute(self, run: Run) -> Outcome:
        recipes = {name: case.recipe(self.recipe) for name, case in self.libraries.items()}
        with run.progress(None, "", "data"):
            opened = self.source.fields()
        libraries = {name: case.library(opened[0]) for name, case in self.libraries.items()}
        runs = [self.source.sampled(field, libraries.values(), run) for field in opened]
        data = runs[0]
        if len(runs) > 1:
            run.say(f"{len(runs)} records in one search; figures show the first")
        if hint := alone(data):
            run.warn(hint)
        # Each case draws from its own stream, so that adding a case changes no other.
        streams = np.random.default_rng(run.seed).spawn(len(libraries))
        pairs = list(zip(libraries.items(), streams, strict=True))
        rows = Regression(self.formulation, bootstraps=self.bootstraps)
        results = {
            name: result_of(
                runs,
                library,
                recipes[name],
                rows,
                self.thesis.get(name, {}),
                self.rollout_s,
                self.living,
                self.held_out,
                self.compared,
                zone_length_m(self.source, opened[0]),
                rng=rng,
                progress=run.watch,
            )
            for (name, library), rng in counted(run.watch, pairs, "library")
        }
        for name, result in results.items():
            if result.discovery.misfit:
                run.warn(f"{name}: {result.discovery.misfit}")
        files = [str(field.attrs.get("file", "")) for field in opened]
        return Outcome(data, results, self.figures, self.formulation.smoother, files)


def alone(data: Trajectory) -> str | None:
    """What to say where one state without inputs is asked to oscillate; else None."""
    if len(data.names) > 1 or find_cycle(data.t, data.states) is None:
        return None
    (name,) = data.names
    return (
        f"{name} oscillates, and one first-order equation cannot: where it rises it never falls "
        f"again. Name a second state, or let +exp=trace signal={name} make one of the signal"
    )
