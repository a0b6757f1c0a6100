"""Known terms fitted in several forms of the regression: what each makes of the same samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.choice import EquationFit, assemble_model, reweight
from ep2sindy.library.library import Library
from ep2sindy.machine.progress import SILENT, Progress, counted
from ep2sindy.model.free_run import FreeRun, free_run, samples_in
from ep2sindy.model.scores import r2
from ep2sindy.regression.rows import Formulation, RegressionRows
from ep2sindy.regression.test_functions import Boxes, Bumps, WindowFunctions
from ep2sindy.regression.weak import Weak
from ep2sindy.search.front import fit_support
from ep2sindy.studies.kinds import Deferred


@dataclass(frozen=True)
class Setting:
    """A form of the regression; weighted: its fit follows the noise of the samples to the rows."""

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
        """The test functions of this form, if it is a weak one."""
        return self.formulation.test_functions if isinstance(self.formulation, Weak) else None

    @property
    def boxes(self) -> Boxes | None:
        """The random windows of this form, if it has any."""
        return self.windows if isinstance(self.windows, Boxes) else None


@dataclass(frozen=True, eq=False)
class Fitted:
    """What one setting makes of a trajectory.

    r2: by state, on the setting's own rows, which differ from setting to setting.
    half_width: by state, in samples, for smooth windows; empty for others.
    f_error: dominant frequency of the first state against the data's, minus one; NaN where the
    integrated model diverges or dies out.
    """

    setting: Setting
    r2: Mapping[str, float]
    half_width: Mapping[str, int]
    integrated: FreeRun
    f_error: float


def settings_of(
    formulation: Formulation,
    boxes: Deferred,
    automatic: Formulation,
    *,
    n_windows: Sequence[int],
    n_points: Sequence[int],
) -> dict[str, Setting]:
    """The differential form, random windows of every number and length, and smooth windows.

    boxes: the form with random windows, whose number and length are null.
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
    """One form with every number and length of windows, named by those that vary."""
    grid = {}
    for windows in n_windows:
        for points in n_points:
            varying = [("n_windows", windows, n_windows), ("n_points", points, n_points)]
            name = "_".join(f"{key}_{value}" for key, value, all in varying if len(all) > 1)
            boxes = Boxes(n_windows=windows, n_points=points)
            grid[name or f"n_points_{points}"] = Setting(replace(form, test_functions=boxes))
    return grid


def check_windows(settings: Mapping[str, Setting], n_samples: int) -> None:
    """Raise ValueError for boxes that are longer than a trajectory of `n_samples`."""
    longest = max((s.boxes.n_points for s in settings.values() if s.boxes), default=0)
    if longest > n_samples:
        raise ValueError(
            f"windows must fit the data: n_points={longest} was asked of {n_samples} samples; "
            "lower n_points or use more data"
        )


def fitted_terms(
    trajectories: Sequence[Trajectory],
    library: Library,
    terms: Mapping[str, Sequence[str]],
    setting: Setting,
    *,
    rng: np.random.Generator,
) -> dict[str, tuple[EquationFit, RegressionRows]]:
    """Fit given terms, state by state, and keep the rows that they were fitted to.

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
    f_data_Hz: float,
    rollout_s: float | None,
    rng: np.random.Generator,
    progress: Progress = SILENT,
) -> dict[str, Fitted]:
    """Fit the same terms in every setting and integrate each model from the first sample.

    terms: state -> its terms. f_data_Hz: the frequency that models are held against. rollout_s:
    how far to integrate; None, or more than there is, means to the data's end.
    Each setting draws its windows from a stream of its own.
    Raises ValueError, before any fit, for windows longer than the data.
    """
    check_windows(settings, run.n_samples)
    widths = {name: _half_widths(run, setting.windows, rng) for name, setting in settings.items()}
    n_samples = run.n_samples if rollout_s is None else samples_in(run, rollout_s)
    results = {}
    pairs = list(zip(settings.items(), rng.spawn(len(settings)), strict=True))
    for (name, setting), stream in counted(progress, pairs, "setting", "fits and free runs"):
        found = fitted_terms([run], library, terms, setting, rng=stream)
        model = assemble_model(
            library,
            [fit for fit, _ in found.values()],
            units=run.units,
            provenance={"formulation": repr(setting.formulation), "trajectories": run.label},
        )
        integrated = free_run(model, run, n_samples=n_samples)
        results[name] = Fitted(
            setting=setting,
            r2={state: _r2_own_rows(*pair) for state, pair in found.items()},
            half_width=widths[name],
            integrated=integrated,
            f_error=integrated.frequency_Hz[run.state_names[0]] / f_data_Hz - 1.0,
        )
    return results


def _half_widths(
    run: Trajectory, functions: WindowFunctions | None, rng: np.random.Generator
) -> dict[str, int]:
    """Of smooth windows, by state."""
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
