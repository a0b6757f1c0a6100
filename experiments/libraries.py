"""Several libraries on the same data, side by side: `+exp=breathing`, `+exp=discover`."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import pandas as pd
from hydra.utils import instantiate
from matplotlib.figure import Figure
from omegaconf import DictConfig, OmegaConf

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.figures import series as plots
from ep2sindy.figures.fronts import front_figure
from ep2sindy.library.equations import equation_text
from ep2sindy.model.integrated import Integrated
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.tensorboard import write_tensorboard
from ep2sindy.signals.smoothers import Smoother
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.libraries import LibraryCase, LibraryResult, candidate_text, compare_libraries
from experiments.build import (
    check_durations,
    check_library,
    inputs_of,
    library_of,
    open_prepared_field,
    recipe_of,
    selection_of,
    started_run,
)
from experiments.libraries_view import (
    Outcome,
    comparison,
    front_tables,
    page,
    print_data,
    print_outcome,
)

USES: tuple[str, ...] = (
    "data",
    "prepare",
    "trajectory",
    "formulation",
    "search",
    "bootstraps",
    "selection",
    "depth",
)  # of conf/config.yaml
KEYS = ("libraries", "rollout_s", "figures", "thesis")


def run(config: DictConfig) -> Path:
    """Discover, integrate, compare; everything lands in a new run folder."""
    with started_run(config, keys=KEYS) as (folder, screen):
        check_durations(config)
        # Everything but the data is built first: a misspelt key must not cost a simulation.
        settings: dict[str, Any] = {
            "recipe": recipe_of(config),
            "rollout_s": config.rollout_s,
            "rng": np.random.default_rng(config.seed),
        }
        to_trajectory = instantiate(config.trajectory, _convert_="all")
        selections = {}
        for name, case in config.libraries.items():
            check_library(name, case)
            selections[name] = instantiate(selection_of(case, config.selection))
        field = open_prepared_field(config)
        libraries = {name: library_of(case, field) for name, case in config.libraries.items()}
        inputs = inputs_of(config, libraries.values())
        data = to_trajectory(field, inputs=inputs, label=config.experiment)
        print_data(screen, data, field.attrs)

        published = cast(dict, OmegaConf.to_container(config.thesis))
        cases = {
            name: LibraryCase(library, selections[name], published.get(name, {}))
            for name, library in libraries.items()
        }
        results = compare_libraries(data, cases, **settings)
        outcome = Outcome(config.experiment, data, results)
        print_outcome(screen, outcome)
        figures = _figures(outcome, settings["recipe"].formulation.smoother, config.figures)
        _write(folder, config, outcome, figures)
    return folder.path


def _write(
    folder: RunFolder, config: DictConfig, outcome: Outcome, figures: Mapping[str, Figure]
) -> None:
    for name, result in outcome.results.items():
        folder.write_model(name, result.discovery.model)
        folder.write_table(f"front_{name}", front_tables(result))
        folder.write_table(
            f"ambiguities_{name}",
            pd.DataFrame(
                [(a.exact, " ".join(a.terms), a.message) for a in result.discovery.ambiguities],
                columns=["exact", "terms", "message"],
            ),
        )
    for name, integrated in outcome.models.items():
        folder.write_table(f"rollout_{_slug(name)}", rollout_table(outcome.run, integrated))
    folder.write_table("comparison", comparison(outcome))
    folder.write_figures(figures)
    summary = _summary(config, outcome)
    write_tensorboard(
        folder.path / "tensorboard",
        figures=figures,
        texts={n: f"    {r.discovery.model.text()}" for n, r in outcome.results.items()},
        hparams=_hparams(config),
        metrics=_scalars(summary, outcome.results),
    )
    folder.write_text("report.html", page(outcome, figures))
    folder.write_json("summary.json", summary)


def _slug(name: str) -> str:
    """A model's name as a file name."""
    return name.replace(", ", "_").replace("'s ", "_").replace(" ", "_")


def rollout_table(run: Trajectory, integrated: Integrated) -> pd.DataFrame:
    """Model and data, sample by sample, so that the figure can be drawn again."""
    rollout, states = integrated.rollout, integrated.model.states
    data = run.columns(states)[: len(rollout.t)]
    columns: dict[str, Any] = {"t_s": rollout.t}
    for k, state in enumerate(states):
        columns |= {f"{state}_data": data[:, k], f"{state}_model": rollout.states[:, k]}
    return pd.DataFrame(columns)


