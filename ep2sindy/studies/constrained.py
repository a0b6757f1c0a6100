"""Fits with relations between coefficients, compared to fits without: `+exp=constrained`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint, constraint
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.results import facts
from ep2sindy.report.run import Run
from ep2sindy.runtime.progress import count_pieces
from ep2sindy.studies.fits import (
    METHOD,
    Outcome,
    Relations,
    Terms,
    fit_and_evaluate,
    held_out_outcome,
    split_in_time,
    terms_of,
)
from ep2sindy.studies.source import Source
from ep2sindy.studies.study import Check, Share
from ep2sindy.studies.views import PlotRange

KINDS = ("base", "constrained")


@dataclass(frozen=True)
class ModelCase:
    """The terms of every state, and the relations between their coefficients."""

    terms: Terms
    relations: Relations

    def constraints(self, name: str, states: Sequence[str]) -> tuple[Library, list[Constraint]]:
        """A library of the terms, and the constraints of the fits without and with relations."""
        library, terms = terms_of(self.terms, states=states, key=f"models.{name}.terms")
        return library, [constraint(library, terms, given) for given in ((), self.relations)]


Models = Annotated[
    Mapping[str, ModelCase],
    Check(
        "like {name: {terms: {x: [x, x*y]}, relations: [..]}}",
        lambda value: isinstance(value, dict) and bool(value),
    ),
]


@dataclass(frozen=True)
class Study:
    """Fit every model with and without its relations, and test it on the end of the record."""

    source: Source
    formulation: Formulation
    models: Models
    held_out: Share
    figures: PlotRange

    def compute(self, run: Run) -> Outcome:
        models = {n: case.constraints(n, self.source.states) for n, case in self.models.items()}
        libraries = [library for library, _ in models.values()]
        _, data = self.source.opened(libraries, run)
        train, held = split_in_time(data, self.held_out)
        judged, labels, findings = {}, {}, {}
        streams = np.random.default_rng(run.seed).spawn(len(models))
        pairs = list(zip(models.items(), streams, strict=True))
        for (name, (library, constraints)), stream in count_pieces(
            run.watch, pairs, "model", "fits and free runs"
        ):
            # Both fits use the same random numbers, so that they differ by the constraint alone.
            seed = int(stream.integers(2**63))
            for kind, each in zip(KINDS, constraints, strict=True):
                rng = np.random.default_rng(seed)
                fit = fit_and_evaluate(train, held, library, each, self.formulation, rng=rng)
                judged[f"{name}_{kind}"] = fit
                labels[f"{name}_{kind}"] = f"{name.replace('_', ' ')}, {kind}"
            findings[name] = {kind: facts(judged[f"{name}_{kind}"], METHOD) for kind in KINDS}
        relations = dict.fromkeys(text for case in self.models.values() for text in case.relations)
        return held_out_outcome(
            train, held, judged, labels, list(relations), self.figures, {"models": findings}
        )
