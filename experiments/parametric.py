"""One model at several operating points, its trends and control laws: `+exp=parametric`."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

from ep2sindy.figures.trends import trends_figure
from ep2sindy.library.library import polynomial
from ep2sindy.model.model import SparseModel
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.tensorboard import LiveScalars, write_tensorboard
from ep2sindy.studies.parametric.all_points import searched_jointly
from ep2sindy.studies.parametric.points import REFINED, PointResult, parametric_study
from ep2sindy.studies.parametric.trends import laws
from experiments.build import started_run
from experiments.checks import check_counts
from experiments.model_view import coefficients
from experiments.parametric_setup import opened_point, point_configs, study_of
from experiments.parametric_summary import summary
from experiments.parametric_tables import (
    ALL_POINTS,
    EACH_POINT,
    Outcome,
    estimates_table,
    laws_table,
    points_table,
    published_table,
    supports_table,
    tied_table,
    trends_table,
)
from experiments.parametric_view import page, print_outcome

USES: tuple[str, ...] = (
    "data",
    "prepare",
    "trajectory",
    "formulation",
    "search",
    "bootstraps",
    "selection",
    "depth",
    "parallel",
)  # of conf/config.yaml
KEYS = (
    "parameters", "points", "model", "cases", "bootstrap", "refining", "library", "law", "trends",
    "figures", "thesis",
)  # fmt: skip


def run(config: DictConfig) -> Path:
    """Open, fit, refine and search every point; everything lands in a new run folder."""
    with started_run(config, keys=KEYS) as (folder, screen):
        # Everything but the data is built first: a misspelt key must not cost a simulation.
        study = study_of(config)
        names = [str(name) for name in config.parameters]
        check_views(config, names)
        law_library = polynomial(names, degree=config.law.degree)
        tying = polynomial(names, degree=config.law.tied_degree)
        thesis = config.thesis and OmegaConf.to_container(config.thesis)
        published = published_table(thesis, names)
        workers = instantiate(config.parallel)
        configs = point_configs(config)
        points = in_order(_watched(workers.run(opened_point, configs), len(configs), "opened"))

        alone, together = np.random.default_rng(config.seed).spawn(2)
        found = parametric_study(points, study, workers=workers, rng=alone)
        with LiveScalars(folder.path / "tensorboard") as live:
            results = in_order(_told(_watched(found, len(points), "fitted"), live))
        joint = searched_jointly(points, results, study, tying, rng=together)
        searches = {EACH_POINT: [result.searched for result in results]}
        outcome = Outcome(
            title=config.experiment,
            study=study,
            parameters=names,
            results=results,
            laws=laws(results, law_library, max_terms=config.law.max_terms),
            searches=searches | ({ALL_POINTS: joint.fitted} if joint else {}),
            joint=joint,
            trends=[(str(each.along), dict(each.at)) for each in config.trends],
            published=published,
        )
        _write_numbers(folder, outcome)
        print_outcome(screen, outcome)
        _write_views(folder, config, outcome)
    return folder.path


def in_order(numbered: Iterable[tuple[int, Any]]) -> list[Any]:
    return [result for _, result in sorted(numbered, key=lambda each: each[0])]


def check_views(config: DictConfig, names: list[str]) -> None:
    """Raise ValueError unless laws, trends and panels can be made of what there is."""
    if set(config.law) != {"degree", "max_terms", "tied_degree"}:
        raise ValueError(
            f"law must have degree, max_terms and tied_degree: {list(config.law)} came"
        )
    check_counts(config.law, *(["max_terms"] if config.law.max_terms is not None else []))
    for each in config.trends:
        if set(each) != {"along", "at"} or {each.along, *each.at} != set(names):
            raise ValueError(
                f"a trend goes along one parameter and holds the others of {names}: {each} came"
            )
    if set(config.figures) != {"panels", "labels"}:
        raise ValueError(f"figures must have panels and labels: {list(config.figures)} came")
    quantities = {name for case in config.cases.values() for name in case.quantities}
    unknown = {name for panel in config.figures.panels for name in panel} - quantities
    if unknown:
        raise ValueError(f"figures.panels names {sorted(unknown)}; there are {sorted(quantities)}")


def _watched(
    numbered: Iterable[tuple[int, Any]], total: int, verb: str
) -> Iterator[tuple[int, Any]]:
    yield from tqdm(numbered, total=total, unit=f"point {verb}", disable=None)


def _told(
    numbered: Iterable[tuple[int, PointResult]], live: LiveScalars
) -> Iterator[tuple[int, PointResult]]:
    """Every result to TensorBoard as it comes; a step is the number of a point in the config."""
    for number, result in numbered:
        scalars = {
            f"{name}/{quantity}": estimate.value
            for name, fit in result.fits.items()
            for quantity, estimate in fit.estimates.items()
        }
        for name, fit in result.fits.items():
            scalars |= {f"{name}/r2/{state}": value for state, value in fit.r2.items()}
        live.write(scalars, step=number)
        yield number, result


def _write_numbers(folder: RunFolder, outcome: Outcome) -> None:
    """What no view may lose: models and tables."""
    for number, result in enumerate(outcome.results):
        for name, fit in result.fits.items():
            folder.write_model(f"point_{number}_{name}", fit.model)
    tables = {
        "points": points_table(outcome),
        "quantities": estimates_table(outcome),
        "supports": supports_table(outcome),
        "laws": laws_table(outcome),
        "trends": trends_table(outcome),
        "tied": tied_table(outcome),
        "coefficients": coefficients(_models(outcome), heading="model"),
    }
    for name, table in tables.items():
        folder.write_table(name, table)


def _models(outcome: Outcome) -> dict[str, SparseModel]:
    return {
        f"point {number}, {name}": fit.model
        for number, result in enumerate(outcome.results)
        for name, fit in result.fits.items()
    }


def _write_views(folder: RunFolder, config: DictConfig, outcome: Outcome) -> None:
    figures = _figures(config, outcome)
    folder.write_figures(figures)
    write_tensorboard(
        folder.path / "tensorboard",
        figures=figures,
        texts={name: f"    {model.text()}" for name, model in _models(outcome).items()},
        hparams=_hparams(config),
        metrics=_metrics(outcome),
    )
    folder.write_text("report.html", page(outcome, figures))
    folder.write_json("summary.json", summary(config, outcome))


def _figures(config: DictConfig, outcome: Outcome) -> dict[str, Figure]:
    """None where no point oscillates or no trend was asked for: an empty figure says nothing."""
    estimates = estimates_table(outcome)
    if estimates.empty or not outcome.trends or not config.figures.panels:
        return {}
    drawn = {fit: laws for fit, laws in outcome.laws.items() if not fit.endswith(REFINED)}
    figure = trends_figure(
        estimates[estimates["usable"]],
        outcome.published,
        drawn,
        panels=[list(panel) for panel in config.figures.panels],
        trends=outcome.trends,
        labels={str(name): label for name, label in config.figures.labels.items()},
    )
    return {"trends": figure}


def _hparams(config: DictConfig) -> dict[str, Any]:
    """The settings that decide the outcome; fixed keys, so that runs can be compared."""
    return {
        "seed": config.seed,
        **{
            key: str(OmegaConf.to_container(config[key]))
            for key in ("formulation", "bootstrap", "refining", "search", "selection", "law")
        },
    }


def _metrics(outcome: Outcome) -> dict[str, float]:
    metrics = {"n_oscillating": float(sum(bool(result.fits) for result in outcome.results))}
    for fit, by_quantity in outcome.laws.items():
        for quantity, law in by_quantity.items():
            metrics[f"law/{fit}/{quantity}/loo_error"] = law.loo_error
            metrics[f"law/{fit}/{quantity}/search_error"] = law.search_error
    return metrics
