"""Integral least squares beside base, weak and constrained models: `+exp=ils`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

import numpy as np
import pandas as pd
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig

from ep2sindy.constraints.relations import Constraint, constraint
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures.windows import loss_against_window_figure
from ep2sindy.refinement.problem import Iteration
from ep2sindy.refinement.windows import MIN_SAMPLES
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.tensorboard import LiveScalars, write_tensorboard
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.held_out import Judged, parted, refined_beside_base, refined_by_window
from experiments.build import (
    check_figures,
    inputs_of,
    open_prepared_field,
    relations_of,
    started_run,
    terms_of,
)
from experiments.checks import check_counts, check_numbers, check_share
from experiments.held_out_view import (
    Outcome,
    data_summary,
    figures_of,
    judged_summary,
    methods_table,
    page,
    print_outcome,
    run_summary,
)
from experiments.libraries import rollout_table
from experiments.libraries_view import print_data
from experiments.model_view import coefficients

USES: tuple[str, ...] = ("data", "prepare", "trajectory", "formulation")  # of conf/config.yaml
KEYS = (
    "weak", "model", "relations", "held_out", "n_windows", "window", "windows", "figures",
)  # fmt: skip
LABELS = {
    "base": "base",
    "weak": "weak",
    "constrained": "constrained",
    "ils": "ILS",
    "ils_constrained": "ILS, constrained",
}


def run(config: DictConfig) -> Path:
    """Fit, refine, judge; everything lands in a new run folder."""
    with started_run(config, keys=KEYS) as (folder, screen):
        check_figures(config)
        check_share(config, "held_out")
        check_counts(config, "n_windows", *(["window"] if config.window is not None else []))
        check_numbers(config, "windows", whole=True)
        # Everything but the data is built first: a misspelt key must not cost a simulation.
        library, terms = terms_of(config.model, states=config.trajectory.states)
        free = constraint(library, terms)
        constrained = constraint(library, terms, relations_of(config.relations, key="relations"))
        forms = {"formulation": instantiate(config.formulation), "weak": instantiate(config.weak)}
        to_trajectory = instantiate(config.trajectory, _convert_="all")
        field = open_prepared_field(config)
        data = to_trajectory(field, inputs=inputs_of(config, [library]), label=config.experiment)
        print_data(screen, data, field.attrs)
        train, held = parted(data, config.held_out)
        check_windows(config, train)

        rng, sweep_rng = np.random.default_rng(config.seed).spawn(2)
        with LiveScalars(folder.path / "tensorboard") as live:
            judged = refined_beside_base(
                train,
                held,
                library,
                free,
                constrained,
                **forms,
                n_windows=config.n_windows,
                window=config.window,
                callback=Watcher(live, {"ils": free, "ils_constrained": constrained}),
                rng=rng,
            )
        outcome = Outcome(config.experiment, train, held, judged, LABELS, list(config.relations))
        print_outcome(screen, outcome)
        by_window = refined_by_window(
            {
                "ils": (judged["base"].model, free),
                "ils_constrained": (judged["constrained"].model, constrained),
            },
            train,
            held,
            list(config.windows),
            n_windows=config.n_windows,
            rng=sweep_rng,
        )
        _write(folder, config, outcome, window_table(by_window, train))
    return folder.path


class Writer(Protocol):
    """What takes scalars while a run goes on, such as `LiveScalars`."""

    def write(self, scalars: Mapping[str, float], *, step: int) -> None: ...


class Watcher:
    """Every iteration of a refinement to a writer, one scalar each."""

    def __init__(self, live: Writer, constraints: Mapping[str, Constraint]) -> None:
        self._live = live
        self._names = {
            name: [each.coefficients[k] for k in each.free] for name, each in constraints.items()
        }
        self._counts = dict.fromkeys(constraints, 0)

    def __call__(self, method: str, iteration: Iteration) -> None:
        scalars = {
            f"{method}/loss": iteration.loss,
            f"{method}/step": iteration.step,
            f"{method}/defect": iteration.defect,
            f"{method}/window_stage": iteration.block,
        }
        for (state, term), value in zip(self._names[method], iteration.scaling, strict=True):
            scalars[f"{method}/scaling/{state}/{term.replace('*', '.')}"] = float(value)
        self._live.write(scalars, step=self._counts[method])
        self._counts[method] += 1


def check_windows(config: DictConfig, train: Trajectory) -> None:
    """Raise ValueError for windows that the fitted part of the data cannot hold."""
    asked = {"window": [config.window or MIN_SAMPLES], "windows": list(config.windows)}
    for key, lengths in asked.items():
        for length in lengths:
            if not MIN_SAMPLES <= length <= train.n_samples:
                raise ValueError(
                    f"{key} must hold {MIN_SAMPLES} samples or more and fit the first part of the "
                    f"data, {train.n_samples} samples: {length} came"
                )


def window_table(by_window: Mapping[str, Mapping[int, Judged]], train: Trajectory) -> pd.DataFrame:
    """One row per method and window length; _started: from a fitted start."""
    period_s = 1.0 / dominant_frequency(train.t, train.states[:, 0])
    rows = []
    for method, judgements in by_window.items():
        for window, each in judgements.items():
            assert each.refinement is not None
            row = {
                "method": method,
                "window": window,
                "periods": (window - 1) * train.dt_s / period_s,
                "loss": each.refinement.loss,
                "status": each.status,
                "text": each.model.text(),
            }
            for run, suffix in ((each.from_sample, ""), (each.from_fit, "_started")):
                numbers = run_summary(run)
                keys = ("f_error", "nrmse", "amplitude_ratio")
                row |= {f"{key}{suffix}": numbers[key] for key in keys}
            rows.append(row)
    return pd.DataFrame(rows)


def _write(folder: RunFolder, config: DictConfig, outcome: Outcome, windows: pd.DataFrame) -> None:
    train = outcome.train
    period_s = 1.0 / dominant_frequency(train.t, train.states[:, 0])
    figures: dict[str, Figure] = {
        **figures_of(outcome, **config.figures),
        "loss_against_window": loss_against_window_figure(
            windows.replace({"method": LABELS}), period=period_s / train.dt_s
        ),
    }
    for name, judged in outcome.judged.items():
        folder.write_model(name, judged.model)
        folder.write_table(
            f"rollout_{name}", rollout_table(outcome.held, judged.from_sample.integrated)
        )
    folder.write_table("methods", methods_table(outcome))
    folder.write_table("coefficients", coefficients(outcome.models, heading="method"))
    folder.write_table("loss_against_window", windows)
    folder.write_figures(figures)
    methods = {name: judged_summary(judged) for name, judged in outcome.judged.items()}
    write_tensorboard(
        folder.path / "tensorboard",
        figures=figures,
        texts={name: f"    {model.text()}" for name, model in outcome.models.items()},
        hparams={
            "seed": config.seed,
            "held_out": config.held_out,
            "n_windows": config.n_windows,
            "window": str(config.window),
        },
        metrics={
            f"{name}/{key}": found[key]
            for name, found in methods.items()
            for key in ("f_error", "nrmse", "amplitude_ratio", "cpu_s")
        },
    )
    folder.write_text("report.html", page(outcome, figures))
    folder.write_json(
        "summary.json",
        {
            "experiment": config.experiment,
            "seed": config.seed,
            "data": data_summary(outcome),
            "methods": methods,
            "loss_against_window": windows.to_dict("records"),
        },
    )
