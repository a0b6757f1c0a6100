"""Equations at several operating points: one structure for all, its coefficients, and their law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import chain, product
from math import prod

import numpy as np
from jaxtyping import Float

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.data.trajectory import Trajectory, point_label
from ep2sindy.discovery.choice import join_choice
from ep2sindy.discovery.method import Regression, TrajectorySearch
from ep2sindy.discovery.result import Discovery, DiscoveryMethod, join_points
from ep2sindy.discovery.shared_support import SharedFront, check_shared, search_shared
from ep2sindy.library.library import Library
from ep2sindy.library.roles import Roles
from ep2sindy.model.model import SparseModel
from ep2sindy.operating.law import (
    LawConstraint,
    LawFunctions,
    constrain_law,
    constrain_roles,
    read_law,
)
from ep2sindy.operating.left_out import (
    ALIKE,
    MOST,
    LawChoice,
    LawTrial,
    choose_law,
    follow_together,
    leave_out,
)
from ep2sindy.operating.point_fits import PointFits, fit_rows, fit_trajectories
from ep2sindy.operating.quiet import QuietPoint, quiet_points
from ep2sindy.operating.records import OperatingRecord, branches_of, values_of
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.refinement.windows import PERIODS
from ep2sindy.regression.ambiguity import ambiguities
from ep2sindy.regression.formulations import Differential, RandomSplit
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import BestSubset
from ep2sindy.runtime.parallel import Workers, collect
from ep2sindy.runtime.progress import Progress, count_pieces
from ep2sindy.selection.conserving import search_conserving_systems
from ep2sindy.selection.criteria import EBIC
from ep2sindy.selection.free_run import FreeRunScore
from ep2sindy.selection.systems import Systems, Trial, best_together

Problems = Mapping[str, Sequence[RegressionRows]]  # by the label of the point

# Windows of the refinements; and if a state was made of another one, and is less certain.
WINDOWS = RefinementSettings(n_windows=20, periods=2.0)
LONG_WINDOWS = RefinementSettings(n_windows=10, periods=8.0)

# Most structures that are compared by their laws, and sizes of the supports that they combine: of
# measured states, and of one that was made of another.
MOST_COMBINED, SIZES, MADE_SIZES = 27, (2, 3, 4), (3, 4, 5, 6)

N_UNDER_ROLES, N_ALIKE = 6, 3  # structures under roles whose laws are compared, and of one size

MOST_FOLLOWED = 20  # windows of each record, on which a law of all points is fitted

FOUND, REFINED = "found", "_refined"  # names of structures, and the end of that of a refinement


@dataclass(frozen=True)
class LawSearch:
    """How one law over operating points is found; `ep.discover(runs, law=...)` takes it.

    Parameters
    ----------
    functions : int, Library, "auto" or list of these, default "auto"
        Of the parameters: see `ep.discover`.
    windows : RefinementSettings, optional
        Windows of trajectories on which the coefficients of every point are refined. None takes 20
        of two periods after a `TrajectorySearch`, or ten of eight if one state was made of another,
        as by `ep.embed`; under a rule that runs models, of as many periods as this takes. After any
        other `Regression` the coefficients stay those of its rows.
    name : str, default ""
        What the likeliest structure is called among the laws that are compared. None of them has a
        name of its own by default: they are found_1, found_2 and so on.

    Examples
    --------
    >>> windows = ep.refinement.RefinementSettings(n_windows=20, periods=4.0)
    >>> ep.discovery.LawSearch(1, windows).functions
    1
    """

    functions: LawFunctions | Sequence[LawFunctions] = "auto"
    windows: RefinementSettings | None = None
    name: str = ""


def discover_together(
    asked: DiscoveryProblem,
    given: Mapping[str, Sequence[Trajectory]],
    method: DiscoveryMethod,
    law: LawSearch | None,
    *,
    workers: Workers,
    rng: np.random.Generator,
    progress: Progress,
) -> Discovery:
    """One structure for all points, and the law of its coefficients if one is asked for.

    At points whose records rest, between others whose records repeat cycles, the law has to rest.
    If no law holds at most of its records and these are on two cycles, it is that of the cycle that
    most are on. given: the runs of each point, by its label.
    """
    quiet = [] if law is None or asked.hidden else quiet_points(given.values(), asked.states)
    aside = {point_label(point.parameters) for point in quiet}
    records = {k: record_of(runs) for k, runs in given.items() if k not in aside}
    repeat = bool(records) and all(record.repeats for record in records.values())
    points = {k: runs for k, runs in given.items() if not (repeat and k in aside)}
    if not repeat or {*asked.library.variables} - {*asked.states}:
        quiet = []  # what rests under inputs depends on theirs
    search = _Search(asked, points, method, law, quiet, workers=workers, rng=rng, progress=progress)
    found = search.discover()
    choice = found.law_choice
    if choice is None or choice.choice.share_on_cycle == MOST or not repeat:
        return found
    numbers = branches_of([*records.values()])
    main = int(2 * numbers.sum() > len(numbers))
    others = [label for label, number in zip(records, numbers, strict=True) if number != main]
    if not others:
        return found
    points = {k: runs for k, runs in points.items() if k not in others}
    found = replace(search, points=points).discover()
    assert found.law_choice is not None
    cycle = ("strong", "weak")[main]
    note = (
        f"two cycles coexist: the law is that of the {len(points)} points on the {cycle} one; "
        f"on the other are {', '.join(others)}"
    )
    choice = replace(found.law_choice, cycle=cycle)
    return replace(found, law_choice=choice, data_warnings=(*found.data_warnings, note))


def record_of(runs: Sequence[Trajectory]) -> OperatingRecord:
    """The record of a point by which laws are judged: its longest run."""
    return OperatingRecord(max(runs, key=lambda run: run.n_samples))


@dataclass(frozen=True, eq=False)
class _Search:
    """What is asked of several operating points together, and the method that answers it.

    points: the runs of each point, by its label. law: None asks for one structure alone. quiet:
    other points, where the law has to rest.
    Raises ValueError for hidden states, or a method that cannot weigh all points at once.
    """

    asked: DiscoveryProblem
    points: Mapping[str, Sequence[Trajectory]]
    method: DiscoveryMethod
    law: LawSearch | None
    quiet: Sequence[QuietPoint]
    workers: Workers = field(kw_only=True)
    rng: np.random.Generator = field(kw_only=True)
    progress: Progress = field(kw_only=True)

    def __post_init__(self) -> None:
        if self.asked.hidden:
            raise ValueError(
                f"equations of several points need samples of every state, got {self.asked.hidden}"
                " as hidden; make the same states of every run by ep.signals.embed_alike"
            )
        check_shared(self.regression)

    @cached_property
    def regression(self) -> Regression:
        """The regression by which structures for all points are found."""
        if isinstance(self.method, Regression):
            return self.method
        if not isinstance(self.method, TrajectorySearch):
            raise ValueError(
                "equations of several points are found by Regression or TrajectorySearch, got "
                f"{self.method!r}"
            )
        n_terms = self.method.max_terms or BestSubset().max_terms
        if self.roles is not None:
            search, rule = BestSubset(n_terms, n_best=2000), FreeRunScore(window_periods=4.0)
            return Regression(search=search, selection=rule, depth=16)
        if self.asked.made:
            rows = Differential(split=RandomSplit(test_fraction=0.0))
            return Regression(rows, BestSubset(n_terms, n_best=2), depth=2)
        return Regression(search=BestSubset(n_terms))

    @property
    def windows(self) -> RefinementSettings | None:
        """Windows of the refinements; None leaves the coefficients as the rows gave them."""
        if self.law is not None and self.law.windows is not None:
            return self.law.windows
        rule = self.regression.selection
        if isinstance(rule, FreeRunScore):  # which refines what it finds at one point, too
            return replace(WINDOWS, periods=rule.window_periods)
        if not isinstance(self.method, TrajectorySearch):
            return None
        return LONG_WINDOWS if self.asked.made else WINDOWS

    @property
    def roles(self) -> Roles | None:
        return self.asked.facts.roles

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(self.asked.runs[0].parameters)

    @cached_property
    def values(self) -> Float[np.ndarray, "points parameters"]:
        return values_of(self.points)

    @property
    def assessed(self) -> list[str]:
        """The states that laws are judged by: those that were not made of others."""
        return [state for state in self.asked.states if state not in self.asked.made]

    def discover(self) -> Discovery:
        """One structure for all points, its coefficients at each, and their law if one is asked."""
        found = None if self.law is None else self.find_law(self.law)
        fits = found.choice.fits if found else self.fit(self.structures[:1])[-1]
        points: dict[str, Discovery] = {}
        fronts, regression = self.fronts_of(fits.relations), self.regression
        for k, (label, same_point) in enumerate(self.points.items()):
            own = [front.points[label] for front in fronts]
            alike = [each for part in self.problems[label] for each in ambiguities(part)]
            points[label] = replace(
                join_choice(own, [f.best for f in own], fits.models[k], regression),
                model=replace(fits.models[k], clock=same_point[0].clock),
                ambiguities=tuple(dict.fromkeys(alike)),
                constraint=fits.relations.at(fits.points[[k]])[0],
                records=same_point,
            )
        return join_points(points, self.values, found)

    @cached_property
    def problems(self) -> Problems:
        """Rows of every point, made in the order of their names, so that theirs does not count."""
        form = self.regression.formulation
        library = self.asked.at_point.with_known_terms(self.asked.states)
        labels = count_pieces(self.progress, sorted(self.points), "point", "rows of the regression")
        rows = {
            label: form.assemble([r.complete() for r in self.points[label]], library, rng=self.rng)
            for label in labels
        }
        return {label: rows[label] for label in self.points}

    @cached_property
    def library(self) -> Library:
        """The terms of the rows, without what is known."""
        return next(iter(self.problems.values()))[0].library.plain

    @cached_property
    def fronts(self) -> list[SharedFront]:
        """Supports of every equation that all points share."""
        return search_shared(self.problems, self.asked, self.regression, progress=self.progress)

    def fronts_of(self, structure: LawConstraint) -> list[SharedFront]:
        """The fronts whose best supports are those of this structure."""
        terms = structure.common.support
        if self.roles is None and all({*f.chosen} == {*terms[f.equation]} for f in self.fronts):
            return self.fronts
        known = replace(self.asked, library=self.library.only(terms))
        rule = replace(self.regression, selection=EBIC())
        return search_shared(self.problems, known, rule, progress=self.progress)

    @cached_property
    def structures(self) -> list[LawConstraint]:
        """The structures to be compared, the likeliest first."""
        if self.roles is not None:
            return self._under_roles(self.roles)
        chosen = {front.equation: front.chosen for front in self.fronts}
        found = [constrain_law(self.asked.library, chosen, parameters=self.parameters)]
        if self.law is None or self.windows is None:
            return found
        sizes = MADE_SIZES if self.asked.made else SIZES
        supports = [
            [front.chosen]
            if front.equation in self.asked.facts.only
            else [s for s in front.supports if len(s) in sizes] or [front.chosen]
            for front in self.fronts
        ]
        several = product(*supports) if prod(map(len, supports)) <= MOST_COMBINED else ()
        for terms in several:
            support = dict(zip(chosen, terms, strict=True))
            with suppress(ValueError):  # relations that these terms cannot keep
                if support != chosen:
                    own = constrain_law(self.asked.library, support, parameters=self.parameters)
                    found.append(own)
        return found

    def _under_roles(self, roles: Roles) -> list[LawConstraint]:
        """Structures that keep the roles at every point, the best by free runs of each first."""
        regression, rule = self.regression, self.regression.rule_of_systems
        tasks = [replace(self.asked, runs=runs) for runs in self.points.values()]
        tasks = [replace(task, library=task.at_point) for task in tasks]
        asked = list(zip(tasks, self.problems.values(), strict=True))
        systems = search_conserving_systems(asked, regression.search, depth=regression.depth)
        pieces = [(own, task.runs) for own, task in zip(systems, tasks, strict=True)]
        stage = self.progress.stage(len(pieces), "point", "free runs of systems")
        trials = collect(self.workers, partial(_try_systems, rule=rule), pieces, stage)
        best = best_together(trials, rule.margin, N_ALIKE)[:N_UNDER_ROLES]
        return [
            constrain_roles(self.library, self.asked.states, own, roles, parameters=self.parameters)
            for own in (systems[0].systems[k].constraint.processes for k in best)
        ]

    def fit(self, structures: Sequence[LawConstraint]) -> list[PointFits]:
        """All structures fitted to rows; and then all of them refined, if that is asked for."""
        rows = [
            fit_rows(
                self.parameters, self.values, list(self.problems.values()), structure,
                provenance=self.regression.provenance, quiet=self.quiet,
            )
            for structure in structures
        ]  # fmt: skip
        if self.windows is None:
            return rows
        refined = fit_trajectories(
            rows, list(self.points.values()), self.windows, first=list(map(self._first, rows)),
            seed=self.rng, workers=self.workers, progress=self.progress,
        )  # fmt: skip
        return [*rows, *refined]

    def _first(self, rows: PointFits) -> Sequence[SparseModel]:
        """Models to begin refinements with: of a law, which averages the noise of all rows."""
        with suppress(ValueError):
            if self.law is not None:
                law = rows.law(rows.functions(self.law.functions))
                return [read_law(law, runs[0].parameters) for runs in self.points.values()]
        return rows.models

    def find_law(self, law: LawSearch) -> LawChoice:
        """The law that does best at points left out.

        Other structures are tried unless the likeliest is as good as any (ALIKE) there. Under
        roles the structures were run freely, and the best few of them are compared.
        """
        n = len(self.structures) if self.roles is not None else 1
        found = self._compare(range(n), law, [])
        if found.runs and found.choice.score > ALIKE and len(self.structures) > n:
            found = self._compare(range(n, len(self.structures)), law, found.trials)
        return found

    def _compare(
        self, places: Sequence[int], law: LawSearch, known: Sequence[LawTrial]
    ) -> LawChoice:
        """The best of the structures at these places, and of what is known already."""
        records, reason, trials = list(map(record_of, self.points.values())), "", list[LawTrial]()
        for k, fits in enumerate(self.fit([self.structures[place] for place in places])):
            number = 1 + places[k % len(places)]
            name = law.name if law.name and number == 1 else f"{FOUND}_{number}"
            name += REFINED if fits.statuses else ""
            try:
                functions = fits.functions(law.functions)
                trials.append(LawTrial(name, fits, functions, records, self.assessed))
            except ValueError as error:
                reason = str(error)
        if not (trials or known):
            raise ValueError(reason)
        refined = [trial for trial in trials if trial.fits.statuses]
        if self.windows is not None and refined:
            periods = max(1.0, self.windows.periods or PERIODS)
            n_windows = min(MOST_FOLLOWED, self.windows.n_windows)
            follow = partial(
                follow_together, law=law.functions, n_windows=n_windows, periods=periods
            )
            stage = self.progress.stage(len(refined), "structure", "laws over all points")
            trials = [trial for trial in trials if not trial.fits.statuses]
            trials += chain(*collect(self.workers, follow, refined, stage))
        tested = leave_out(trials, workers=self.workers, progress=self.progress)
        return choose_law([*known, *tested])


def _try_systems(piece: tuple[Systems, Sequence[Trajectory]], *, rule: FreeRunScore) -> list[Trial]:
    systems, runs = piece
    return rule.trials(systems, runs)
