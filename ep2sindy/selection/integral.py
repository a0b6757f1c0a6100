"""Selection by trajectories integrated over windows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.many import DrivenWindows, Ensemble
from ep2sindy.model.model import coef_matrix
from ep2sindy.search.front import ParetoFront
from ep2sindy.selection.combinations import combinations, joint_scores
from ep2sindy.selection.resampled import _within_one_error
from ep2sindy.signals.kalman import KalmanSmoother
from ep2sindy.signals.spectrum import dominant_frequency


@dataclass(frozen=True)
class IntegralScore:
    """Judge equations together, by integrating them: which system keeps to the trajectories?

    Every combination of candidates, one per equation, starts from smoothed samples and runs
    over `n_windows` windows, spread evenly over the trajectories. Its error is the mean square
    distance to the samples in variances of each state, 1 - R2, averaged over the states; no more
    than 10, which a run that diverges gets. Of the combinations within one standard error of the
    least mean error, the one of fewest terms wins. score = the least error of all combinations
    with the candidate, no less than that limit; the winner's candidates a hair below.
    Assumes windows short enough that the error of their start does not outgrow that of the model.
    window_s: None for half a dominant period of the first state; no longer than a trajectory.
    The standard error counts no more windows than fit in side by side.
    max_combinations: more are refused. How they are integrated is in `Ensemble`.
    """

    window_s: float | None = None
    n_windows: int = 20
    max_combinations: int = 4096
    label: ClassVar[str] = "integral error"

    def __post_init__(self) -> None:
        if self.window_s is not None and not self.window_s > 0.0:
            raise ValueError(
                f"window_s must be positive: {self.window_s} came; leave it out to take half a "
                "period"
            )
        for name in ("n_windows", "max_combinations"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1: {getattr(self, name)} came")

    def scores(self, fronts: Sequence[ParetoFront]) -> list[Float[np.ndarray, " _candidates"]]:
        """Raises ValueError for rows without trajectories, a state without a front, or more than
        max_combinations.
        """
        places = combinations(fronts, self.max_combinations)
        records = records_of(fronts)
        window_s = self.window_s or _half_period(records)
        n_samples = sum(run.n_samples for run in records.runs)
        lengths, starts, n_independent = [], [], 0.0
        for run in records.runs:
            n_steps = int(np.clip(round(window_s / run.dt_s), 1, run.n_samples - 1))
            n_windows = max(1, round(self.n_windows * run.n_samples / n_samples))
            last = run.n_samples - 1 - n_steps
            starts.append(np.unique(np.linspace(0, last, n_windows).round().astype(np.int64)))
            lengths.append(n_steps)
            n_independent += min(len(starts[-1]), (run.n_samples - 1) / n_steps)
        errors = records.errors(ensemble_of(fronts, places), starts, lengths)
        limit = _within_one_error(errors, n_independent)
        return joint_scores(fronts, places, errors.mean(axis=1), limit=limit)


def ensemble_of(
    fronts: Sequence[ParetoFront], places: Int[np.ndarray, "combinations fronts"]
) -> Ensemble:
    """One model per combination, its states in the order of the fronts."""
    library = fronts[0].problem.library
    coef = [
        coef_matrix(library, [c.coef_by_term for c in front.candidates])[:, place]
        for front, place in zip(fronts, places.T, strict=True)
    ]
    return Ensemble(library, [front.equation for front in fronts], np.stack(coef, axis=1))


@dataclass(frozen=True, eq=False)
class Records:
    """The trajectories that equations are judged by, and their states smoothed."""

    runs: Sequence[Trajectory]
    smoothed: Sequence[Float[np.ndarray, "_ n_states"]]

    def errors(
        self,
        ensemble: Ensemble,
        starts: Sequence[Int[np.ndarray, " _"]],
        n_steps: Sequence[int],
    ) -> Float[np.ndarray, "models windows"]:
        """Error of every model on every window of every run, started from its smoothed sample.

        starts, n_steps: one per run, in samples. The error is that of `Ensemble.errors`, in
        variances of the smoothed states.
        """
        joined = np.concatenate(self.smoothed)
        centre, spread = joined.mean(axis=0), joined.std(axis=0)
        errors = []
        for run, x, at, n in zip(self.runs, self.smoothed, starts, n_steps, strict=True):
            if at.size:
                windows = DrivenWindows.of(run, x, ensemble.states, ensemble.inputs, at, n)
                errors.append(ensemble.errors(windows, centre=centre, spread=spread))
        return np.concatenate(errors, axis=1)


def records_of(fronts: Sequence[ParetoFront]) -> Records:
    """What stands behind the rows, states in the order of the fronts.

    Raises ValueError for rows without trajectories or a state without a front.
    """
    runs = fronts[0].problem.trajectories
    if not runs:
        raise ValueError(
            "to integrate, the rows must know their trajectories: none came with the regression; "
            "pass them as RegressionRows(trajectories=...)"
        )
    equations = [front.equation for front in fronts]
    if sorted(equations) != sorted(runs[0].state_names):
        raise ValueError(
            f"to integrate, every state needs one front: {equations} came for the states "
            f"{list(runs[0].state_names)}"
        )
    return Records(runs, [KalmanSmoother().smooth(run.t, run.columns(equations)) for run in runs])


def _half_period(records: Records) -> float:
    """Half the dominant period of the first state in the longest trajectory, or all of it."""
    pairs = zip(records.runs, records.smoothed, strict=True)
    run, x = max(pairs, key=lambda pair: np.ptp(pair[0].t))
    frequency_Hz = dominant_frequency(run.t, x[:, 0])
    return 0.5 / frequency_Hz if frequency_Hz > 0.0 else float(np.ptp(run.t))
