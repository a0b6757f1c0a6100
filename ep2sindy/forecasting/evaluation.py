"""How a model does on a record: its free run, cycle, rest points, forecasts and lack of fit."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from html import escape
from textwrap import wrap
from types import MappingProxyType
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.baselines import check_fitted
from ep2sindy.forecasting.skill import ForecastSkill, forecast_skill
from ep2sindy.model.comparison import ComparedRecord, FreeRunBounds, Status, columns_of, record_of
from ep2sindy.model.fixed_point import RestPoint, rest_point
from ep2sindy.model.model import SparseModel
from ep2sindy.model.rollout import Rollout
from ep2sindy.model.stability import (
    LEAST_WAIT,
    LimitCycle,
    basin_stability,
    limit_cycle,
    periods_to_reach,
)
from ep2sindy.runtime.screen import WIDTH, html_table, one_screen, text_table
from ep2sindy.runtime.values import check_kind
from ep2sindy.signals.attractor import follow_phase
from ep2sindy.signals.spectrum import DECAYED, dominant_frequency

N_REST = 16  # samples of a record from which rest points are looked for
IN_PHASE = 0.25  # periods, by which a run that is in phase may be ahead or behind
NEUTRAL = 1e-6  # growth per turn of a perturbation from a rest point that neither grows nor decays
# Distance of two rest points, in standard deviations: Newton's method ends short of multiple roots.
APART = 1e-2
STD, WIDEST = " standard deviations", len("amplitude ratio  ")
LEFT = 100.0  # times a record's size, from which a run's is not reported
N_SHOWN = 4  # most states, and most rest points, that the table shows one by one


@runtime_checkable
class HoldsModel(Protocol):
    """A result that holds a model and why it does not explain its data, such as a Discovery."""

    @property
    def model(self) -> SparseModel: ...
    @property
    def lack_of_fit(self) -> str: ...


@dataclass(frozen=True, eq=False, repr=False)
class Evaluation:
    """How a model does on a record: integrated from one sample, driven by its inputs if it has any.

    Only the second halves are compared, after transients. If the record does not repeat one
    waveform, or has fewer than eight periods, all of it is compared. Cycle, rest points and
    forecasts are computed when they are first asked for.

    Parameters
    ----------
    model : SparseModel
        The equations.
    record : Trajectory
        The samples over which the model was integrated.
    rollout : Rollout
        The run of the model.
    compared : ComparedRecord
        The part of the record that is compared.
    status : Status
        How the run goes.
    is_similar : bool
        Whether the run is like the record: sustained, or, without a cycle to compare, with its
        envelope, or with its means and amplitudes.
    f_error : float
        Relative error of the frequency. NaN for a run that diverged, or if the record or the run
        has no period.
    amplitude_ratio : mapping of str to float
        Standard deviation of each state relative to the record's. NaN for a run that diverged.
    waveform_error : mapping of str to float
        Difference of the waveforms of each state, in standard deviations. NaN for a run that
        diverged, or if the record or the run has no period.
    lack_of_fit : str, default ''
        Why the model does not explain the data it was found from. Empty if it does, or if that is
        not known.
    forecasts : callable, optional
        Makes `forecast`. None without held-out samples.
    """

    model: SparseModel
    record: Trajectory
    rollout: Rollout
    compared: ComparedRecord
    status: Status
    is_similar: bool
    f_error: float
    amplitude_ratio: Mapping[str, float]
    waveform_error: Mapping[str, float]
    lack_of_fit: str = ""
    forecasts: Callable[[], ForecastSkill] | None = field(default=None, repr=False)

    @property
    def text(self) -> str:
        """The status, and after which time a run diverged or left a domain."""
        if self.status is Status.NO_CYCLE:
            are = "are" if self.is_similar else "are not"
            return f"{self.status}; its means and amplitudes {are} the record's"
        of = f" of {self.rollout.outside}" if self.rollout.outside else ""
        lasted = self.rollout.lasted_text if self.rollout.diverged else ""
        return f"{self.status}{of} after {lasted}" if lasted else str(self.status)

    @property
    def rank(self) -> tuple[bool, int]:
        """Sorts the best first: by whether the run is like the record, then by the status."""
        return not self.is_similar, list(Status).index(self.status)

    @cached_property
    def excursion(self) -> float:
        """Largest distance from the data's mean, in standard deviations."""
        return self.compared.excursion(self.rollout.states)

    @cached_property
    def frequency_Hz(self) -> Mapping[str, float]:
        """By state; NaN if the run diverged or the state decayed."""
        found = {}
        for k, column in enumerate(self.rollout.states.T):
            alive = column[len(column) // 2 :].std() > DECAYED * self.compared.std[k]
            steady = alive and not self.rollout.diverged
            frequency_Hz = dominant_frequency(self.rollout.t, column) if steady else float("nan")
            found[self.model.states[k]] = frequency_Hz
        return MappingProxyType(found)

    @cached_property
    def nrmse(self) -> float:
        """Root mean square error over all samples, in standard deviations; NaN if it diverged."""
        if self.rollout.diverged:
            return float("nan")
        samples = self.compared.states
        off = (self.rollout.states - samples) / zero_to_one(samples.std(axis=0))
        return float(np.sqrt(np.mean(np.square(off))))

    @cached_property
    def _slip(self) -> Float[np.ndarray, " samples"] | None:
        """Phase of the run before the record's, in periods; None without a period or a phase."""
        record, states = self.compared, self.rollout.states
        n = len(states)
        if record.cycle is None or n < 4 or not (states.std(axis=0) > 0.0).all():
            return None
        straight = 2.0 * np.pi * record.cycle.frequency_Hz * (record.t[:n] - record.t[0])
        leader = int(np.argmax(np.abs(record.cycle.harmonics[0]) / record.std))
        theirs, ours = (
            follow_phase(record.t[:n], values[:n, leader], straight)
            for values in (record.states, states)
        )
        slip: np.ndarray = (ours - theirs) / (2.0 * np.pi)
        return slip - np.round(slip[0])

    @property
    def periods(self) -> float:
        """Periods of the data until the model's phase is a quarter off, or those of the record.

        NaN for data without a period.
        """
        record = self.compared
        if record.cycle is None:
            return float("nan")
        if self._slip is None:
            return 0.0
        off = np.flatnonzero(np.abs(self._slip) > IN_PHASE)
        last = off[0] if off.size else len(self._slip) - 1
        return float((record.t[last] - record.t[0]) * record.cycle.frequency_Hz)

    @property
    def phase_end(self) -> float:
        """How far the run is ahead of the record at its end, in periods.

        It is averaged over the last eight periods. NaN if the run diverged, or for data without a
        period.
        """
        if self._slip is None or self.rollout.diverged:
            return float("nan")
        return float(self._slip[-1])

    @property
    def phase_text(self) -> str:
        """For how long it is in phase, and the lag at the end if it still is; empty if unknown."""
        if not np.isfinite(self.periods):
            return ""
        text, ahead = f"in phase for {self.periods:.3g} periods", self.phase_end
        if not abs(ahead) <= IN_PHASE:
            return text
        side = "ahead" if ahead > 0.0 else "behind"
        return f"{text}, {abs(ahead):.2g} of a period {side} at the end"

    @cached_property
    def cycle(self) -> LimitCycle | None:
        """The closed orbit on which the run ends; None if it ends on none, or is driven."""
        if self.model.inputs or self.rollout.diverged or self.status is Status.DECAYS:
            return None
        frequency_Hz = np.nanmax(list(self.frequency_Hz.values()), initial=0.0)
        if not frequency_Hz > 0.0:
            return None
        return limit_cycle(self.model, self.rollout.states[-1], period_s=1.0 / frequency_Hz)

    @property
    def multiplier(self) -> float:
        """Largest modulus of the nontrivial Floquet multipliers; NaN without a cycle."""
        return float("nan") if self.cycle is None else self.cycle.largest_multiplier

    @cached_property
    def basin_stability(self) -> float:
        """Fraction of the starts around the cycle that reach it; NaN without a cycle."""
        return float("nan") if self.cycle is None else basin_stability(self.model, self.cycle)

    @cached_property
    def rest(self) -> RestPoint | None:
        """Where the model rests inside its cycle; None without a cycle, or if it does not."""
        if self.cycle is None:
            return None
        states = self.cycle.states
        scale, positive = states.std(axis=0), states.min(axis=0) > 0.0
        return rest_point(self.model, states.mean(axis=0), scale, positive)

    @cached_property
    def rest_points(self) -> tuple[RestPoint, ...]:
        """Rest points that Newton's method reaches from samples of the record and their mean.

        They lie within its range or one more on either side, for which alone the model was made. Of
        a line of rest points there is one. Empty for a model with inputs. No density is negative.
        """
        if self.model.inputs:
            return ()
        states, std = self.compared.states, self.compared.std
        anywhere, width = np.zeros(len(std), dtype=np.bool_), np.ptp(states, axis=0)
        low, high = states.min(axis=0) - width, states.max(axis=0) + width
        low[list(self.compared.densities)] = 0.0
        starts = (states.mean(axis=0), *states[:: max(1, len(states) // N_REST)])
        found: list[RestPoint] = []
        for near in starts:
            point = rest_point(self.model, near, std, anywhere)
            if point is None or not ((low <= point.state) & (point.state <= high)).all():
                continue
            lines = [p for p in (point, *found) if self._stays(p)]
            if len(lines) == 2 and lines[0] is point:
                continue
            if all(np.abs((point.state - p.state) / std).max() > APART for p in found):
                found.append(point)
        return tuple(found)

    def _stays(self, rest: RestPoint) -> bool:
        """Whether nothing moves next to a rest point, in one direction at least."""
        length_s = float(self.record.t[-1] - self.record.t[0])
        return not rest.frequency_Hz and abs(rest.growth_per_s) * length_s < NEUTRAL

    @cached_property
    def forecast(self) -> ForecastSkill | None:
        """Skill of forecasts of the held-out part; None without it."""
        return None if self.forecasts is None else self.forecasts()

    @property
    def caution(self) -> str:
        """A sentence if the cycle is neutral; else empty."""
        if self.cycle is None or self.cycle.stability != "neutral":
            return ""
        return (
            "the cycle is neutral: it neither attracts nor repels, and every start has a cycle of "
            "its own, so the model does not show what sets the amplitude"
        )

    @property
    def cycle_text(self) -> str:
        """The stability of the cycle, in a sentence; empty without a cycle."""
        if self.cycle is None:
            return ""
        wait = periods_to_reach(self.cycle)
        slowly = f", slowly, over {wait:.0f} periods" if wait > LEAST_WAIT else ""
        text = (
            f"The cycle is {self.cycle.stability}: of a perturbation {self.multiplier:.3g} is left "
            f"after a period (Floquet multiplier); {100.0 * self.basin_stability:.0f} % of starts "
            f"from 0.3 to 3 times the cycle's mean reach it{slowly}."
        )
        return text if self.rest is None else f"{text} It rests at {self._rest_text(self.rest)}."

    @property
    def rest_texts(self) -> list[str]:
        """The rest points near the record, each in a line."""
        return [f"rests at {self._rest_text(rest)}" for rest in self.rest_points[:N_SHOWN]]

    def _rest_text(self, rest: RestPoint) -> str:
        """Where the model rests, and what becomes of a small perturbation."""
        units, clock = self.model.units, self.rollout.clock
        place = ", ".join(
            f"{state} = {value:.3g}{'' if units[state] == '1' else f' {units[state]}'}"
            for state, value in zip(self.model.states, rest.state.tolist(), strict=True)
        )
        kind, change = ("unstable", "grows") if rest.growth_per_s > 0.0 else ("stable", "decays")
        rate = f" at {clock.seconds * abs(rest.growth_per_s):.3g} {clock.rate_unit('1')}"
        if abs(rest.growth_per_s) <= NEUTRAL * rest.frequency_Hz or self._stays(rest):
            kind, change, rate = "neutral", "neither grows nor decays", ""
        turns = (
            f" and oscillates at {clock.frequency_text(rest.frequency_Hz)}"
            if rest.frequency_Hz
            else ""
        )
        return f"{place}, {kind}: a perturbation {change}{rate}{turns}"

    @property
    def rows(self) -> list[tuple[str, str]]:
        """Quantities and their values, as text; computes what has not been asked for."""
        clock = self.rollout.clock
        frequencies = {s: clock.frequency_text(f) for s, f in self.frequency_Hz.items() if f == f}
        error = f" ({100.0 * self.f_error:+.2g} %)" if np.isfinite(self.f_error) else ""
        cycle = self.cycle and (
            f"{self.cycle.stability}, multiplier {self.multiplier:.3g}; "
            f"{100.0 * self.basin_stability:.0f} % of starts reach it"
        )
        found = [
            ("forecasts", "" if self.forecast is None else self.forecast.text),
            ("status", self.text),
            ("frequency", _listed(frequencies) + error),
            ("amplitude ratio", _listed(_sizes(self.amplitude_ratio))),
            ("waveform error", _listed(_texts(self.waveform_error), STD)),
            ("phase", self.phase_text if np.isfinite(self.phase_end) else ""),
            ("cycle", cycle or ""),
            *(("rests at", self._rest_text(rest)) for rest in self.rest_points[:N_SHOWN]),
            ("lack of fit", self.lack_of_fit),
        ]
        return [(name, value) for name, value in found if value]

    def __repr__(self) -> str:
        rows = [
            (name if k == 0 else "", line)
            for name, value in self.rows
            for k, line in enumerate(wrap(value, WIDTH - WIDEST))
        ]
        return one_screen(text_table(["quantity", "value"], rows))

    def _repr_html_(self) -> str:
        return html_table(["quantity", "value"], [(n, escape(value)) for n, value in self.rows])


def evaluate(
    model: SparseModel | HoldsModel,
    run: Run,
    *,
    initial: Float[np.ndarray, " n_states"] | None = None,
    n_samples: int | None = None,
    bounds: FreeRunBounds | None = None,
    assessed: Sequence[str] | None = None,
    n_fitted: int | None = None,
) -> Evaluation:
    """Integrate a model over a record and compare the attractors of both.

    The result states whether the model sustains the record's oscillation, with its frequency,
    amplitudes and waveform, and how stable its cycle is.

    Parameters
    ----------
    model : SparseModel, or Discovery
        The model. The lack of fit of a discovery is reported as well.
    run : run
        A Trajectory, or whatever `discover` takes as one run.
    initial : (n_states,) array, optional
        State to start from, in SI. None takes the data's first sample.
    n_samples : int, optional
        Number of samples of the run that are compared. None takes all.
    bounds : FreeRunBounds, optional
        Largest deviations at which the run counts as sustained.
    assessed : sequence of str, optional
        States that determine the status and the frequency error, such as the measured one. None
        takes all.
    n_fitted : int, optional
        Number of samples at the start that the model was fitted to. It is then integrated over the
        rest, from the last of these, and forecasts of the rest are counted.

    Returns
    -------
    Evaluation
        The status, the deviations, and on demand cycle, rest points and forecasts.

    Raises
    ------
    ValueError
        If an assessed state is not in the model, or there are too few samples.

    Examples
    --------
    >>> run = ep.lotka_volterra().trajectory(noise=0.02, rng=0)
    >>> str(ep.evaluate(ep.lotka_volterra().model, run).status)
    'sustained'
    """
    lack_of_fit, forecasts = "", None
    if isinstance(model, HoldsModel):
        lack_of_fit, model = model.lack_of_fit, model.model
    check_kind("model", model, SparseModel, "found.model")
    whole = part = trajectory_of(run)
    if n_fitted is not None:
        check_fitted(whole, n_fitted)
        part = whole.window(n_fitted - 1, whole.n_samples)
        forecasts = partial(forecast_skill, model, whole, n_fitted=n_fitted)
    n_samples = part.n_samples if n_samples is None else min(n_samples, part.n_samples)
    rollout = model.rollout(part, n_samples=n_samples, initial=initial)
    part, bounds = part.window(0, n_samples), bounds or FreeRunBounds()
    compared = record_of(part, model.states)
    similarity = ours = compared.similarity(rollout.states, bounds)
    if assessed is not None:
        columns = columns_of(model.states, assessed)
        ours = record_of(part, assessed).similarity(rollout.states[:, columns], bounds)
    by_state = {
        name: MappingProxyType(dict(zip(model.states, values.tolist(), strict=True)))
        for name, values in similarity.by_state.items()
    }
    return Evaluation(
        model=model,
        record=part,
        rollout=rollout,
        compared=compared,
        status=Status.LEAVES_DOMAIN if rollout.outside else ours.status,
        is_similar=ours.is_similar,
        f_error=ours.f_error,
        lack_of_fit=lack_of_fit,
        forecasts=forecasts,
        **by_state,
    )


def _texts(values: Mapping[str, float]) -> dict[str, str]:
    return {state: f"{value:.3g}" for state, value in values.items() if np.isfinite(value)}


def _sizes(ratios: Mapping[str, float]) -> dict[str, str]:
    return {state: size_text(ratio) for state, ratio in ratios.items() if np.isfinite(ratio)}


def size_text(ratio: float, form: str = ".3g") -> str:
    """A ratio of sizes; of a run that has left the record's, that it is far over it."""
    return f"{ratio:{form}}" if ratio <= LEFT else f"over {LEFT:.0f}"


def _listed(texts: Mapping[str, str], unit: str = "") -> str:
    """`x 1.01, y 0.99`, of the first states if there are many; empty without any."""
    shown = [f"{state} {text}" for state, text in texts.items()]
    left = len(shown) - N_SHOWN
    return (
        ", ".join(shown[:N_SHOWN]) + (f" and {left} more" if left > 0 else "") + unit * bool(shown)
    )
