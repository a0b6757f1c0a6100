"""Fits at several operating points: quantities with intervals for each, and searches of terms."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import column_norms
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import AnyMethod, Regression
from ep2sindy.library.library import Library
from ep2sindy.library.relations import Constraint
from ep2sindy.model.model import SparseModel
from ep2sindy.operating.fit_rows import LawFit, fit_law, score_rows
from ep2sindy.operating.law import read_coefficients
from ep2sindy.operating.quantities import (
    FITTED,
    REFINED,
    SEARCHED,
    Fitted,
    PointResult,
    Quantity,
    estimate_from_covariance,
    estimate_from_draws,
)
from ep2sindy.operating.records import OperatingRecord, check_alike, name_point
from ep2sindy.operating.shared_support import SharedDiscovery, discover_shared
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.refinement.refine import refine
from ep2sindy.refinement.windows import MIN_SAMPLES
from ep2sindy.regression.bootstraps import Bootstraps, count_block_draws
from ep2sindy.regression.constrained import WeightedEquation, constrained_fit, weigh_equations
from ep2sindy.regression.gram_kernels import invert_gram
from ep2sindy.regression.rows import Formulation, RegressionRows
from ep2sindy.regression.searches import BestSubset
from ep2sindy.runtime.parallel import Workers, collect
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.signals.spectrum import (
    Oscillation,
    dominant_frequency,
    oscillation,
    relative_spread,
    samples_in_periods,
)

MIN_BLOCKS = 5  # fewest blocks in a record: with fewer, draws differ too little from one another


@dataclass(frozen=True)
class Refining:
    """Settings of the refinement: number of windows, periods of each, and most iterations."""

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
    """One way to fit the terms: relations of the coefficients, and quantities read from them."""

    constraint: Constraint
    quantities: Mapping[str, Quantity]


@dataclass(frozen=True, eq=False)
class PointStudy:
    """Settings of the fits and searches at every operating point.

    library: holds the terms of all cases, which are fitted to the rows of the formulation.
    searched: the library in which the method searches for terms.
    Raises ValueError for a quantity whose coefficient a case does not have.
    """

    library: Library
    cases: Mapping[str, Case]
    bootstrap: TimeBootstrap
    refining: Refining
    searched: Library
    method: AnyMethod
    formulation: Formulation

    def __post_init__(self) -> None:
        for case in self.cases.values():
            for quantity in case.quantities.values():
                quantity.place(case.constraint, self.library)

    @property
    def fits(self) -> dict[str, Case]:
        """All fits of a point by name: every case, and its refinement."""
        return {name + end: case for name, case in self.cases.items() for end in ("", REFINED)}


def fit_points(
    points: Sequence[OperatingRecord],
    study: PointStudy,
    *,
    workers: Workers,
    rng: np.random.Generator,
    tell: Callable[[int, PointResult], None] = lambda number, result: None,
    progress: Progress = SILENT,
) -> list[PointResult]:
    """Fit and refine all cases at every point, each on its own samples, and search for terms.

    The result of a point depends on its data and its place in the list, not on the workers or on
    the other points. tell: called with the number of a point and its result as soon as it is known.
    Raises ValueError, naming the point, for one that lacks a state or a variable, has another unit,
    or has too short a record.
    """
    variables = [*study.library.variables, *study.searched.variables]
    check_alike(points, list(dict.fromkeys(variables)))
    pieces = list(zip(points, rng.spawn(len(points)), strict=True))
    stage = progress.stage(len(points), "point fitted")
    return collect(workers, partial(_fit_point, study=study), pieces, stage, tell=tell)


def _fit_point(
    piece: tuple[OperatingRecord, np.random.Generator], *, study: PointStudy
) -> PointResult:
    point, rng = piece
    with name_point(point.parameters):
        return _point_result(point, study, rng=rng)


def _point_result(
    point: OperatingRecord, study: PointStudy, *, rng: np.random.Generator
) -> PointResult:
    run, status = point.trajectory, point.status
    if run is None:
        return PointResult(point.parameters, status)
    if status == Oscillation.OSCILLATING:
        status = oscillation(run.t, run.states)
    result = PointResult(
        parameters=point.parameters,
        status=status,
        n_samples=run.n_samples,
        dt_s=run.dt_s,
        f_Hz=dominant_frequency(run.t, run.states[:, 0]),
        spread=dict(zip(run.state_names, relative_spread(run.states).tolist(), strict=True)),
    )
    if status != Oscillation.OSCILLATING:
        return result
    rows, *streams, last = rng.spawn(2 * len(study.cases) + 2)
    problems = study.formulation.assemble([run], study.library, rng=rows)
    record, fits = _FittedRecord(run, problems, study, 1.0 / result.f_Hz), {}
    for k, (name, case) in enumerate(study.cases.items()):
        fits[name] = record.fit(case, rng=streams[2 * k])
        start = fits[name].model
        fits[name + REFINED] = record.refine(case, start, rng=streams[2 * k + 1])
    return replace(result, fits=fits, searched=record.search(rng=last))


@dataclass(frozen=True, eq=False)
class _FittedRecord:
    """The record of one point with its rows and its period, to which every case is fitted."""

    run: Trajectory
    problems: Sequence[RegressionRows]
    study: PointStudy
    period_s: float

    def fit(self, case: Case, *, rng: np.random.Generator) -> Fitted:
        """Least squares, with intervals and covariance from a bootstrap in blocks of time."""
        run, problems, bootstrap = self.run, self.problems, self.study.bootstrap
        provenance = {"formulation": repr(self.study.formulation), "trajectories": run.label}
        model = constrained_fit(problems, case.constraint, units=run.units, provenance=provenance)
        n_groups = len(np.unique(np.concatenate([p.groups[~p.test] for p in problems])))
        group_s = (run.t[-1] - run.t[0]) / n_groups
        draws = resample_coefficients(
            problems,
            case.constraint,
            model,
            block=max(1, round(bootstrap.periods * self.period_s / group_s)),
            n_draws=bootstrap.n_draws,
            rng=rng,
        )
        coef = read_coefficients(model, case.constraint)
        covariance = np.atleast_2d(np.cov(draws[:, coef != 0.0], rowvar=False))
        estimates, drawn = estimate_from_draws(
            coef, draws, case.quantities, case.constraint, self.study.library
        )
        model, r2 = replace(model, covariance=covariance), _r2(problems, model)
        return Fitted(model, FITTED, r2, estimates=estimates, draws=drawn)

    def refine(self, case: Case, start: SparseModel, *, rng: np.random.Generator) -> Fitted:
        """The case's coefficients, refined so that integrated windows follow the data."""
        run, how = self.run, self.study.refining
        samples = samples_in_periods(how.periods, frequency_Hz=1.0 / self.period_s, dt_s=run.dt_s)
        settings = RefinementSettings(
            n_windows=how.n_windows,
            window=int(np.clip(samples, MIN_SAMPLES, run.n_samples)),
            method=MultipleShooting(max_iter=how.max_iter),
            constraint=case.constraint,
        )
        found = refine(start, [run], settings, seed=rng)
        estimates = {}
        if found.model.covariance is not None:
            estimates = estimate_from_covariance(
                found.model, case.quantities, case.constraint, self.study.library
            )
        r2 = _r2(self.problems, found.model)
        return Fitted(found.model, found.status, r2, loss=found.loss, estimates=estimates)

    def search(self, *, rng: np.random.Generator) -> Fitted:
        """The model that the study's method chooses."""
        found = discover(self.run, self.study.searched, self.study.method, seed=rng)
        fronts = found.fronts.values()
        problems = list(dict.fromkeys(f.problem for f in fronts if f.problem is not None))
        no_rows = dict.fromkeys(found.model.states, float("nan"))  # of a search of trajectories
        return Fitted(found.model, SEARCHED, no_rows | _r2(problems, found.model))


