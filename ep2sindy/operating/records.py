"""Operating points: their parameters, the record taken at each, and the cycle it is on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.numbers import least_squares, zero_to_one
from ep2sindy.data.trajectory import Trajectory, check_agreement, point_label
from ep2sindy.regression.pooled import Basis
from ep2sindy.signals.attractor import Cycle, find_cycle
from ep2sindy.signals.spectrum import Oscillation, relative_amplitude, steps_in
from ep2sindy.signals.trace import MIN_PERIODS

# Two cycles coexist if the relative amplitudes of the records, less a plane over the parameters,
# form two groups. The gap between these must exceed the spread in a group by the factor APART, and
# the logarithm of the amplitude must differ by MIN_STEP; a trend alone makes no branches.
APART, MIN_STEP = 3.0, 0.3

N_ROBUST = 50  # fits of the plane, each weighted by the residuals of the one before

# A group of this many or fewer records has no spread of its own to compare with.
FEW = 4


@dataclass(frozen=True, eq=False)
class OperatingRecord:
    """One operating point, and the record that was taken there.

    trajectory: None if the source says that nothing oscillates. status: as the source says; only
    "oscillating" is checked, other values are taken as given. notes: remarks on problems of the
    data. used: description of the data.
    Raises ValueError for parameters that are not finite, or for a status that is not text.
    """

    parameters: Mapping[str, float]
    trajectory: Trajectory | None
    status: str = Oscillation.OSCILLATING
    notes: Sequence[str] = ()
    used: str = ""

    def __post_init__(self) -> None:
        values = {name: float(value) for name, value in self.parameters.items()}
        object.__setattr__(self, "parameters", values)
        if not values or not np.isfinite(list(values.values())).all():
            raise ValueError(f"operating point {self.label} must have parameters, all finite")
        if not isinstance(self.status, str):
            raise ValueError(
                "status must be text, such as 'oscillating': "
                f"a {type(self.status).__name__} came; OperatingRecord.of(parameters, run) finds "
                "the cycle of a record itself"
            )
        if self.trajectory is None and self.status == Oscillation.OSCILLATING:
            raise ValueError(f"{self.label} oscillates: it needs its trajectory")

    @staticmethod
    def of(parameters: Mapping[str, float], run: Trajectory) -> OperatingRecord:
        """A record that laws can be made of. Raises ValueError for one without a `cycle`."""
        record = OperatingRecord(parameters, run)
        _ = record.cycle
        return record

    @property
    def label(self) -> str:
        return point_label(self.parameters)

    @property
    def run(self) -> Trajectory:
        if self.trajectory is None:
            raise ValueError(f"operating point {self.label} has no record: it is {self.status}")
        return self.trajectory

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
    def relative_amplitude(self) -> float:
        """Standard deviation over mean of the waveform, root mean square over the states."""
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
        return self.run.window(self.slowest, self.run.n_samples)


@contextmanager
def name_point(parameters: Mapping[str, float]) -> Iterator[None]:
    """Put the name of the operating point before errors raised inside."""
    try:
        yield
    except (ValueError, OSError) as error:
        raise ValueError(f"operating point {point_label(parameters)}: {error}") from error


def check_alike(records: Sequence[OperatingRecord], variables: Sequence[str]) -> None:
    """Raise ValueError, naming the point, unless all have the same states, variables and units."""
    known = [record for record in records if record.trajectory is not None]
    for record in known:
        with name_point(record.parameters):
            check_agreement([known[0].run, record.run], variables)


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


def check_records(records: Sequence[OperatingRecord]) -> None:
    """Raise ValueError unless all have the same states, units and parameters, and these vary."""
    if not records:
        raise ValueError("a law needs operating points that oscillate: none came")
    names = list(records[0].parameters)
    for record in records:
        if set(record.parameters) != set(names):
            raise ValueError(
                f"every operating point must have {names}: {dict(record.parameters)} came"
            )
    if len(records) == 1:
        raise ValueError(
            f"a law needs more than one operating point: {records[0].label} came alone; add "
            "points near it"
        )
    check_varying(read_points(records), names)
    check_alike(records, records[0].run.state_names)


def read_points(records: Sequence[OperatingRecord]) -> Float[np.ndarray, "records parameters"]:
    """Parameters of the records, columns in the order of the first record's."""
    names = list(records[0].parameters)
    return np.array([[record.parameters[name] for name in names] for record in records])


def read_point(
    names: Sequence[str], parameters: Mapping[str, float]
) -> Float[np.ndarray, " parameters"]:
    """Values of the parameters of these names at a point; ValueError unless they are finite."""
    if set(parameters) != set(names) or not np.isfinite(list(parameters.values())).all():
        raise ValueError(
            f"an operating point must have one finite value for each of {list(names)}, and no "
            f"other: {dict(parameters)} came"
        )
    return np.array([float(parameters[name]) for name in names])


def most_central(records: Sequence[OperatingRecord]) -> OperatingRecord:
    """The record whose parameters are nearest to the mean of all."""
    values = read_points(records)
    off = (values - values.mean(axis=0)) / zero_to_one(np.ptp(values, axis=0))
    return records[int(np.argmin(np.linalg.norm(off, axis=1)))]


def interpolation_errors(
    records: Sequence[OperatingRecord], basis: Basis
) -> tuple[Float[np.ndarray, " records"], Float[np.ndarray, " records"]]:
    """Leave-one-out errors of interpolating frequency and amplitude by functions of the parameters.

    Both are interpolated directly, in logarithms.
    Returns the relative error of the frequency, and the largest relative error of the standard
    deviation over the states. They show how smoothly the records vary: no law of these functions
    can be much better.
    """
    f = np.log([[record.cycle.frequency_Hz] for record in records])
    logs = np.hstack([f, np.log([record.cycle.std for record in records])])
    off = np.abs(np.expm1(basis.predict_left_out(logs) - logs))
    return off[:, 0], off[:, 1:].max(axis=1)


def branches_of(records: Sequence[OperatingRecord]) -> Int[np.ndarray, " records"]:
    """Cycle of each record: 0 on the stronger (or only) cycle, 1 on the weaker.

    The logarithm of the relative amplitude is fitted robustly by a plane over the parameters, and
    its residuals are sorted. Two cycles coexist if the residuals show a gap that is wide compared
    with the spread on either side of it.
    """
    amplitude = np.log([record.relative_amplitude for record in records])
    left = _off_plane(read_points(records), amplitude)
    order = np.argsort(left)
    gaps = np.diff(left[order])
    nothing = np.zeros(len(records), dtype=np.int64)
    if len(records) < FEW or not gaps.size:
        return nothing
    k = int(np.argmax(gaps))
    weak, strong = order[: k + 1], order[k + 1 :]
    inner = [np.ptp(left[group]) / len(group) for group in (weak, strong) if len(group) > FEW]
    spread = max(inner, default=np.inf)
    if not (gaps[k] > MIN_STEP and gaps[k] > APART * spread):
        return nothing
    found = nothing.copy()
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
