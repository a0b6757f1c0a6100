"""From config to values: what several experiments share."""

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import xarray as xr
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from ep2sindy.library import Library, polynomial
from ep2sindy.report import RunFolder, Screen, command_line


@contextmanager
def started_run(config: DictConfig) -> Iterator[tuple[RunFolder, Screen]]:
    """A new run folder that already holds its config and provenance, and its screen."""
    folder = RunFolder.create(Path(config.output), config.experiment, now=datetime.now())
    folder.write_text("config.yaml", OmegaConf.to_yaml(config, resolve=True))
    folder.write_provenance(seed=config.seed, command=command_line())
    screen = Screen(folder.path / "run.log")
    try:
        yield folder, screen
    finally:
        screen.close()


def open_prepared_field(config: DictConfig) -> xr.Dataset:
    """The field of the `data` group after the steps of `prepare`."""
    steps = [instantiate(step, _partial_=True, _convert_="all") for step in config.prepare]
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


LIBRARY_KEYS = {"variables", "variables_if_present", "degree", "products", "selection"}


def check_library(name: str, case: DictConfig) -> None:
    """Raise ValueError for a key that would do nothing, or one that is missing."""
    unknown = set(case) - LIBRARY_KEYS
    missing = {"variables", "degree"} - set(case)
    if unknown or missing:
        raise ValueError(
            f"libraries.{name} may have {sorted(LIBRARY_KEYS)} and needs variables and degree: "
            f"{sorted(map(str, case))} came"
        )


def library_of(case: DictConfig, field: xr.Dataset) -> Library:
    """The polynomial library of one case, without optional variables that the field lacks."""
    optional = [name for name in case.get("variables_if_present", []) if name in field]
    return polynomial(
        [*case.variables, *optional], degree=case.degree, products=list(case.get("products", []))
    )
