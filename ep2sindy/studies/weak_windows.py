"""Dependence of coefficient errors under noise on the number and length of windows.

The experiment is `+exp=weak_windows`. Source: the thesis, appendix, III-A. The true support is
known, and least squares gives the coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.windows import window_error_figure
from ep2sindy.library.library import Library, named_terms
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.document import Captioned, Picture, Result, Section, Table, Text
from ep2sindy.report.results import json_rows
from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Workers, rows_in_order
from ep2sindy.studies.study import Count, Counts, Deferred, Levels, Positive
from ep2sindy.studies.weak import Setting, check_windows, fit_terms, settings_of
from ep2sindy.systems.systems import System

FIGURE = (
    "||beta - beta_true|| / ||beta_true|| over all equations against noise: a panel per window "
    "length, a line per number of windows; black: the same forms in every panel."
)


@dataclass(frozen=True)
class Study:
    """Errors of coefficients of known terms under noise, in every form, with all kinds of windows.

    rate_Hz: sampling rate of the system. formulation: the differential form. boxes: the form with
    random windows. automatic: the form with smooth windows. noises: standard deviations of the
    white noise, in RMS of each state. A realization is one draw of the noise. All settings share
    it, and so do all noise levels but for its size.
    """

    system: System
    rate_Hz: Positive
    formulation: Formulation
    boxes: Deferred
    automatic: Formulation
    n_windows: Counts
    n_points: Counts
    noises: Levels
    n_realizations: Count
    parallel: Workers

    def compute(self, run: Run) -> Outcome:
        settings = settings_of(
            self.formulation,
            self.boxes,
            self.automatic,
            n_windows=self.n_windows,
            n_points=self.n_points,
        )
        n_pieces = len(self.noises) * self.n_realizations
        with run.progress(n_pieces, "realization") as progress:
            errors = self.errors(settings, seed=run.seed, progress=progress)
        return Outcome(self.sampled, settings, errors, window_cells(errors, settings))

    @property
    def sampled(self) -> System:
        return replace(self.system, rate_Hz=self.rate_Hz)

    def errors(
        self,
        settings: Mapping[str, Setting],
        *,
        seed: int = 0,
        progress: Callable[[int], None] = lambda n_more: None,
    ) -> pd.DataFrame:
        """The coefficient error of every setting on every realization.

        Workers share the realizations. One row per noise, number and setting. Raises ValueError,
        before any fit, for windows longer than the trajectory, or if there is nothing to run.
        """
        check_windows(settings, round(self.system.duration_s * self.rate_Hz))
        tasks = list(product(self.noises, range(self.n_realizations)))
        fit = partial(_realization, self.sampled, settings, seed=seed)
        return pd.DataFrame(rows_in_order(self.parallel, fit, tasks, progress))


def true_library(system: System) -> Library:
    """The terms of all equations of a system, each once."""
    names = [name for state in system.model.states for name in system.model.terms(state)]
    return named_terms(system.model.library.variables, list(dict.fromkeys(names)))


def coefficient_error(
    system: System, run: Trajectory, setting: Setting, *, rng: np.random.Generator
) -> float:
    """||beta - beta_true|| / ||beta_true||; beta holds the coefficients of all equations."""
    truth = {state: system.model.terms(state) for state in system.model.states}
    terms = {state: list(of) for state, of in truth.items()}
    found = fit_terms([run], true_library(system), terms, setting, rng=rng)
    fitted = {state: candidate.coef_by_term for state, (candidate, _) in found.items()}
    beta_true = np.array([truth[state][name] for state in truth for name in terms[state]])
    beta = np.array([fitted[state][name] for state in truth for name in terms[state]])
    return float(np.linalg.norm(beta - beta_true) / np.linalg.norm(beta_true))


def _realization(
    system: System, settings: Mapping[str, Setting], task: tuple[float, int], *, seed: int
) -> list[dict[str, object]]:
    noise, number = task
    run = system.trajectory(noise=noise, rng=np.random.default_rng([seed, number]))
    rows: list[dict[str, object]] = []
    for name, setting in settings.items():
        # Each setting has its own random stream, so that leaving one out changes no other.
        rng = np.random.default_rng([seed, number, *name.encode()])
        error = coefficient_error(system, run, setting, rng=rng)
        rows.append({"setting": name, "noise": noise, "number": number, "error": error})
    return rows


def window_cells(errors: pd.DataFrame, settings: Mapping[str, Setting]) -> pd.DataFrame:
    """Mean and standard deviation over the realizations, one row per setting and noise.

    n_windows, n_points: missing for settings without random windows.
    """
    grouped = errors.groupby(["setting", "noise"], sort=False)["error"]
    cells = grouped.agg(error_mean="mean", error_std="std", n="count").reset_index()
    boxes = [settings[name].boxes for name in cells["setting"]]
    for place, key in enumerate(("n_windows", "n_points"), start=1):
        values = [getattr(box, key) if box else None for box in boxes]
        cells.insert(place, key, pd.Series(values, dtype="Int64"))
    return cells


@dataclass(frozen=True, eq=False)
class Outcome:
    """Errors of all settings.

    errors: from `Study.errors`. cells: their means, from `window_cells`.
    """

    system: System
    settings: Mapping[str, Setting]
    errors: pd.DataFrame
    cells: pd.DataFrame

    def models(self) -> dict[str, SparseModel]:
        return {}

    def tables(self) -> dict[str, pd.DataFrame]:
        return {"errors": self.errors, "cells": self.cells}

    def figures(self) -> dict[str, Captioned]:
        references = [name for name, setting in self.settings.items() if not setting.boxes]
        draw = partial(window_error_figure, self.cells, references=references)
        return {"errors": Captioned(draw, FIGURE)}

    def in_short(self) -> Result:
        """The windows of least error at each level of noise."""
        least = self.cells.loc[self.cells.groupby("noise")["error_mean"].idxmin()]
        lines = [
            f"{100 * row['noise']:g} % noise: {row['setting']}, {100 * row['error_mean']:.2g} %"
            for row in least.to_dict("records")
        ]
        return Result(
            f"Found: the windows of least error for {self.system.name}",
            [Text(f"error of the coefficients in the mean: {'; '.join(lines)}")],
            load='pandas.read_csv("{}/tables/cells.csv")',
            picture="errors",
        )

    def sections(self) -> list[Section]:
        system = self.system
        text = (
            f"{system.name}, {system.duration_s:g} s at {system.rate_Hz:g} Hz, "
            f"{int(self.cells['n'].iloc[0])} realizations of the noise, in % of each state's RMS; "
            "the terms of the equations are known, and least squares finds their coefficients "
            "(automatic_weighted: weighted)."
        )
        note = "Without noise the error is that of the integrals and derivatives."
        return [
            Section("Windows", [Text(text), Picture("errors")]),
            Section(
                "Coefficient error, mean over the realizations",
                [Table(by_noise(self.cells), note=note)],
            ),
        ]

    def summary(self) -> dict[str, Any]:
        return {"cells": json_rows(self.cells)}

    def headline(self) -> dict[str, float]:
        return {
            f"{row['setting']}/error_{100 * row['noise']:g}_percent": row["error_mean"]
            for row in self.cells.to_dict("records")
        }


def by_noise(cells: pd.DataFrame) -> pd.DataFrame:
    """One row per setting, one column of mean errors per noise level, as text."""
    shown = cells.assign(noise=[f"{100 * noise:g} % noise" for noise in cells["noise"]])
    table = shown.pivot(index="setting", columns="noise", values="error_mean")
    order = [shown["setting"].unique(), shown["noise"].unique()]
    texts = table.loc[order[0], order[1]].map("{:.2e}".format)
    return texts.reset_index().rename_axis(columns=None)
