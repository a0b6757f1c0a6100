"""From config to values: what several experiments share."""

import inspect
import re
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import datetime
from functools import reduce
from operator import add
from pathlib import Path
from typing import Any, cast

import numpy as np
import xarray as xr
from hydra.utils import instantiate
from omegaconf import DictConfig, ListConfig, OmegaConf

from ep2sindy.discovery.recipe import Recipe
from ep2sindy.library.library import Library, named_terms, polynomial
from ep2sindy.library.terms import variables_of
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.screen import Screen

# The keys of conf/config.yaml, which every study meets; each study names those it adds.
BASE_KEYS = {
    "data", "formulation", "search", "bootstraps", "selection", "depth", "parallel", "experiment",
    "study", "seed", "output", "prepare", "trajectory",
}  # fmt: skip


def check_overrides(overrides: Iterable[str], *, used: Collection[str], experiment: str) -> None:
    """Raise ValueError for a key of conf/config.yaml that was set but that a study does not use."""
    unused = BASE_KEYS - {"experiment", "study", "seed", "output"} - set(used)
    for text in overrides:
        key = re.split(r"[.=@]", text.lstrip("+~/"))[0]
        if key in unused:
            raise ValueError(
                f"{text!r} would do nothing: {experiment} does not use {key!r}; leave it out"
            )


@contextmanager
def started_run(config: DictConfig, *, keys: Collection[str]) -> Iterator[tuple[RunFolder, Screen]]:
    """A new run folder that already holds its config and provenance, and its screen.

    keys: top-level keys that the study takes, beside those of conf/config.yaml.
    """
    check_config(config, keys=keys)
    folder = RunFolder.create(Path(config.output), config.experiment, now=datetime.now())
    folder.write_text("config.yaml", OmegaConf.to_yaml(config, resolve=True))
    folder.write_provenance(
        seed=config.seed, command=["python", "-m", "experiments.run", *sys.argv[1:]]
    )
    screen = Screen(folder.path / "run.log")
    try:
        yield folder, screen
    except BaseException as error:
        screen.log(f"ended early: {type(error).__name__}: {error}")
        raise
    finally:
        screen.close()


def check_config(config: DictConfig, *, keys: Collection[str]) -> None:
    """Raise ValueError for a key that would do nothing, or a setting of the wrong kind."""
    known = BASE_KEYS | set(keys)
    unknown = set(config) - known
    if unknown:
        raise ValueError(f"unknown keys {sorted(map(str, unknown))}; there are {sorted(known)}")
    if not isinstance(config.seed, int) or config.seed < 0:
        raise ValueError(f"seed must be a whole number, zero or more: {config.seed!r} came")
    if not isinstance(config.depth, int) or config.depth < 1:
        raise ValueError(f"depth must be a whole number, one or more: {config.depth!r} came")
    if not str(config.experiment).isidentifier():
        raise ValueError(
            f"experiment names a folder: letters, digits and _, not {config.experiment!r}"
        )


def check_durations(config: DictConfig) -> None:
    """Raise ValueError unless `rollout_s` and all of `figures` are positive, or null."""
    _check_positive({"rollout_s": config.rollout_s})
    check_figures(config)


def check_figures(config: DictConfig) -> None:
    """Raise ValueError unless `figures` has its two keys, both positive, or null."""
    if set(config.figures) != {"duration_s", "f_max_Hz"}:
        raise ValueError(
            f"figures must have duration_s and f_max_Hz: {sorted(map(str, config.figures))} came"
        )
    _check_positive({f"figures.{key}": value for key, value in config.figures.items()})


def _check_positive(numbers: Mapping[str, object]) -> None:
    for key, value in numbers.items():
        if value is not None and not (isinstance(value, int | float) and value > 0):
            raise ValueError(f"{key} must be a positive number, or null for all: {value!r} came")


def recipe_of(config: DictConfig) -> Recipe:
    """How equations are searched for."""
    groups = ("formulation", "search", "bootstraps", "selection")
    return Recipe(**{name: instantiate(config[name]) for name in groups}, depth=config.depth)


