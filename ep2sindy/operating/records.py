"""Runs at their operating points: how they are grouped and checked, and the cycle each repeats."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.numbers import least_squares, zero_to_one
from ep2sindy.data.trajectory import Trajectory, check_agreement, point_label
from ep2sindy.signals.attractor import Cycle, find_cycle
from ep2sindy.signals.signal import MIN_PERIODS
from ep2sindy.signals.spectrum import relative_amplitude, steps_in

Point = Mapping[str, float]  # parameter -> value

# Two cycles coexist if the logarithms of the records' amplitudes, less a plane over the parameters,
# form two groups. The gap between these must exceed the spread in a group by the factor APART, and
# the logarithm of the amplitude must differ by MIN_STEP; a trend alone makes no branches.
APART, MIN_STEP = 3.0, 0.3

N_ROBUST = 50  # fits of the plane, each weighted by the residuals of the one before

# A group of this many or fewer records has no spread of its own to compare with.
FEW = 4


@dataclass(frozen=True, eq=False)
class OperatingRecord:
    """A run at an operating point (`run.parameters`), and the cycle that it repeats.

    Raises ValueError for a run without parameters.
    """

    run: Trajectory

    def __post_init__(self) -> None:
        if not self.run.parameters:
            raise ValueError(
                f"a record needs its operating point: {self.run.label or 'a run'} has no "
                "parameters; make it with Trajectory(..., parameters={'V_D_V': 300.0})"
            )

    @property
    def parameters(self) -> Point:
        return self.run.parameters

    @property
    def label(self) -> str:
        return point_label(self.parameters)

    @cached_property
    def cycle(self) -> Cycle:
        """The cycle that the record repeats.

        Raises ValueError, naming the point, for a record without a period or with fewer than six.
        """
        cycle = find_cycle(self.run.t, self.run.states)
        where = f"operating point {self.label}"
        if cycle is None:
            raise ValueError(
                f"{where}: its record has no period to learn from; leave the point out, or record "
                "it for longer"
            )
        if cycle.n_periods < MIN_PERIODS:
            raise ValueError(
                f"{where}: its record holds {cycle.n_periods:.1f} periods of the {MIN_PERIODS:g} "
                "that are needed; record it for longer"
            )
        return cycle

    @property
    def repeats(self) -> bool:
        """Whether the record holds enough periods of a cycle."""
        try:
            return self.cycle is not None
        except ValueError:
            return False

    @property
    def relative_amplitude(self) -> float:
        """Standard deviation over mean of the waveform: see `spectrum.relative_amplitude`."""
        return relative_amplitude(self.cycle.mean, self.cycle.std)

    @property
    def slowest(self) -> int:
        """Index of the slowest sample of the first two periods, states in standard deviations.

        A free run starts here: during the pulse a small error of the model is a large one in phase.
        """
        n = round(steps_in(2.0, frequency_Hz=self.cycle.frequency_Hz, dt_s=self.run.dt_s))
        x = self.run.states[: max(n, 3)] / zero_to_one(self.cycle.std)
        return int(np.argmin(np.linalg.norm(np.gradient(x, axis=0), axis=1)))

    @property
    def from_slowest(self) -> Trajectory:
        """The record from its slowest sample on. Raises ValueError if it repeats no cycle."""
        return self.run.window(self.slowest, self.run.n_samples)


@contextmanager
def name_point(parameters: Point) -> Iterator[None]:
    """Put the name of the operating point before errors raised inside."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise ValueError(f"operating point {point_label(parameters)}: {error}") from error


def group_by_point(
    runs: Sequence[Trajectory], variables: Sequence[str]
) -> dict[str, list[Trajectory]]:
    """The runs of every operating point, by its label; runs of one point need not be neighbours.

    Raises ValueError, naming the point, for runs whose parameters have other names, or whose
    states, variables or units differ.
    """
    points: dict[str, list[Trajectory]] = {}
    for run in runs:
        first = runs[0]
        if set(run.parameters) != set(first.parameters):
            raise ValueError(
                "runs of several operating points need the same parameters, got "
                f"{list(first.parameters)}, and {list(run.parameters)} in "
                f"{run.label or 'another run'}; name them alike in all, or give runs of one point"
            )
        with name_point(run.parameters):
            check_agreement([first, run], variables)
        in_order = {name: run.parameters[name] for name in first.parameters}
        points.setdefault(point_label(in_order), []).append(run)
    return points


