"""One model at several operating points: its quantities and intervals, and what a search finds."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from ep2sindy.constraints.fit import constrained_fit
from ep2sindy.constraints.relations import Constraint
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.library.library import Library
from ep2sindy.machine.parallel import Workers
from ep2sindy.model.model import SparseModel
from ep2sindy.model.scores import r2
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.refine import refine
from ep2sindy.refinement.windows import MIN_SAMPLES
from ep2sindy.regression.rows import Formulation, RegressionRows
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.parametric.oscillation import (
    OSCILLATING,
    PointData,
    check_points,
    naming,
    oscillation,
    spread,
)
from ep2sindy.studies.parametric.quantities import (
    Estimate,
    Quantity,
    drawn_estimates,
    propagated_estimates,
)
from ep2sindy.studies.parametric.time_bootstrap import (
    TimeBootstrap,
    coefficients_of,
    resampled_coefficients,
)

FITTED, SEARCHED, CONVERGED = "fitted", "searched", "converged"
REFINED = "_refined"  # ends the name of a case's refinement


@dataclass(frozen=True)
class Refining:
    """What models are refined on: this many windows, each of so many periods."""

    n_windows: int
    periods: float
    max_iter: int

    def __post_init__(self) -> None:
        if min(self.n_windows, self.max_iter) < 2 or self.periods <= 0.0:
            raise ValueError(
                "refinement needs two windows and iterations or more, and windows some length: "
                f"n_windows={self.n_windows}, periods={self.periods}, max_iter={self.max_iter} came"
            )


@dataclass(frozen=True, eq=False)
class Case:
    """One way to fit the terms: under these relations, read as these quantities."""

    constraint: Constraint
    quantities: Mapping[str, Quantity]


@dataclass(frozen=True, eq=False)
class PointStudy:
    """What is done at every operating point.

    library: holds the terms of all cases. searched: the library that terms are looked for in, by
    the recipe. formulation: makes the rows of the fits.
    Raises ValueError for a quantity whose coefficient a case does not have.
    """

    library: Library
    cases: Mapping[str, Case]
    bootstrap: TimeBootstrap
    refining: Refining
    searched: Library
    recipe: AnyMethod
    formulation: Formulation

    def __post_init__(self) -> None:
        for case in self.cases.values():
            for quantity in case.quantities.values():
                quantity.place(case.constraint, self.library)

    @property
    def fits(self) -> dict[str, Case]:
        """By name all fits of a point: every case, and its refinement."""
        return {name + end: case for name, case in self.cases.items() for end in ("", REFINED)}


@dataclass(frozen=True, eq=False)
class Fitted:
    """A model of one operating point.

    status: fitted, by least squares; searched; or what became of a refinement.
    r2: by state, of the derivative, on training rows. loss: of a refinement, else NaN.
    draws: by quantity, (draws,), what the intervals of least squares were taken from.
    The model's covariance is that of the draws, or of the refinement.
    """

    model: SparseModel
    status: str
    r2: Mapping[str, float]
    loss: float = float("nan")
    estimates: Mapping[str, Estimate] = field(default_factory=dict)
    draws: Mapping[str, Float[np.ndarray, " draws"]] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class PointResult:
    """What one operating point gave; without fits unless its status is "oscillating".

    f_Hz: dominant frequency of the first state. spread: by state, standard deviation over mean.
    fits: by case, and by case + "_refined". searched: what the search chose.
    """

    parameters: Mapping[str, float]
    status: str
    n_samples: int = 0
    dt_s: float = float("nan")
    f_Hz: float = float("nan")
    spread: Mapping[str, float] = field(default_factory=dict)
    fits: Mapping[str, Fitted] = field(default_factory=dict)
    searched: Fitted | None = None

    def usable(self, fit: str) -> bool:
        """Whether a fit was made here and came to its end."""
        return fit in self.fits and self.fits[fit].status in (FITTED, CONVERGED)


def parametric_study(
    points: Sequence[PointData], study: PointStudy, *, workers: Workers, rng: np.random.Generator
) -> Iterator[tuple[int, PointResult]]:
    """Every point on its own samples: all cases fitted and refined, and terms searched for.

    Yields (number of the point, result) in any order; a result depends on its data and its place
    in the list, not on the workers or on what the other points are.
    Raises ValueError, naming the point, where one lacks a state or a variable, differs in its
    unit, or is too short a record.
    """
    variables = [*study.library.variables, *study.searched.variables]
    check_points(points, list(dict.fromkeys(variables)))
    pieces = zip(points, rng.spawn(len(points)), strict=True)
    yield from workers.run(partial(_fitted_point, study=study), pieces)


def _fitted_point(
    piece: tuple[PointData, np.random.Generator], *, study: PointStudy
) -> PointResult:
    point, rng = piece
    with naming(point.parameters):
        return _point_result(point, study, rng=rng)


def _point_result(point: PointData, study: PointStudy, *, rng: np.random.Generator) -> PointResult:
    run = point.trajectory
    if run is None:
        return PointResult(point.parameters, point.status)
    result = PointResult(
        parameters=point.parameters,
        status=oscillation(run) if point.status == OSCILLATING else point.status,
        n_samples=run.n_samples,
        dt_s=run.dt_s,
        f_Hz=dominant_frequency(run.t, run.states[:, 0]),
        spread=dict(zip(run.state_names, spread(run.states).tolist(), strict=True)),
    )
    if result.status != OSCILLATING:
        return result
    period_s = 1.0 / result.f_Hz
    rows, *streams, last = rng.spawn(2 * len(study.cases) + 2)
    problems = study.formulation.assemble([run], study.library, rng=rows)
    fits = {}
    for k, (name, case) in enumerate(study.cases.items()):
        fits[name] = _least_squares(run, problems, case, study, period_s, rng=streams[2 * k])
        fits[name + REFINED] = _refined(
            run, problems, case, study, period_s, start=fits[name].model, rng=streams[2 * k + 1]
        )
    return replace(result, fits=fits, searched=_searched(run, study, rng=last))


def _least_squares(
    run: Trajectory,
    problems: Sequence[RegressionRows],
    case: Case,
    study: PointStudy,
    period_s: float,
    *,
    rng: np.random.Generator,
) -> Fitted:
    """The case's fit, its intervals and covariance from rows redrawn in blocks of time."""
    provenance = {"formulation": repr(study.formulation), "trajectories": run.label}
    model = constrained_fit(problems, case.constraint, units=run.units, provenance=provenance)
    n_groups = len(np.unique(np.concatenate([p.groups[~p.test] for p in problems])))
    group_s = (run.t[-1] - run.t[0]) / n_groups
    draws = resampled_coefficients(
        problems,
        case.constraint,
        model,
        block=max(1, round(study.bootstrap.periods * period_s / group_s)),
        n_draws=study.bootstrap.n_draws,
        rng=rng,
    )
    coef = coefficients_of(model, case.constraint)
    covariance = np.atleast_2d(np.cov(draws[:, coef != 0.0], rowvar=False))
    estimates, drawn = drawn_estimates(coef, draws, case.quantities, case.constraint, study.library)
    return Fitted(
        model=replace(model, covariance=covariance),
        status=FITTED,
        r2=_r2(problems, model),
        estimates=estimates,
        draws=drawn,
    )