def prepared_steps(config: DictConfig) -> list[Callable[[xr.Dataset], xr.Dataset]]:
    """The steps of `prepare`; an argument that a step does not know is refused here."""
    steps = []
    for k, entry in enumerate(config.prepare):
        if not isinstance(entry, DictConfig):
            raise ValueError(
                f"prepare[{k}] must be like {{_target_: ep2sindy.crop, start_s: 0}}: {entry!r} came"
            )
        step = instantiate(entry, _partial_=True, _convert_="all")
        try:
            inspect.signature(step.func).bind(None, **step.keywords)
        except TypeError as error:
            raise ValueError(f"prepare[{k}], {step.func.__name__}: {error}") from error
        steps.append(step)
    return steps


def open_prepared_field(config: DictConfig) -> xr.Dataset:
    """The field of the `data` group after the steps of `prepare`."""
    steps = prepared_steps(config)
    field = instantiate(config.data, _convert_="all")
    for step in steps:
        field = step(field)
    return field


def inputs_of(config: DictConfig, libraries: Iterable[Library]) -> list[str]:
    """Variables of the libraries that are neither states nor averages of products."""
    products = [f"<{name.replace(' ', '')}>" for name in config.trajectory.products]
    known = {*config.trajectory.states, *products}
    variables = dict.fromkeys(v for library in libraries for v in library.variables)
    return [name for name in variables if name not in known]


def terms_of(
    model: DictConfig, *, states: Sequence[str], key: str = "model"
) -> tuple[Library, dict[str, list[str]]]:
    """The terms of every state, and a library that holds each of them once.

    key: what the config calls this model, for the message.
    """
    given = cast(dict, OmegaConf.to_container(model))
    if set(given) != set(states) or not all(
        isinstance(names, list) and names for names in given.values()
    ):
        raise ValueError(
            f"{key} must list the terms of every state of {list(states)}, such as "
            f"{{x: [x, x*y]}}: {given} came"
        )
    terms = {state: [str(name) for name in given[state]] for state in states}
    factors = [
        variable for names in terms.values() for name in names for variable in variables_of(name)
    ]
    variables = list(dict.fromkeys([*states, *factors]))
    named = reduce(add, (named_terms(variables, names) for names in terms.values()))
    return named.take(np.argsort(named.degrees, kind="stable")), terms


def relations_of(given: Any, *, key: str) -> list[str]:
    """The relations of a config. Raises ValueError unless they are a list with something in it."""
    if not isinstance(given, ListConfig) or not given:
        raise ValueError(
            f"{key} must be a list of relations, such as ['x: x*y == -1 * y: x*y']: {given!r} came"
        )
    return [str(text) for text in given]


LIBRARY_KEYS = {"variables", "variables_if_present", "degree", "products", "n_norm"}


def check_library(name: str, case: DictConfig) -> None:
    """Raise ValueError for a key that would do nothing, or one that is missing."""
    unknown = set(case) - LIBRARY_KEYS
    missing = {"variables", "degree"} - set(case)
    if unknown or missing:
        raise ValueError(
            f"libraries.{name} may have {sorted(LIBRARY_KEYS)} and needs variables and degree: "
            f"{sorted(map(str, case))} came"
        )


def selection_of(case: DictConfig, selection: DictConfig) -> DictConfig:
    """The rule that all libraries share; where it has an n_norm, a library may set its own."""
    if "n_norm" in case and "n_norm" in selection:
        return cast(DictConfig, OmegaConf.merge(selection, {"n_norm": case.n_norm}))
    return selection


def library_of(case: DictConfig, field: xr.Dataset) -> Library:
    """The polynomial library of one case, without optional variables that the field lacks."""
    optional = [name for name in case.get("variables_if_present", []) if name in field]
    return polynomial(
        [*case.variables, *optional], degree=case.degree, products=list(case.get("products", []))
    )
