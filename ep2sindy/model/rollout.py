"""Integration of models in time, along data or freely; right-hand sides of the terms in use."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from ep2sindy.data.numbers import band_of, zero_to_one
from ep2sindy.data.trajectory import Trajectory, as_dataframe, as_dataset, check_time
from ep2sindy.library.units import SECONDS, Clock
from ep2sindy.model.inputs import Curve, driven
from ep2sindy.model.solve import Border, Driven, Edge, Integration, edges_of, solve_stages
from ep2sindy.model.vector_field import Equations, VectorField
from ep2sindy.runtime.screen import one_screen, text_table

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

# A start that is less than this fraction of what the first rates add tells no size of the state.
NEGLIGIBLE = 1e-12


@dataclass(frozen=True, eq=False)
class Rollout:
    """Result of integrating a model along data or freely.

    t: (samples,) in s, states: (samples, n_states), inputs: (samples, n_inputs), all cut where
    a diverged run stopped. units: by name, of states and inputs. clock: display format of t.
    outside: the function of the model whose domain the run has left, or an empty text; such a
    run counts as diverged. draws: (draws, samples, n_states), runs with coefficients drawn from
    their covariance, NaN where one has diverged; None unless they were asked for.
    """

    t: Float[np.ndarray, " samples"]
    states: Float[np.ndarray, "samples n_states"]
    diverged: bool
    message: str
    state_names: tuple[str, ...]
    inputs: Float[np.ndarray, "samples n_inputs"]
    input_names: tuple[str, ...]
    units: Mapping[str, str]
    outside: str = ""
    clock: Clock = SECONDS
    draws: Float[np.ndarray, "draws samples n_states"] | None = field(default=None, repr=False)

    def band(
        self, level: float = 0.9
    ) -> tuple[Float[np.ndarray, "samples n_states"], Float[np.ndarray, "samples n_states"]]:
        """Lower and upper bound between which this fraction of the draws lies at each time.

        Raises ValueError for a run without draws, or a level that is no fraction.
        """
        if self.draws is None:
            raise ValueError("a band needs draws: ask for them, simulate(..., draws=100)")
        low, high = band_of(self.draws, level)
        return low, high

    @property
    def lasted_s(self) -> float:
        return float(self.t[-1] - self.t[0]) if len(self.t) else 0.0

    @property
    def lasted_text(self) -> str:
        """Duration of the run, such as `182 µs`; empty if nothing was integrated."""
        return self.clock.duration_text(self.lasted_s) if self.lasted_s else ""

    def to_dataframe(self) -> pd.DataFrame:
        """States, then inputs, as columns in SI over an index `time` in s."""
        return as_dataframe(self.t, self._values, [*self.state_names, *self.input_names])

    def to_xarray(self) -> xr.Dataset:
        """States and inputs over the coordinate `time` in s, with their units and clock."""
        names = [*self.state_names, *self.input_names]
        return as_dataset(self.t, self._values, names, self.units, self.clock)

    @property
    def _values(self) -> Float[np.ndarray, "samples variables"]:
        return np.concatenate([self.states, self.inputs], axis=1)

    def __repr__(self) -> str:
        end = f"stopped: {self.message}" if self.diverged else "ran to the end"
        head = f"Rollout: {len(self.t)} samples over {self.lasted_text or 'no time'}, {end}" + (
            "" if self.draws is None else f"; {len(self.draws)} draws"
        )
        ranges = [
            [name, self.units.get(name, "1"), f"{column.min():.4g}", f"{column.max():.4g}"]
            for name, column in zip(self.state_names, self.states.T, strict=True)
            if len(column)
        ]
        return one_screen([head, *text_table(["state", "unit", "from", "to"], ranges)])

    def trajectory(self, *, label: str = "") -> Trajectory:
        """The samples of the run as a Trajectory, up to where it ended.

        Raises ValueError for fewer than two samples, or a state that never changed.
        """
        return Trajectory(
            t=self.t,
            states=self.states,
            state_names=self.state_names,
            inputs=self.inputs,
            input_names=self.input_names,
            units=self.units,
            label=label,
            clock=self.clock,
        )


def simulate(
    model: Equations,
    t: ArrayLike,
    x0: ArrayLike | Mapping[str, float],
    inputs: ArrayLike | Mapping[str, Any] | None,
    *,
    blow_up: float,
    rtol: float = 1e-8,
    limit_s: float = 300.0,
    reach: Float[np.ndarray, " n_states"] | None = None,
    bound: str = "the largest expected",
) -> Rollout:
    """Integrate a model freely from one state; see `SparseModel.simulate`.

    reach: (n_states,), largest states expected, in SI, that scale the run in place of its start;
    a start where a state passes through zero tells nothing of its size. bound: what they are, in
    words.
    """
    times = np.asarray(t, dtype=np.float64)
    start = check_start(model.states, x0, hint="; the order is simulate(t, x0)")
    check_time(times)
    drive, samples = driven(model.inputs, inputs, times, model.courses)
    if reach is None:
        # An input may begin at zero as well: its largest sample tells what it does to a state.
        driving = np.take_along_axis(samples, np.abs(samples).argmax(axis=0, keepdims=True), axis=0)
        reach = start_scale(model, start, driving[0], float(times[-1] - times[0]))
        bound = "its start"
    scale = zero_to_one(reach)
    y, border = start / scale, _border(model.field, np.append(start, samples[0]), drive, scale)
    if border and (edge := border(times[0], y)):
        message = f"the start, at t = {times[0]:.6g} s, is outside {edge.text}"
        found = Integration(times[:1], y[None], -1, message, edge)
    else:
        found = solve_stages(
            Driven(model.field.scaled(scale), drive),
            times,
            y,
            border=border,
            stops=drive.stops,
            blow_up=blow_up,
            bound=bound,
            rtol=rtol,
            limit_s=limit_s,
        )
    return Rollout(
        t=found.t,
        states=found.y * scale,
        diverged=found.ended_early,
        message=found.message,
        state_names=tuple(model.states),
        inputs=samples[: len(found.t)],
        input_names=tuple(model.inputs),
        units=model.units,
        outside=found.edge.function.name if found.edge else "",
    )


def start_scale(
    model: Equations,
    start: Float[np.ndarray, " n_states"],
    inputs: Float[np.ndarray, " n_inputs"],
    duration_s: float,
) -> Float[np.ndarray, " n_states"]:
    """Sizes of the states of a run that starts here, in SI: those of the start, where it has any.

    A state that starts at zero has the size that its rate gives it within the duration or, if that
    is shorter, the fastest time scale of the start. If its rate is zero as well, the rate follows
    from what the other states have become by then. The size is one for a state that stays at zero.
    """
    n = len(start)
    values = np.append(start, inputs)
    size = np.abs(start)
    with np.errstate(all="ignore"):  # of functions outside their domain, and of rates that overflow
        jacobian = model.field.jacobian(values)
        finite = bool(np.isfinite(jacobian).all())
        fastest = np.abs(np.linalg.eigvals(jacobian)).max() if finite else 0.0
        for _ in range(n):  # the longest chain of states of which each sets off the next
            moved = model.field.rates(values) / max(fastest, 1.0 / duration_s)
            small = (np.abs(start) <= NEGLIGIBLE * np.abs(moved)) & np.isfinite(moved)
            size = np.where(small, np.maximum(size, np.abs(moved)), size)
            values[:n] = np.where(small, moved, start)
    return zero_to_one(size)


def check_start(
    states: Sequence[str], x0: ArrayLike | Mapping[str, float], *, name: str = "x0", hint: str = ""
) -> Float[np.ndarray, " n_states"]:
    """Return x0, which may be a mapping, as an array; name: by which an error calls it.

    Raises ValueError unless it has a finite number for each state.
    """
    if isinstance(x0, Mapping):
        if set(x0) != set(states):
            raise ValueError(f"x0 must give a number for each of {list(states)}, got {dict(x0)}")
        x0 = [x0[state] for state in states]
    start = np.asarray(x0, dtype=np.float64)
    if start.shape != (len(states),) or not np.isfinite(start).all():
        got = f"shape {start.shape}" if start.size > 8 else f"{start.tolist()}"
        raise ValueError(
            f"{name} must give a finite number for each of {list(states)}, got {got}{hint}"
        )
    return start


def _border(
    field: VectorField, start: np.ndarray, drive: Curve, scale: np.ndarray
) -> Border | None:
    """Border of the domain of the functions that the equations use; None without an edge."""
    edges = edges_of(field.library.functions, field.library.variables, start)

    def first_beyond(t: float, y: np.ndarray) -> Edge | None:
        values = np.append(y * scale, drive(t))
        return next((edge for edge in edges if edge.margin(values) <= 0.0), None)

    return first_beyond if edges else None