def _refined(
    run: Trajectory,
    problems: Sequence[RegressionRows],
    case: Case,
    study: PointStudy,
    period_s: float,
    *,
    start: SparseModel,
    rng: np.random.Generator,
) -> Fitted:
    """The same coefficients, moved until integrated windows follow the data."""
    samples = round(study.refining.periods * period_s / run.dt_s) + 1
    found = refine(
        start,
        [run],
        n_windows=study.refining.n_windows,
        window=int(np.clip(samples, MIN_SAMPLES, run.n_samples)),
        method=MultipleShooting(max_iter=study.refining.max_iter),
        constraint=case.constraint,
        rng=rng,
    )
    known = found.model.covariance is not None
    return Fitted(
        model=found.model,
        status=found.status,
        r2=_r2(problems, found.model),
        loss=found.loss,
        estimates=propagated_estimates(found.model, case.quantities, case.constraint, study.library)
        if known
        else {},
    )


def _searched(run: Trajectory, study: PointStudy, *, rng: np.random.Generator) -> Fitted:
    found = discover(run, study.searched, study.recipe, seed=rng)
    fronts = found.fronts.values()
    problems = list(dict.fromkeys(front.problem for front in fronts if front.problem is not None))
    no_rows = dict.fromkeys(found.model.states, float("nan"))  # of a search of trajectories
    return Fitted(model=found.model, status=SEARCHED, r2=no_rows | _r2(problems, found.model))


def _r2(problems: Sequence[RegressionRows], model: SparseModel) -> dict[str, float]:
    """Of the derivative, by state, on training rows as they are."""
    found = {}
    for problem in problems:
        rows = ~problem.test
        for number, state in enumerate(problem.equations):
            predicted = problem.theta[rows] @ model.coef[:, model.states.index(state)]
            truth = problem.target[rows, number]
            found[state] = float(r2(truth=truth, prediction=predicted[None])[0])
    return found
