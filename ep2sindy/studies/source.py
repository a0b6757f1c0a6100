"""Where a study's data come from: a field, its preparation, and the trajectory made of it."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import xarray as xr

from ep2sindy.data.trajectory import Trajectory
from ep2sindy.library.library import Library
from ep2sindy.report.run import Run
from ep2sindy.signals.spectrum import dominant_frequency
from ep2sindy.studies.kinds import Deferred
from ep2sindy.studies.simulated import check_recorded, say_simulation

Step = Callable[[xr.Dataset], xr.Dataset]


@dataclass(frozen=True, eq=False)
class FieldSource:
    """A field and the steps that prepare it."""

    data: Deferred
    prepare: Sequence[Step] = ()

    def field(self) -> xr.Dataset:
        """Raises DivergedError for a simulation that broke before it could be studied.

        What the data say of themselves stays, whatever a step makes of them: arithmetic of
        xarray drops it, and a run that diverged would be silent.
        """
        field: xr.Dataset = self.data.build()
        check_recorded(field)
        said = dict(field.attrs)
        for step in self.prepare:
            field = step(field)
        return field.assign_attrs(said | field.attrs)


@runtime_checkable
class Sampling(Protocol):
    """How a field becomes a trajectory; states and products are its own."""

    states: Sequence[str]
    products: Sequence[str]

    def trajectory(self, field: xr.Dataset, *, inputs: Sequence[str], label: str) -> Trajectory: ...


@dataclass(frozen=True, eq=False)
class Source:
    """A field, the steps that prepare it, and how it becomes a trajectory."""

    data: Deferred
    prepare: Sequence[Step]
    trajectory: Sampling

    @property
    def states(self) -> list[str]:
        return list(self.trajectory.states)

    def field(self) -> xr.Dataset:
        return FieldSource(self.data, self.prepare).field()

    def inputs(self, libraries: Iterable[Library]) -> list[str]:
        """Variables of the libraries that are neither states nor averages of products."""
        products = [f"<{name.replace(' ', '')}>" for name in self.trajectory.products]
        known = {*self.states, *products}
        variables = dict.fromkeys(v for library in libraries for v in library.variables)
        return [name for name in variables if name not in known]

    def sampled(self, field: xr.Dataset, libraries: Iterable[Library], run: Run) -> Trajectory:
        """The trajectory that libraries need, and a word on it for those who watch."""
        say_simulation(run, field.attrs)  # first: it may say why the rest cannot work
        data = self.trajectory.trajectory(field, inputs=self.inputs(libraries), label=run.title)
        say_data(run, data)
        return data


def zone_length_m(source: Source) -> float | None:
    """Of the zone that the trajectory is averaged over, along z; None for the whole axis."""
    z = getattr(getattr(source.trajectory, "zone", None), "z", None)
    return None if z is None else float(z[1] - z[0])


def say_data(run: Run, data: Trajectory) -> None:
    frequencies = ", ".join(
        f"{name} {data.clock.frequency_text(dominant_frequency(data.t, column))}"
        for name, column in zip(data.state_names, data.states.T, strict=True)
    )
    run.say(
        f"data: {data.n_samples} samples of {data.clock.duration_text(data.dt_s, digits=4)}; "
        f"dominant frequency {frequencies}"
    )


def data_summary(data: Trajectory) -> dict[str, Any]:
    """What a summary says of a trajectory."""
    return {
        "n_samples": data.n_samples,
        "dt_s": data.dt_s,
        "time_unit": data.clock.unit,  # that people read; numbers are in seconds
        "f_kHz": 1e-3 * dominant_frequency(data.t, data.states[:, 0]),
        "variables": list(data.names),
        "units": dict(data.units),
    }