def check_varying(
    points: Float[np.ndarray, "points parameters"],
    parameters: Sequence[str],
    *,
    remedy: str = "leave it out, or add points",
) -> None:
    """Raise ValueError for a parameter that is the same at all points: no law can depend on it.

    remedy: advice for the error message, with `{name}` for the parameter's name.
    """
    for name, column in zip(parameters, points.T, strict=True):
        if np.ptp(column) == 0.0:
            raise ValueError(
                f"a parameter must vary: {name!r} is {column[0]:g} at all {len(points)} operating "
                f"points; {remedy.format(name=name)}"
            )


def read_points(
    points: Sequence[Point], names: Sequence[str]
) -> Float[np.ndarray, "points parameters"]:
    """Values of the parameters at every point, a column for each name.

    Raises ValueError for a point that lacks one, has another, or has a value that is not finite.
    """
    for point in points:
        if set(point) != set(names) or not np.isfinite(list(point.values())).all():
            raise ValueError(
                f"an operating point must have one finite value for each of {list(names)}, and no "
                f"other, got {dict(point)}"
            )
    return np.array([[float(point[name]) for name in names] for point in points])


def values_at(
    points: Sequence[Point], names: Sequence[str]
) -> Float[np.ndarray, "points parameters"]:
    """Values of some parameters of points that may have more, a column for each name."""
    return read_points([{name: point[name] for name in names} for point in points], names)


def values_of(points: Mapping[str, Sequence[Trajectory]]) -> Float[np.ndarray, "points parameters"]:
    """Parameters of all points. Raises ValueError for runs without parameters."""
    first = [runs[0].parameters for runs in points.values()]
    if not first[0]:
        raise ValueError(
            "a law or a shared support needs runs of several operating points, which carry their "
            "parameters: Trajectory(..., parameters={'V_D_V': 300.0}), or ep.read_runs("
            "'runs/V{V_D_V}.csv'), got runs without parameters"
        )
    return read_points(first, list(first[0]))


def most_central(points: Float[np.ndarray, "points parameters"]) -> int:
    """Index of the point that is nearest to the mean of all."""
    off = (points - points.mean(axis=0)) / zero_to_one(np.ptp(points, axis=0))
    return int(np.argmin(np.linalg.norm(off, axis=1)))


def branches_of(records: Sequence[OperatingRecord]) -> Int[np.ndarray, " records"]:
    """Cycle of each record: 0 on the stronger (or only) cycle, 1 on the weaker.

    Parameters
    ----------
    records : sequence of OperatingRecord
        Records of several operating points.

    Returns
    -------
    (records,) int array
        The number of the cycle of each record.

    Notes
    -----
    The logarithm of the standard deviation, in the mean over the states, is fitted robustly by a
    plane over the parameters, and its residuals are sorted. Two cycles coexist if the residuals
    show a gap that is wide compared with the spread on either side of it.
    """
    amplitude = np.array([np.log(record.cycle.std).mean() for record in records])
    values = read_points([r.parameters for r in records], list(records[0].parameters))
    left = _off_plane(values, amplitude)
    order = np.argsort(left)
    gaps = np.diff(left[order])
    found = np.zeros(len(records), dtype=np.int64)
    if len(records) < FEW:
        return found
    k = int(np.argmax(gaps))
    weak, strong = order[: k + 1], order[k + 1 :]
    inner = [np.ptp(left[group]) / len(group) for group in (weak, strong) if len(group) > FEW]
    spread = max(inner, default=np.inf)
    if gaps[k] > MIN_STEP and gaps[k] > APART * spread:
        found[weak] = 1
    return found


def _off_plane(
    values: Float[np.ndarray, "points parameters"], target: Float[np.ndarray, " points"]
) -> Float[np.ndarray, " points"]:
    """Residuals of a plane of least absolute deviations; of a constant if the points are few."""
    centred = (values - values.mean(axis=0)) / zero_to_one(np.ptp(values, axis=0))
    columns = np.column_stack([np.ones(len(values)), centred])
    if len(values) < 2 * columns.shape[1]:
        columns = columns[:, :1]
    weights = np.ones(len(values))
    left = target
    for _ in range(N_ROBUST):
        coef = least_squares(columns * weights[:, None], target * weights)
        left = target - columns @ coef
        weights = 1.0 / np.sqrt(np.maximum(np.abs(left), 1e-6))
    return left
