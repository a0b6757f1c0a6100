"""Laws of the operating point: fit to the records of all points, and leave-one-out tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from jaxtyping import Float

from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.relations import Relation
from ep2sindy.model.comparison import FreeRunBounds, Verdict, deviation
from ep2sindy.model.free_run import FreeRun, free_run
from ep2sindy.operating.law import (
    NOTHING,
    Known,
    LawConstraint,
    OperatingLaw,
    constrain_law,
    make_basis,
    read_coefficients,
)
from ep2sindy.operating.records import (
    OperatingRecord,
    check_records,
    read_points,
)
from ep2sindy.refinement.law import LawRefinement, refine_law
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.problem import RefinementSettings
from ep2sindy.refinement.refine import Refinement, refine
from ep2sindy.regression.constrained import constrained_fit
from ep2sindy.regression.formulations import Differential, RandomSplit
from ep2sindy.regression.pooled import invert_covariance, pool_coefficients
from ep2sindy.runtime.parallel import Serial, Workers, collect
from ep2sindy.runtime.progress import Progress, as_progress
from ep2sindy.signals.spectrum import samples_in_periods

MOST = 10.0  # upper bound on the reported deviation, also used if there is none

Structure = Mapping[str, Sequence[str]]


# No reweighting: states are scaled by their standard deviation, as in the judging of free runs.
SETTINGS = RefinementSettings(n_windows=20, periods=2.0, n_reweights=0)


def set_window(
    settings: RefinementSettings, records: Sequence[OperatingRecord]
) -> RefinementSettings:
    """Settings for the records of one law: windows have the same number of samples in all of them.

    Periods are those of the median frequency; no window is longer than half of any record.
    """
    if settings.periods is None:
        return settings
    frequency_Hz = [record.cycle.frequency_Hz for record in records]
    dt_s = [record.run.dt_s for record in records]
    wanted = samples_in_periods(settings.periods, frequency_Hz=frequency_Hz, dt_s=dt_s)
    window = min(wanted, *(record.run.n_samples // 2 for record in records))
    return replace(settings, window=window, periods=None)


@dataclass(frozen=True, eq=False)
class OperatingFit:
    """Records of one branch, each refined on its own with the same terms, as input for laws.

    A law W of the free coefficients z(p) = W f(p) is fitted to these refinements (`fit_law`: the
    least sum over the records of d_p^T I_p d_p, with d_p = W f(p) - z_p and I_p the information),
    or to all trajectories at once (`refine_law`).
    Assumes that one law holds for all records: they are on one cycle.
    structure: state -> terms. relations: those of the coefficients, and known coefficients. fits:
    one per record.
    """

    records: Sequence[OperatingRecord]
    structure: Structure
    relations: LawConstraint
    fits: Sequence[Refinement]
    settings: RefinementSettings
    seed: int

    @property
    def n_free(self) -> int:
        """Number of coefficients that the relations leave free."""
        return len(self.relations.common.free)

    @cached_property
    def coefficients(self) -> Float[np.ndarray, "records free"]:
        """The free coefficients of each record."""
        common = self.relations.common
        return np.array([read_coefficients(fit.model, common) for fit in self.fits])[:, common.free]

    @cached_property
    def information(self) -> Float[np.ndarray, "records free free"]:
        """Information matrix of each record's free coefficients; zero if its refinement failed."""
        free = self.relations.common.free
        found = np.zeros((len(self.fits), len(free), len(free)))
        for own, fit in zip(found, self.fits, strict=True):
            if fit.covariance_naive is not None:
                own[:] = invert_covariance(fit.covariance_naive[np.ix_(free, free)])
        return found

    @property
    def points(self) -> Float[np.ndarray, "records parameters"]:
        return read_points(self.records)

    def without(self, number: int) -> OperatingFit:
        others = [k for k in range(len(self.records)) if k != number]
        return replace(
            self,
            records=[self.records[k] for k in others],
            fits=[self.fits[k] for k in others],
        )

    def functions(self, degree: int) -> Library:
        """Polynomials of the parameters. Raises ValueError if the records do not suffice."""
        found = polynomial(list(self.records[0].parameters), degree=degree)
        make_basis(found, self.points)
        return found

    def fit_law(self, functions: Library) -> OperatingLaw:
        """The law closest to the separate refinements, each weighted by its information."""
        return self._make_law(functions, self._pool(functions), None, "weighted")

    def refine_law(
        self,
        functions: Library,
        *,
        start: OperatingLaw | None = None,
        progress: Progress | bool = False,
    ) -> tuple[OperatingLaw, LawRefinement]:
        """The law refined over the trajectories of all records at once, with intervals.

        start: a law close to the result, which shortens the refinement. None starts from the
        law of `fit_law`, with all stages.
        """
        settings = set_window(self.settings, self.records)
        if start is None:
            near = self._pool(functions)
        else:
            # Functions beyond these stand in known coefficients alone.
            near = start.coef[self.relations.common.free, : len(functions)]
            settings = _shorten(settings)
        found = refine_law(
            [fit.model for fit in self.fits],
            [[record.run] for record in self.records],
            functions.evaluate(self.points),
            settings,
            constraints=self.relations.at(self.points),
            start=near,
            seed=self.seed,
            progress=progress,
        )
        return self._make_law(functions, found.law, found.covariance, "refined"), found

    def _pool(self, functions: Library) -> Float[np.ndarray, "free functions"]:
        basis = make_basis(functions, self.points)
        return pool_coefficients(self.coefficients, self.information, basis)

    def _make_law(
        self, functions: Library, free: np.ndarray, covariance: np.ndarray | None, how: str
    ) -> OperatingLaw:
        model, points = self.fits[0].model, self.points
        return self.relations.make_law(model, functions, points, free, covariance, how)