def _r2(problems: Sequence[RegressionRows], model: SparseModel) -> dict[str, float]:
    """R2 of the derivative, by state, on the unweighted training rows."""
    return {
        state: score_rows(problem, model, state)
        for problem in problems
        for state in problem.equations
    }


@dataclass(frozen=True)
class TimeBootstrap:
    """Settings of the bootstrap in time: number of draws, and length of a block in periods."""

    n_draws: int
    periods: float

    def __post_init__(self) -> None:
        if self.n_draws < 40 or self.periods <= 0.0:
            raise ValueError(
                "a 95 % interval needs 40 draws or more, and blocks some length: "
                f"n_draws={self.n_draws}, periods={self.periods} came"
            )


def resample_coefficients(
    problems: Sequence[RegressionRows],
    constraint: Constraint,
    model: SparseModel,
    *,
    block: int,
    n_draws: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "draws coefs"]:
    """Coefficients of `constrained_fit` on training rows redrawn in blocks of time, in SI.

    A draw counts groups of rows, the same for all equations. Each equation keeps the weight that it
    has on all rows, and rows of known noise stay whitened as under `model`. model: result of
    `constrained_fit` on these problems. block: number of consecutive groups in a block.
    Returns one column per coefficient of the constraint. The draws are shifted so that their mean
    is the fit: blocks seldom reach the ends of the record, which would bias them. Before the shift,
    a coefficient whose terms are zero on all rows of a draw is zero in this draw.
    Raises ValueError for blocks that leave fewer than five to draw from, or several trajectories.
    Source: Kuensch 1989, doi:10.1214/aos/1176347265; Lahiri 2003, Resampling Methods for Dependent
    Data, 2.5, for the centre.
    """
    if len(problems[0].trajectories) > 1:
        raise ValueError(
            "a bootstrap over time needs one trajectory, or blocks would cross from one to the "
            f"next: {len(problems[0].trajectories)} came"
        )
    equations = weigh_equations(problems, constraint)
    coef = read_coefficients(model, constraint)
    rows = [_free_rows(equation, constraint, coef) for equation in equations]
    groups = [e.problem.groups[~e.problem.test] for e in equations]
    numbers = np.unique(np.concatenate(groups))
    _check_blocks(len(numbers), block)
    scale = column_norms(np.concatenate(rows))
    sums = np.zeros((len(numbers), len(scale), len(scale)))
    for own, group in zip(rows, groups, strict=True):
        unit = own / scale
        np.add.at(sums, np.searchsorted(numbers, group), unit[:, :, None] * unit[:, None, :])
    counts = np.array(
        [
            count_block_draws(len(numbers), n_drawn=len(numbers), block=block, rng=rng)
            for _ in range(n_draws)
        ],
        dtype=np.float64,
    )
    grams = np.tensordot(counts, sums, axes=1)
    z = (invert_gram(grams[:, :-1, :-1]) @ grams[:, :-1, -1:])[:, :, 0]
    z *= scale[-1] / scale[:-1]
    return (z - z.mean(axis=0) + coef[constraint.free]) @ constraint.C.T + constraint.d


