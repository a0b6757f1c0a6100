"""Relations between the coefficients of equations, beside none: `+exp=constrained`."""

from pathlib import Path

import numpy as np
from hydra.utils import instantiate
from omegaconf import DictConfig

from ep2sindy.constraints.relations import Constraint, constraint
from ep2sindy.library.library import Library
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.tensorboard import write_tensorboard
from ep2sindy.studies.held_out import Judged, constrained_beside_base, parted
from experiments.build import (
    check_figures,
    inputs_of,
    open_prepared_field,
    relations_of,
    started_run,
    terms_of,
)
from experiments.checks import check_share
from experiments.held_out_view import (
    Outcome,
    data_summary,
    figures_of,
    judged_summary,
    methods_table,
    page,
    print_outcome,
)
from experiments.libraries import rollout_table
from experiments.libraries_view import print_data
from experiments.model_view import coefficients

USES: tuple[str, ...] = ("data", "prepare", "trajectory", "formulation")  # of conf/config.yaml
KEYS = ("models", "held_out", "figures")


def run(config: DictConfig) -> Path:
    """Fit every model with and without its relations; everything lands in a new run folder."""
    with started_run(config, keys=KEYS) as (folder, screen):
        check_figures(config)
        check_share(config, "held_out")
        # Everything but the data is built first: a misspelt key must not cost a simulation.
        models = models_of(config)
        formulation = instantiate(config.formulation)
        to_trajectory = instantiate(config.trajectory, _convert_="all")
        field = open_prepared_field(config)
        inputs = inputs_of(config, [library for library, _ in models.values()])
        data = to_trajectory(field, inputs=inputs, label=config.experiment)
        print_data(screen, data, field.attrs)
        train, held = parted(data, config.held_out)

        rng = np.random.default_rng(config.seed)
        judged: dict[str, Judged] = {}
        for (name, (library, constraints)), stream in zip(
            models.items(), rng.spawn(len(models)), strict=True
        ):
            found = constrained_beside_base(
                train, held, library, constraints, formulation, rng=stream
            )
            judged |= {f"{name}_{kind}": each for kind, each in found.items()}
        labels = {f"{n}_{kind}": f"{n.replace('_', ' ')}, {kind}" for n in models for kind in KINDS}
        relations = [text for case in config.models.values() for text in case.relations]
        outcome = Outcome(
            config.experiment, train, held, judged, labels, list(dict.fromkeys(relations))
        )
        print_outcome(screen, outcome)
        _write(folder, config, outcome)
    return folder.path


KINDS = ("base", "constrained")


def models_of(config: DictConfig) -> dict[str, tuple[Library, dict[str, Constraint]]]:
    """Library of every model, and its constraints without and with relations."""
    if not isinstance(config.models, DictConfig) or not config.models:
        raise ValueError(
            "models must be like {name: {terms: {x: [x, x*y]}, relations: [..]}}: "
            f"{config.models!r} came"
        )
    found = {}
    for key, case in config.models.items():
        name = str(key)
        if not isinstance(case, DictConfig) or set(case) != {"terms", "relations"}:
            raise ValueError(f"models.{name} must have terms and relations: {case!r} came")
        library, terms = terms_of(
            case.terms, states=config.trajectory.states, key=f"models.{name}.terms"
        )
        relations = relations_of(case.relations, key=f"models.{name}.relations")
        constraints = (constraint(library, terms), constraint(library, terms, relations))
        found[name] = library, dict(zip(KINDS, constraints, strict=True))
    return found


def _write(folder: RunFolder, config: DictConfig, outcome: Outcome) -> None:
    figures = figures_of(outcome, **config.figures)
    for name, judged in outcome.judged.items():
        folder.write_model(name, judged.model)
        folder.write_table(
            f"rollout_{name}", rollout_table(outcome.held, judged.from_sample.integrated)
        )
    folder.write_table("methods", methods_table(outcome))
    folder.write_table("coefficients", coefficients(outcome.models, heading="method"))
    folder.write_figures(figures)
    found = {name: judged_summary(judged) for name, judged in outcome.judged.items()}
    write_tensorboard(
        folder.path / "tensorboard",
        figures=figures,
        texts={name: f"    {model.text()}" for name, model in outcome.models.items()},
        hparams={"seed": config.seed, "held_out": config.held_out},
        metrics={
            f"{name}/{key}": each[key]
            for name, each in found.items()
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
            "models": {
                name: {kind: found[f"{name}_{kind}"] for kind in KINDS} for name in config.models
            },
        },
    )
