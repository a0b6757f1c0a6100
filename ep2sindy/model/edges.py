"""Where a run leaves the domain of its model's functions, such as log(x) at x = 0."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from ep2sindy.library.functions import Function, Interval


@dataclass(frozen=True)
class Edge:
    """A function, the place of its variable among values, and the interval its argument is in.

    interval: None where the start is in none.
    """

    function: Function
    place: int
    interval: Interval | None

    def margin(self, values: Float[np.ndarray, " known"]) -> float:
        """How far the argument is inside; zero or less where it has left."""
        argument = self.function.scale * values[self.place] + self.function.shift
        low, high = self.interval or (np.inf, -np.inf)
        return float(min(argument - low, high - argument))

    @property
    def text(self) -> str:
        return f"the domain of {self.function.name}, which needs {self.function.need}"


def edges_of(
    functions: Sequence[Function], known: Sequence[str], start: Float[np.ndarray, " known"]
) -> tuple[Edge, ...]:
    """Where functions end, on either side of where a run starts; sin(x) has no end."""
    edges = []
    for function in functions:
        place = list(known).index(function.variable)
        interval = function.interval(float(start[place]))
        if interval is None or np.isfinite(interval).any():
            edges.append(Edge(function, place, interval))
    return tuple(edges)


@dataclass(frozen=True)
class Border:
    """All edges of a model along one run: an event for a solver, which ends there.

    values: time in s and scaled states -> states and inputs in SI.
    """

    edges: tuple[Edge, ...]
    values: Callable[[float, np.ndarray], np.ndarray]
    terminal: bool = True

    def __call__(self, t: float, y: np.ndarray) -> float:
        at = self.values(t, y)
        return min(edge.margin(at) for edge in self.edges)

    def nearest(self, t: float, y: np.ndarray) -> Edge:
        at = self.values(t, y)
        return min(self.edges, key=lambda edge: edge.margin(at))

    def beyond(self, t: float, y: np.ndarray) -> Edge | None:
        """An edge that a state lies beyond, if any."""
        if not self.edges:
            return None
        at = self.values(t, y)
        return next((edge for edge in self.edges if edge.margin(at) <= 0.0), None)
