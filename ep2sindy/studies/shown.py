"""What several studies show alike: figures of runs, and runs as tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.integrated import Integrated
from ep2sindy.model.model import SparseModel
from ep2sindy.studies.kinds import PositiveOrAll

INTEGRATED = "integrated from the first sample (nrmse 1: no better than a constant)"


@dataclass(frozen=True)
class Shown:
    """How much figures show: the start of a record, and the low end of spectra."""

    duration_s: PositiveOrAll
    f_max_Hz: PositiveOrAll

    def span_s(self, data: Trajectory) -> float:
        return self.duration_s or float(data.t[-1] - data.t[0])

    def up_to_Hz(self, data: Trajectory) -> float:
        return self.f_max_Hz or 0.5 / data.dt_s


def rollout_table(data: Trajectory, integrated: Integrated) -> pd.DataFrame:
    """Model and data, sample by sample, so that the figure can be drawn again."""
    rollout, states = integrated.rollout, integrated.model.states
    samples = data.columns(states)[: len(rollout.t)]
    columns: dict[str, Any] = {"t_s": rollout.t}
    for k, state in enumerate(states):
        columns |= {f"{state}_data": samples[:, k], f"{state}_model": rollout.states[:, k]}
    return pd.DataFrame(columns)


def coefficients(models: Mapping[str, SparseModel], *, heading: str) -> pd.DataFrame:
    """One row per model, state and term: in SI, with 95 % intervals where they are known.

    heading: of the column that holds the models' names.
    """
    rows = []
    for name, model in models.items():
        for state in model.states:
            ends = model.intervals(state) if model.covariance is not None else {}
            for term, value in model.terms(state).items():
                lower, upper = ends.get(term, (np.nan, np.nan))
                row: dict[str, Any] = {heading: name, "state": state, "term": term}
                rows.append(row | {"coef": value, "lower": lower, "upper": upper})
    return pd.DataFrame(rows)
