"""Known terms fitted in the weak form, with windows of several lengths: `+exp=weak`.

The experiment `+exp=weak_windows` uses the same forms and fits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import EquationFit, assemble_model, reweight
from ep2sindy.library.library import Library
from ep2sindy.model.free_run import FreeRun, free_run, samples_in
from ep2sindy.model.model import SparseModel
from ep2sindy.model.scores import r2
from ep2sindy.regression.front import fit_support
from ep2sindy.regression.rows import Formulation, RegressionRows
from ep2sindy.regression.test_functions import Boxes, Bumps, WindowFunctions
from ep2sindy.regression.weak import Weak
from ep2sindy.report.document import Captioned, Equation, Result, Section, Table, Text, pictures
from ep2sindy.report.results import Metric, Metrics, ResultTable, View
from ep2sindy.report.run import Run
from ep2sindy.runtime.progress import SILENT, Progress, count_pieces
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.fits import Terms, equation_texts, terms_of
from ep2sindy.studies.source import Source, data_summary
from ep2sindy.studies.study import Coefficients, Count, Counts, Deferred, PositiveOrAll
from ep2sindy.studies.views import (
    INTEGRATED,
    PlotRange,
    best_run,
    coefficients,
    equation_sections,
    found_model,
    intervals,
    model_summary,
    rollout_tables,
    run_figures,
)

FIGURES = ("trajectories", "phase", "derivatives", "spectra")
INTERVALS = (
    "The intervals say how far the noise of the samples moves the coefficients if these terms are "
    "the whole law; what the terms lack, they do not count."
)


@dataclass(frozen=True)
class Study:
    """Fit the same terms in every form, integrate each model, and compare.

    formulation: the differential form; its smoother gives the data's derivative in figures. boxes:
    the form with random windows. automatic: the form with smooth windows. model: the terms of every
    state. rollout_s: integration time; None means to the data's end. thesis: published equations
    for comparison.
    """

    source: Source
    formulation: Formulation
    boxes: Deferred
    automatic: Formulation
    model: Terms
    n_windows: Count
    n_points: Counts
    rollout_s: PositiveOrAll
    figures: PlotRange
    thesis: Coefficients = field(default_factory=dict)

    def compute(self, run: Run) -> Outcome:
        settings = settings_of(
            self.formulation,
            self.boxes,
            self.automatic,
            n_windows=[self.n_windows],
            n_points=self.n_points,
        )
        library, terms = terms_of(self.model, states=self.source.states)
        with run.progress(None, "", "data"):
            record = self.source.field()
        data = self.source.sampled(record, [library], run)
        fitted = fit_settings(
            data,
            library,
            terms,
            settings,
            rollout_s=self.rollout_s,
            rng=np.random.default_rng(run.seed),
            progress=run.watch,
        )
        return Outcome(self, data, dominant_frequency(data.t, data.states[:, 0]), fitted)


@dataclass(frozen=True)
class Setting:
    """A form of the regression.

    weighted: whether its fit propagates the samples' noise to the rows.
    """

    formulation: Formulation
    weighted: bool = False

    def __post_init__(self) -> None:
        can = isinstance(self.formulation, Weak) and self.formulation.errors_in_variables
        if self.weighted and not can:
            raise ValueError(
                "a weighted fit needs the formulation Weak with errors_in_variables: "
                f"{self.formulation} came"
            )

    @property
    def windows(self) -> WindowFunctions | None:
        """The test functions of this form; None if it is not a weak form."""
        return self.formulation.test_functions if isinstance(self.formulation, Weak) else None

    @property
    def boxes(self) -> Boxes | None:
        """The random windows of this form; None if it has none."""
        return self.windows if isinstance(self.windows, Boxes) else None


@dataclass(frozen=True, eq=False)
class SettingFit:
    """Fit of a trajectory in one setting.

    r2: by state, on the setting's own rows, which differ from setting to setting.
    half_width: by state, in samples, for smooth windows; empty for others.
    """

    setting: Setting
    r2: Mapping[str, float]
    half_width: Mapping[str, int]
    integrated: FreeRun

    def by_state(self, value: Callable[[str], Any]) -> dict[str, Any]:
        return {state: value(state) for state in self.integrated.model.states}

    def window_steps(self, state: str) -> int:
        """Steps in one window, from end to end; 0 if the form has no windows."""
        boxes = self.setting.boxes
        return boxes.n_points - 1 if boxes else 2 * self.half_width.get(state, 0)


def settings_of(
    formulation: Formulation,
    boxes: Deferred,
    automatic: Formulation,
    *,
    n_windows: Sequence[int],
    n_points: Sequence[int],
) -> dict[str, Setting]:
    """The differential form, random windows of every number and length, and smooth windows.

    boxes: the form with random windows; it leaves their number and length null.
    """
    chosen = {"n_windows": n_windows[0], "n_points": n_points[0]}
    for key in chosen:
        given = boxes.settings.get("test_functions", {}).get(key)
        if given is not None:
            raise ValueError(
                f"boxes.test_functions.{key} is what {key} says: {given!r} came; set {key} alone"
            )
    form = boxes.changed({f"test_functions.{key}": value for key, value in chosen.items()}).build()
    return {
        "differential": Setting(formulation),
        **boxes_grid(form, n_windows=n_windows, n_points=n_points),
        "automatic": Setting(automatic),
        "automatic_weighted": Setting(automatic, weighted=True),
    }


def boxes_grid(
    form: Weak, *, n_windows: Sequence[int], n_points: Sequence[int]
) -> dict[str, Setting]:
    """One form with every number and length of windows, named by those of the two that vary."""
    grid = {}
    for windows in n_windows:
        for points in n_points:
            varying = [("n_windows", windows, n_windows), ("n_points", points, n_points)]
            name = "_".join(f"{key}_{value}" for key, value, all in varying if len(all) > 1)
            boxes = Boxes(n_windows=windows, n_points=points)
            grid[name or f"n_points_{points}"] = Setting(replace(form, test_functions=boxes))
    return grid


def check_windows(settings: Mapping[str, Setting], n_samples: int) -> None:
    """Raise ValueError for random windows longer than a trajectory of `n_samples`."""
    longest = max((s.boxes.n_points for s in settings.values() if s.boxes), default=0)
    if longest > n_samples:
        raise ValueError(
            f"windows must fit the data: n_points={longest} was asked of {n_samples} samples; "
            "lower n_points or use more data"
        )


def fit_terms(
    trajectories: Sequence[Trajectory],
    library: Library,
    terms: Mapping[str, Sequence[str]],
    setting: Setting,
    *,
    rng: np.random.Generator,
) -> dict[str, tuple[EquationFit, RegressionRows]]:
    """Fit given terms, state by state, and keep the rows of the fits.

    Raises ValueError as the form's `assemble` and `fit_support` do.
    """
    problems = setting.formulation.assemble(trajectories, library, rng=rng)
    found = {}
    for problem in problems:
        for state in problem.equations:
            plain = fit_support(problem, state, terms[state])
            fit = EquationFit(state, plain.terms, plain.coef)
            found[state] = (reweight(problem, plain) if setting.weighted else fit, problem)
    return found


def fit_settings(
    run: Trajectory,
    library: Library,
    terms: Mapping[str, Sequence[str]],
    settings: Mapping[str, Setting],
    *,
    rollout_s: float | None,
    rng: np.random.Generator,
    progress: Progress = SILENT,
) -> dict[str, SettingFit]:
    """Fit the same terms in every setting and integrate each model from the first sample.

    terms: state -> its terms. rollout_s: integration time; None, or a time beyond the data, means
    to the data's end.
    Each setting draws its windows from its own random stream.
    Raises ValueError, before any fit, for windows longer than the data.
    """
    check_windows(settings, run.n_samples)
    widths = {name: _half_widths(run, setting.windows, rng) for name, setting in settings.items()}
    n_samples = run.n_samples if rollout_s is None else samples_in(run, rollout_s)
    results = {}
    pairs = list(zip(settings.items(), rng.spawn(len(settings)), strict=True))
    for (name, setting), stream in count_pieces(progress, pairs, "setting", "fits and free runs"):
        found = fit_terms([run], library, terms, setting, rng=stream)
        model = assemble_model(
            library,
            [fit for fit, _ in found.values()],
            units=run.units,
            provenance={"formulation": repr(setting.formulation), "trajectories": run.label},
        )
        integrated = free_run(model, run, n_samples=n_samples)
        results[name] = SettingFit(
            setting=setting,
            r2={state: _r2_own_rows(*pair) for state, pair in found.items()},
            half_width=widths[name],
            integrated=integrated,
        )
    return results


def _half_widths(
    run: Trajectory, functions: WindowFunctions | None, rng: np.random.Generator
) -> dict[str, int]:
    """Half-width of the smooth test functions for each state, in samples."""
    if not isinstance(functions, Bumps):
        return {}
    windows = [functions.windows(run.t, x, rng=rng) for x in run.states.T]
    return {
        state: int(w.last[0] - w.first[0]) // 2
        for state, w in zip(run.state_names, windows, strict=True)
    }


def _r2_own_rows(fit: EquationFit, problem: RegressionRows) -> float:
    columns = [problem.library.index(name) for name in fit.terms]
    prediction = fit.coef[None] @ problem.theta[:, columns].T
    truth = problem.target[:, problem.equations.index(fit.equation)]
    return float(r2(truth=truth, prediction=prediction)[0])


@dataclass(frozen=True, eq=False)
class Outcome:
    """Fits of the data in every setting. f_data_Hz: dominant frequency of the first state."""

    study: Study
    data: Trajectory
    f_data_Hz: float
    fitted: Mapping[str, SettingFit]

    @property
    def labelled(self) -> dict[str, SettingFit]:
        """The fits by readable names of the settings."""
        return {_label(name, fitted): fitted for name, fitted in self.fitted.items()}

    def models(self) -> dict[str, SparseModel]:
        return {name: fitted.integrated.model for name, fitted in self.fitted.items()}

    def tables(self) -> dict[str, pd.DataFrame]:
        models = {name: fitted.integrated for name, fitted in self.fitted.items()}
        return {
            **rollout_tables(self.data, models),
            "settings": self._settings(),
            "coefficients": coefficients(self.models(), heading="setting"),
        }

    def figures(self) -> dict[str, Captioned]:
        models = {name: fitted.integrated for name, fitted in self.labelled.items()}
        shown, smoother = self.study.figures, self.study.formulation.smoother
        return run_figures(FIGURES, self.data, models, shown, smoother=smoother)

    def in_short(self) -> Result:
        """The setting whose model runs best over the record."""
        best = best_run({name: fitted.integrated for name, fitted in self.fitted.items()})
        fitted = self.fitted[best]
        scores = ", ".join(f"{state}' {value:.3f}" for state, value in fitted.r2.items())
        more = [Text(f"R2 of its rows: {scores}; the best of {len(self.fitted)} settings")]
        return found_model(
            f"Found with {_label(best, fitted)}",
            fitted.integrated,
            file=best,
            picture="trajectories",
            more=more,
            where="the record",
            seen=True,
        )

    def sections(self) -> list[Section]:
        published = [
            Equation(state, terms, lead="thesis, Eq. 24", aside=True, on_screen=True)
            for state, terms in self.study.thesis.items()
        ]
        models = {name: fitted.integrated.model for name, fitted in self.labelled.items()}
        return [
            Section("Equations", [*published, Text(INTERVALS, page_only=True)]),
            *equation_sections(models, self.data.clock),
            Section("Integrated", [self._table(), *pictures(FIGURES)]),
        ]

    def _settings(self) -> pd.DataFrame:
        """One row per setting and state: windows, equation, R2, and how the model runs."""
        rows = ResultTable(self.fitted, self._metrics()).csv("setting", by_state=True)
        return rows.astype({"n_points": "Int64", "half_width": "Int64"})

    def _table(self) -> Table:
        rows = ResultTable(self.labelled, self._metrics()).screen("setting", by_state=True)
        n = len(self.data.state_names)
        return Table(
            rows,
            title=f"Models {INTEGRATED}",
            breaks=range(n - 1, len(rows), n),
            note=f"The data's first state has {self.data.clock.frequency_text(self.f_data_Hz)}. "
            "R2 is on each setting's own rows: windows average, so it is not comparable between "
            "settings.",
        )

    def _metrics(self) -> Metrics[SettingFit]:
        """Metrics of the fits; samples, length and periods are of the first state's window."""
        clock, dt_s = self.data.clock, self.data.dt_s

        def frequency(fitted: SettingFit) -> str:
            f_Hz, error = first_frequency_Hz(fitted), fitted.integrated.f_error
            if not np.isfinite(f_Hz):
                return "-"
            text = clock.frequency_text(f_Hz)
            return f"{text} ({100 * error:+.0f} %)" if np.isfinite(error) else text

        return [
            Metric("n_points", lambda f: f.setting.boxes and f.setting.boxes.n_points, View.CSV),
            Metric("half_width", lambda f: f.by_state(f.half_width.get), View.CSV),
            Metric(
                "half_width_s",
                lambda f: f.by_state(lambda s: dt_s * f.half_width[s] if f.half_width else None),
                View.CSV,
            ),
            Metric("text", lambda f: equation_texts(f.integrated.model), View.CSV),
            Metric(
                "samples", lambda f: f.by_state(f.window_steps), View.SCREEN,
                format=lambda n: str(n + 1) if n else "-",
            ),
            Metric(
                "length", lambda f: f.by_state(f.window_steps), View.SCREEN,
                format=lambda n: clock.duration_text(n * dt_s) if n else "-",
            ),
            Metric(
                "periods", lambda f: f.by_state(f.window_steps), View.SCREEN,
                format=lambda n: f"{n * dt_s * self.f_data_Hz:.2f}" if n else "-",
            ),
            Metric("r2", lambda f: f.r2, View.ALL, "R2", "{:.3f}"),
            Metric("f", frequency, View.SCREEN),
            Metric("f_Hz", lambda f: f.integrated.frequency_Hz, View.CSV),
            Metric("f_kHz", lambda f: 1e-3 * first_frequency_Hz(f), View.JSON),
            Metric("f_error", lambda f: f.integrated.f_error, View.FILES | View.HEADLINE),
            Metric("nrmse", lambda f: f.integrated.nrmse, View.ALL, format="{:.2f}"),
            Metric("verdict", lambda f: f.integrated.text, View.SHOWN),
        ]  # fmt: skip

    def summary(self) -> dict[str, Any]:
        rows = ResultTable(self.fitted, self._metrics()).json()
        settings = {
            name: model_summary(fitted.integrated.model)
            | _windows_summary(fitted, self.data.dt_s)
            | rows[name]
            for name, fitted in self.fitted.items()
        }
        return {"data": data_summary(self.data), "settings": settings}

    def headline(self) -> dict[str, float]:
        models = ResultTable(self.fitted, self._metrics()).headline()
        return {"data/f_kHz": 1e-3 * self.f_data_Hz} | models


def first_frequency_Hz(fitted: SettingFit) -> float:
    return fitted.integrated.frequency_Hz[fitted.integrated.model.states[0]]


def _label(name: str, fitted: SettingFit) -> str:
    """`70 points` for random windows; other names with commas for underscores."""
    boxes = fitted.setting.boxes
    return f"{boxes.n_points} points" if boxes else name.replace("_", ", ")


def _windows_summary(fitted: SettingFit, dt_s: float) -> dict[str, Any]:
    """Windows of the kinds that a setting has, and intervals if they are known."""
    found: dict[str, Any] = {}
    if boxes := fitted.setting.boxes:
        found = {"n_points": boxes.n_points, "n_windows": boxes.n_windows}
    if fitted.half_width:
        found = {
            "half_width": dict(fitted.half_width),
            "half_width_s": {state: n * dt_s for state, n in fitted.half_width.items()},
        }
    if (known := intervals(fitted.integrated.model)) is not None:
        found["intervals"] = known
    return found
