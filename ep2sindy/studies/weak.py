"""Known terms fitted in the weak form, with windows of several lengths: `+exp=weak`.

The experiment `+exp=weak_windows` uses the same forms and fits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import assemble_model, reweight
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.library.library import Library
from ep2sindy.model.comparison import samples_in
from ep2sindy.model.scores import r2
from ep2sindy.regression.formulations import Weak
from ep2sindy.regression.front import Candidate, fit_support
from ep2sindy.regression.rows import Formulation, RegressionRows
from ep2sindy.regression.windows import Boxes, Bumps, WindowFunctions
from ep2sindy.report.document import Equation, Table, Text
from ep2sindy.report.results import Metric, Metrics, ResultTable, View
from ep2sindy.report.run import Run
from ep2sindy.runtime.progress import SILENT, Progress, count_pieces
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.fits import RUN, Outcome, Terms, terms_of
from ep2sindy.studies.source import Source, data_summary
from ep2sindy.studies.study import Coefficients, Count, Counts, Deferred, PositiveOrAll
from ep2sindy.studies.views import INTEGRATED, MODEL, PlotRange, intervals, run_figures

FIGURES = ("trajectories", "phase", "derivatives", "spectra")
INTERVALS = (
    "The intervals say how far the noise of the samples moves the coefficients if these terms are "
    "the whole law; what the terms lack, they do not count."
)
NOTE = (
    "The data's first state has {}. R2 is on each setting's own rows: windows average, so it is "
    "not comparable between settings."
)
TOLD = ("f", "f_Hz", "f_kHz", "f_error", "nrmse")  # of a run
WHOLE = {"n_points": "Int64", "half_width": "Int64"}


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
        _, data = self.source.opened([library], run)
        fitted = fit_settings(
            data,
            library,
            terms,
            settings,
            rollout_s=self.rollout_s,
            rng=np.random.default_rng(run.seed),
            progress=run.watch,
        )
        return _outcome(self, data, fitted)


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
    integrated: Evaluation

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
) -> dict[str, tuple[Candidate, RegressionRows]]:
    """Fit given terms, state by state, and keep the rows of the fits.

    Raises ValueError as the form's `assemble` and `fit_support` do.
    """
    problems = setting.formulation.assemble(trajectories, library, rng=rng)
    found = {}
    for problem in problems:
        for state in problem.equations:
            plain = fit_support(problem, state, terms[state])
            found[state] = (reweight(problem, plain) if setting.weighted else plain, problem)
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
        integrated = evaluate(model, run, n_samples=n_samples)
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


def _r2_own_rows(fit: Candidate, problem: RegressionRows) -> float:
    columns = [problem.library.index(name) for name in fit.terms]
    prediction = fit.coef[None] @ problem.theta[:, columns].T
    truth = problem.target[:, problem.equations.index(fit.equation)]
    return float(r2(truth=truth, prediction=prediction)[0])


def _outcome(study: Study, data: Trajectory, fitted: Mapping[str, SettingFit]) -> Outcome:
    """Fits of the data in every setting."""
    f_Hz = dominant_frequency(data.t, data.states[:, 0])
    metrics = _metrics(data, f_Hz)
    labels = {name: _label(name, each) for name, each in fitted.items()}
    settings = ResultTable(fitted, metrics)
    rows = ResultTable({labels[name]: each for name, each in fitted.items()}, metrics)
    scores = {
        name: ", ".join(f"{state}' {value:.3f}" for state, value in each.r2.items())
        for name, each in fitted.items()
    }
    summaries = {
        name: rows | _windows_summary(fitted[name], data.dt_s)
        for name, rows in settings.json().items()
    }
    n, smoother = len(data.state_names), study.formulation.smoother
    drawn = {labels[name]: each.integrated for name, each in fitted.items()}
    return Outcome(
        data=data,
        seen=True,
        runs={name: each.integrated for name, each in fitted.items()},
        labels=labels,
        kind="setting",
        fits=settings.csv("setting", by_state=True).astype(WHOLE),
        shown=Table(
            rows.screen("setting", by_state=True),
            title=f"Models {INTEGRATED}",
            breaks=range(n - 1, n * len(fitted), n),
            note=NOTE.format(data.clock.frequency_text(f_Hz)),
        ),
        about=[
            *(
                Equation(state, terms, lead="thesis, Eq. 24", aside=True, on_screen=True)
                for state, terms in study.thesis.items()
            ),
            Text(INTERVALS, page_only=True),
        ],
        drawn=run_figures(FIGURES, data, drawn, study.figures, smoother=smoother),
        findings={"data": data_summary(data), "settings": summaries},
        numbers={"data/f_kHz": 1e-3 * f_Hz} | settings.headline(),
        of_best={name: f"R2 of its rows: {text}; " for name, text in scores.items()},
    )


def _metrics(data: Trajectory, f_data_Hz: float) -> Metrics[SettingFit]:
    """Metrics of the fits; samples, length and periods are of the first state's window."""
    clock, dt_s = data.clock, data.dt_s
    lengths: dict[str, Callable[[int], str]] = {
        "samples": lambda n: str(n + 1),
        "length": lambda n: clock.duration_text(n * dt_s),
        "periods": lambda n: f"{n * dt_s * f_data_Hz:.2f}",
    }
    return [
        *(metric.of(lambda f: f.integrated.model) for metric in MODEL),
        Metric("n_points", lambda f: f.setting.boxes and f.setting.boxes.n_points, View.CSV),
        Metric("half_width", lambda f: f.by_state(f.half_width.get), View.CSV),
        Metric(
            "half_width_s",
            lambda f: f.by_state(lambda s: dt_s * f.half_width[s] if f.half_width else None),
            View.CSV,
        ),
        *(
            Metric(
                name, lambda f: f.by_state(f.window_steps), View.SCREEN,
                format=partial(_or_dash, text=text),
            )
            for name, text in lengths.items()
        ),
        Metric("r2", lambda f: f.r2, View.ALL, "R2", "{:.3f}"),
        *(metric.of(lambda f: f.integrated) for metric in RUN if metric.key in TOLD),
        Metric("status", lambda f: f.integrated.text, View.SHOWN),
    ]  # fmt: skip


def _or_dash(n: int, text: Callable[[int], str]) -> str:
    """The text for a number of steps; a dash if there are no windows."""
    return text(n) if n else "-"


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
