"""Models whose terms are given, fitted to every operating point: by its rows, then refined."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.model.model import SparseModel
from ep2sindy.operating.law import LawConstraint
from ep2sindy.operating.point_fits import FAILED, PointFits, information_of
from ep2sindy.operating.quantities import Quantity, QuantityEstimate, estimate_quantities
from ep2sindy.operating.records import Point, group_by_point, name_point, read_points
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.refinement.refine import refine
from ep2sindy.refinement.windows import MIN_SAMPLES
from ep2sindy.regression.constrained import rows_r2, solve_constrained
from ep2sindy.regression.rows import Formulation, RegressionRows
from ep2sindy.runtime.parallel import Workers, collect
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.signals.spectrum import (
    Oscillation,
    dominant_frequency,
    oscillation,
    samples_in_periods,
)

FITTED = "fitted"
REFINED = "_refined"  # suffix of the name of a model's refinement

# Rows depend on each other over a cycle, which repeats itself: blocks of intervals hold two.
BLOCK_PERIODS = 2.0


@dataclass(frozen=True, eq=False)
class GivenModel:
    """Terms of every state with their relations, and the quantities that coefficients mean."""

    relations: LawConstraint
    quantities: Mapping[str, Quantity] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class FittingSettings:
    """How models are fitted to each point: rows by a formulation, then windows of trajectories.

    library: holds the terms of all models. n_windows, periods: number of windows, and the length of
    each in periods of the point.
    """

    library: Library
    formulation: Formulation
    n_windows: int
    periods: float

    def __post_init__(self) -> None:
        if self.n_windows < 2 or not self.periods > 0.0:
            raise ValueError(
                "refinement needs two windows or more, of some length, got "
                f"n_windows={self.n_windows} and periods={self.periods}"
            )


@dataclass(frozen=True, eq=False)
class FittedModel:
    """A model of one operating point, with the covariance of its coefficients.

    status: "fitted" by least squares, or that of a refinement. r2: for each state, of the
    derivative, on training rows. loss: of a refinement, else NaN. information: inverse covariance
    of the free coefficients for independent residuals; zero if the fit failed.
    """

    model: SparseModel
    status: str
    r2: Mapping[str, float]
    estimates: Mapping[str, QuantityEstimate]
    information: Float[np.ndarray, "free free"]
    loss: float = float("nan")

    @property
    def is_usable(self) -> bool:
        return self.status not in FAILED


@dataclass(frozen=True, eq=False)
class PointResult:
    """Results at one operating point; without fits unless its status is "oscillating".

    f_Hz: dominant frequency of the first state. fits: by the name of the model, and of the model +
    "_refined".
    """

    parameters: Point
    status: str
    n_samples: int = 0
    dt_s: float = float("nan")
    f_Hz: float = float("nan")
    fits: Mapping[str, FittedModel] = field(default_factory=dict)

    def is_usable(self, fit: str) -> bool:
        """True if this fit exists and did not fail."""
        return fit in self.fits and self.fits[fit].is_usable


def fit_models(
    runs: Sequence[Trajectory | None],
    models: Mapping[str, GivenModel],
    how: FittingSettings,
    *,
    workers: Workers,
    rng: np.random.Generator,
    tell: Callable[[int, PointResult], None] = lambda number, result: None,
    progress: Progress = SILENT,
) -> dict[int, PointResult]:
    """Fit and refine all models at every point with a run, each on its own samples.

    The result of a point depends on its data and its place in the list, not on the workers or on
    the other points. tell: called with the number of a point and its result as soon as it is known.
    Returns the results by number of the point.
    Raises ValueError, naming the point, for too short a record, or runs whose states or units
    differ.
    """
    known = {k: run for k, run in enumerate(runs) if run is not None}
    group_by_point(list(known.values()), how.library.variables)
    streams, numbers = rng.spawn(len(runs)), list(known)
    pieces = [(known[k], streams[k]) for k in numbers]
    found = collect(
        workers, partial(_fit_point, models=models, how=how), pieces,
        progress.stage(len(pieces), "point fitted"), tell=lambda j, r: tell(numbers[j], r),
    )  # fmt: skip
    return dict(zip(numbers, found, strict=True))


def _fit_point(
    piece: tuple[Trajectory, np.random.Generator],
    *,
    models: Mapping[str, GivenModel],
    how: FittingSettings,
) -> PointResult:
    run, rng = piece
    with name_point(run.parameters):
        result = PointResult(
            parameters=run.parameters,
            status=oscillation(run.t, run.states),
            n_samples=run.n_samples,
            dt_s=run.dt_s,
            f_Hz=dominant_frequency(run.t, run.states[:, 0]),
        )
        if result.status != Oscillation.OSCILLATING:
            return result
        rows, *streams, _ = rng.spawn(2 * len(models) + 2)
        problems = how.formulation.assemble([run], how.library, rng=rows)
        point, fits = _FittedPoint(run, problems, how, result), dict[str, FittedModel]()
        for k, (name, model) in enumerate(models.items()):
            fits[name] = point.fit(model)
            fits[name + REFINED] = point.refine(model, fits[name].model, rng=streams[2 * k + 1])
        return replace(result, fits=fits)


@dataclass(frozen=True, eq=False)
class _FittedPoint:
    """The record of one point with its rows, to which every model is fitted."""

    run: Trajectory
    problems: Sequence[RegressionRows]
    how: FittingSettings
    result: PointResult

    def fit(self, given: GivenModel) -> FittedModel:
        """Least squares; the covariance is a sandwich with blocks of time as clusters."""
        run, problems = self.run, self.problems
        (constraint,) = given.relations.at(read_points([run.parameters], list(run.parameters)))
        solution = solve_constrained(problems, constraint)
        group_s = (run.t[-1] - run.t[0]) / len(np.unique(solution.groups))
        block = max(1, round(BLOCK_PERIODS / (self.result.f_Hz * group_s)))
        model = solution.model(
            problems[0].library,
            units=run.units,
            provenance={"formulation": repr(self.how.formulation), "trajectories": run.label},
            root=solution.clustered_root(block),
        )
        return self._fitted(given, model, FITTED, solution.information)

    def refine(
        self, given: GivenModel, start: SparseModel, *, rng: np.random.Generator
    ) -> FittedModel:
        """The coefficients, refined so that integrated windows follow the data."""
        run, how = self.run, self.how
        samples = samples_in_periods(how.periods, frequency_Hz=self.result.f_Hz, dt_s=run.dt_s)
        (constraint,) = given.relations.at(read_points([run.parameters], list(run.parameters)))
        settings = RefinementSettings(
            n_windows=how.n_windows,
            window=int(np.clip(samples, MIN_SAMPLES, run.n_samples)),
            constraint=constraint,
        )
        found = refine(start, [run], settings, seed=rng)
        information = information_of(found, given.relations.common)
        return self._fitted(given, found.model, found.status, information, found.loss)

    def _fitted(
        self,
        given: GivenModel,
        model: SparseModel,
        status: str,
        information: Float[np.ndarray, "free free"],
        loss: float = float("nan"),
    ) -> FittedModel:
        scores = rows_r2(model, self.problems)
        estimates = estimate_quantities(model, given.quantities)
        return FittedModel(model, status, scores, estimates, information, loss)


def fits_of(name: str, given: GivenModel, results: Sequence[PointResult]) -> PointFits:
    """One fit of every point, as the data of laws; those that failed have no information."""
    names = list(results[0].parameters)
    fits = [result.fits[name] for result in results]
    return PointFits(
        parameters=tuple(names),
        points=read_points([result.parameters for result in results], names),
        relations=given.relations,
        models=[fit.model for fit in fits],
        information=np.array([fit.information for fit in fits]),
        how="trajectories" if name.endswith(REFINED) else "rows",
    )
