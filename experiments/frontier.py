"""How fast and how long one must sample to find known equations: `+exp=frontier`."""

from collections.abc import Mapping
from pathlib import Path
from typing import cast

import pandas as pd
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig
from rich.table import Table
from tqdm import tqdm

from ep2sindy.figures.identified import frontier_figure
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.page import figure_html, page_html, table_html
from ep2sindy.report.tensorboard import write_tensorboard
from ep2sindy.studies.frontier import identification_frontier
from ep2sindy.synthetic.systems import System
from experiments.build import started_run
from experiments.checks import check_numbers
from experiments.variants import chosen_variants

USES: tuple[str, ...] = ("parallel",)  # of conf/config.yaml
KEYS = ("system", "variants", "definitions", "rates_Hz", "durations_s")
TITLE = "Lowest sampling rate from which on all rates identify the system"
CAPTION = (
    "Filled: the true equations of all states are on the variant's fronts. Hollow: they are not. "
    "Cross: too few samples for the variant to run, which counts as not identified."
)


def run(config: DictConfig) -> Path:
    """Sample, search, judge; everything lands in a new run folder."""
    with started_run(config, keys=KEYS) as (folder, screen):
        workers = instantiate(config.parallel)
        check_numbers(config, "rates_Hz", "durations_s")
        variants = chosen_variants(config)
        system = instantiate(config.system)
        with tqdm(
            total=len(config.rates_Hz) * len(config.durations_s), unit="trajectory", disable=None
        ) as bar:
            points = identification_frontier(
                system,
                variants,
                rates_Hz=[float(rate) for rate in config.rates_Hz],
                durations_s=[float(duration) for duration in config.durations_s],
                workers=workers,
                seed=config.seed,
                progress=lambda n_done: cast(None, bar.update(n_done - bar.n)),
            )
        lowest = lowest_rates(points)
        screen.print(_rich(lowest))
        figures = {"frontier": frontier_figure(points)}
        folder.write_table("points", points)
        folder.write_table("lowest_rates", lowest)
        folder.write_text("report.html", _page(config, system, points, lowest))
        _write(folder, config, points, figures)
    return folder.path


def lowest_rates(points: pd.DataFrame) -> pd.DataFrame:
    """A row per variant: identified points, then the frontier in Hz; NaN where there is none."""
    rows = []
    for variant, of_variant in points.groupby("variant", sort=False):
        row: dict[str, object] = {
            "variant": variant,
            "identified": f"{of_variant['identified'].sum()} of {len(of_variant)}",
        }
        for duration_s, column in of_variant.groupby("duration_s"):
            falling = column.sort_values("rate_Hz", ascending=False)
            unbroken = falling["identified"].cummin()
            row[f"{duration_s:g} s"] = falling.loc[unbroken, "rate_Hz"].min()
        rows.append(row)
    return pd.DataFrame(rows)


def _rich(lowest: pd.DataFrame) -> Table:
    table = Table(*lowest.columns, title=f"{TITLE} (Hz), by duration", show_edge=False)
    for variant, identified, *rates in lowest.itertuples(index=False):
        table.add_row(
            variant, identified, *("-" if pd.isna(rate) else f"{rate:g}" for rate in rates)
        )
    return table


def _page(config: DictConfig, system: System, points: pd.DataFrame, lowest: pd.DataFrame) -> str:
    too_few = points[points["reason"] != ""]
    counts = ", ".join(
        f"{variant} {n}" for variant, n in too_few.groupby("variant", sort=False).size().items()
    )
    body = [
        f"<p>{system.name}: one noise-free trajectory per sampling rate and duration, all from "
        f"the same initial state. Points with too few samples to run: {counts or 'none'}; "
        "tables/points.csv says why.</p>",
        figure_html("frontier", CAPTION),
        f"<h2>{TITLE} (Hz), by duration</h2>",
        table_html(lowest),
        "<footer>Config and tables lie beside.</footer>",
    ]
    return page_html(config.experiment, body)


def _write(
    folder: RunFolder, config: DictConfig, points: pd.DataFrame, figures: Mapping[str, Figure]
) -> None:
    folder.write_figures(figures)
    write_tensorboard(
        folder.path / "tensorboard",
        figures=figures,
        texts={},
        hparams={"seed": config.seed, "variants": str(list(config.variants))},
        metrics={
            f"{variant}/identified_percent": float(100.0 * column.mean())
            for variant, column in points.groupby("variant")["identified"]
        },
    )
    kept = points[["variant", "rate_Hz", "duration_s", "identified"]]
    folder.write_json(
        "summary.json",
        {
            "experiment": config.experiment,
            "seed": config.seed,
            "points": [
                row | {"identified": bool(row["identified"])} for row in kept.to_dict("records")
            ],
        },
    )
