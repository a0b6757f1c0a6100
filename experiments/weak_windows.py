"""Coefficient errors for windows of many numbers and lengths: `+exp=weak_windows`."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import cast

import pandas as pd
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from rich.table import Table
from tqdm import tqdm

from ep2sindy.figures.windows import window_error_figure
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.page import figure_html, page_html, table_html
from ep2sindy.report.tensorboard import write_tensorboard
from ep2sindy.studies.weak_windows import coefficient_errors, window_cells
from ep2sindy.synthetic.systems import System
from experiments.build import started_run
from experiments.checks import check_counts, check_numbers
from experiments.weak import settings_of

USES: tuple[str, ...] = ("parallel",)  # of conf/config.yaml
KEYS = (
    "boxes", "automatic", "system", "rate_Hz", "n_windows", "n_points", "noises",
    "n_realizations",
)  # fmt: skip
COUNTS = ("n_windows", "n_points")
TITLE = "Coefficient error, mean over the realizations"
CAPTION = (
    "||beta - beta_true|| / ||beta_true|| over all equations against noise: a panel per window "
    "length, a line per number of windows; black: the same forms in every panel."
)


def run(config: DictConfig) -> Path:
    """Draw noise, fit, measure; everything lands in a new run folder."""
    with started_run(config, keys=KEYS) as (folder, screen):
        check_counts(config, "n_realizations")
        workers = instantiate(config.parallel)
        check_numbers(config, "n_windows", "n_points", whole=True)
        check_numbers(config, "noises", zero=True)
        settings = settings_of(config)
        system = system_of(config)
        with tqdm(
            total=len(config.noises) * config.n_realizations, unit="realization", disable=None
        ) as bar:
            errors = coefficient_errors(
                system,
                settings,
                noises=[float(noise) for noise in config.noises],
                n_realizations=config.n_realizations,
                workers=workers,
                seed=config.seed,
                progress=lambda n_done: cast(None, bar.update(n_done - bar.n)),
            )
        cells = window_cells(errors, settings)
        readable = by_noise(cells)
        screen.print(_rich(readable))
        references = [name for name, setting in settings.items() if not setting.boxes]
        figures = {"errors": window_error_figure(cells, references=references)}
        folder.write_table("errors", errors)
        folder.write_table("cells", cells)
        folder.write_text("report.html", _page(config, system, readable))
        _write(folder, config, cells, figures)
    return folder.path


def system_of(config: DictConfig) -> System:
    """The system of the config at the config's sampling rate."""
    rate_Hz = config.rate_Hz
    if type(rate_Hz) not in (int, float) or not rate_Hz > 0:
        raise ValueError(f"rate_Hz must be a positive number: {rate_Hz!r} came")
    return replace(instantiate(config.system), rate_Hz=float(rate_Hz))


def by_noise(cells: pd.DataFrame) -> pd.DataFrame:
    """A row per setting, a column of mean errors per noise level."""
    shown = cells.assign(noise=[f"{100 * noise:g} % noise" for noise in cells["noise"]])
    table = shown.pivot(index="setting", columns="noise", values="error_mean")
    order = [shown["setting"].unique(), shown["noise"].unique()]
    return table.loc[order[0], order[1]].reset_index().rename_axis(columns=None)


def _rich(table: pd.DataFrame) -> Table:
    shown = Table(*table.columns, title=TITLE, show_edge=False)
    for name, *errors in table.itertuples(index=False):
        shown.add_row(name, *(f"{error:.2e}" for error in errors))
    return shown


def _page(config: DictConfig, system: System, table: pd.DataFrame) -> str:
    body = [
        f"<p>{system.name}, {system.duration_s:g} s at {system.rate_Hz:g} Hz, "
        f"{config.n_realizations} realizations of the noise; the terms of the equations are "
        "known, and least squares finds their coefficients (automatic_weighted: weighted).</p>",
        figure_html("errors", CAPTION),
        f"<h2>{TITLE}</h2>",
        table_html(table),
        "<p>Without noise the error is that of the integrals and derivatives.</p>",
        "<footer>Noise in % of each state's RMS. Config, every error and these tables lie "
        "beside.</footer>",
    ]
    return page_html(config.experiment, body)


def _write(
    folder: RunFolder, config: DictConfig, cells: pd.DataFrame, figures: Mapping[str, Figure]
) -> None:
    folder.write_figures(figures)
    write_tensorboard(
        folder.path / "tensorboard",
        figures=figures,
        texts={},
        hparams={
            "seed": config.seed,
            "rate_Hz": config.rate_Hz,
            "n_realizations": config.n_realizations,
            "automatic": str(OmegaConf.to_container(config.automatic)),
        },
        metrics={
            f"{row['setting']}/error_{100 * row['noise']:g}_percent": row["error_mean"]
            for row in cells.to_dict("records")
        },
    )
    rows = [
        row | {key: None if pd.isna(row[key]) else int(row[key]) for key in COUNTS}
        for row in cells.to_dict("records")
    ]
    folder.write_json(
        "summary.json", {"experiment": config.experiment, "seed": config.seed, "cells": rows}
    )
