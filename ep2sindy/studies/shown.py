"""What several studies show alike: runs as figures and tables, models as equations and tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures import series
from ep2sindy.model.integrated import Integrated
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import Rollout
from ep2sindy.report.document import Block, Equation, Section, Text
from ep2sindy.studies.kinds import PositiveOrAll

if TYPE_CHECKING:
    from matplotlib.figure import Figure

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


def rollout_drawings(
    data: Trajectory, rollouts: Mapping[str, Rollout], shown: Shown
) -> dict[str, Callable[[], Figure]]:
    """Trajectories, spectra and, of two states or more, phase portraits; each drawn when called."""
    span_s, plane = shown.span_s(data), data.state_names[:2]
    drawn: dict[str, Callable[[], Figure]] = {
        "trajectories": partial(series.trajectory_figure, data, rollouts, duration_s=span_s),
        "spectra": partial(series.spectrum_figure, data, rollouts, f_max_Hz=shown.up_to_Hz(data)),
    }
    if len(plane) > 1:
        drawn["phase"] = partial(
            series.phase_figure, data, rollouts, plane=plane, duration_s=span_s
        )
    return drawn


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


def intervals_text(model: SparseModel, state: str) -> str:
    """`n_i: -6.77e+05 to -6.74e+05`, term by term."""
    ends = model.intervals(state)
    return "; ".join(f"{term}: {low:.4g} to {high:.4g}" for term, (low, high) in ends.items())


def equation_sections(
    models: Mapping[str, SparseModel], *, page_only: bool = False
) -> list[Section]:
    """Under the name of each model its equations, with intervals where they are known."""
    found = []
    for name, model in models.items():
        blocks: list[Block] = []
        for state in model.states:
            blocks.append(Equation(state, model.terms(state), on_screen=True))
            if model.covariance is not None:
                blocks.append(Text(f"95 %: {intervals_text(model, state)}", page_only=page_only))
        found.append(Section(name, blocks, level=3))
    return found
