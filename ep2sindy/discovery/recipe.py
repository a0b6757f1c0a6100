"""The recipe: how equations are searched for, in one value that every discovery takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool

from ep2sindy.constraints.relations import Relation, completed
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation.estimate import Estimate, estimate
from ep2sindy.estimation.solver import Joint
from ep2sindy.library.library import Library
from ep2sindy.regression.rows import Formulation
from ep2sindy.regression.weak import WeightedWeak
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.search.bootstraps import Bootstraps, Resamples, Supports, pooled, resamples
from ep2sindy.search.front import ParetoFront, pareto_front
from ep2sindy.search.searches import BestSubset, Search
from ep2sindy.selection.criteria import EBIC, Evidence
from ep2sindy.selection.rule import Selection, SystemSelection, selected


@dataclass(frozen=True)
class Asked:
    """What a user knows of the equations before they are searched.

    relations: between coefficients. terms: by state, of an equation that is known but for its
    coefficients; it is not searched.
    """

    relations: Sequence[Relation] = ()
    terms: Mapping[str, Sequence[str]] = field(default_factory=dict)

    def of(
        self, equation: str, library: Library, found: Sequence[Bool[np.ndarray, "_ terms"]]
    ) -> list[Bool[np.ndarray, "_ terms"]]:
        """What was found for an equation in every draw, as far as it agrees with what is known.

        Raises ValueError for a term that the library does not have.
        """
        if equation in self.terms:
            known = np.zeros((1, len(library)), dtype=np.bool_)
            known[0, [library.index(name) for name in self.terms[equation]]] = True
            return [known] * len(found)
        if not self.relations:
            return list(found)
        return [completed(masks, library, equation, self.relations) for masks in found]


@dataclass(frozen=True, eq=False)
class SearchedEquation:
    """One equation after the search.

    draws: the bootstraps of its rows. number: its place among the equations of those rows.
    found: what the search proposed in every draw. supports: the same, pooled. front: their fits.
    """

    draws: Resamples
    number: int
    found: Sequence[Bool[np.ndarray, "_ terms"]]
    supports: Supports
    front: ParetoFront


@dataclass(frozen=True)
class Finding:
    """Supports that a method offers, without the last fit.

    kept: state -> the supports on its front. selected: state -> the support of its equation, or
    None where the method offers candidates and leaves the choice to the user.
    """

    kept: Mapping[str, Sequence[frozenset[str]]]
    selected: Mapping[str, frozenset[str]] | None


def check_kind(name: str, value: object, kind: type, example: str) -> None:
    """Raise ValueError for a value of another kind, or a class where a value is meant."""
    if isinstance(value, type) or not isinstance(value, kind):
        raise ValueError(f"{name} must be a {kind.__name__}, such as {example}: {value!r} came")


def check_asked(asked: Asked, library: Library, states: Sequence[str]) -> None:
    """Raise ValueError for a state or a term that is not there, or an equation without terms."""
    named = [(state, term) for r in asked.relations for _, state, term in r.factors]
    named += [(state, term) for state, terms in asked.terms.items() for term in terms]
    for state, term in named:
        if state not in states:
            raise ValueError(f"unknown state {state!r}; there are {list(states)}")
        library.index(term)
    if empty := [state for state, terms in asked.terms.items() if not terms]:
        raise ValueError(f"an equation whose terms are given must have some: {empty} has none")


@dataclass(frozen=True)
class Recipe:
    """How equations are searched for: with nothing asked, the route that finds known systems most
    often in noise (docs/estimation.md), `Recipe(search=Joint())`.

    A `Joint` search fits whole trajectories; the formulation's rows then serve tables alone.
    Whoever names a formulation, bootstraps or a rule that judges rows asks for a regression. Its
    best route is Recipe(WeightedWeak()), the thesis's
    Recipe(Differential(), AdaptiveLasso(), Bootstraps(), Knee()).
    formulation: None means WeightedWeak(). search: None means Joint(), or BestSubset() for a
    regression. bootstraps: None means none. selection: None means Evidence(), or EBIC() for one.
    depth: candidates kept per size: 3 lets a true support win that noise has put second or third.
    Raises ValueError for a rule or bootstraps that do not go with the search.

    >>> thesis = ep.Recipe(ep.Differential(), ep.AdaptiveLasso(), ep.Bootstraps(), ep.Knee())
    >>> run = ep.lotka_volterra().trajectory(noise=0.01, rng=0)
    >>> list(ep.discover(run, recipe=thesis, seed=0).model.terms("x"))
    ['x', 'x*y']
    """

    formulation: Formulation = None  # type: ignore[assignment]  # __post_init__ sets all of them
    search: Joint | Search = None  # type: ignore[assignment]
    bootstraps: Bootstraps = None  # type: ignore[assignment]
    selection: Selection = None  # type: ignore[assignment]
    depth: int = 1

    def __post_init__(self) -> None:
        rows_asked = self.formulation is not None or self.bootstraps is not None
        if self.search is None:
            joint = not rows_asked and isinstance(self.selection, Evidence | None)
            object.__setattr__(self, "search", Joint() if joint else BestSubset())
        joint = isinstance(self.search, Joint)
        for name, value in {
            "formulation": WeightedWeak(),
            "bootstraps": Bootstraps(n=0),
            "selection": Evidence() if joint else EBIC(),
        }.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        check_kind("formulation", self.formulation, Formulation, "ep.WeightedWeak()")
        if not joint:
            check_kind("search", self.search, Search, "ep.BestSubset()")
        check_kind("bootstraps", self.bootstraps, Bootstraps, "ep.Bootstraps(n=0)")
        check_kind("selection", self.selection, Selection, "ep.EBIC()")
        if joint and not isinstance(self.selection, Evidence | SystemSelection):
            raise ValueError(
                "a joint search weighs models by the likelihood of trajectories: selection must "
                "be Evidence() (selection=evidence), or a rule that runs models, such as "
                f"FreeRunScore(): {self.selection!r} came. Rules of rows go with a regression, "
                "such as BestSubset() (search=best_subset)"
            )
        if joint and self.bootstraps.n:
            raise ValueError(
                f"a joint search draws no bootstraps: {self.bootstraps!r} came; take "
                "Bootstraps(n=0) (bootstraps=none), or a regression"
            )
        if type(self.depth) is not int or self.depth < 1:
            raise ValueError(f"depth must be a whole number, one or more: {self.depth!r} came")

    def searched(
        self,
        runs: Sequence[Trajectory],
        library: Library,
        asked: Asked | None = None,
        *,
        rng: np.random.Generator | int,
        progress: Progress = SILENT,
    ) -> list[SearchedEquation]:
        """Assemble the rows, search every bootstrap of them, and fit what is found.

        Raises ValueError for a joint search: it has no rows.
        """
        if isinstance(self.search, Joint):
            raise ValueError(
                "a joint search fits whole trajectories, and serves discover() and the experiments "
                f"discover, breathing and benchmark: {self.search!r} came; use BestSubset here"
            )
        rng, asked = np.random.default_rng(rng), asked or Asked()
        equations = []
        with progress.stage(None, "", "rows of the regression"):
            problems = self.formulation.assemble(runs, library, rng=rng)
        for problem in problems:
            with progress.stage(None, "", "draws of rows"):
                draws = resamples(problem, self.bootstraps, rng=rng)
            for k, equation in enumerate(problem.equations):
                with progress.stage(len(draws.xx), "draw", f"search for {equation}'") as advance:
                    proposed = draws.searched(self.search, k, advance)
                found = asked.of(equation, library, proposed)
                supports = pooled(draws, k, found)
                front = pareto_front(problem, supports, depth=self.depth)
                equations.append(SearchedEquation(draws, k, found, supports, front))
        return equations

    def find(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator | int
    ) -> Finding:
        """The supports alone: what a benchmark counts."""
        if isinstance(self.search, Joint):
            return _finding(estimate(runs, library, self.search))
        rng = np.random.default_rng(rng)
        fronts = [equation.front for equation in self.searched(runs, library, rng=rng)]
        scores = self.selection.scores(fronts)
        chosen = [selected(*pair) for pair in zip(fronts, scores, strict=True)]
        return Finding(
            kept={f.equation: [frozenset(c.terms) for c in f.candidates] for f in fronts},
            selected={c.equation: frozenset(c.terms) for c in chosen},
        )

    @property
    def provenance(self) -> dict[str, str]:
        """What a model remembers of how it was found."""
        names = ("formulation", "search", "bootstraps", "selection")
        return {name: repr(getattr(self, name)) for name in names}


def _finding(found: Estimate) -> Finding:
    states = found.model.states
    return Finding(
        kept={s: [frozenset(w.coef) for w in found.weighed[s]] for s in states},
        selected={s: frozenset(found.model.terms(s)) for s in states},
    )
