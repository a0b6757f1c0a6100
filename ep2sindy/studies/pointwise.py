"""A search at every grid point, and the regimes that come out: `+exp=pointwise`."""

from __future__ import annotations

import json
import time
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import xarray as xr

import ep2sindy
from ep2sindy.data.netcdf import write_netcdf
from ep2sindy.discovery.method import AnyMethod
from ep2sindy.discovery.pointwise import Kept, PointSearch, blocks_of, pointwise
from ep2sindy.discovery.recipe import regression_of
from ep2sindy.discovery.regimes import regimes
from ep2sindy.library.library import Library, named_terms
from ep2sindy.library.terms import variables_of
from ep2sindy.machine.files import fingerprint
from ep2sindy.machine.own import own_source
from ep2sindy.machine.parallel import Workers
from ep2sindy.machine.progress import Advance
from ep2sindy.report.run import Run
from ep2sindy.studies.kinds import A_LIST, Count, Deferred, Names
from ep2sindy.studies.pointwise_view import Outcome
from ep2sindy.studies.simulated import say_simulation
from ep2sindy.studies.source import Step, open_prepared, say_field
from ep2sindy.thruster.parameters import Thruster

# What does not change the result of a point, and may differ when a broken run is taken up.
AFTERWARDS = {"output", "parallel", "max_regimes", "keep", "outline", "experiment", "study"}


@dataclass(frozen=True)
class Study:
    """Search everywhere, group what was found.

    terms: those of variables_if_present are left out where the field lacks their variables.
    keep: folder of finished blocks, where a run that takes up a broken one finds them. outline:
    the thruster whose channel is drawn into the maps.
    """

    data: Deferred
    prepare: Sequence[Step]
    recipe: AnyMethod
    parallel: Workers
    states: Names
    terms: Annotated[Sequence[str | int], A_LIST]  # 1, the constant, is a number to YAML
    variables_if_present: Sequence[str]
    least_variation: float
    max_regimes: Count
    block_points: Count
    keep: str
    outline: Thruster | None

    def __post_init__(self) -> None:
        self.search(self.library(lacking=()), seed=0)  # what cannot work is refused here

    def library(self, *, lacking: Collection[str]) -> Library:
        """The terms, without those of variables that a field lacks."""
        factors = {name: variables_of(name) for name in map(str, self.terms)}
        terms = [name for name, variables in factors.items() if not {*lacking} & {*variables}]
        used = dict.fromkeys([*self.states, *(v for name in terms for v in factors[name])])
        return named_terms(list(used), terms)

    def search(self, library: Library, *, seed: int) -> PointSearch:
        method = regression_of(self.recipe)
        return PointSearch(self.states, library, method, self.least_variation, seed)

    def compute(self, run: Run) -> Outcome:
        with run.progress(None, "", "data"):
            field = open_prepared(self.data, self.prepare)
        say_simulation(run, field.attrs)
        say_field(run, field)
        lacking = [name for name in self.variables_if_present if name not in field]
        search = self.search(self.library(lacking=lacking), seed=run.seed)
        left_out = [name for name in map(str, self.terms) if name not in search.library.names]
        if left_out:
            run.say(f"terms left out, for this field lacks their variables: {left_out}")
        kept = Kept(Path(self.keep) / blocks_key(run.settings))
        begin = time.perf_counter()
        result, n_before = self._searched(field, search, kept, run)
        wall_s = time.perf_counter() - begin
        rng = np.random.default_rng(run.seed)
        with run.progress(None, "", "regimes"):
            found = regimes(result, rng=rng, max_regimes=self.max_regimes)
        result = result.assign(regime=found.labels, confidence=found.confidence)
        packed = {str(name): {"zlib": True, "complevel": 4} for name in result.data_vars}
        write_netcdf(result, run.folder.path / "pointwise.nc", encoding=packed)
        kept.clear()
        return Outcome(result, found, self.outline, wall_s=wall_s, n_before=n_before)

    def _searched(
        self, field: xr.Dataset, search: PointSearch, kept: Kept, run: Run
    ) -> tuple[xr.Dataset, int]:
        """The result, from where an earlier run was broken off; points that it had done."""
        blocks = blocks_of(field, self.block_points)
        n_before = sum(block.n_points for block in blocks if kept.holds(block))
        n_points = sum(block.n_points for block in blocks)
        if n_before:
            run.say(f"going on with {n_before} of {n_points} points that a broken run had done")
        try:
            result = pointwise(
                field,
                search,
                workers=self.parallel,
                kept=kept,
                block_points=self.block_points,
                progress=Rates(run, n_before),
            )
        except KeyboardInterrupt:
            run.say(
                f"finished blocks are kept in {kept.folder}: the same command goes on with them"
            )
            raise
        return result, n_before


@dataclass(frozen=True, eq=False)
class Rates:
    """The run's own progress, and points per second in TensorBoard while the run goes on.

    n_before: points that were done already, and come first.
    """

    run: Run
    n_before: int

    @contextmanager
    def stage(self, total: int | None, unit: str, label: str = "") -> Iterator[Advance]:
        begin, done = time.perf_counter(), 0
        with self.run.progress(total, unit, label) as advance:

            def count(n_more: int) -> None:
                nonlocal done
                done += n_more
                advance(n_more)
                per_s = max(done - self.n_before, 0) / max(time.perf_counter() - begin, 1e-9)
                rates = {"points/done": float(done), "points/per_s": per_s}
                self.run.board.scalars(rates, step=done)

            yield count


def blocks_key(settings: Mapping[str, Any]) -> str:
    """What the result of a block depends on: settings, the files they name, the code."""
    decisive = {key: value for key, value in settings.items() if key not in AFTERWARDS}
    decisive["files"] = [
        (str(path), each.stat().st_size, each.stat().st_mtime_ns)
        for key, text in texts([settings["data"], settings["prepare"]])
        if key != "cache" and text and (path := Path(text)).exists()
        for each in (path, *sorted(path.rglob("*")))  # a Zarr store is a folder
    ]
    found = json.dumps(decisive, sort_keys=True)
    for sources in (Path(ep2sindy.__file__).parent, *own_sources(settings)):
        found = fingerprint(found, sources=sources)
    return found


def own_sources(settings: Mapping[str, Any]) -> list[Path]:
    """Modules and packages other than ours that the settings name: the user's own code."""
    names = [text for key, text in texts(settings) if key in ("_target_", "study") and "." in text]
    found = {own_source(name) for name in names if not name.startswith("ep2sindy.")}
    return sorted(path for path in found if path is not None)


def texts(settings: object, key: str = "") -> Iterator[tuple[str, str]]:
    """Every text among some settings, at any depth, after the key that it stands under."""
    if isinstance(settings, Mapping):
        for name, value in settings.items():
            yield from texts(value, str(name))
    elif isinstance(settings, list):
        for each in settings:
            yield from texts(each, key)
    elif isinstance(settings, str):
        yield key, settings
