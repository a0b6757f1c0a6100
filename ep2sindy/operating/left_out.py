"""Laws tested at points left out: run freely there, and chosen by how they do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float

from ep2sindy.library.library import Library
from ep2sindy.model.comparison import FreeRunBounds, Verdict, deviation
from ep2sindy.model.free_run import FreeRun, free_run
from ep2sindy.operating.point_fits import PointFits
from ep2sindy.operating.records import OperatingRecord
from ep2sindy.regression.pooled import Basis

MOST = 10.0  # upper bound on the reported deviation, also used if there is none
CLOSE = 0.05  # deviation, as a share of its bound, that does not justify another term


@dataclass(frozen=True, eq=False)
class LeftOutRun:
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


@dataclass(frozen=True, eq=False)
class LawTrial:
    """A model's fits at all points, with one kind of law, tested by leaving out each point in turn.

    name: of the model. rate_errors: as of `PointFits.rate_errors`. runs: of records with the law of
    the others; empty for a model that inputs drive, which has no free runs.
    """

    name: str
    fits: PointFits
    functions: Library
    rate_errors: Float[np.ndarray, " points"]
    runs: Sequence[LeftOutRun]

    @property
    def n_numbers(self) -> int:
        """Number of fitted numbers: those of the law of the free coefficients."""
        return self.fits.n_free * len(self.functions)

    @cached_property
    def errors(self) -> Float[np.ndarray, " points"]:
        """Errors by which laws are compared: of the runs, or of the rates if nothing ran freely.

        Of runs, the largest deviation from the record's cycle in units of the bound, at most ten
        and at least a twentieth: smaller deviations do not justify another term.
        """
        if not self.runs:
            return self.rate_errors
        return np.maximum([run.error for run in self.runs], CLOSE)


def try_law(
    name: str, fits: PointFits, records: Sequence[OperatingRecord], functions: Library
) -> LawTrial:
    """Test the law of these functions at every point, each left out in turn.

    Raises ValueError if the points do not suffice for a law without each of them.
    """
    errors, runs = fits.rate_errors(functions), []
    if not fits.models[0].inputs:
        for k, record in enumerate(records):
            law = fits.law_without(k, functions)
            point = {name: record.parameters[name] for name in law.parameters}
            run = free_run(law.at(extrapolate=True, **point), record.from_slowest)
            runs.append(LeftOutRun(record, run, law.is_inside(point)))
    return LawTrial(name, fits, functions, errors, runs)


def fewest_of_least(trials: Sequence[tuple[Float[np.ndarray, " points"], int]]) -> int:
    """Index of the trial with fewest numbers whose mean error cannot be told from the least.

    trials: errors at each point, and a count of numbers. The difference of the errors from the
    least, point by point, must be within one standard error.
    """
    means = [float(errors.mean()) for errors, _ in trials]
    best = min(range(len(trials)), key=lambda k: (means[k], trials[k][1]))
    near = []
    for k, (errors, _) in enumerate(trials):
        apart = errors - trials[best][0]
        reach = apart.std(ddof=1) / np.sqrt(len(apart)) if len(apart) > 1 else 0.0
        if apart.mean() <= reach:
            near.append(k)
    return min(near, key=lambda k: (trials[k][1], means[k]))


def error_statistics(left_out: Sequence[LeftOutRun]) -> dict[str, float | int]:
    """Statistics of the runs at points left out: counts, medians, and the 90 % quantile.

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


def interpolation_errors(
    records: Sequence[OperatingRecord], basis: Basis
) -> tuple[Float[np.ndarray, " records"], Float[np.ndarray, " records"]]:
    """Leave-one-out errors of interpolating frequency and amplitude by functions of the parameters.

    Both are interpolated directly, in logarithms.
    Returns the relative error of the frequency, and the largest relative error of the standard
    deviation over the states. They show how smoothly the records vary: no law of these functions
    can be much better.
    """
    f = np.log([[record.cycle.frequency_Hz] for record in records])
    logs = np.hstack([f, np.log([record.cycle.std for record in records])])
    off = np.abs(np.expm1(basis.predict_left_out(logs) - logs))
    return off[:, 0], off[:, 1:].max(axis=1)
