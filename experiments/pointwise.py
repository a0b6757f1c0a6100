"""A search at every grid point, and the regimes that come out: `+exp=pointwise`."""

import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import xarray as xr
from hydra.utils import instantiate
from omegaconf import DictConfig, OmegaConf
from tqdm import tqdm

import ep2sindy
from ep2sindy.discovery.blocks import Kept, blocks_of
from ep2sindy.discovery.pointwise import STATUSES, PointSearch, pointwise
from ep2sindy.discovery.regimes import regimes
from ep2sindy.figures.maps import MEDIANS, coefficient_maps, quality_maps, regime_map
from ep2sindy.library.equations import equation_text
from ep2sindy.library.library import Library, named_terms
from ep2sindy.library.terms import variables_of
from ep2sindy.machine.files import fingerprint, replacing
from ep2sindy.machine.parallel import Workers
from ep2sindy.report.folder import RunFolder
from ep2sindy.report.screen import Screen
from ep2sindy.report.tensorboard import LiveScalars, write_tensorboard
from ep2sindy.thruster.parameters import Thruster
from experiments.build import open_prepared_field, recipe_of, started_run
from experiments.checks import check_counts, check_lists
from experiments.pointwise_view import Outcome, page, print_outcome, summary, terms_table

USES: tuple[str, ...] = (
    "data",
    "prepare",
    "formulation",
    "search",
    "bootstraps",
    "selection",
    "depth",
    "parallel",
)  # of conf/config.yaml
KEYS = (
    "states", "terms", "variables_if_present", "least_variation", "max_regimes", "block_points",
    "keep", "outline",
)  # fmt: skip
# What does not change the result of a point, and may differ when a broken run is taken up.
AFTERWARDS = {"output", "parallel", "max_regimes", "keep", "outline", "experiment", "study"}


def run(config: DictConfig) -> Path:
    """Search everywhere, group what was found; everything lands in a new run folder."""
    with started_run(config, keys=KEYS) as (folder, screen):
        check_counts(config, "max_regimes", "block_points")
        check_lists(config, "states", "terms")
        # Everything but the data is built first: a misspelt key must not cost a simulation.
        workers = instantiate(config.parallel)
        settings = search_settings(config)
        outline = instantiate(config.outline)
        field = open_prepared_field(config)
        search = PointSearch(library=library_of(config, field), **settings)
        left_out = [name for name in config.terms if name not in search.library.names]
        if left_out:
            screen.print(f"terms left out, for this field lacks their variables: {left_out}")
        kept = Kept(Path(config.keep) / blocks_key(config))
        begin = time.perf_counter()
        result, n_before = _searched(config, field, search, workers, kept, folder, screen)
        wall_s = time.perf_counter() - begin
        found = regimes(
            result, rng=np.random.default_rng(config.seed), max_regimes=config.max_regimes
        )
        result = result.assign(regime=found.labels, confidence=found.confidence)
        write_result(folder.path / "pointwise.nc", result)
        outcome = Outcome(config.experiment, result, found, wall_s, n_before)
        print_outcome(screen, outcome)
        _write(folder, config, outcome, outline)
        kept.clear()
    return folder.path


def _searched(
    config: DictConfig,
    field: xr.Dataset,
    search: PointSearch,
    workers: Workers,
    kept: Kept,
    folder: RunFolder,
    screen: Screen,
) -> tuple[xr.Dataset, int]:
    """The study, from where an earlier run was broken off; points that it had done."""
    blocks = blocks_of(field, config.block_points)
    n_before = sum(block.n_points for block in blocks if kept.holds(block))
    n_points = sum(block.n_points for block in blocks)
    if n_before:
        screen.print(f"going on with {n_before} of {n_points} points that a broken run had done")
    try:
        with progress_of(folder, n_points, n_before) as progress:
            result = pointwise(
                field,
                search,
                workers=workers,
                kept=kept,
                block_points=config.block_points,
                progress=progress,
            )
    except KeyboardInterrupt:
        screen.print(
            f"finished blocks are kept in {kept.folder}: the same command goes on with them"
        )
        raise
    return result, n_before


