"""Frequency and amplitude between operating points, interpolated from their records alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float
from scipy.special import stdtrit

from ep2sindy.data.trajectory import point_label
from ep2sindy.library.library import Library
from ep2sindy.operating.law import in_hull, make_basis, outside
from ep2sindy.operating.records import OperatingRecord, read_points, values_at
from ep2sindy.regression.pooled import Basis
from ep2sindy.runtime.values import read_only


@dataclass(frozen=True)
class InterpolatedCycle:
    """Frequency in Hz and standard deviation of each state at an operating point.

    Each comes with the half-width of its 95 % interval.
    """

    frequency_Hz: tuple[float, float]
    amplitude: Mapping[str, tuple[float, float]]


@dataclass(frozen=True, eq=False)
class Interpolation:
    """Frequency and amplitude as functions of the operating point, without a model.

    The functions are fitted by least squares to the frequency of the records, and to the standard
    deviation of each state. Half-widths follow from the errors at points left out one at a time,
    y_p - y_(without p), of those that the others enclose, if there are any: Student's quantile,
    with a degree of freedom for every point beyond the number of functions, times their root mean
    square. Assumes errors of one size at all points.

    functions: of the parameters. points: of the records, with columns in the order of the
    functions' variables. cycles: for each point, the frequency in Hz, then the standard deviations.
    Raises ValueError if the points do not suffice for leaving each out.
    Source: Allen 1974, doi:10.1080/00401706.1974.10489157, for the errors.
    """

    functions: Library
    points: Float[np.ndarray, "points parameters"]
    states: tuple[str, ...]
    cycles: Float[np.ndarray, "points 1+n_states"]

    def __post_init__(self) -> None:
        object.__setattr__(self, "points", read_only(self.points))
        object.__setattr__(self, "cycles", read_only(self.cycles))
        assert self.cycles.shape == (len(self.points), 1 + len(self.states))
        _ = self._basis  # the points must suffice

    @staticmethod
    def of(
        functions: Library, records: Sequence[OperatingRecord], states: Sequence[str]
    ) -> Interpolation:
        """Of some states between records. Raises ValueError for a record without a cycle."""
        columns = [records[0].run.state_names.index(state) for state in states]
        points = values_at([record.parameters for record in records], functions.variables)
        cycles = np.array([(r.cycle.frequency_Hz, *r.cycle.std[columns]) for r in records])
        return Interpolation(functions, points, tuple(states), cycles)

    @staticmethod
    def best(
        several: Sequence[Library], records: Sequence[OperatingRecord], states: Sequence[str]
    ) -> Interpolation | None:
        """That of the functions by which points left out are missed least, in the mean.

        None if a record has no cycle, or if there are too few points for any.
        """
        found = []
        for functions in several:
            with suppress(ValueError):
                found.append(Interpolation.of(functions, records, states))
        return min(found, key=lambda each: float(each.errors.mean()), default=None)

    @cached_property
    def _basis(self) -> Basis:
        return make_basis(self.functions, self.points, n_spare=1)

    @cached_property
    def _left_out(self) -> Float[np.ndarray, "points 1+n_states"]:
        return self._basis.predict_left_out(self.cycles)

    @property
    def errors(self) -> Float[np.ndarray, "points 2"]:
        """Relative errors at every point left out: of the frequency, and of the worst amplitude."""
        off = np.abs(self._left_out / self.cycles - 1.0)
        return np.column_stack([off[:, 0], off[:, 1:].max(axis=1)])

    def at(self, **parameters: float) -> InterpolatedCycle:
        """The cycle at an operating point that the records enclose.

        Raises ValueError for parameters that are missing or unknown, values that are not finite, or
        a point outside the convex hull of the records.
        """
        names = self.functions.variables
        (values,) = read_points([parameters], names)
        if not in_hull(self.points, values):
            remedy = "record a point beyond it"
            raise outside(point_label(parameters), names, self.points, "interpolation", remedy)
        basis = self._basis
        weights = self.functions.evaluate(values[None])[0] @ basis.to_law(np.ones(1))
        middle = weights @ basis.orthonormal.T @ self.cycles
        quantile = stdtrit(len(self.points) - len(self.functions), 0.975)
        off = self._left_out - self.cycles
        inside = [in_hull(np.delete(self.points, k, axis=0), p) for k, p in enumerate(self.points)]
        off = off[inside] if any(inside) else off
        reach = quantile * np.sqrt(np.square(off).mean(axis=0))
        frequency, *amplitudes = zip(middle.tolist(), reach.tolist(), strict=True)
        return InterpolatedCycle(frequency, dict(zip(self.states, amplitudes, strict=True)))
