"""The algorithm on one screen: trajectories and a library in, fronts and a model out."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.last_fit import assemble_model, reweighted
from ep2sindy.library.library import Library
from ep2sindy.machine.screen import N_LINES, one_screen
from ep2sindy.model.display import model_html, model_lines
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.ambiguity import Ambiguity, ambiguities
from ep2sindy.regression.rows import Formulation
from ep2sindy.search.bootstraps import Bootstraps, pooled_supports
from ep2sindy.search.front import Candidate, ParetoFront, pareto_front
from ep2sindy.search.searches import Search
from ep2sindy.selection.rule import Selection, selected

MOST_NOTES = 6  # on a screen


@dataclass(frozen=True, eq=False)
class Discovery:
    """What a search leaves: per state a front, scores and the selected candidate; the model.

    scores: by state, one per candidate of its front, the lowest selected.
    ambiguities: terms that these data cannot tell apart.
    """

    fronts: Mapping[str, ParetoFront] = field(repr=False)
    scores: Mapping[str, Float[np.ndarray, " candidates"]] = field(repr=False)
    chosen: Mapping[str, Candidate]
    model: SparseModel = field(repr=False)
    ambiguities: Sequence[Ambiguity]

    def __repr__(self) -> str:
        notes = [f"note: {a.message}" for a in self.ambiguities][:MOST_NOTES]
        left = len(self.ambiguities) - len(notes)
        tail = [*notes, *([f"... {left} more notes"] if left else [])]
        body = model_lines(self.model, n_lines=N_LINES - 1 - len(tail))
        return one_screen([self._headline(), *body, *tail])

    def _repr_html_(self) -> str:
        notes = "".join(f"<li>{html.escape(a.message)}</li>" for a in self.ambiguities)
        head = f"<div>{html.escape(self._headline())}</div>"
        return head + model_html(self.model) + (f"<ul>{notes}</ul>" if notes else "")

    def _headline(self) -> str:
        rule = self.model.provenance.get("selection", "a rule unknown")
        return f"Discovery of {len(self.chosen)} equations, chosen by {rule}"


def discover(
    trajectories: Sequence[Trajectory],
    library: Library,
    *,
    formulation: Formulation,
    search: Search,
    bootstraps: Bootstraps,
    selection: Selection,
    depth: int = 1,
    rng: np.random.Generator,
) -> Discovery:
    """Find sparse equations for every state of the trajectories.

    Rows are assembled by `formulation`; `search` proposes supports in every bootstrap; each
    support is fitted to all training rows, and the `depth` best of every size make the front;
    `selection` picks one per equation. Where the formulation follows the noise of the samples
    into the rows, the picked terms are fitted again with weights, and their covariance known.
    """
    problems = formulation.assemble(trajectories, library, rng=rng)
    fronts = [
        pareto_front(problem, found, depth=depth)
        for problem in problems
        for found in pooled_supports(problem, search, bootstraps, rng=rng)
    ]
    scores = selection.scores(fronts)
    chosen = [selected(front, score) for front, score in zip(fronts, scores, strict=True)]
    model = assemble_model(
        library,
        [
            candidate if front.problem.noisy is None else reweighted(front.problem, candidate)
            for front, candidate in zip(fronts, chosen, strict=True)
        ],
        units=trajectories[0].units,
        provenance={
            "formulation": repr(formulation),
            "search": repr(search),
            "bootstraps": repr(bootstraps),
            "selection": repr(selection),
            "trajectories": ", ".join(run.label for run in trajectories),
        },
    )
    states = [front.equation for front in fronts]
    return Discovery(
        fronts=dict(zip(states, fronts, strict=True)),
        scores=dict(zip(states, scores, strict=True)),
        chosen=dict(zip(states, chosen, strict=True)),
        model=model,
        ambiguities=tuple(dict.fromkeys(a for problem in problems for a in ambiguities(problem))),
    )
