"""A trajectory: sampled states and inputs of one system over one segment of time."""

from __future__ import annotations

import copyreg
import html
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from numbers import Real
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.gaps import LONGEST_STEP, MIN_SEGMENT, between_gaps, mean_step, present_rows
from ep2sindy.data.numbers import check_magnitude, real_numbers, rounding_s, seconds
from ep2sindy.library.names import check_state, check_variable
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.runtime.screen import html_table, one_screen, text_table
from ep2sindy.runtime.values import Columns, Mask, Samples, check_list, locked, read_only

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr


def read_only_mapping(values: dict) -> MappingProxyType:
    """Wrap a dict in a mapping that cannot be changed."""
    return MappingProxyType(values)


# Pickle cannot handle this type, and trajectories and models are sent to other processes.
copyreg.pickle(MappingProxyType, lambda kept: (read_only_mapping, (dict(kept),)))


class ConstantStateError(ValueError):
    """A state never changes, so its dynamics cannot be identified."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Time series of the modelled states and of the inputs that drive them.

    A trajectory is one record, measured or simulated. Its arrays are copied and cannot be changed;
    methods such as `window` return a new trajectory.

    Parameters
    ----------
    t : (samples,) array
        Times in s, increasing. Steps may be unequal. Dates are counted from the first, in s.
    states : (samples, n_states) array
        Samples of the states, in SI.
    state_names : sequence of str
        One name per column of `states`.
    inputs : (samples, n_inputs) array, default none
        Samples of what drives the states from outside, such as a voltage.
    input_names : sequence of str, default ()
        One name per column of `inputs`.
    units : mapping of str to str, default {}
        Unit of any of the variables and parameters by name. A name that is absent has the unit "1".
    label : str, default ''
        Name of the record, shown in figures and tables.
    clock : Clock, default SECONDS
        Unit in which times are displayed. `t` stays in s.
    missing : (samples, n_states) bool array, optional
        True where a state was not measured, such as a channel of a slower rate. Samples there may
        be NaN and are interpolated. None means that all were measured.
    parameters : mapping of str to float, default {}
        The operating point: the value of each quantity that was the same at all samples, by name.

    Raises
    ------
    ValueError
        If the times do not increase, lengths differ, values are masked, not finite or not real
        numbers, a magnitude lies below 1e-50 or above 1e150, a name is repeated or is not a word of
        letters, digits and _ (or an average such as `<n_i*n_n>`), there are fewer than two samples,
        a state never changes, or a parameter is not a finite number or has the name of a variable.

    Examples
    --------
    >>> t = np.linspace(0.0, 1e-3, 101)
    >>> run = ep.Trajectory(t, np.sin(6e4 * t)[:, None], ["I_d"], units={"I_d": "A"})
    >>> run.n_samples, run.columns(["I_d"]).shape
    (101, (101, 1))
    """

    # Lengths are typed `_` because __post_init__ compares them and raises a clearer error.
    t: Float[np.ndarray, " _"]
    states: Float[np.ndarray, "_ n_states"]
    state_names: Sequence[str]
    inputs: Float[np.ndarray, "_ n_inputs"] = field(default_factory=lambda: np.empty((0, 0)))
    input_names: Sequence[str] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    label: str = ""
    clock: Clock = SECONDS
    missing: Bool[np.ndarray, "_ n_states"] | None = None
    parameters: Mapping[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        check_list("state_names", self.state_names)
        check_list("input_names", self.input_names)
        empty = not self.input_names and not np.size(self.inputs)
        inputs = np.empty((len(self.t), 0)) if empty else self.inputs
        for name, value in {
            "t": read_only(seconds(self.t)),
            "states": self._filled(real_numbers(self.states, "states")),
            "inputs": locked(real_numbers(inputs, "inputs")),
            "state_names": tuple(self.state_names),
            "input_names": tuple(self.input_names),
            "parameters": MappingProxyType(_finite(self.parameters)),
        }.items():
            object.__setattr__(self, name, value)
        for name in self.names:
            check_state(name)
        for name in self.parameters:
            check_variable(name)
            if name in (*self.names, "time"):
                raise ValueError(
                    f"a parameter needs a name that no variable has, got {name!r}; rename one"
                )
        units = {n: self.units.get(n, "1") for n in (*self.names, *self.parameters)}
        object.__setattr__(self, "units", MappingProxyType(units))
        self._check_shapes()
        check_time(self.t)
        self._check_finite()
        check_magnitude(self.values, self.names)
        self._check_variation()

    def _filled(self, states: np.ndarray) -> Float[np.ndarray, "_ n_states"]:
        """The states, interpolated where they are missing."""
        if self.missing is None:
            return locked(states)
        missing = np.asarray(self.missing)
        if missing.shape != states.shape or missing.dtype != np.bool_:
            raise ValueError(
                "missing must be a mask of the states, true or false for each sample, got "
                f"{missing.dtype} of shape {missing.shape} with states of shape "
                f"{states.shape}; write missing=np.isnan(states)"
            )
        lacking = np.atleast_1d(missing.all(axis=0))
        if empty := [n for n, lacks in zip(self.state_names, lacking, strict=False) if lacks]:
            raise ValueError(
                f"every state needs samples: all of {empty} are missing; leave them out, or name "
                "them in hidden=..."
            )
        t, filled = seconds(self.t), np.array(states, dtype=np.float64)
        for column, lacks in zip(filled.T, missing.T, strict=True):
            column[lacks] = np.interp(t[lacks], t[~lacks], column[~lacks])
        object.__setattr__(self, "missing", locked(missing.copy()) if missing.any() else None)
        return locked(filled)

    def complete(self) -> Trajectory:
        """The samples at which every state was measured, for methods that need all of them.

        Raises ValueError if fewer than two are left.
        """
        if self.missing is None:
            return self
        return self._at(present_rows(dict(zip(self.names, self._as_measured().T, strict=True))))

    def _lacking(self) -> str:
        """How many samples every state lacks, in brackets; "" if it lacks none."""
        if self.missing is None:
            return ""
        counts = zip(self.state_names, self.missing.sum(axis=0).tolist(), strict=True)
        return f" ({', '.join(f'{name} lacks {n}' for name, n in counts if n)})"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the states, then of the inputs: the order of the library's variables."""
        return (*self.state_names, *self.input_names)

    @property
    def values(self) -> Float[np.ndarray, "samples variables"]:
        """States and inputs side by side, in the order of `names`."""
        return self.columns(self.names)

    @property
    def n_samples(self) -> int:
        return len(self.t)

    @cached_property
    def dt_s(self) -> float:
        """Mean time step in s, gaps left out."""
        return mean_step(self.t)

    def columns(self, names: Sequence[str]) -> Float[np.ndarray, "samples columns"]:
        """Samples of some states or inputs, in the order of `names`.

        Raises ValueError for an unknown name; the error lists the known ones.
        """
        for name in names:
            if name not in self.names:
                raise ValueError(
                    f"unknown variable {name!r}; this trajectory has {list(self.names)}"
                )
        n_states = len(self.state_names)
        columns = np.empty((self.n_samples, len(names)))
        for j, k in enumerate(map(self.names.index, names)):
            columns[:, j] = self.states[:, k] if k < n_states else self.inputs[:, k - n_states]
        return columns

    def window(self, start: int, stop: int) -> Trajectory:
        """Samples from `start` to `stop` (exclusive) as a new trajectory."""
        if not 0 <= start < stop <= self.n_samples:
            raise ValueError(
                f"a window must lie inside the trajectory: [{start}, {stop}) was asked of "
                f"{self.n_samples} samples"
            )
        return self._at(slice(start, stop))

    def _at(self, rows: slice | Mask) -> Trajectory:
        return replace(
            self,
            t=self.t[rows],
            states=self.states[rows],
            inputs=self.inputs[rows],
            missing=None if self.missing is None else self.missing[rows],
        )

    def segments(self, min_samples: int = MIN_SEGMENT) -> list[Trajectory]:
        """The segments between gaps as trajectories of their own; only itself, if it has no gap.

        Nothing that takes differences or integrates may lead across a gap (`between_gaps`).
        Segments of fewer samples, and those in which a state rests, are left out.
        Raises ValueError if none is left.
        """
        pieces = between_gaps(self.t)
        if len(pieces) == 1:
            return [self]
        found = []
        for start, stop in pieces:
            if stop - start >= min_samples:
                with suppress(ConstantStateError):
                    found.append(self.window(start, stop))
        if not found:
            raise ValueError(
                f"a trajectory must hold {min_samples} samples without a gap: {len(pieces) - 1} "
                f"steps are over {LONGEST_STEP:g} times the median step; cut it at its pauses, or "
                "interpolate it first"
            )
        return found

    def to_dataframe(self) -> pd.DataFrame:
        """States, then inputs, as columns in SI over an index `time` in s; NaN where missing."""
        return as_dataframe(self.t, self._as_measured(), self.names)

    def to_xarray(self) -> xr.Dataset:
        """States and inputs over `time` in s, NaN where missing, with their units and clock.

        The parameters are scalar coordinates, which their attribute `role` tells from others.
        """
        samples = as_dataset(self.t, self._as_measured(), self.names, self.units, self.clock)
        return samples.assign_coords(
            {
                name: ((), value, {"units": self.units[name], ROLE: PARAMETER})
                for name, value in self.parameters.items()
            }
        )

    def _as_measured(self) -> Float[np.ndarray, "samples variables"]:
        """All values, NaN in place of those that were interpolated."""
        values = self.values.copy()
        if self.missing is not None:
            values[:, : len(self.state_names)][self.missing] = np.nan
        return values

    def __repr__(self) -> str:
        table = text_table(["", "", "unit", "from", "to"], self._ranges())
        return one_screen([self._headline(), *table])

    def _repr_html_(self) -> str:
        rows = [list(map(html.escape, row)) for row in self._ranges()]
        table = html_table(["", "", "unit", "from", "to"], rows)
        return f"<div>{html.escape(self._headline())}</div>{table}"

    def _headline(self) -> str:
        steps = np.diff(self.t)
        even = np.ptp(steps) <= max(1e-6 * self.dt_s, 2 * rounding_s(self.t))
        clock = self.clock
        factor, unit = (1.0, "s") if clock == SECONDS else clock.scale(1.0)
        lengths = [self.dt_s] if even else [float(steps.min()), float(steps.max())]
        step = " to ".join(f"{factor * each:.4g}" for each in lengths)
        label = f" {self.label!r}" if self.label else ""
        label += f" at {point_label(self.parameters)}" if self.parameters else ""
        span = f"{factor * self.t[0]:.6g} to {factor * self.t[-1]:.6g}"
        return (
            f"Trajectory{label}: {self.n_samples} samples{self._lacking()}, t = {span} {unit} in "
            f"steps of {step} {unit}"
        )

    def _ranges(self) -> list[list[str]]:
        """Role, name, unit and range of every variable."""
        roles = ["state"] * len(self.state_names) + ["input"] * len(self.input_names)
        return [
            [role, name, self.units[name], f"{column.min():.4g}", f"{column.max():.4g}"]
            for role, name, column in zip(roles, self.names, self.values.T, strict=True)
        ]

    def _check_shapes(self) -> None:
        for role, values, names in (
            ("states", self.states, self.state_names),
            ("inputs", self.inputs, self.input_names),
        ):
            if values.ndim != 2 or len(values) != len(self.t):
                raise ValueError(
                    f"{role} must have shape (samples, variables) with as many samples as t, got "
                    f"{values.shape} with {len(self.t)} times"
                )
            if values.shape[1] != len(names):
                raise ValueError(
                    f"{role} must have one name per column, got {values.shape[1]} columns with "
                    f"the names {list(names)}"
                )
        repeated = [name for name, n in Counter(self.names).items() if n > 1]
        if repeated:
            raise ValueError(f"variable names must be unique, got {repeated} more than once")
        if not self.state_names:
            raise ValueError("a trajectory needs at least one state; name one in state_names")

    def _check_finite(self) -> None:
        rows, columns = np.nonzero(~np.isfinite(self.values))
        if rows.size:
            k, name = rows[0], self.names[columns[0]]
            raise ValueError(
                f"samples must be finite: {name}[{k}] = {self.values[k, columns[0]]} at t = "
                f"{self.t[k]:.6g} s ({rows.size} such values); crop, mask or interpolate them "
                "first, or say that they were not measured (missing=np.isnan(states))"
            )

    def _check_variation(self) -> None:
        columns = np.ascontiguousarray(self.states.T)  # reductions over few columns are slow
        for name, width, level in zip(
            self.state_names, np.ptp(columns, axis=1), np.abs(columns).max(axis=1), strict=True
        ):
            # A variation within rounding error says nothing about the system's derivative.
            if width <= 1e-12 * level:
                raise ConstantStateError(
                    f"a state must vary: {name!r} stays at {level:.6g} over all "
                    f"{self.n_samples} samples; leave it out, or pass it as an input"
                )


def point_label(parameters: Mapping[str, float]) -> str:
    """Label of an operating point, such as `V_D_V=300, mdot_mg_s=5`."""
    return ", ".join(f"{name}={value:g}" for name, value in parameters.items())


def _finite(parameters: Mapping[str, float]) -> dict[str, float]:
    """The parameters as floats. Raises ValueError unless they are finite numbers."""
    for name, value in parameters.items():
        if isinstance(value, bool) or not isinstance(value, Real) or not np.isfinite(float(value)):
            raise ValueError(f"a parameter must be a finite number, got {name}={value!r}")
    return {name: float(value) for name, value in parameters.items()}


def check_time(t: Samples) -> None:
    """Raise ValueError unless t has two samples or more, is finite and increases."""
    if t.ndim != 1 or len(t) < 2:
        raise ValueError(f"a trajectory needs at least two samples: t has shape {t.shape}")
    check_increasing("t", t, "s")


def check_increasing(name: str, points: Float[np.ndarray, " points"], unit: str) -> None:
    """Raise ValueError unless points are finite and increase."""
    bad = np.flatnonzero(~np.isfinite(points))
    if bad.size:
        raise ValueError(
            f"{name} must be finite: {name}[{bad[0]}] = {points[bad[0]]} ({bad.size} such "
            "samples); cut or fill them first"
        )
    stalls = np.flatnonzero(np.diff(points) <= 0)
    if stalls.size:
        k = int(stalls[0])
        raise ValueError(
            f"{name} must increase: {name}[{k + 1}] = {points[k + 1]:.9g} {unit} follows "
            f"{points[k]:.9g} {unit}; drop what repeats, or sort by {name} first"
        )


def check_agreement(trajectories: Sequence[Trajectory], variables: Sequence[str]) -> None:
    """Raise ValueError unless all trajectories have the same states, and agree in units.

    Units of parameters count, too. variables: of the library. They may stand in any order among
    the inputs, which are taken by name; states must come in one order.
    """
    if not trajectories:
        raise ValueError("at least one trajectory is needed to find equations, got none")
    first = trajectories[0]
    names = [*first.state_names, *(v for v in variables if v not in first.state_names)]
    for k, run in enumerate(trajectories):
        missing = [name for name in names if name not in run.names]
        if missing or run.state_names != first.state_names:
            way = "give all of them the same states, named alike and in the same order"
            if lacking := [name for name in missing if name not in first.state_names]:
                way = (
                    f"the library needs {lacking}: sample it as a state or pass it as an input, "
                    "leave its terms out, or derive it (+exp=trace does, of one signal)"
                )
            raise ValueError(
                f"every trajectory needs the states {list(first.state_names)} and the variables "
                f"{list(variables)}: trajectory {k} has states {list(run.state_names)} and inputs "
                f"{list(run.input_names)}; {way}"
            )
        for name in (*names, *run.parameters):
            if run.units[name] != first.units.get(name, run.units[name]):
                raise ValueError(
                    f"units must agree: {name!r} is in {first.units[name]} in trajectory 0 and "
                    f"in {run.units[name]} in trajectory {k}; convert one of them first"
                )


def spread_blocks(runs: Sequence[Trajectory], *, most: int, block: int) -> list[Trajectory]:
    """Blocks of neighbouring samples that show a law, or none, nearly as well as a long record.

    They are spread evenly over the records, whose noise may change, and have at most `most` samples
    together, each at most `block`. Records of at most `most` samples together come back whole.
    """
    if sum(run.n_samples for run in runs) <= most:
        return list(runs)
    bounds = [
        (run, np.linspace(0, run.n_samples, -(-run.n_samples // block) + 1).astype(int))
        for run in runs
    ]
    pieces = [(run, *pair) for run, each in bounds for pair in pairwise(each.tolist())]
    longest = max(last - first for _, first, last in pieces)
    chosen = np.linspace(0, len(pieces) - 1, most // longest).round().astype(int)
    found = []
    for run, first, last in (pieces[k] for k in np.unique(chosen)):
        with suppress(ValueError):  # a state may rest, or be missing, for as long as a block
            found.append(run.window(first, last))
    return found or list(runs)


# Samples as a pandas table or an xarray Dataset, to continue with in other tools.


CLOCK = "read_in"  # attribute of the time coordinate: the unit in which times are displayed
ROLE, PARAMETER = "role", "parameter"  # attribute of a scalar coordinate, and its value


def as_dataframe(t: Samples, values: Columns, names: Sequence[str]) -> pd.DataFrame:
    """A column per variable, in SI, over an index `time_s`; `ep.discover` takes it as a run."""
    import pandas as pd  # takes time to import, and few ask for it

    return pd.DataFrame(values, index=pd.Index(t, name="time_s"), columns=list(names))


def as_dataset(
    t: Samples, values: Columns, names: Sequence[str], units: Mapping[str, str], clock: Clock
) -> xr.Dataset:
    """A variable for each name over `time` in s, with units and the clock's as attributes."""
    import xarray as xr

    columns = zip(names, values.T, strict=True)
    return xr.Dataset(
        {name: ("time", column, {"units": units[name]}) for name, column in columns},
        coords={"time": ("time", t, {"units": "s", CLOCK: clock.unit})},
    )
