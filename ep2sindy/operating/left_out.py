"""Laws tested at points left out: over windows of their records, and run freely there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.library.library import Library
from ep2sindy.model.model import SparseModel
from ep2sindy.model.stability import ATTRACTING_BELOW
from ep2sindy.operating.law import read_law
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
    this one.
    """

    record: OperatingRecord
    run: Evaluation
    inside: bool

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
    batch = cut_windows(
        [run],
        states=models[0].states,
        inputs=models[0].inputs,
        n_windows=N_WINDOWS,
        window=window,
        rng=0,
        courses=models[0].courses,
    )
    method = MultipleShooting(step=FusedRungeKutta(N_SUBSTEPS))
    paths = smooth_batch(models, batch, method=method)
    squares = np.square(paths - batch.data).mean(axis=(2, 3))
    return np.sqrt(np.where(squares < 1.0, squares, 1.0).mean(axis=1))


def run_left_out(trial: LawTrial, records: Sequence[OperatingRecord]) -> list[LeftOutRun]:
    """Run every record freely with the law of the others."""
    runs = []
    for k, record in enumerate(records):
        law = trial.fits.law_without(k, trial.functions)
        run = evaluate(read_law(law, record.parameters), record.from_slowest)
        runs.append(LeftOutRun(record, run, law.is_inside(record.parameters)))
    return runs


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
        "n_sustained": sum(each.run.holds for each in left_out),
        "diverging": sum(each.run.rollout.diverged for each in left_out),
        "f_median": float(np.median(f)),
        "f_90": float(np.quantile(f, 0.9, method="higher")),
        "amplitude_median": _median(amplitude),
        "waveform_median": _median(waveform),
    }


def _median(values: Float[np.ndarray, " points"]) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if known.size else float("nan")
