"""Run the simulator, once or over any of its parameters, and show what it did: `+exp=simulate`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import xarray as xr

from ep2sindy.report.run import Run
from ep2sindy.runtime.parallel import Workers
from ep2sindy.studies.kinds import Deferred, Kind, Positive, PositiveOrAll
from ep2sindy.studies.simulate_scan import (
    FAILED,
    ScanOutcome,
    Simulated,
    compile_kernels,
    scan_points,
    simulated,
)
from ep2sindy.studies.simulate_view import Outcome
from ep2sindy.studies.simulated import is_simulation, say_simulation
from ep2sindy.studies.study import Outcome as AnyOutcome
from ep2sindy.thruster.cache import write


def _is_scan(value: Any) -> bool:
    if not isinstance(value, dict) or not value:
        return value is None
    lists = all(isinstance(each, list) and each for each in value.values())
    return lists and all(each not in v[:k] for v in value.values() for k, each in enumerate(v))


Scan = Annotated[
    Mapping[str, Sequence[Any]] | None,
    Kind("like {operating_point.voltage: [250,300]}, each value once, or null", _is_scan),
]


@dataclass(frozen=True)
class Windowed:
    """How much figures show: the last periods of the record, and spectra up to a frequency."""

    periods: Positive
    f_max_Hz: PositiveOrAll


@dataclass(frozen=True, eq=False)
class Study:
    """One run, or one for every combination of some values.

    scan: places in the data group, such as `operating_point.voltage`, and their values; None for
    one run. labels: what places are called in tables and figures; else by their names.
    Raises ValueError for a place where nothing stands.
    """

    data: Deferred
    scan: Scan
    parallel: Workers
    figures: Windowed
    labels: Mapping[str, str]

    def __post_init__(self) -> None:
        scan_points(self.data, self.scan or {})  # a misspelt place must cost no simulation

    def compute(self, run: Run) -> AnyOutcome:
        return self._scanned(run) if self.scan else self._one(run)

    def _one(self, run: Run) -> Outcome:
        field = self.data.build()
        check_simulation(field, self.data)
        write(field, run.folder.path / "field.nc")
        say_simulation(run, field.attrs)
        return Outcome(field, periods=self.figures.periods, f_max_Hz=self.figures.f_max_Hz)

    def _scanned(self, run: Run) -> ScanOutcome:
        points = scan_points(self.data, self.scan or {})
        with run.progress(None, "", "kernels, compiled once"):
            compile_kernels([point.data for point in points])
        found: dict[int, Simulated] = {}
        with run.progress(len(points), "simulation") as came:
            for number, result in self.parallel.run(simulated, points):
                found[number] = result
                came(1)
        results = [found[number] for number in range(len(points))]
        if all(each.status == FAILED for each in results):
            raise ValueError(f"a scan needs a point that can be run: {results[0].message}")
        for point, result in zip(points, results, strict=True):
            for note in result.notes:
                run.warn(f"{point.label}: {note}")
        return ScanOutcome(points, results, self.labels)


def check_simulation(field: object, data: Deferred) -> None:
    """Raise ValueError unless the data group names a simulation of this package."""
    if not (isinstance(field, xr.Dataset) and is_simulation(field.attrs)):
        raise ValueError(
            "data must be a simulation, with status, current and parameters as its attributes: "
            f"{data.settings['_target_']} gave none; choose data=simulation"
        )
