"""Equations at several operating points: one support for all, its coefficients, and their law."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from ep2sindy.data.coerce import DiscoveryProblem
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import join_choice
from ep2sindy.discovery.method import Regression, TrajectorySearch
from ep2sindy.discovery.result import Discovery, DiscoveryMethod, join_points
from ep2sindy.discovery.shared_support import SharedFront, check_shared, search_shared
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint
from ep2sindy.operating.law import (
    LawConstraint,
    LawFunctions,
    OperatingLaw,
    constrain_law,
    law_of_constraint,
    read_law,
)
from ep2sindy.operating.point_fits import PointFits, fit_rows, fit_trajectories
from ep2sindy.operating.records import values_of
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.regression.ambiguity import ambiguities
from ep2sindy.regression.pooled import fewest_of_least
from ep2sindy.regression.rows import RegressionRows
from ep2sindy.regression.searches import BestSubset
from ep2sindy.runtime.progress import Progress, count_pieces

# States are weighted by their standard deviation at every point: points weigh alike in a law.
WINDOWS = RefinementSettings(n_windows=20, periods=2.0, n_reweights=0)


@dataclass(frozen=True, eq=False)
class PointsProblem:
    """What is asked of several operating points together, and the method that answers it.

    points: the runs of each point, by its label. structure: the constraint of terms that a search
    under roles has found; or None.
    Raises ValueError for hidden states, or a method that cannot weigh all points at once.
    """

    asked: DiscoveryProblem
    points: Mapping[str, Sequence[Trajectory]]
    method: DiscoveryMethod
    structure: Constraint | None = None

    def __post_init__(self) -> None:
        if self.asked.hidden:
            raise ValueError(
                f"equations of several points need samples of every state, got {self.asked.hidden}"
                " as hidden; make the same states of every run by ep.signals.embed_alike"
            )
        check_shared(self.regression)

    @property
    def regression(self) -> Regression:
        """The regression by which supports for all points are found."""
        if isinstance(self.method, Regression):
            return self.method
        if not isinstance(self.method, TrajectorySearch):
            raise ValueError(
                "equations of several points are found by Regression or TrajectorySearch, got "
                f"{self.method!r}"
            )
        n_terms = self.method.max_terms
        return Regression(search=BestSubset() if n_terms is None else BestSubset(max_terms=n_terms))

    @property
    def parameters(self) -> tuple[str, ...]:
        return tuple(self.asked.runs[0].parameters)

    @property
    def values(self) -> Float[np.ndarray, "points parameters"]:
        return values_of(self.points)

    def discover(
        self,
        law: LawFunctions | Sequence[LawFunctions] | None,
        *,
        rng: np.random.Generator,
        progress: Progress,
    ) -> Discovery:
        """One support for all points, its coefficients at each, and their law if one is asked."""
        problems = self._rows(rng, progress)
        fronts = search_shared(problems, self.asked, self.regression, progress=progress)
        rows = fit_rows(
            self.parameters, self.values, list(problems.values()), self._relations(fronts),
            provenance=self.regression.provenance,
        )  # fmt: skip
        fits, found = rows, None if law is None else choose_law(rows, law)
        if isinstance(self.method, TrajectorySearch):
            start, runs = rows, list(self.points.values())
            if found is not None:  # it averages the noise of the rows of all points
                at = [dict(zip(self.parameters, p, strict=True)) for p in rows.points.tolist()]
                start = replace(rows, models=[read_law(found, point) for point in at])
            fits = fit_trajectories(start, runs, WINDOWS, seed=rng, progress=progress)
            found = None if law is None else choose_law(fits, law)
        points: dict[str, Discovery] = {}
        for k, (label, same_point) in enumerate(self.points.items()):
            own = [front.points[label] for front in fronts]
            alike = [each for part in problems[label] for each in ambiguities(part)]
            points[label] = replace(
                join_choice(own, [f.best for f in own], fits.models[k], self.regression),
                model=replace(fits.models[k], clock=same_point[0].clock),
                ambiguities=tuple(dict.fromkeys(alike)),
                constraint=fits.relations.at(fits.points[[k]])[0],
            )
        return join_points(points, self.values, found)

    def _rows(
        self, rng: np.random.Generator, progress: Progress
    ) -> dict[str, Sequence[RegressionRows]]:
        """Rows of every point, made in the order of their names, so that theirs does not count."""
        form, library = self.regression.formulation, self.asked.library
        labels = count_pieces(progress, sorted(self.points), "point", "rows of the regression")
        rows = {
            label: form.assemble([r.complete() for r in self.points[label]], library, rng=rng)
            for label in labels
        }
        return {label: rows[label] for label in self.points}

    def _relations(self, fronts: Sequence[SharedFront]) -> LawConstraint:
        """The terms of all points, with their relations."""
        if self.structure is not None:
            return law_of_constraint(self.structure, self.parameters)
        return constrain_law(
            self.asked.library,
            {front.equation: front.chosen for front in fronts},
            parameters=self.parameters,
        )


def choose_law(fits: PointFits, law: LawFunctions | Sequence[LawFunctions]) -> OperatingLaw:
    """The law through the fits of all points, of several the one that errs least where left out.

    Laws whose errors cannot be distinguished count as equal, and that of fewest functions is taken.
    Raises ValueError if the points do not suffice for any.
    """
    if isinstance(law, int | str | Library):
        return fits.law(fits.functions(law))
    tested, reasons = fits.test_laws(law)
    if not tested:
        raise ValueError(["law=[...] must name degrees or functions", *reasons][-1])
    best = fewest_of_least([(errors, len(functions)) for functions, errors in tested])
    return fits.law(tested[best][0])
