"""Known terms in the weak form, with windows of several lengths: `+exp=weak`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig, ListConfig, OmegaConf

from ep2sindy.figures.series import derivative_figure, rollout_figures
from ep2sindy.regression.test_functions import Boxes
from ep2sindy.regression.weak import Weak
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.tensorboard import write_tensorboard
from ep2sindy.signals.smoothers import Smoother
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.weak_forms import Fitted, Setting, boxes_grid, fit_settings
from experiments.build import (
    check_durations,
    inputs_of,
    open_prepared_field,
    started_run,
    terms_of,
)
from experiments.checks import check_counts, check_numbers
from experiments.libraries import rollout_table
from experiments.libraries_view import print_data
from experiments.model_view import coefficients
from experiments.weak_view import Outcome, page, print_outcome, settings_table

USES: tuple[str, ...] = ("data", "prepare", "trajectory", "formulation")  # of conf/config.yaml
KEYS = (
    "boxes", "automatic", "model", "n_windows", "n_points", "rollout_s", "figures", "thesis",
)  # fmt: skip


def run(config: DictConfig) -> Path:
    """Fit, integrate, compare; everything lands in a new run folder."""
    with started_run(config, keys=KEYS) as (folder, screen):
        check_durations(config)
        check_counts(config, "n_windows")
        check_numbers(config, "n_points", whole=True)
        # Everything but the data is built first: a misspelt key must not cost a simulation.
        settings = settings_of(config)
        library, terms = terms_of(config.model, states=config.trajectory.states)
        to_trajectory = instantiate(config.trajectory, _convert_="all")
        field = open_prepared_field(config)
        data = to_trajectory(field, inputs=inputs_of(config, [library]), label=config.experiment)
        print_data(screen, data, field.attrs)

        f_data_Hz = dominant_frequency(data.t, data.states[:, 0])
        fitted = fit_settings(
            data,
            library,
            terms,
            settings,
            f_data_Hz=f_data_Hz,
            rollout_s=config.rollout_s,
            rng=np.random.default_rng(config.seed),
        )
        published = cast(dict, OmegaConf.to_container(config.thesis))
        outcome = Outcome(config.experiment, data, f_data_Hz, fitted, published)
        print_outcome(screen, outcome)
        figures = _figures(outcome, instantiate(config.formulation.smoother), config.figures)
        _write(folder, config, outcome, figures)
    return folder.path


def settings_of(config: DictConfig) -> dict[str, Setting]:
    """The differential form, random windows of every length, and smooth windows."""
    automatic = instantiate(config.automatic)
    n_windows = config.n_windows
    return {
        "differential": Setting(instantiate(config.formulation)),
        **boxes_grid(
            boxes_form(config),
            n_windows=list(n_windows) if isinstance(n_windows, ListConfig) else [n_windows],
            n_points=list(config.n_points),
        ),
        "automatic": Setting(automatic),
        "automatic_weighted": Setting(automatic, weighted=True),
    }


def boxes_form(config: DictConfig) -> Weak:
    """The form with random windows, whose number and length are top-level keys."""
    given = config.boxes.test_functions
    for key in ("n_windows", "n_points"):
        if given[key] is not None:
            raise ValueError(
                f"boxes.test_functions.{key} is what {key} says: {given[key]!r} came; "
                f"set {key} alone"
            )
    return instantiate(config.boxes, test_functions=Boxes())


def _figures(outcome: Outcome, smoother: Smoother, shown: DictConfig) -> dict[str, Figure]:
    run = outcome.run
    models = {name: f.integrated.model for name, f in outcome.labelled.items()}
    rollouts = {name: f.integrated.rollout for name, f in outcome.labelled.items()}
    duration_s = shown.duration_s or float(run.t[-1] - run.t[0])
    return {
        **rollout_figures(run, rollouts, duration_s=duration_s, f_max_Hz=shown.f_max_Hz),
        "derivatives": derivative_figure(run, models, smoother=smoother, duration_s=duration_s),
    }


def _write(
    folder: RunFolder, config: DictConfig, outcome: Outcome, figures: Mapping[str, Figure]
) -> None:
    for name, fitted in outcome.fitted.items():
        folder.write_model(name, fitted.integrated.model)
        folder.write_table(f"rollout_{name}", rollout_table(outcome.run, fitted.integrated))
    folder.write_table("settings", settings_table(outcome))
    models = {name: fitted.integrated.model for name, fitted in outcome.fitted.items()}
    folder.write_table("coefficients", coefficients(models, heading="setting"))
    folder.write_figures(figures)
    write_tensorboard(
        folder.path / "tensorboard",
        figures=figures,
        texts={n: f"    {f.integrated.model.text()}" for n, f in outcome.fitted.items()},
        hparams={
            "seed": config.seed,
            "n_windows": config.n_windows,
            "n_points": str(list(config.n_points)),
            "formulation": str(OmegaConf.to_container(config.formulation)),
            "automatic": str(OmegaConf.to_container(config.automatic)),
        },
        metrics=_scalars(outcome),
    )
    folder.write_text("report.html", page(outcome, figures))
    folder.write_json("summary.json", _summary(config, outcome))


def _summary(config: DictConfig, outcome: Outcome) -> dict[str, Any]:
    run = outcome.run
    return {
        "experiment": config.experiment,
        "seed": config.seed,
        "data": {
            "n_samples": run.n_samples,
            "dt_s": run.dt_s,
            "f_kHz": 1e-3 * outcome.f_data_Hz,
            "variables": list(run.names),
            "units": dict(run.units),
        },
        "settings": {name: _setting(f, run.dt_s) for name, f in outcome.fitted.items()},
    }


def _setting(fitted: Fitted, dt_s: float) -> dict[str, Any]:
    integrated = fitted.integrated
    model, boxes = integrated.model, fitted.setting.boxes
    windows: dict[str, Any] = {}
    if boxes:
        windows = {"n_points": boxes.n_points, "n_windows": boxes.n_windows}
    if fitted.half_width:
        windows = {
            "half_width": dict(fitted.half_width),
            "half_width_s": {state: n * dt_s for state, n in fitted.half_width.items()},
        }
    known = model.covariance is not None
    return {
        "text": model.text(),
        **windows,
        "equations": {state: model.terms(state) for state in model.states},
        **({"intervals": {s: model.intervals(s) for s in model.states}} if known else {}),
        "r2": dict(fitted.r2),
        "f_kHz": 1e-3 * integrated.frequency_Hz[model.states[0]],
        "f_error": fitted.f_error,
        "nrmse": integrated.nrmse,
        "verdict": integrated.verdict,
    }


def _scalars(outcome: Outcome) -> dict[str, float]:
    scalars = {"data/f_kHz": 1e-3 * outcome.f_data_Hz}
    for name, fitted in outcome.fitted.items():
        scalars[f"{name}/f_error"] = fitted.f_error
        scalars[f"{name}/nrmse"] = fitted.integrated.nrmse
        scalars |= {f"{name}/{state}/r2": value for state, value in fitted.r2.items()}
    return scalars
