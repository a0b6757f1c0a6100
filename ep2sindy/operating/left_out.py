"""Laws tested at points left out: over windows of their records, and run freely there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.library.library import Library
from ep2sindy.model.model import SparseModel
from ep2sindy.model.stability import ATTRACTING_BELOW
from ep2sindy.operating.law import make_basis, read_law
from ep2sindy.operating.point_fits import PointFits
from ep2sindy.operating.records import OperatingRecord
from ep2sindy.refinement.methods.multiple_shooting import MultipleShooting
from ep2sindy.refinement.refine import smooth_batch
from ep2sindy.refinement.steps import FusedRungeKutta
from ep2sindy.refinement.windows import cut_windows, dominant_window

# Windows of every record that is left out, and steps of the integration in each of its samples.
N_WINDOWS, N_SUBSTEPS = 20, 4


@dataclass(frozen=True, eq=False)
class LeftOutRun:
    """A free run of one point with the law fitted to the other points.

    The run starts at one sample of the point's record. inside: True if the other points enclose
    this one. interpolated: its errors of `interpolate`, or NaN where the others do not enclose it.
    """

    record: OperatingRecord
    run: Evaluation
    inside: bool
    interpolated: Mapping[str, float]

    @property
    def attracts(self) -> bool:
        """True if the run ends on a cycle that attracts, and so sets the amplitude by itself."""
        return self.run.multiplier < ATTRACTING_BELOW


@dataclass(frozen=True, eq=False)
class LawTrial:
    """One fit of all points, and its law of some functions, tested by leaving out each in turn.

    name: of the fit. errors: for each point, the root mean square over windows of its record, in
    standard deviations of the states, of what the law of the others leaves; see `window_errors`.
    Fits of any kind can be compared by it, whatever bias their coefficients have.
    """

    name: str
    fits: PointFits
    functions: Library
    errors: Float[np.ndarray, " points"]

    @property
    def n_numbers(self) -> int:
        """Number of fitted numbers: those of the law of the free coefficients."""
        return self.fits.n_free * len(self.functions)


def window_errors(
    models: Sequence[SparseModel], run: Trajectory, *, periods: float = 1.0
) -> Float[np.ndarray, " models"]:
    """Error of each model in windows of some periods, over which only its starts are fitted.

    It is the root mean square over windows, samples and states, each in its standard deviations; a
    constant errs by about one, and so does by convention a model that blows up.
    """
    window = dominant_window([run], models[0].states, periods=periods)
    batch = cut_windows([run], models[0], n_windows=N_WINDOWS, window=window, rng=0)
    method = MultipleShooting(step=FusedRungeKutta(N_SUBSTEPS))
    paths = smooth_batch(models, batch, method=method)
    squares = np.square(paths - batch.data).mean(axis=(2, 3))
    return np.sqrt(np.where(squares < 1.0, squares, 1.0).mean(axis=1))


def interpolate(
    functions: Library,
    points: Float[np.ndarray, "points variables"],
    records: Sequence[OperatingRecord],
) -> Float[np.ndarray, "points 2"]:
    """Errors at every point of frequency and amplitude interpolated between the other points.

    No model has a part in it: the functions of a law are fitted to the frequencies, and to the
    standard deviation of each state, of the other records. points: in the order of the functions'
    variables. Returns the relative error of the frequency, and that of the worst amplitude.
    Raises ValueError if the points do not suffice.
    """
    own = np.array([(record.cycle.frequency_Hz, *record.cycle.std) for record in records])
    off = np.abs(make_basis(functions, points, n_spare=1).predict_left_out(own) / own - 1.0)
    return np.column_stack([off[:, 0], off[:, 1:].max(axis=1)])


def run_left_out(trial: LawTrial, records: Sequence[OperatingRecord]) -> list[LeftOutRun]:
    """Run every record freely with the law of the others, and interpolate between these."""
    runs, functions = [], trial.functions
    interpolated = interpolate(functions, trial.fits.columns(functions), records)
    for k, record in enumerate(records):
        law = trial.fits.law_without(k, functions)
        run = evaluate(read_law(law, record.parameters), record.from_slowest)
        inside = law.is_inside(record.parameters)
        off = interpolated[k] if inside else np.full(2, np.nan)
        errors = dict(zip(("frequency", "amplitude"), off.tolist(), strict=True))
        runs.append(LeftOutRun(record, run, inside, errors))
    return runs


def error_statistics(left_out: Sequence[LeftOutRun]) -> dict[str, float | int]:
    """Statistics of the runs at points left out: counts, medians, and the 90 % quantile.

    A point without a frequency counts as an infinite frequency error, and does not enter the
    medians of amplitude and waveform. These are taken over each point's worst state. Over the
    points that the others enclose, the medians of the law stand next to those of `interpolate`.
    """
    f = np.array([abs(each.run.f_error) for each in left_out])
    f[np.isnan(f)] = np.inf
    ratios = [np.array(list(each.run.amplitude_ratio.values())) for each in left_out]
    amplitude = np.array([np.abs(ratio - 1.0).max() for ratio in ratios])
    waveform = np.array([max(each.run.waveform_error.values()) for each in left_out])
    inside = np.array([each.inside for each in left_out])
    between = np.array([[*each.interpolated.values()] for each in left_out])
    return {
        "n": len(left_out),
        "n_cycles": int(np.isfinite(f).sum()),
        "n_sustained": sum(each.run.holds for each in left_out),
        "diverging": sum(each.run.rollout.diverged for each in left_out),
        "f_median": float(np.median(f)),
        "f_90": float(np.quantile(f, 0.9, method="higher")),
        "amplitude_median": _median(amplitude),
        "waveform_median": _median(waveform),
        "n_enclosed": int(inside.sum()),
        "f_enclosed": _median(f[inside]),
        "f_interpolated": _median(between[:, 0]),
        "amplitude_enclosed": _median(np.nan_to_num(amplitude, nan=np.inf)[inside]),
        "amplitude_interpolated": _median(between[:, 1]),
    }


def _median(values: Float[np.ndarray, " points"]) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if known.size else float("nan")
