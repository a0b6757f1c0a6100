"""A model integrated over data, and how far it strays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import Rollout
from ep2sindy.signals.spectrum import dominant_frequency


@dataclass(frozen=True, eq=False)
class Integrated:
    """A model, its run over the first samples of the data, and how far it strays.

    frequency_Hz: dominant frequency of each state of the rollout; NaN where it diverged, or where
    the state died out: less than a tenth of the data's spread in the second half.
    nrmse: root mean square error over the rollout, in standard deviations of the data, RMS
    over the states; NaN where it diverged. A constant at the mean scores 1.
    """

    model: SparseModel
    rollout: Rollout
    frequency_Hz: Mapping[str, float]
    nrmse: float

    @property
    def verdict(self) -> str:
        """One word or two on the trajectory."""
        if self.rollout.diverged:
            return f"diverges at {self.rollout.t[-1]:.3g} s"
        if np.isnan(list(self.frequency_Hz.values())).any():
            return "dies out"
        return "oscillates" if self.nrmse >= 1.0 else "follows the data"


def integrate(
    model: SparseModel,
    run: Trajectory,
    n_samples: int,
    *,
    initial: Float[np.ndarray, " n_states"] | None = None,
) -> Integrated:
    """Run a model over the first samples of the data, and compare.

    initial: the state to start from, in SI; None takes the data's.
    """
    rollout = model.rollout(run, n_samples=n_samples, initial=initial)
    return Integrated(model, rollout, _frequencies(model, rollout, run), _nrmse(rollout, run))


def samples_in(run: Trajectory, duration_s: float) -> int:
    """Number of samples in the first `duration_s`, or in all where the data end before.

    Raises ValueError for a duration that holds fewer than two samples.
    """
    n = int(np.searchsorted(run.t, run.t[0] + duration_s * (1 + 1e-9), side="right"))
    if n < 2:
        raise ValueError(
            f"a window must hold two samples: {duration_s:g} s was asked of steps of {run.dt_s:g} s"
        )
    return n


def _frequencies(model: SparseModel, rollout: Rollout, run: Trajectory) -> dict[str, float]:
    found = {}
    for name, column in zip(model.states, rollout.states.T, strict=True):
        alive = column[len(column) // 2 :].std() > 0.1 * run.columns([name]).std()
        steady = alive and not rollout.diverged
        found[name] = dominant_frequency(rollout.t, column) if steady else float("nan")
    return found


def _nrmse(rollout: Rollout, run: Trajectory) -> float:
    if rollout.diverged:
        return float("nan")
    data = run.states[: len(rollout.t)]
    return float(np.sqrt(np.mean(np.square((rollout.states - data) / data.std(axis=0)))))
