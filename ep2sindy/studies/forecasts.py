"""Forecasts in studies: their section with its sentence and figure."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.series import forecast_figure
from ep2sindy.forecasting.skill import MODEL, ForecastSkill, forecast_skill
from ep2sindy.model.model import SparseModel
from ep2sindy.report.report import Report
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.studies.source import LEAST_SAMPLES, is_short

CAPTION = (
    "Forecast of the last part of the record, its start estimated from the past alone, with the "
    "band that is to hold 90 % of the samples. Last panel: error of forecasts from starts all over "
    "that part, by horizon (1: no better than the mean); persistence: the last sample "
    "stays; harmonics: the mean cycle continues; autoregression: linear in the samples or in their "
    "logarithms, its order by AIC; neighbours: what followed the most similar moments."
)


def why_none(run: Trajectory, n_fitted: int) -> str:
    """Why a record is too short for forecasts; empty if it is not."""
    if not is_short(run, n_fitted):
        return ""
    return (
        f"no forecasts: they need {LEAST_SAMPLES} samples or more to fit and as many to test; the "
        f"record has {run.n_samples}, {n_fitted} to fit and {run.n_samples - n_fitted} to test"
    )


def skill_of(
    model: SparseModel, run: Trajectory, *, n_fitted: int, starts: int, seen: bool,
    progress: Progress = SILENT,
) -> ForecastSkill | None:  # fmt: skip
    """Skill of a model of measured states; None for an empty model, or a short record.

    seen: whether the model was fitted to all of the record.
    """
    if not starts or is_short(run, n_fitted) or not model.coef.any():
        return None
    skill = forecast_skill(model, run, n_fitted=n_fitted, starts=starts, progress=progress)
    return replace(skill, seen=seen)


def add_forecasts(
    report: Report, name: str, run: Trajectory, skill: ForecastSkill, *, title: str = "Forecasts"
) -> None:
    """Add how far ahead a model forecasts, next to baselines: a part of the section before.

    name: of the model, which names the files.
    """
    report.section(title, f"forecasts: {skill.text}", _note(skill), level=3)
    report.figure(f"forecast_{name}", partial(forecast_figure, run, skill), CAPTION)
    errors = pd.DataFrame({"horizon_s": skill.horizons_s, **skill.nrmse})
    report.samples(f"forecast_{name}", errors)
    report.summary.setdefault("forecasts", {})[name] = skill.summary()


def _note(skill: ForecastSkill) -> str:
    """How many forecasts there are, and how far their bands can be trusted."""
    held = f"the bands of 90 % hold {100.0 * skill.coverage_90:.0f} % of the samples"
    if not np.isfinite(skill.coverage_90):
        held = (
            "there are no bands: what the model was fitted to is too short, grows or decays "
            "throughout, or forecasts of it diverge"
        )
    steps = " Baselines take the samples interpolated onto equal steps." if skill.resampled else ""
    fitted = ", although the model was fitted to all of the record" if skill.seen else ""
    n = len(skill.squared[MODEL])
    return f"{n} starts, whose states are estimated from the past alone{fitted}; {held}.{steps}"