def _figures(outcome: Outcome, smoother: Smoother, shown: DictConfig) -> dict[str, Figure]:
    run, results = outcome.run, outcome.results
    span_s = float(run.t[-1] - run.t[0])
    duration_s = shown.duration_s or span_s
    f_max_Hz = shown.f_max_Hz or 0.5 / run.dt_s
    models = {name: r.selected.model for name, r in results.items()}
    rollouts = {name: r.selected.rollout for name, r in results.items()}
    published = {n: r.published.rollout for n, r in results.items() if r.published is not None}
    figures = {
        "data": plots.data_figure(run, duration_s=duration_s, f_max_Hz=f_max_Hz),
        **{
            f"front_{name}": front_figure(
                r.discovery.fronts, r.discovery.scores, label=r.case.selection.label
            )
            for name, r in results.items()
        },
        "trajectories": plots.trajectory_figure(run, rollouts, duration_s=duration_s),
        "derivatives": plots.derivative_figure(
            run, models, smoother=smoother, duration_s=duration_s
        ),
    }
    if published:
        figures["trajectories_thesis"] = plots.trajectory_figure(
            run, published, duration_s=duration_s
        )
    if len(run.state_names) > 1:
        plane = run.state_names[:2]
        figures["phase"] = plots.phase_figure(run, rollouts, plane=plane, duration_s=duration_s)
    return figures


def _summary(config: DictConfig, outcome: Outcome) -> dict[str, Any]:
    run = outcome.run
    first = run.state_names[0]
    return {
        "experiment": config.experiment,
        "seed": config.seed,
        "data": {
            "n_samples": run.n_samples,
            "dt_s": run.dt_s,
            "f_kHz": 1e-3 * dominant_frequency(run.t, run.states[:, 0]),
            "variables": list(run.names),
            "units": dict(run.units),
        },
        "models": {
            name: {
                "equations": {s: _equation_summary(result, s) for s in result.discovery.fronts},
                "trajectory": _trajectory_summary(result.selected, first),
                "thesis_terms": _published_summary(result, first),
            }
            for name, result in outcome.results.items()
        },
    }


def _trajectory_summary(integrated: Integrated, state: str) -> dict[str, Any]:
    return {
        "f_kHz": 1e-3 * integrated.frequency_Hz[state],
        "nrmse": integrated.nrmse,
        "diverged": integrated.rollout.diverged,
    }


def _published_summary(result: LibraryResult, state: str) -> dict[str, Any] | None:
    """The published terms fitted to our data."""
    if result.published is None:
        return None
    return {
        "equations": {
            name: {
                "terms": result.published.model.terms(name),
                "r2_test": candidate.r2_test,
                "text": candidate_text(candidate),
            }
            for name, candidate in result.refitted.items()
        },
        "trajectory": _trajectory_summary(result.published, state),
    }


def _equation_summary(result: LibraryResult, state: str) -> dict[str, Any]:
    chosen, scores = result.discovery.chosen[state], result.discovery.scores[state]
    terms = result.discovery.model.terms(state)
    return {
        "terms": terms,
        "n_terms": chosen.n_terms,
        "r2_test": chosen.r2_test,
        "r2_train": chosen.r2_train,
        result.case.selection.label: float(scores.min()),
        "share": chosen.share,
        "inclusion": dict(zip(chosen.terms, chosen.inclusion.tolist(), strict=True)),
        "text": equation_text(state, terms),
    }


def _scalars(summary: Mapping[str, Any], results: Mapping[str, LibraryResult]) -> dict[str, float]:
    scalars = {"data/f_kHz": summary["data"]["f_kHz"]}
    for name, model in summary["models"].items():
        scalars[f"{name}/f_kHz"] = model["trajectory"]["f_kHz"]
        scalars[f"{name}/nrmse"] = model["trajectory"]["nrmse"]
        for state, equation in model["equations"].items():
            for key in ("r2_test", "n_terms", results[name].case.selection.label):
                scalars[f"{name}/{state}/{key}"] = equation[key]
    return scalars


def _hparams(config: DictConfig) -> dict[str, Any]:
    """The settings that decide a search; fixed keys, so that runs can be compared."""
    return {
        "seed": config.seed,
        "formulation": str(OmegaConf.to_container(config.formulation)),
        "search": str(OmegaConf.to_container(config.search)),
        "selection": str(OmegaConf.to_container(config.selection)),
        "depth": config.depth,
        "n_bootstraps": config.bootstraps.n,
        "n_culled": config.bootstraps.n_culled,
    }
