"""A law over a map of operating points: cycles, fixed points, and the limits of oscillation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.model.comparison import Status
from ep2sindy.model.fixed_point import rest_point
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import simulate
from ep2sindy.model.stability import limit_cycle
from ep2sindy.operating.law import OperatingLaw, read_law
from ep2sindy.operating.records import OperatingRecord, Point, values_at
from ep2sindy.signals.spectrum import SIMULATED, relative_amplitude

# Least decay rate per period of a fixed point at which a diverging run counts as resting: e-fold in
# a hundred periods.
NEUTRAL = 0.01

# A smaller spread is no cycle (the simulator's "steady"): a fraction of the mean, or of the
# record's standard deviation if that is larger, as of a state that swings around zero.
STILL = SIMULATED.spread

N_PERIODS = 40  # length of a run, in which it may settle


MAX_PARAMETERS = 2  # most parameters of a map that can be drawn


@dataclass(frozen=True, eq=False)
class MapPoint:
    """A law's model at one operating point.

    inside: True in the hull of the records. status: of a run that starts near the cycle of the
    nearest record: sustained, decays to a fixed point, or diverges.
    frequency_Hz, relative_amplitude: of its cycle (standard deviation over mean, root mean square
    over the states that do not swing around zero); NaN without a cycle.
    growth_per_s: largest real part of the fixed point's eigenvalues, in 1/s, positive if it is
    unstable; NaN if there is no fixed point near. second: modulus of the second Floquet multiplier;
    NaN without a cycle.
    """

    parameters: Point
    inside: bool
    status: Status
    frequency_Hz: float
    relative_amplitude: float
    growth_per_s: float
    second: float

    @property
    def row(self) -> dict[str, object]:
        """The point as a row of a table, its frequency in kHz."""
        return {
            **self.parameters,
            "inside": self.inside,
            "status": str(self.status),
            "f_kHz": 1e-3 * self.frequency_Hz,
            "relative_amplitude": self.relative_amplitude,
            "growth_per_s": self.growth_per_s,
            "second_multiplier": self.second,
        }


def map_points(points: Sequence[Point], n: int) -> list[dict[str, float]]:
    """A grid over the ranges of the points, the last parameter varying fastest."""
    names = list(points[0])
    if len(names) > MAX_PARAMETERS:
        return []
    values = values_at(points, names)
    axes = np.linspace(values.min(axis=0), values.max(axis=0), n).T.tolist()
    return [dict(zip(names, each, strict=True)) for each in product(*axes)]


def law_map(
    law: OperatingLaw, records: Sequence[OperatingRecord], points: Sequence[Point]
) -> list[MapPoint]:
    """The law's models at given operating points, each started from the nearest record."""
    known = values_at([record.parameters for record in records], law.parameters)
    off = (values_at(points, law.parameters)[:, None] - known) / zero_to_one(np.ptp(known, axis=0))
    nearest = np.linalg.norm(off, axis=-1).argmin(axis=1)
    return [_map_point(law, records[k], at) for k, at in zip(nearest, points, strict=True)]


def _map_point(law: OperatingLaw, record: OperatingRecord, point: Point) -> MapPoint:
    model, period_s = read_law(law, point), 1.0 / record.cycle.frequency_Hz
    status, late = _run(model, record)
    mean, (frequency_Hz, amplitude, second) = record.cycle.mean, (np.nan, np.nan, np.nan)
    if status is Status.SUSTAINED:
        cycle = limit_cycle(model, late, period_s=period_s)
        if cycle is None:
            status = Status.DECAYS
        elif cycle.stability == "repelling":
            status = Status.DIVERGES
        else:
            mean = cycle.states.mean(axis=0)
            if _moves(cycle.states, record):
                amplitude = relative_amplitude(mean, cycle.states.std(axis=0))
                frequency_Hz, second = 1.0 / cycle.period_s, cycle.largest_multiplier
            else:
                status = Status.DECAYS
    elif status is Status.DECAYS:
        mean = late
    rest = rest_point(model, mean, record.cycle.std, record.run.states.min(axis=0) > 0.0)
    growth = np.nan if rest is None else rest.growth_per_s
    if status is Status.DIVERGES and growth * period_s < -NEUTRAL:
        # The fixed point is stable, but the record's cycle lies outside its basin: the model rests.
        status = Status.DECAYS
    return MapPoint(
        parameters=dict(point),
        inside=law.is_inside(point),
        status=status,
        frequency_Hz=float(frequency_Hz),
        relative_amplitude=float(amplitude),
        growth_per_s=growth,
        second=second,
    )


def _run(
    model: SparseModel, record: OperatingRecord
) -> tuple[Status, Float[np.ndarray, " n_states"]]:
    """Status of a run from the record's slowest sample, and its final state."""
    start, n, reach = record.run.states[record.slowest], 50, np.abs(record.run.states).max(axis=0)
    t = np.linspace(0.0, N_PERIODS / record.cycle.frequency_Hz, N_PERIODS * n + 1)
    run = simulate(model, t, start, None, blow_up=1e3, rtol=1e-7, reach=reach)
    if run.diverged or not np.isfinite(run.states).all():
        return Status.DIVERGES, start
    moves = _moves(run.states[-5 * n :], record)
    return (Status.SUSTAINED if moves else Status.DECAYS), run.states[-1]


def _moves(states: Float[np.ndarray, "samples n_states"], record: OperatingRecord) -> bool:
    size = np.maximum(np.abs(states.mean(axis=0)), zero_to_one(record.cycle.std))
    return float(np.square(states.std(axis=0) / size).mean()) >= STILL**2
