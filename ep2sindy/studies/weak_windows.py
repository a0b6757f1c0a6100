"""How the number and length of windows decide the coefficients that noise leaves.

Source: the thesis, appendix, III-A: the true support is known, and least squares does the rest.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import pandas as pd

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library, named_terms
from ep2sindy.machine.parallel import ONE_BY_ONE, Workers
from ep2sindy.studies.weak_forms import Setting, check_windows, fitted_terms
from ep2sindy.synthetic.systems import System


def true_library(system: System) -> Library:
    """The terms of all of a system's equations, each once."""
    names = [name for state in system.model.states for name in system.model.terms(state)]
    return named_terms(system.model.library.variables, list(dict.fromkeys(names)))


def coefficient_error(
    system: System, run: Trajectory, setting: Setting, *, rng: np.random.Generator
) -> float:
    """||beta - beta_true|| / ||beta_true||, the coefficients of all equations in one vector."""
    truth = {state: system.model.terms(state) for state in system.model.states}
    terms = {state: list(of) for state, of in truth.items()}
    found = fitted_terms([run], true_library(system), terms, setting, rng=rng)
    fitted = {state: candidate.coef_by_term for state, (candidate, _) in found.items()}
    beta_true = np.array([truth[state][name] for state in truth for name in terms[state]])
    beta = np.array([fitted[state][name] for state in truth for name in terms[state]])
    return float(np.linalg.norm(beta - beta_true) / np.linalg.norm(beta_true))


def coefficient_errors(
    system: System,
    settings: Mapping[str, Setting],
    *,
    noises: Sequence[float],
    n_realizations: int,
    workers: Workers = ONE_BY_ONE,
    seed: int = 0,
    progress: Callable[[int], None] = lambda n_done: None,
) -> pd.DataFrame:
    """The error of every setting on every realization, realizations being the workers' pieces.

    noises: standard deviations of the white noise, in RMS of each state. A realization is one
    draw of it, the same for all settings and, but for its size, for all levels.
    One row per noise, number and setting. Raises ValueError, before any fit, for windows that
    are longer than the trajectory, or nothing to run.
    """
    if n_realizations < 1 or not len(noises) or not settings:
        raise ValueError(
            "errors need a realization, a noise level and a setting at least: "
            f"n_realizations={n_realizations}, noises={list(noises)}, settings={list(settings)}"
        )
    check_windows(settings, round(system.duration_s * system.rate_Hz))
    tasks = [(noise, number) for noise in noises for number in range(n_realizations)]
    fit = partial(_realization, system, settings, seed=seed)
    found = {}
    for n_done, (place, rows) in enumerate(workers.run(fit, tasks), start=1):
        found[place] = rows
        progress(n_done)
    return pd.DataFrame([row for place in sorted(found) for row in found[place]])


def _realization(
    system: System, settings: Mapping[str, Setting], task: tuple[float, int], *, seed: int
) -> list[dict[str, object]]:
    noise, number = task
    run = system.trajectory(noise=noise, rng=np.random.default_rng([seed, number]))
    rows: list[dict[str, object]] = []
    for name, setting in settings.items():
        # A stream of its own, so that leaving a setting out changes no other.
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
