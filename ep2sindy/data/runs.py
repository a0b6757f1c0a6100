"""Runs from what people have: tables, Datasets over time, and arrays; one of them or several."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np

from ep2sindy.data.gaps import MissingSamples, describe_gaps, describe_missing, present_rows
from ep2sindy.data.numbers import count_dates, real_numbers, seconds
from ep2sindy.data.quantities import columns_in_si, time_unit
from ep2sindy.data.trajectory import CLOCK, PARAMETER, ROLE, Trajectory
from ep2sindy.library.units import SECONDS, Clock, seconds_in
from ep2sindy.runtime.values import Columns, Samples, check_list, check_positive

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    Run: TypeAlias = (
        Trajectory | pd.DataFrame | xr.Dataset | tuple[np.ndarray, np.ndarray] | np.ndarray
    )
    Runs: TypeAlias = Run | Sequence[Run] | Mapping[str, Run]
else:  # pandas is not imported only to name a type
    Run = Runs = object

TIMES = ("time", "t", "time_s", "t_s")  # accepted names of a table's time column, in seconds


def trajectories_of(
    runs: object, *, t: object = None, inputs: Sequence[str] = (), partial: bool = False
) -> list[Trajectory]:
    """Convert one run, or a list or a dict of runs, to trajectories.

    A run is one of the following.
    - A Trajectory.
    - A pandas DataFrame with a column of times in s (`time`, `t`, `time_s`, `t_s`) or in the unit
      that its name says (`Year`, `Time (h)`), an index of such a name, or an index of dates. Its
      other columns are states; columns labelled by a number are called x0, x1 ... Results are
      displayed in the unit of the times.
    - An xarray Dataset whose one dimension is time, such as `Trajectory.to_xarray` gives; its
      attribute `units` says in which unit of time. Scalar coordinates whose attribute `role` is
      "parameter" are its operating point.
    - A tuple (t, x) of times (samples,) and states (samples,) or (samples, n_states). The states
      are then called x, or x0, x1 ...
    - An array x, or a DataFrame without times, where `t` gives them.
    Samples that hold a NaN are left out, with the warning `MissingSamples`; if partial, only those
    that hold nothing else, and in the others the state counts as missing.
    t: times of such runs in s: an array, a list of one array for each run of a list, or the step
    between samples. inputs: names of columns that are inputs and not states, in every run.
    A tuple of runs, none of them an array, is a list of them. The keys of a dict are the runs'
    labels.
    Raises ValueError for anything else, for an input that lacks a value, and for whatever
    Trajectory refuses.
    """
    if isinstance(runs, Mapping) and not is_run(runs):
        found = trajectories_of([*runs.values()], t=t, inputs=inputs, partial=partial)
        return [replace(run, label=str(key)) for key, run in zip(runs, found, strict=True)]
    if isinstance(runs, tuple) and all(map(is_run, runs)):
        runs = list(runs)
    several = isinstance(runs, Sequence) and not isinstance(runs, tuple | str)
    listed: list[Any] = [*cast("Sequence[Any]", runs)] if several else [runs]
    if not listed:
        raise ValueError("at least one run is needed, got an empty list")
    times = t if isinstance(t, list | tuple) and several else [t] * len(listed)
    if len(times) != len(listed):
        raise ValueError(f"t must hold times for each run, got {len(times)} for {len(listed)}")
    found = []
    for k, (run, own) in enumerate(zip(listed, times, strict=True)):
        timed = run if own is None else _timed(run, own)
        which = f" {k} of the list" if several else ""
        found.append(_with_inputs(_trajectory(timed, which, partial), inputs))
    return found


def _timed(run: object, t: object) -> object:
    """A run that has no times, with times or a step in s."""
    if isinstance(t, str):
        raise ValueError(
            f"t must be times or a step in s, got {t!r}; call a table's column of times 'time', "
            "or by its unit, as 'time (ms)'"
        )
    if isinstance(run, Trajectory | tuple) or _is_field(run):
        raise ValueError(f"t is for arrays and tables without times, got a {type(run).__name__}")
    rows: Any = run if is_run(run) else np.ma.asanyarray(run)
    times: Any = t
    if np.ndim(times) == 0:
        check_positive("t", times)
        times = times * np.arange(len(rows))
    if not is_run(run):
        return times, rows
    times = np.asarray(times)
    if times.shape != (len(rows),):
        raise ValueError(f"t must have a time for each of {len(rows)} rows, got {times.shape}")
    return rows.reset_index(drop=True).assign(**{TIMES[0]: times})


def _with_inputs(run: Trajectory, inputs: Sequence[str]) -> Trajectory:
    """The run with some of its columns as inputs."""
    check_list("inputs", inputs)
    names = [name for name in inputs if name not in run.input_names]
    if not names:
        return run
    if unknown := [name for name in names if name not in run.state_names]:
        raise ValueError(f"unknown inputs {unknown}; the run has {list(run.names)}")
    own = np.isin(run.state_names, names)
    missing = np.zeros(run.states.shape, dtype=bool) if run.missing is None else run.missing
    if (lacking := missing[:, own].any(axis=0)).any():
        raise ValueError(
            "an input needs a value at every sample: "
            f"{np.array(run.state_names)[own][lacking].tolist()} lack some; fill them in, or leave "
            "these samples out"
        )
    return replace(
        run,
        states=run.states[:, ~own],
        state_names=[name for name in run.state_names if name not in names],
        inputs=np.column_stack([run.inputs, run.columns(names)]),
        input_names=[*run.input_names, *names],
        missing=missing[:, ~own],
    )


def is_run(value: object) -> bool:
    """True if a value holds samples together with their times: a trajectory or a table."""
    return isinstance(value, Trajectory) or _is_of(value, "pandas", "DataFrame") or _is_field(value)


def _is_of(value: object, package: str, name: str) -> bool:
    """Whether a value is of a class of a package, which its maker has imported already."""
    module = sys.modules.get(package)
    return module is not None and isinstance(value, getattr(module, name))


def _is_field(value: object) -> bool:
    return _is_of(value, "xarray", "Dataset")


def trajectory_of(run: object) -> Trajectory:
    """Convert one run to a trajectory; see `trajectories_of`."""
    return _trajectory(run, "", False)


def _trajectory(run: object, which: str, partial: bool) -> Trajectory:
    if isinstance(run, Trajectory):
        return run
    if _is_field(run):
        return _from_field(cast("xr.Dataset", run), partial)
    if is_run(run):
        return _from_table(cast("pd.DataFrame", run), partial)
    if isinstance(run, tuple) and len(run) == 2:
        return _from_arrays(*run, partial)
    raise ValueError(
        "a run must be a Trajectory, a pandas DataFrame with a time column, an xarray Dataset over "
        f"time, or a tuple (t, x) of arrays; run{which} is of type {type(run).__name__}; an array "
        "needs t=..., its times or its step in s; several runs go into a list or a dict"
    )


def _from_field(field: xr.Dataset, partial: bool) -> Trajectory:
    """Convert a Dataset over time to a trajectory; see `_from_table`."""
    if tuple(field.dims) != ("time",):
        raise ValueError(
            "a Dataset must have the dimension time alone to be a run, got "
            f"{list(map(str, field.dims))}; average over a zone, ep.zone_average(field, "
            "ep.Zone(), states=[...]), or at a point, ep.Zone(z=PLACE)"
        )
    if "time" not in field.coords:
        raise ValueError(
            "a Dataset that is a run needs a coordinate time, in s or another unit, or of dates: "
            "set field.assign_coords(time=...)"
        )
    if (unit := str(field["time"].attrs.get("units", "s"))) != "s":
        times = seconds_in(unit) * field["time"].values
        attrs = {CLOCK: unit} | field["time"].attrs | {"units": "s"}
        field = field.assign_coords(time=("time", times, attrs))
    run = _from_table(field.to_dataframe()[list(field.data_vars)], partial)
    units = {str(name): str(each.attrs.get("units", "1")) for name, each in field.variables.items()}
    point = {
        str(name): each.item()
        for name, each in field.coords.items()
        if not each.dims and each.attrs.get(ROLE) == PARAMETER
    }
    clock = Clock.of(str(field["time"].attrs.get(CLOCK, run.clock.unit)))
    return replace(run, units=units, clock=clock, parameters=point)


def _from_table(table: pd.DataFrame, partial: bool) -> Trajectory:
    """Convert a table with a column or an index of times to a trajectory, in SI.

    Names, their units and marks of missing samples are read as those of a file are. partial: a row
    that lacks some of the states stays, and these count as missing.
    """
    if time_unit(table.index.name) or table.index.dtype.kind in "mM":
        if not time_unit(table.index.name):
            table = table.rename_axis(index=TIMES[0])  # dates are times, whatever they are called
        table = table.reset_index(allow_duplicates=True)
    # A bare number gets an x, or it would look like a constant term.
    words = [f"x{n}" if isinstance(n, int | np.integer) else str(n) for n in table.columns]
    table = table.set_axis(words, axis="columns")
    if not table.columns.is_unique:
        raise ValueError(
            f"columns of a table must have names of their own, got {list(table.columns)}; rename "
            "or drop those that repeat"
        )
    times = {name: unit for name in table.columns if (unit := time_unit(name))}
    times = {name: unit for name, unit in times.items() if name in TIMES} or times
    if len(times) != 1:
        raise ValueError(
            f"a table must have one time column, called one of {list(TIMES)}, in s, or by its unit "
            f"of time, as 'Year' or 'Time (h)': its columns are {list(table.columns)}; rename one "
            "with table.rename(columns=...)"
        )
    ((time, unit),) = times.items()
    wrong = {
        str(name): str(kind)
        for name, kind in table.dtypes.items()
        if kind.kind not in ("iufmM" if name == time else "iuf")
    }
    if wrong:
        hint = "give time in s, as numbers or dates" if time in wrong else "drop them"
        raise ValueError(f"columns of a table must hold real numbers, got {wrong}; {hint}")
    values, units = columns_in_si(table.drop(columns=time))
    t, clock = _elapsed(table[time], unit)
    return _present(t, values, units, clock, partial)


def _present(
    t: Samples, values: Columns, units: Mapping[str, str], clock: Clock, partial: bool
) -> Trajectory:
    """The run without the samples that are NaN. units: by state. partial: see `trajectories_of`."""
    states, absent = list(units), np.isnan(values)
    if not absent.any():
        return Trajectory(t, values, states, clock=clock, units=units)
    missing = None
    if partial and not absent.all(axis=0).any():
        kept = ~absent.all(axis=1)
        missing = absent[kept]
        words = describe_missing(t, dict(zip(states, absent.T, strict=True)), clock)
    else:
        kept = present_rows(dict(zip(states, values.T, strict=True)))
        words = describe_gaps(t[kept], len(t), clock)
    warnings.warn(words, MissingSamples, stacklevel=5)
    return Trajectory(t[kept], values[kept], states, missing=missing, clock=clock, units=units)


def _elapsed(column: pd.Series, unit: str) -> tuple[Samples, Clock]:
    """Times of a column in s, and their clock: the unit in its name; of dates, by their steps."""
    if column.dtype.kind in "mM":
        t, unit = count_dates(column)
        return t, Clock.of(unit)
    t = seconds(column.to_numpy())
    return (t, SECONDS) if unit == "s" else (t * seconds_in(unit), Clock.of(unit))


def _from_arrays(t: object, x: object, partial: bool) -> Trajectory:
    times: Any = np.ma.asanyarray(t)
    states: Any = np.ma.asanyarray(x)
    if times.ndim != 1 or states.ndim not in (1, 2) or len(times) != len(states):
        raise ValueError(
            "arrays (t, x) must have shapes (samples,) and (samples,) or (samples, n_states), got "
            f"{times.shape} and {states.shape}"
        )
    columns = real_numbers(states[:, None] if states.ndim == 1 else states, "states")
    names = ["x"] if states.ndim == 1 else [f"x{k}" for k in range(states.shape[1])]
    return _present(seconds(times), columns, dict.fromkeys(names, "1"), SECONDS, partial)