def _shorten(settings: RefinementSettings) -> RefinementSettings:
    """Settings for a start close to the result: the first stage remembers the whole window."""
    method = settings.method or MultipleShooting()
    if settings.window is None or not isinstance(method, MultipleShooting):
        return settings  # refine_law says that no other method will do
    near = replace(method, first_memory=settings.window, tolerance=1e-4)
    return replace(settings, method=near)


def operating_fit(
    records: Sequence[OperatingRecord],
    library: Library,
    structure: Structure,
    *,
    relations: Sequence[Relation | str] = (),
    known: Known = NOTHING,
    settings: RefinementSettings = SETTINGS,
    seed: int = 0,
    progress: Progress | bool = False,
) -> OperatingFit:
    """Refine every record on its own with the same terms, from least squares of the derivative.

    relations: between the coefficients, as texts such as `n_i: n_i*n_n == -1 * n_n: n_i*n_n`.
    known: coefficients that are known functions of the parameters, in SI, such as
    `{"n_n": {"1": {"mdot_mg_s": 4.6e22}}}`. Both hold exactly in every fit and in every law.
    settings: of these refinements and of the law's; windows have the same length in all records.
    Raises ValueError for records whose parameters do not vary or whose states differ, for an
    unknown state or term, for relations that contradict each other or leave nothing free, or for
    settings with a constraint.
    """
    check_records(records)
    if settings.constraint is not None:
        raise ValueError(
            "laws of the operating point take no constraint: the structure says which terms an "
            "equation has; leave `constraint` out of the settings, and give relations=[...] or "
            "known={...} to operating_fit"
        )
    states = list(records[0].run.state_names)
    if set(structure) != set(states):
        raise ValueError(f"a structure must have terms for each of {states}: {structure} came")
    whole = {state: list(structure[state]) for state in states}
    held = constrain_law(library, whole, relations, known, parameters=list(records[0].parameters))
    at = held.at(read_points(records))
    rows = Differential(split=RandomSplit(test_fraction=0.0))
    starts = []
    for record, own in zip(records, at, strict=True):
        problems = rows.assemble([record.run], library, rng=np.random.default_rng(seed))
        starts.append(constrained_fit(problems, own, units=record.run.units))
    runs = [[record.run] for record in records]
    how = set_window(settings, records)
    fits = refine(starts, runs, how, constraints=at, seed=seed, progress=progress)
    return OperatingFit(records, whole, held, fits, settings, seed)


@dataclass(frozen=True, eq=False)
class LeaveOneOut:
    """A free run of one point with the law fitted to the other points.

    The run starts at one sample of the point's record. inside: True if the other points enclose
    this one.
    """

    record: OperatingRecord
    run: FreeRun
    inside: bool

    @property
    def error(self) -> float:
        """Largest deviation from the record's cycle, in units of its bound; at most ten."""
        run = self.run
        amplitude, waveform = (
            np.array(list(each.values())) for each in (run.amplitude_ratio, run.waveform_error)
        )
        found = deviation(run.f_error, amplitude, waveform, FreeRunBounds())
        return MOST if np.isnan(found) else min(found, MOST)


def error_statistics(left_out: Sequence[LeaveOneOut]) -> dict[str, float | int]:
    """Statistics of the errors at points left out: counts, medians, and the 90 % quantile.

    A point without a frequency counts as an infinite frequency error, and does not enter the
    medians of amplitude and waveform. These are taken over each point's worst state.
    """
    f = np.array([abs(each.run.f_error) for each in left_out])
    f[np.isnan(f)] = np.inf
    ratios = [np.array(list(each.run.amplitude_ratio.values())) for each in left_out]
    amplitude = np.array([np.abs(ratio - 1.0).max() for ratio in ratios])
    waveform = np.array([max(each.run.waveform_error.values()) for each in left_out])
    return {
        "n": len(left_out),
        "n_lives": sum(each.run.verdict is Verdict.LIVES for each in left_out),
        "diverging": sum(each.run.rollout.diverged for each in left_out),
        "f_median": float(np.median(f)),
        "f_90": float(np.quantile(f, 0.9, method="higher")),
        "amplitude_median": _median(amplitude),
        "waveform_median": _median(waveform),
    }


def _median(values: Float[np.ndarray, " points"]) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if known.size else float("nan")


def leave_one_out(
    fit: OperatingFit,
    functions: Library,
    *,
    start: OperatingLaw | None = None,
    workers: Workers | None = None,
    progress: Progress | bool = False,
) -> list[LeaveOneOut]:
    """Test each point in turn with the law of the others, run freely.

    start: a law from which that of the others is refined (`refine_law`); None takes `fit_law`.
    Raises ValueError if the points without one do not suffice for the law.
    """
    for k, record in enumerate(fit.records):
        try:
            make_basis(functions, fit.without(k).points)
        except ValueError as error:
            raise ValueError(f"{record.label} cannot be left out: {error}") from error
    one = partial(_leave_out, fit=fit, functions=functions, start=start)
    n_points = len(fit.records)
    stage = as_progress(progress).stage(n_points, "point", "law without a point")
    return collect(workers or Serial(), one, range(n_points), stage)


def _leave_out(
    number: int, *, fit: OperatingFit, functions: Library, start: OperatingLaw | None
) -> LeaveOneOut:
    record, others = fit.records[number], fit.without(number)
    if start is None:
        law = others.fit_law(functions)
    else:
        law, _ = others.refine_law(functions, start=start)
    model = law.model_at(record.parameters, extrapolate=True)
    run = free_run(model, record.from_slowest)
    return LeaveOneOut(record, run, law.is_inside(record.parameters))
