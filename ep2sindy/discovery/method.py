"""Discovery methods, each a single value with all settings of a search.

A `TrajectorySearch` fits states and coefficients together; a `Regression` makes rows from the runs,
and searches these. The method `identify` of both makes candidates, chooses among them and fits the
chosen ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.data.numbers import column_norms
from ep2sindy.data.sensor import bounds_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import choose, choose_system, join_choice
from ep2sindy.discovery.result import Discovery
from ep2sindy.estimation.cost import check_limit_s
from ep2sindy.estimation.estimate import Estimate, ScoredSupport, estimate
from ep2sindy.library.library import Library
from ep2sindy.regression.ambiguity import Ambiguity, ambiguities, few_rows, find_ambiguities
from ep2sindy.regression.bootstraps import Bootstraps, Resamples, Supports, draw_resamples, pool
from ep2sindy.regression.formulations import WeightedWeak
from ep2sindy.regression.front import Candidate, ParetoFront, pareto_front
from ep2sindy.regression.rows import Formulation
from ep2sindy.regression.searches import BestSubset, Search
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.runtime.values import check_kind, set_counts
from ep2sindy.selection.criteria import EBIC, Evidence, Selection

if TYPE_CHECKING:
    from ep2sindy.selection.free_run import FreeRunScore


@dataclass(frozen=True)
class Finding:
    """Supports that a method offers, without the final fit.

    kept: state -> all supports that were compared: of a regression those on its front, of a search
    of trajectories the best few of every size. selected: state -> the support of its equation, or
    None if the method offers candidates and leaves the choice to the user.
    """

    kept: Mapping[str, Sequence[frozenset[str]]]
    selected: Mapping[str, frozenset[str]] | None


@dataclass(frozen=True)
class TrajectorySearch:
    """Search by the likelihood of whole trajectories, states and coefficients fitted together.

    It is made for noisy samples of all states of a system whose law the library contains. No
    derivative is estimated, so that it finds laws that no regression can find.

    Parameters
    ----------
    max_terms : int, optional
        The most terms of one equation. None allows seven, and more where an equation of a large
        library needs them.
    align : bool, default False
        True shifts channels that lag forward. False counts a channel delay as a lack of fit of the
        model, and reports the delay.
    limit_s : float, optional
        Wall time in s after which the search ends with the best model that it has, and reports so.
    selection : Selection, default Evidence()
        `ep.discovery.Evidence()`, or a rule that runs models, such as `FreeRunScore()`.
    depth : int, default 1
        Number of candidates of each size that such a rule tests.
    courses : mapping of str to str, optional
        How each input goes from one sample to the next: "held", "linear" or "smooth". For other
        inputs the likeliest course is taken.

    Raises
    ------
    ValueError
        If max_terms or depth is below one, the limit is not positive, or the rule does not go with
        this search.

    Notes
    -----
    Minimises over the states x at all samples, the coefficients c and their support

        sum_k |(y_k - x_k) / sigma|^2 + sum_k |(F(x_k; c) - x_(k+1)) / (rho sigma)|^2
        + sum_j penalty_j

    with the samples y, their noise sigma, and the flow F of the equations over one step. rho falls
    from 0.3 (relaxed states) to 1e-4 (an exact trajectory). The penalty of a term is that of
    `ep.discovery.Evidence`. Assumes independent, normal noise, white or correlated over some
    samples.

    Source: de Jong 1991, doi:10.1214/aos/1176348139, for the filter; docs/estimation.md.

    Examples
    --------
    >>> run = ep.lotka_volterra().trajectory(noise=0.1, rng=0)
    >>> list(ep.discover(run, method=ep.TrajectorySearch(max_terms=3)).model.terms("x"))
    ['x', 'x*y']
    """

    max_terms: int | None = None
    align: bool = False
    limit_s: float | None = None
    selection: Selection = field(default_factory=Evidence)
    depth: int = 1
    courses: Mapping[str, str] | None = field(default=None, hash=False)

    def __post_init__(self) -> None:
        set_counts(self, {"depth": 1, "max_terms": 1})
        check_limit_s(self.limit_s)
        check_kind("selection", self.selection, Selection, "ep.discovery.Evidence()")
        if self.selection.basis == "rows":
            raise ValueError(
                "a search of trajectories weighs models by their likelihood: selection must "
                "be Evidence() (selection=evidence), or a rule that runs models, such as "
                f"FreeRunScore(), got {self.selection!r}. Rules of rows go with a regression, "
                "such as Regression(search=BestSubset()) (search=best_subset)"
            )

    @property
    def provenance(self) -> dict[str, str]:
        """Record in a model of how it was found."""
        return {"search": repr(self), "selection": repr(self.selection)}

    def identify(
        self, task: DiscoveryProblem, *, rng: np.random.Generator, progress: Progress = SILENT
    ) -> Discovery:
        """Estimate states and coefficients, and choose; the search is deterministic.

        Ambiguities are terms whose values at the samples are alike. Raises ValueError for roles
        with a rule that runs models.
        """
        if task.facts.roles is not None and self.selection.basis == "runs":
            raise ValueError(
                "a search of trajectories keeps roles by likelihood: selection must be Evidence(), "
                f"got {self.selection!r}; Regression(selection=FreeRunScore()) tests by runs"
            )
        found = self._estimate(task, progress)
        library = task.library.with_known_terms(task.states)
        task = DiscoveryProblem(found.runs, library)
        return replace(
            self._choose(found, task, progress),
            ambiguities=_ambiguities_of_samples(task),
            data_warnings=found.data_warnings,
            estimate=found,
        )

    def _estimate(self, task: DiscoveryProblem, progress: Progress) -> Estimate:
        provenance = self.provenance | _labels(task)
        return estimate(
            task.runs,
            task.library,
            hidden=task.hidden,
            max_terms=self.max_terms,
            align=self.align,
            courses=self.courses,
            limit_s=self.limit_s,
            provenance=provenance,
            progress=progress,
        )

    def _choose(self, found: Estimate, task: DiscoveryProblem, progress: Progress) -> Discovery:
        """Candidates of every equation with their scores, and the model by the selection rule."""
        fronts = [_front(s, found.supports[s], task.library, self.depth) for s in task.states]
        decision = self.selection.decide(fronts, task, progress=progress)
        if decision.model is not None:
            provenance = found.model.provenance
            choice = choose_system(fronts, decision, self, task.runs, provenance=provenance)
            return replace(choice, model=replace(choice.model, courses=found.model.courses))
        scored = [front.with_scores(s) for front, s in zip(fronts, decision.scores, strict=True)]
        best = [front.best for front in scored]
        choice = join_choice(scored, best, found.model, self)
        return replace(choice, note=found.note, constraint=found.constraint)

    def find(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator | int
    ) -> Finding:
        """Supports alone, as a benchmark counts them."""
        task = DiscoveryProblem(runs, library)
        found = self._estimate(task, SILENT)
        model = self._choose(found, task, SILENT).model
        return Finding(
            kept={s: [frozenset(each.coef) for each in found.supports[s]] for s in task.states},
            selected={s: frozenset(model.terms(s)) for s in task.states},
        )


def _front(
    state: str, scored: Sequence[ScoredSupport], library: Library, depth: int
) -> ParetoFront:
    """The likeliest `depth` candidates of every size, the empty support first."""
    by_size = groupby(scored, key=lambda support: len(support.coef))  # they are sorted
    ranked = [pair for _, same_size in by_size for pair in enumerate(same_size)]
    kept = [support for k, support in ranked if k < depth or support.deviance == 0.0]
    if not kept or kept[0].coef:
        kept = [ScoredSupport({}, float("inf")), *kept]
    ordered = [{name: s.coef[name] for name in library.names if name in s.coef} for s in kept]
    pairs = zip(ordered, kept, strict=True)
    return ParetoFront(state, [Candidate.of(state, coef, s.deviance) for coef, s in pairs])


def _ambiguities_of_samples(task: DiscoveryProblem) -> tuple[Ambiguity, ...]:
    """Terms whose values at the samples cannot be distinguished."""
    theta = task.theta
    theta = theta / column_norms(theta)
    return find_ambiguities(task.library, lambda: theta, theta.T @ theta)


@dataclass(frozen=True, eq=False)
class SearchedEquation:
    """One equation of a regression after the search.

    draws: the bootstraps of its rows. number: its index among the equations of those rows.
    found: supports proposed by the search in every draw. supports: the same, pooled. front: their
    fits.
    """

    draws: Resamples
    number: int
    found: Sequence[Bool[np.ndarray, "_ terms"]]
    supports: Supports
    front: ParetoFront


@dataclass(frozen=True)
class Regression:
    """Search by regression: a formulation makes rows, and a search proposes supports for them.

    The search runs in every bootstrap of the rows. Each proposed support is fitted to all training
    rows, the best of every size form the front, and the rule selects one per equation. If the noise
    of the samples is propagated into the rows, the selected terms are fitted again with weights.
    `Regression()` is the best regression that we know; the example shows that of the thesis.

    Parameters
    ----------
    formulation : Formulation, default WeightedWeak()
        How samples become rows: `Differential`, `Weak` or `WeightedWeak`.
    search : Search, default BestSubset()
        What proposes supports: `BestSubset`, `AdaptiveLasso` or `STLSQ`.
    selection : Selection, default EBIC()
        What selects a candidate of the front: `EBIC`, `Knee` or `FreeRunScore`.
    bootstraps : Bootstraps, default Bootstraps(n=0)
        How often the search is repeated on random rows. With n = 0 it runs once, on all training
        rows.
    depth : int, default 1
        Number of candidates of each size on the front. 3 lets a true support be selected that noise
        has ranked second or third.

    Raises
    ------
    ValueError
        If a value is not a formulation, search, rule or bootstraps, or depth is below one.

    Notes
    -----
    Every support S is fitted by least squares,

        minimise |y - X_S b|^2 over b

    with one row of y and X per sample or window, in the unit of the derivative. The search and the
    rule state their own objectives.

    Examples
    --------
    >>> thesis = ep.Regression(ep.Differential(), ep.AdaptiveLasso(), ep.Knee(), ep.Bootstraps())
    >>> run = ep.lotka_volterra().trajectory(noise=0.01, rng=0)
    >>> list(ep.discover(run, method=thesis, seed=0).model.terms("x"))
    ['x', 'x*y']
    """

    formulation: Formulation = field(default_factory=WeightedWeak)
    search: Search = field(default_factory=BestSubset)
    selection: Selection = field(default_factory=EBIC)
    bootstraps: Bootstraps = field(default_factory=lambda: Bootstraps(n=0))
    depth: int = 1

    def __post_init__(self) -> None:
        check_kind("formulation", self.formulation, Formulation, "ep.WeightedWeak()")
        check_kind("search", self.search, Search, "ep.BestSubset()")
        check_kind("bootstraps", self.bootstraps, Bootstraps, "ep.Bootstraps(n=0)")
        check_kind("selection", self.selection, Selection, "ep.EBIC()")
        if self.selection.basis == "likelihood":
            raise ValueError(
                "Evidence weighs what a search of trajectories found, and a regression has rows: "
                "take TrajectorySearch() (search=trajectory), or select by EBIC() (selection=ebic)"
            )
        set_counts(self, {"depth": 1})

    @property
    def provenance(self) -> dict[str, str]:
        """Record in a model of how it was found."""
        names = ("formulation", "search", "bootstraps", "selection")
        return {name: repr(getattr(self, name)) for name in names}

    def identify(
        self, task: DiscoveryProblem, *, rng: np.random.Generator, progress: Progress = SILENT
    ) -> Discovery:
        """Assemble rows, search them, and choose. Raises ValueError for hidden states."""
        if task.hidden:
            raise ValueError(
                f"a regression needs samples of every state, got {list(task.hidden)} as hidden; "
                "take TrajectorySearch(), or make states of a signal by ep.embed"
            )
        if any(run.missing is not None for run in task.runs):
            task = replace(task, runs=[run.complete() for run in task.runs])
        if task.facts.roles is None:
            equations = self.search_equations(task, rng=rng, progress=progress)
            fronts = [equation.front for equation in equations]
            choice = self.choose(fronts, task, progress=progress)
        else:
            choice = self._choose_under(task, rng=rng, progress=progress)
        found: list[Ambiguity] = []
        for rows in dict.fromkeys(front.rows for front in choice.fronts.values()):
            # Known equations are not searched, so too few rows do no harm to them.
            if not set(rows.equations) <= set(task.facts.only):
                found += few_rows(rows)
            found += ambiguities(rows)
        data_warnings = _limits(task.runs)
        return replace(choice, ambiguities=tuple(dict.fromkeys(found)), data_warnings=data_warnings)

    @property
    def rule_of_systems(self) -> FreeRunScore:
        """The selection, as a search under roles needs it. Raises ValueError for other rules."""
        from ep2sindy.selection.free_run import FreeRunScore  # loads torch

        if not isinstance(self.selection, FreeRunScore):
            raise ValueError(
                "roles tie all equations together, so a rule must rank whole systems: selection "
                f"must be FreeRunScore(), got {self.selection!r}"
            )
        return self.selection

    def _choose_under(
        self, task: DiscoveryProblem, *, rng: np.random.Generator, progress: Progress
    ) -> Discovery:
        """Search all equations at once for systems that keep the roles, and let the rule decide.

        The search is made once, on all training rows: bootstraps weigh one equation at a time.
        """
        from ep2sindy.selection.conserving import search_conserving_systems  # loads torch

        rule = self.rule_of_systems
        library = task.library.with_known_terms(task.states)
        with progress.stage(None, "", "rows of the regression"):
            problems = self.formulation.assemble(task.runs, library, rng=rng)
        (systems,) = search_conserving_systems([(task, problems)], self.search, depth=self.depth)
        decision = rule.assess(systems, task.runs, progress=progress)
        provenance = self.provenance | _labels(task)
        return choose_system(systems.fronts, decision, self, task.runs, provenance=provenance)

    def search_equations(
        self, task: DiscoveryProblem, *, rng: np.random.Generator | int, progress: Progress = SILENT
    ) -> list[SearchedEquation]:
        """Assemble the rows, search every bootstrap of them, and fit the supports found."""
        rng, equations = np.random.default_rng(rng), []
        with progress.stage(None, "", "rows of the regression"):
            problems = self.formulation.assemble(task.runs, task.library, rng=rng)
        for problem in problems:
            with progress.stage(None, "", "draws of rows"):
                draws = draw_resamples(problem, self.bootstraps, rng=rng)
            for k, equation in enumerate(problem.equations):
                with progress.stage(len(draws.xx), "draw", f"search for {equation}'") as advance:
                    allowed = task.library.allowed(equation)
                    proposed = draws.search(self.search, k, advance, allowed=allowed)
                found = task.complete(equation, proposed)
                supports = pool(draws, k, found)
                front = pareto_front(problem, supports, depth=self.depth)
                equations.append(SearchedEquation(draws, k, found, supports, front))
        return equations

    def choose(
        self, fronts: Sequence[ParetoFront], task: DiscoveryProblem, *, progress: Progress = SILENT
    ) -> Discovery:
        """Select a candidate from every front, and fit it."""
        provenance = self.provenance | _labels(task)
        return choose(fronts, self, task, provenance=provenance, progress=progress)

    def find(
        self, runs: Sequence[Trajectory], library: Library, *, rng: np.random.Generator | int
    ) -> Finding:
        """Supports alone, as a benchmark counts them."""
        task = DiscoveryProblem(runs, library)
        fronts = [e.front for e in self.search_equations(task, rng=rng)]
        scores = self.selection.decide(fronts, task).scores
        chosen = [f.with_scores(s).best for f, s in zip(fronts, scores, strict=True)]
        return Finding(
            kept={f.equation: [frozenset(c.terms) for c in f.candidates] for f in fronts},
            selected={c.equation: frozenset(c.terms) for c in chosen},
        )


AnyMethod = TrajectorySearch | Regression


def _labels(task: DiscoveryProblem) -> dict[str, str]:
    return {"trajectories": ", ".join(run.label for run in task.runs)}


def _limits(runs: Sequence[Trajectory]) -> tuple[str, ...]:
    """Remarks on clipped or rounded samples, for regressions on rows."""
    found = [bounds_of(run.states, run.state_names) for run in runs]
    words = dict.fromkeys(each for bounds in found if bounds for each in bounds.words)
    hint = "rows take them for values; TrajectorySearch() reads them as limits"
    return tuple(f"{each}: {hint}" for each in words)


def of_means(method: AnyMethod) -> AnyMethod:
    """A method for samples that are means: those of an input that is held change linearly."""
    if not isinstance(method, TrajectorySearch) or not method.courses:
        return method
    courses = {n: "linear" if how == "held" else how for n, how in method.courses.items()}
    return replace(method, courses=courses)


def method_of(
    formulation: Formulation,
    search: TrajectorySearch | Search,
    bootstraps: Bootstraps,
    selection: Selection,
    depth: int,
) -> AnyMethod:
    """The method for settings that are chosen one by one, such as the groups of a config.

    A `TrajectorySearch` takes the rule and the depth, unless its own are set, and ignores the
    formulation: it makes no rows, but experiments may make some next to it.
    Raises ValueError for bootstraps that do not go with the search, or a rule or depth that differs
    from the search's own.
    """
    if not isinstance(search, TrajectorySearch):
        return Regression(formulation, search, selection, bootstraps, depth)
    if bootstraps.n:
        raise ValueError(
            f"a search of trajectories draws no bootstraps, got {bootstraps!r}; take "
            "Bootstraps(n=0) (bootstraps=none), or a regression"
        )
    set_here: dict[str, Any] = {}
    for name, given in (("selection", selection), ("depth", depth)):
        own, default = getattr(search, name), getattr(TrajectorySearch(), name)
        if given != default:  # a config always has a value there
            if own not in (default, given):
                raise ValueError(
                    f"{name} must be set once, got {own!r} in the search (search.{name}), and "
                    f"{given!r} next to it; leave one of them out"
                )
            set_here[name] = given
    return replace(search, **set_here)