def _check_blocks(n_groups: int, block: int) -> None:
    if n_groups < MIN_BLOCKS * block:
        raise ValueError(
            f"a bootstrap over time needs {MIN_BLOCKS} blocks or more: blocks of {block} were "
            f"asked of {n_groups} groups of rows; use fewer periods per block "
            "(bootstrap.periods), or a longer record"
        )


def _free_rows(
    equation: WeightedEquation, constraint: Constraint, coef: Float[np.ndarray, " coefs"]
) -> Float[np.ndarray, "rows columns"]:
    """One equation's rows by free coefficient, the target last; residual variance 1."""
    at = equation.at
    theta, target = equation.rows(coef[at])
    return np.column_stack([theta @ constraint.C[at], target - theta @ constraint.d[at]])


@dataclass(frozen=True, eq=False)
class SharedResult:
    """Result of one search over all points that oscillate.

    fitted: for each point that oscillates, the support with the point's own coefficients; None at
    the others. fit: the coefficients as polynomials of the parameters; None if the points do not
    suffice, for the reason in `why_no_law`.
    """

    found: SharedDiscovery
    fitted: Sequence[Fitted | None]
    fit: LawFit | None
    why_no_law: str = ""


def search_shared(
    points: Sequence[OperatingRecord],
    results: Sequence[PointResult],
    study: PointStudy,
    law: Library,
    *,
    rng: np.random.Generator,
    progress: Progress = SILENT,
) -> SharedResult | None:
    """Search all points that oscillate at once; None for fewer than two of them.

    law: functions of the points' parameters that give the coefficients. Also None for a search
    that cannot weigh several points: only BestSubset can.
    """
    used = {
        point.label: point
        for point, result in zip(points, results, strict=True)
        if result.fits and point.trajectory is not None
    }
    method = study.method
    if len(used) < 2 or not isinstance(method, Regression):
        return None
    if not isinstance(method.search, BestSubset):
        return None
    found = discover_shared(
        {label: [point.run] for label, point in used.items()},
        study.searched,
        replace(method, bootstraps=Bootstraps(n=0)),
        seed=rng,
        progress=progress,
    )
    fit, reason = None, ""
    try:
        parameters = {label: point.parameters for label, point in used.items()}
        with progress.stage(None, "", "one law of all coefficients"):
            fit = fit_law(found, law, parameters=parameters)
    except ValueError as error:
        reason = str(error)
    labels = [point.label for point in points]
    fitted = [_fitted(found, label) if label in used else None for label in labels]
    return SharedResult(found, fitted, fit, reason)


def _fitted(found: SharedDiscovery, label: str) -> Fitted:
    scores = {
        state: front.points[label].candidates[front.supports.index(found.chosen[state])].r2_train
        for state, front in found.fronts.items()
    }
    return Fitted(model=found.models[label], status=SEARCHED, r2=scores)