def _write(
    folder: RunFolder, config: DictConfig, outcome: Outcome, outline: Thruster | None
) -> None:
    folder.write_table("terms", terms_table(outcome.result))
    folder.write_table("regimes", outcome.regimes.table)
    figures = {
        "regimes": regime_map(outcome.regimes, outline=outline),
        "quality": quality_maps(outcome.result, outline=outline),
    }
    if (outcome.result["n_terms"] > 0).any():
        figures |= {"coefficients": coefficient_maps(outcome.result, outline=outline)}
    folder.write_figures(figures)
    found = summary(outcome)
    counts = {f"points/{name}": float(found["status"].get(name, 0)) for name in STATUSES}
    write_tensorboard(
        folder.path / "tensorboard",
        figures=figures,
        texts={
            f"regime_{k}": f"    {MEDIANS}: {_text(outcome, k)}" for k in range(found["regimes"])
        },
        hparams=_hparams(config),
        metrics={key: float(found[key]) for key in ("n_points", "n_valid", "regimes")} | counts,
    )
    folder.write_text("report.html", page(outcome, figures))
    folder.write_json(
        "summary.json", found | {"experiment": config.experiment, "seed": config.seed}
    )


def _text(outcome: Outcome, regime: int) -> str:
    equations = outcome.regimes.equations(regime)
    return "; ".join(equation_text(state, terms) for state, terms in equations.items())


def _hparams(config: DictConfig) -> dict[str, Any]:
    """The settings that decide the outcome; fixed keys, so that runs can be compared."""
    groups = ("formulation", "search", "selection")
    named = {key: str(config[key]["_target_"]).rpartition(".")[-1] for key in groups}
    return {
        "seed": config.seed,
        "terms": str(list(config.terms)),
        "n_bootstraps": config.bootstraps.n,
        **named,
    }


def search_settings(config: DictConfig) -> dict[str, Any]:
    return {
        "states": list(config.states),
        "recipe": recipe_of(config),
        "least_variation": config.least_variation,
        "seed": config.seed,
    }


def library_of(config: DictConfig, field: xr.Dataset) -> Library:
    """The terms of the config, without those of optional variables that the field lacks."""
    lacking = {name for name in config.variables_if_present if name not in field}
    factors = {name: variables_of(name) for name in map(str, config.terms)}
    terms = [name for name, variables in factors.items() if not lacking & set(variables)]
    used = dict.fromkeys([*config.states, *(v for name in terms for v in factors[name])])
    return named_terms(list(used), terms)


def blocks_key(config: DictConfig) -> str:
    """What the result of a block depends on: settings, the files they name, the code."""
    settings = cast(dict, OmegaConf.to_container(config, resolve=True))
    decisive = {key: value for key, value in settings.items() if key not in AFTERWARDS}
    decisive["files"] = [
        (str(path), each.stat().st_size, each.stat().st_mtime_ns)
        for path in files_named({key: settings[key] for key in ("data", "prepare")})
        for each in (path, *sorted(path.rglob("*")))  # a Zarr store is a folder
    ]
    found = json.dumps(decisive, sort_keys=True)
    for package in (Path(ep2sindy.__file__).parent, Path(__file__).parent):
        found = fingerprint(found, sources=package)
    return found


def files_named(settings: object) -> list[Path]:
    """Every text among some settings that is the path of a file or folder, but the cache."""
    if isinstance(settings, dict):
        settings = [value for key, value in settings.items() if key != "cache"]
    if isinstance(settings, list):
        return [path for each in settings for path in files_named(each)]
    is_path = isinstance(settings, str) and settings and Path(settings).exists()
    return [Path(str(settings))] if is_path else []


@contextmanager
def progress_of(folder: RunFolder, n_points: int, n_before: int) -> Iterator[Callable[[int], None]]:
    """A bar with points per second, and the same in TensorBoard while the run goes on.

    n_before: points that were done already, and come first.
    """
    begin = time.perf_counter()
    with (
        LiveScalars(folder.path / "tensorboard") as live,
        tqdm(total=n_points, unit="point", disable=None) as bar,
    ):
        done = 0

        def progress(n_more: int) -> None:
            nonlocal done
            done += n_more
            bar.update(n_more)
            per_s = max(done - n_before, 0) / max(time.perf_counter() - begin, 1e-9)
            live.write({"points/done": float(done), "points/per_s": per_s}, step=done)

        yield progress


def write_result(path: Path, result: xr.Dataset) -> None:
    """Write as NetCDF, compressed, whole or not at all."""
    packed = {str(name): {"zlib": True, "complevel": 4} for name in result.data_vars}
    with replacing(path) as temporary:
        result.to_netcdf(temporary, engine="h5netcdf", encoding=packed)
