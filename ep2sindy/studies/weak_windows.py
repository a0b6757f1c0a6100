"""Dependence of coefficient errors under noise on the number and length of windows.

The experiment is `+exp=weak_windows`. Source: the thesis, appendix, III-A. The true support is
known, and least squares gives the coefficients, in the ways that `studies.fitted` has.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.windows import window_error_figure
from ep2sindy.library.library import named_terms
from ep2sindy.library.relations import constraint
from ep2sindy.regression.constrained import constrained_fit
from ep2sindy.regression.rows import Formulation
from ep2sindy.report.document import Result, Text
from ep2sindy.report.report import Report
from ep2sindy.runtime.parallel import Workers, rows_in_order
from ep2sindy.runtime.progress import SILENT, Progress
from ep2sindy.studies.fitted import Fit, boxes_of, expand
from ep2sindy.studies.study import Count, Levels, Positive
from ep2sindy.systems.systems import System

FIGURE = (
    "||beta - beta_true|| / ||beta_true|| over all equations against noise: a panel per window "
    "length, a line per number of windows; black: the same forms in every panel."
)


@dataclass(frozen=True)
class Study:
    """Errors of coefficients of known terms under noise, in every form, with all kinds of windows.

    rate_Hz: sampling rate of the system. formulation, forms, fits: as in a study of fits. noises:
    standard deviations of the white noise, in RMS of each state. A realization is one draw of the
    noise. All fits share it, and so do all noise levels but for its size.
    """

    system: System
    rate_Hz: Positive
    formulation: Formulation
    fits: Mapping[str, Fit]
    noises: Levels
    n_realizations: Count
    parallel: Workers
    forms: Mapping[str, Formulation] = field(default_factory=dict)

    def run(self, report: Report) -> None:
        ways = expand(self.fits, self.forms, self.formulation)
        forms = {way.name: way.form for way in ways if way.form is not None}
        errors = self.errors(forms, seed=report.seed, progress=report.watch)
        cells, system = error_cells(errors, forms), self.system
        report.section(
            "Windows",
            f"{system.name}, {system.duration_s:g} s at {self.rate_Hz:g} Hz, "
            f"{self.n_realizations} realizations of the noise, in % of each state's RMS; the terms "
            "of the equations are known, and least squares finds their coefficients.",
        )
        references = [name for name, form in forms.items() if boxes_of(form) is None]
        draw = partial(window_error_figure, cells, references=references)
        report.figure("errors", draw, FIGURE)
        report.section("Coefficient error, mean over the realizations")
        note = "Without noise the error is that of the integrals and derivatives."
        report.table("cells", cells, note=note)
        report.samples("errors", errors)
        means = cells.to_dict("records")
        report.headline |= {
            f"{row['fit']}/error_{100 * row['noise']:g}_percent": row["error_mean"] for row in means
        }
        least = cells.loc[cells.groupby("noise")["error_mean"].idxmin()].to_dict("records")
        lines = [
            f"{100 * row['noise']:g} % noise: {row['fit']}, {100 * row['error_mean']:.2g} %"
            for row in least
        ]
        report.found(
            Result(
                f"Found: the windows of least error for {system.name}",
                [Text(f"error of the coefficients in the mean: {'; '.join(lines)}")],
                load='pandas.read_csv("{}/tables/cells.csv")',
                picture="errors",
            )
        )

    def errors(
        self, forms: Mapping[str, Formulation], *, seed: int = 0, progress: Progress = SILENT
    ) -> pd.DataFrame:
        """The coefficient error of every form on every realization.

        Workers share the realizations. One row per noise, number and form. Raises ValueError if
        there is nothing to run.
        """
        tasks = list(product(self.noises, range(self.n_realizations)))
        sampled = replace(self.system, rate_Hz=self.rate_Hz)
        fit = partial(_realization, sampled, forms, seed=seed)
        return pd.DataFrame(rows_in_order(self.parallel, fit, tasks, "realization", progress))


def coefficient_error(
    system: System, run: Trajectory, form: Formulation, *, rng: np.random.Generator
) -> float:
    """||beta - beta_true|| / ||beta_true||; beta holds the coefficients of all equations."""
    truth = {state: system.model.terms(state) for state in system.model.states}
    names = list(dict.fromkeys(name for terms in truth.values() for name in terms))
    library = named_terms(system.model.library.variables, names)
    held = constraint(library, {state: list(terms) for state, terms in truth.items()})
    found = constrained_fit(form.assemble([run], library, rng=rng), held)
    beta = np.array([found.terms(state).get(term, 0.0) for state, term in held.coefficients])
    beta_true = np.array([truth[state][term] for state, term in held.coefficients])
    return float(np.linalg.norm(beta - beta_true) / np.linalg.norm(beta_true))


def _realization(
    system: System, forms: Mapping[str, Formulation], task: tuple[float, int], *, seed: int
) -> list[dict[str, object]]:
    noise, number = task
    run = system.trajectory(noise=noise, rng=np.random.default_rng([seed, number]))
    rows: list[dict[str, object]] = []
    for name, form in forms.items():
        # Each form has its own random stream, so that leaving one out changes no other.
        rng = np.random.default_rng([seed, number, *name.encode()])
        error = coefficient_error(system, run, form, rng=rng)
        rows.append({"fit": name, "noise": noise, "number": number, "error": error})
    return rows


def error_cells(errors: pd.DataFrame, forms: Mapping[str, Formulation]) -> pd.DataFrame:
    """Mean and standard deviation over the realizations, one row per form and noise.

    n_windows, n_points: missing for forms without random windows.
    """
    grouped = errors.groupby(["fit", "noise"], sort=False)["error"]
    cells = grouped.agg(error_mean="mean", error_std="std", n="count").reset_index()
    boxes = [boxes_of(forms[name]) for name in cells["fit"]]
    for place, key in enumerate(("n_windows", "n_points"), start=1):
        values = [getattr(box, key) if box else None for box in boxes]
        cells.insert(place, key, pd.Series(values, dtype="Int64"))
    return cells
