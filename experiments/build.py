"""From config to values: what several experiments share."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path

import xarray as xr
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf

from ep2sindy.library import Library, polynomial
from ep2sindy.report import RunFolder, Screen, command_line
from ep2sindy.trajectory import Trajectory


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


def trajectory_of(config: DictConfig, field: xr.Dataset, variables: Sequence[str]) -> Trajectory:
    """Time series of the states, and of those `variables` that are not states, as inputs."""
    average = instantiate(config.trajectory, _convert_="all")
    products = [f"<{name.replace(' ', '')}>" for name in config.trajectory.products]
    known = {*config.trajectory.states, *products}
    inputs = [name for name in dict.fromkeys(variables) if name not in known]
    return average(field, inputs=inputs, label=config.experiment)


def library_of(case: DictConfig, field: xr.Dataset) -> Library:
    """The polynomial library of one case, without optional variables that the field lacks."""
    optional = [name for name in case.get("variables_if_present", []) if name in field]
    return polynomial(
        [*case.variables, *optional], degree=case.degree, products=list(case.get("products", []))
    )
