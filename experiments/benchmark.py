"""Every variant on systems with known equations, over and over: `+exp=benchmark`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from ep2sindy.figures.identified import COUNTS, MERITS, benchmark_figure
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.tensorboard import write_tensorboard
from ep2sindy.studies.benchmark import cells, run_benchmark
from experiments.benchmark_view import Outcome, page, print_outcome
from experiments.build import started_run
from experiments.checks import check_counts, check_lists, check_numbers
from experiments.variants import chosen_variants

USES: tuple[str, ...] = ("parallel",)  # of conf/config.yaml
KEYS = (
    "n_realizations", "n_trajectories", "systems", "noises", "variants", "definitions",
    "thesis",
)  # fmt: skip


def run(config: DictConfig) -> Path:
    """Draw, search, count; everything lands in a new run folder."""
    with started_run(config, keys=KEYS) as (folder, screen):
        check_counts(config, "n_realizations", "n_trajectories")
        workers = instantiate(config.parallel)
        check_lists(config, "systems")
        check_numbers(config, "noises", zero=True)
        variants = chosen_variants(config)
        n_tasks = len(config.systems) * len(config.noises) * config.n_realizations
        with tqdm(total=n_tasks, unit="realization", disable=None) as bar:
            outcomes = run_benchmark(
                variants,
                systems=list(config.systems),
                noises=[float(noise) for noise in config.noises],
                n_realizations=config.n_realizations,
                n_trajectories=config.n_trajectories,
                workers=workers,
                seed=config.seed,
                progress=lambda n_done: cast(None, bar.update(n_done - bar.n)),
            )
        folder.write_table("outcomes", outcomes)
        outcome = Outcome(
            title=config.experiment,
            variants=variants,
            cells=cells(outcomes),
            published=published_cells(cast(dict, OmegaConf.to_container(config.thesis))),
        )
        print_outcome(screen, outcome)
        figures = {"benchmark": benchmark_figure(outcome.cells, thesis=outcome.published)}
        _write(folder, config, outcome, figures)
    return folder.path


def published_cells(thesis: Mapping[str, Any]) -> pd.DataFrame:
    """The thesis's tables in the shape of our cells; selected as a number of realizations."""
    columns = ["on_front", "selected_percent_of_those", "mean_correct_terms"]
    rows = [
        (variant, system, *values)
        for variant, systems in thesis["on_front"].items()
        for system in systems
        for values in zip(
            thesis["noises"], *(thesis[column][variant][system] for column in columns), strict=True
        )
    ]
    table = pd.DataFrame(rows, columns=["variant", "system", "noise", *columns])
    table = table.astype(dict.fromkeys(["noise", *columns], float))
    percent = table.pop("selected_percent_of_those")
    table["selected"] = (table["on_front"] * percent / 100.0).round(1)
    return table.assign(n=thesis["n"])


def _write(
    folder: RunFolder, config: DictConfig, outcome: Outcome, figures: Mapping[str, Figure]
) -> None:
    folder.write_table("cells", _beside_thesis(outcome))
    folder.write_figures(figures)
    write_tensorboard(
        folder.path / "tensorboard",
        figures=figures,
        texts={name: f"    {variant}" for name, variant in outcome.variants.items()},
        hparams=_hparams(config),
        metrics=_scalars(outcome.cells),
    )
    folder.write_text("report.html", page(outcome, figures))
    folder.write_json("summary.json", _summary(config, outcome))


def _summary(config: DictConfig, outcome: Outcome) -> dict[str, Any]:
    """Counts as whole numbers; null where a variant selects nothing."""
    rows = outcome.cells.astype({"on_front": int}).to_dict("records")
    return {
        "experiment": config.experiment,
        "seed": config.seed,
        "cells": [
            row | {"selected": None if np.isnan(row["selected"]) else int(row["selected"])}
            for row in rows
        ],
    }


def _beside_thesis(outcome: Outcome) -> pd.DataFrame:
    """Our cells, and what the thesis found in the same ones."""
    columns = {merit: f"thesis_{merit}" for merit in MERITS}
    published = outcome.published.rename(columns=columns)
    keys = ["system", "noise", "variant"]
    return outcome.cells.merge(published[[*keys, *columns.values()]], how="left", on=keys)


def _scalars(table: pd.DataFrame) -> dict[str, float]:
    """Means over systems and noise levels; none for a variant that selects nothing."""
    scalars = {}
    for name, rows in table.groupby("variant", sort=False):
        for merit in COUNTS:
            scalars[f"{name}/{merit}_percent"] = float(100.0 * rows[merit].sum() / rows["n"].sum())
        scalars[f"{name}/mean_correct_terms"] = float(rows["mean_correct_terms"].mean())
        scalars[f"{name}/cpu_ms"] = float(1e3 * rows["cpu_s_per_search"].mean())
    return scalars


def _hparams(config: DictConfig) -> dict[str, Any]:
    """The settings that decide the outcome; fixed keys, so that runs can be compared."""
    lists = {key: str(list(config[key])) for key in ("systems", "noises", "variants")}
    counts = {key: config[key] for key in ("n_realizations", "n_trajectories")}
    return {"seed": config.seed, **counts, **lists}
