"""What is said of a model: how it follows samples, keeps a cycle, and forecasts; the only judge."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from html import escape
from textwrap import wrap
from types import MappingProxyType
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.runs import Runs, trajectories_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.forecasting.baselines import check_fitted
from ep2sindy.forecasting.following import Following
from ep2sindy.forecasting.skill import ForecastSkill, forecast_skill
from ep2sindy.library.terms import variables_of
from ep2sindy.model.comparison import (
    ComparedRecord,
    Comparison,
    FreeRunBounds,
    Status,
    columns_of,
    record_of,
)
from ep2sindy.model.fixed_point import UNDETERMINED, RestPoint, rest_points
from ep2sindy.model.model import SparseModel
from ep2sindy.model.restarts import OneStep, one_step
from ep2sindy.model.rollout import Rollout
from ep2sindy.model.stability import LimitCycle, end_of_long_run, limit_cycle, multiplier_error
from ep2sindy.runtime.screen import WIDTH, html_table, one_screen, text_table
from ep2sindy.runtime.values import check_kind
from ep2sindy.signals.attractor import LEAST_FOR_NOISE, follow_phase
from ep2sindy.signals.spectrum import DECAYED, dominant_frequency

IN_PHASE = 0.25  # periods, by which a run that is in phase may be ahead or behind
STD, WIDEST = " standard deviations", 36  # columns of a table before the model's
COLUMNS = ("quantity", "data", "model")
# Times a record's size, from which and below which a run's is not reported; and of a period, of a
# lag.
LEFT, NOTHING, LEAST_SHOWN = 100.0, 1e-3, 0.01
N_SHOWN = 4  # most states, and most rest points, that the table shows one by one

# How a run ends, whatever drives it.
ENDS = (Status.NEGATIVE, Status.LEAVES_DOMAIN, Status.DIVERGES)
MOST_WORDS = 11  # of a verdict, so that its heading has twelve with a name

# A cycle attracts if its multiplier lies below one by this many standard errors, and if runs of
# this many relaxation times stay on it.
ERRORS, RELAXATIONS = 2.0, 3.0


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

    It is judged in this order. By samples: if a run from a start that is fitted to them stays
    within their noise, it follows them. By the cycle, of a record without inputs that repeats one:
    a run from its first sample has to stay on it, and it has to attract. By forecasts.

    Cycles are compared over second halves, after transients. If the record does not repeat one
    waveform, or has fewer than eight periods, all of it is compared. Whatever takes runs of its own
    is computed when it is first asked for.

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
    comparison : Comparison
        How the run compares with the record's cycle, or with its statistics without one.
    bounds : FreeRunBounds
        Largest deviations at which the run counts as staying on the record's cycle.
    assessed : sequence of int
        Numbers of the states that determine the status.
    lack_of_fit : str, default ''
        Why the model does not explain the data it was found from. Empty if it does, or if that is
        not known.
    forecasts : callable, optional
        Makes `forecast`. None without held-out samples.
    each : sequence of Evaluation, default ()
        Of several records, the evaluation of each; all else is then that of the worst.
    """

    model: SparseModel
    record: Trajectory
    rollout: Rollout
    compared: ComparedRecord
    comparison: Comparison
    bounds: FreeRunBounds
    assessed: Sequence[int]
    lack_of_fit: str = ""
    forecasts: Callable[[], ForecastSkill | None] | None = field(default=None, repr=False)
    each: Sequence[Evaluation] = ()

    @property
    def f_error(self) -> float:
        """Relative error of the frequency; NaN if the run diverged, or without a period."""
        return self.comparison.f_error

    @property
    def amplitude_ratio(self) -> Mapping[str, float]:
        """Standard deviation of each state relative to the record's; NaN if the run diverged."""
        return self._by_state("amplitude_ratio")

    @property
    def waveform_error(self) -> Mapping[str, float]:
        """Difference of the waveforms of each state, in standard deviations; NaN without one."""
        return self._by_state("waveform_error")

    def _by_state(self, name: str) -> Mapping[str, float]:
        values = self.comparison.by_state[name].tolist()
        return MappingProxyType(dict(zip(self.model.states, values, strict=True)))

    @cached_property
    def status(self) -> Status:
        """The verdict by samples and cycle: the first of `Status` that holds."""
        if self.model.coef.any() and self.following.followed_s:
            return Status.FOLLOWS
        compared = self.comparison.status
        if compared is Status.NO_CYCLE or (self.is_driven and compared not in ENDS):
            return Status.DEPARTS
        return self._stability if self.comparison.stays else compared

    @property
    def holds(self) -> bool:
        """Whether the model follows the samples, or sustains their oscillation."""
        return self.status in (Status.FOLLOWS, Status.SUSTAINED)

    @property
    def is_driven(self) -> bool:
        """Whether inputs drive the model, or were among what its terms were chosen from."""
        return bool(self.model.inputs)

    @cached_property
    def _stability(self) -> Status:
        """What becomes of a run that stays on the record's cycle as long as this was recorded."""
        cycle, length_s = self.cycle, float(self.record.t[-1] - self.record.t[0])
        if cycle is None:
            return Status.SUSTAINED if self._stays(RELAXATIONS * length_s) else Status.WRONG_CYCLE
        if cycle.stability != "attracting":
            return Status.NEUTRAL if cycle.stability == "neutral" else Status.REPELLING
        needed_s = RELAXATIONS * cycle.relaxation_s
        surely = 1.0 - self.multiplier > ERRORS * multiplier_error(cycle)
        if (surely and needed_s <= length_s) or self._stays(needed_s):
            return Status.SUSTAINED
        return Status.NOT_TOLD if cycle.relaxation_s > length_s else Status.WRONG_CYCLE

    def _stays(self, duration_s: float) -> bool:
        """Whether another solver, from the record's start, stays on its cycle for so long."""
        data = self.compared.cycle
        assert data is not None
        start, period_s = self.rollout.states[0], 1.0 / data.frequency_Hz
        end = end_of_long_run(self.model, start, duration_s, period_s, self.compared.std)
        if end is None:
            return False
        return replace(self.compared, t=end[0], states=end[1]).similarity(end[1], self.bounds).stays

    @cached_property
    def following(self) -> Following:
        """How near runs stay to the samples, in units of their noise."""
        return Following(self.model, self.record, self.rollout, self.compared, self.assessed)

    @property
    def distance(self) -> Mapping[str, float]:
        """Distance of a run from each state's samples, in units of their noise (`Following`)."""
        values = self.following.distances.tolist()
        return MappingProxyType(dict(zip(self.model.states, values, strict=True)))

    @cached_property
    def one_step(self) -> OneStep | None:
        """Forecasts over one step, from samples alone; of several records, over all of them.

        None for records too short for one.
        """
        with suppress(ValueError):
            return one_step(self.model, [run.record for run in self.each or [self]])
        return None

    @property
    def rival(self) -> str:
        """What forecasts the first steps better than the model, in words; empty if nothing does.

        It vetoes a model: equations that forecast worse than the last sample, or than the mean,
        are no more than candidates.
        """
        if self.status is Status.FOLLOWS:
            return ""
        if self.forecast is not None:
            return self.forecast.veto
        return self.one_step.rival if self.one_step else ""

    @property
    def text(self) -> str:
        """The status, and after which time a run diverged or left a domain."""
        if self.status is Status.FOLLOWS:
            return f"{self.status} {self.following.text}"
        return self.run_text if self.status is self.comparison.status else str(self.status)

    @property
    def run_text(self) -> str:
        """How the run from one sample compares with the record."""
        status = self.comparison.status
        of = f" of {self.rollout.outside}" if self.rollout.outside else ""
        lasted = self.rollout.lasted_text if self.rollout.diverged else ""
        return f"{status}{of} after {lasted}" if lasted else str(status)

    @property
    def heading(self) -> str:
        """The verdict alone, in few words: by samples, by the cycle, and by forecasts."""
        if not self.model.coef.any():
            return "no equations found"
        if self.status is Status.FOLLOWS:
            return self.text
        if self.rival:
            return f"no equations found: {self.rival} forecasts better"
        forecasts = "" if self.forecast is None else self.forecast.text
        own = str(self.status)
        both = f"{own}; {forecasts}" if forecasts else self.text
        if len(both.split()) <= MOST_WORDS:
            return both
        return forecasts if self.status is Status.DEPARTS else own

    @property
    def rank(self) -> int:
        """Sorts the best first."""
        return list(Status).index(self.status)

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
        if abs(ahead) < LEAST_SHOWN:
            return f"{text}, within {LEAST_SHOWN} of a period at the end"
        side = "ahead" if ahead > 0.0 else "behind"
        return f"{text}, {abs(ahead):.2g} of a period {side} at the end"

    @cached_property
    def cycle(self) -> LimitCycle | None:
        """The closed orbit on which the run ends; None if it ends on none, or is driven."""
        if self.is_driven or self.rollout.diverged or self.comparison.status is Status.DECAYS:
            return None
        frequency_Hz = max((f for f in self.frequency_Hz.values() if f == f), default=0.0)
        if not frequency_Hz > 0.0:
            return None
        return limit_cycle(self.model, self.rollout.states[-1], period_s=1.0 / frequency_Hz)

    @property
    def multiplier(self) -> float:
        """Largest modulus of the nontrivial Floquet multipliers; NaN without a cycle."""
        return float("nan") if self.cycle is None else self.cycle.largest_multiplier

    @cached_property
    def rest_points(self) -> tuple[RestPoint, ...]:
        """Rest points near the record (`ep2sindy.model.fixed_point`); none of a driven model."""
        if self.model.inputs:
            return ()
        compared, length_s = self.compared, float(self.record.t[-1] - self.record.t[0])
        return rest_points(self.model, compared.states, compared.std, compared.densities, length_s)

    @cached_property
    def forecast(self) -> ForecastSkill | None:
        """Skill of forecasts of the held-out part; None without it."""
        return None if self.forecasts is None else self.forecasts()

    @property
    def missing(self) -> str:
        """What the model or the record lacks, in a sentence; empty if nothing is known to."""
        terms = [term for state in self.model.states for term in self.model.terms(state)]
        used = {variable for term in terms for variable in variables_of(term)}
        unused = [name for name in self.model.inputs if name not in used]
        if unused and self.status is not Status.FOLLOWS:
            return f"No term of the model holds the input {' or '.join(unused)}."
        if self.cycle is None or self.status is Status.FOLLOWS:
            return ""
        if self.status is Status.NEUTRAL:
            return (
                "Every start has a cycle of its own: the model does not show what sets the "
                "amplitude."
            )
        if self.status is Status.REPELLING:
            return "Perturbations of the model's cycle grow: it is left sooner or later."
        if self.status is Status.NOT_TOLD:
            turns = self.cycle.relaxation_s / self.cycle.period_s
            return (
                f"By the model a perturbation of its cycle lasts {turns:.0f} periods: a longer "
                "record is needed to show whether it decays."
            )
        return ""

    @property
    def cycle_text(self) -> str:
        """The stability of the cycle, in sentences; empty without a cycle."""
        if self.cycle is None:
            return ""
        reached = f" From how far it is reached is {UNDETERMINED}."
        return (
            f"The model's cycle is {self.cycle.stability}: of a perturbation {self.multiplier:.3g} "
            "is left after a period (Floquet multiplier)."
            f"{reached if self.cycle.stability == 'attracting' else ''}"
        )

    @property
    def rest_texts(self) -> list[str]:
        """The rest points near the record, each in a line."""
        known = () if self.rival else self.rest_points[:N_SHOWN]
        return [f"rests at {each.text(self.model, self.rollout.clock)}" for each in known]

    @property
    def frequency_text(self) -> str:
        """`20 kHz (+1.2 %)`, the first state's frequency and its error; a dash if it has none."""
        frequency_Hz = self.frequency_Hz[self.model.states[0]]
        if not np.isfinite(frequency_Hz):
            return "-"
        clock, data = self.rollout.clock, self.compared.cycle
        if data is None or not np.isfinite(self.f_error):
            return clock.frequency_text(frequency_Hz)
        own = clock.frequency_text(data.frequency_Hz * (1.0 + self.f_error))
        return f"{own} ({error_text(self.f_error)})"

    @property
    def distance_text(self) -> str:
        """`x 1.02, y 0.98 times the noise of the samples`; empty where that is not known."""
        own = [(self.model.states[k], self.following.distances[k]) for k in self.assessed]
        known = [f"{state} {off:.3g}" for state, off in own if off <= LEFT][:N_SHOWN]
        if not known or self.record.n_samples < LEAST_FOR_NOISE:
            return ""
        return f"{', '.join(known)} times the noise of the samples"

    @property
    def table(self) -> list[tuple[str, str, str]]:
        """Quantity, data and model, as text: of the cycle, or else the distance in noises."""
        clock, states = self.rollout.clock, self.model.states
        data, rows = self.compared.cycle, []
        if data is not None and np.isfinite(self.f_error) and not self.is_driven:
            theirs = clock.frequency_text(data.frequency_Hz)
            rows.append(("frequency", theirs, self.frequency_text))
        sizes = self.compared.std, self.compared.std * self.comparison.by_state["amplitude_ratio"]
        if self.is_driven:
            sizes = self.compared.states.std(axis=0), self.rollout.states.std(axis=0)
        for state, std, own_std in list(zip(states, *sizes, strict=True))[:N_SHOWN]:
            unit = f" {self.model.units[state]}".removesuffix(" 1")
            model = f"{own_std:.4g}{unit}" if own_std <= LEFT * std else f"over {LEFT:.0f} times"
            known = np.isfinite(own_std)
            rows.append((f"amplitude of {state}", f"{std:.4g}{unit}", model if known else "-"))
        waveform = max(self.waveform_error.values())
        if np.isfinite(waveform) and not self.is_driven:
            rows.append(("waveform", "", f"within {waveform:.2g}{STD}"))
        if self.phase_text and not self.is_driven:
            rows.append(("phase", "", self.phase_text))
        off = f"{size_text(self.nrmse)}{STD}" if np.isfinite(self.nrmse) else ""
        if self.status is Status.FOLLOWS:
            off = self.distance_text
            rows += [("distance", "", off)] if off else []
        elif off and (self.is_driven or not self.phase_text):
            rows.append(("distance", "", "; ".join(filter(None, [off, self.distance_text]))))
        return rows

    @property
    def rows(self) -> list[tuple[str, str, str]]:
        """All that is said: quantity, data, model; computes what has not been asked for."""
        found = [
            ("status", "", self.text),
            *self.table,
            ("cycle", "", self.cycle_text),
            *(("rests", "", text.removeprefix("rests ")) for text in self.rest_texts),
            ("score", "", self.one_step.text if self.one_step else ""),
            ("forecasts", "", "" if self.forecast is None else self.forecast.text),
            ("missing", "", self.missing),
            ("lack of fit", "", self.lack_of_fit if self.status is not Status.FOLLOWS else ""),
        ]
        return [row for row in found if row[2]]

    def __repr__(self) -> str:
        lines = [
            (name, data, line) if k == 0 else ("", "", line)
            for name, data, model in self.rows
            for k, line in enumerate(wrap(model, WIDTH - WIDEST))
        ]
        return one_screen(text_table(COLUMNS, lines))

    def _repr_html_(self) -> str:
        return html_table(COLUMNS, [[escape(cell) for cell in row] for row in self.rows])


def evaluate(
    model: SparseModel | HoldsModel,
    runs: Runs,
    *,
    initial: Float[np.ndarray, " n_states"] | None = None,
    n_samples: int | None = None,
    bounds: FreeRunBounds | None = None,
    assessed: Sequence[str] | None = None,
    n_fitted: int | None = None,
) -> Evaluation:
    """Judge a model by one record or several.

    The result states whether the model follows the samples to within their noise; if not, whether
    it sustains the record's oscillation, with its frequency, amplitudes and waveform; and how far
    it forecasts, next to forecasts without a model.

    Parameters
    ----------
    model : SparseModel, or Discovery
        The model. The lack of fit of a discovery is reported as well.
    runs : run, or list or dict of runs
        A Trajectory, or whatever `discover` takes. Of several, the result is that of the worst
        record, and `each` has all of them.
    initial : (n_states,) array, optional
        State to start from, in SI. None takes the data's first sample.
    n_samples : int, optional
        Number of samples of the run that are compared. None takes all.
    bounds : FreeRunBounds, optional
        Largest deviations at which the run counts as staying on the record's cycle.
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
    'follows the samples'
    """
    lack_of_fit = ""
    if isinstance(model, HoldsModel):
        lack_of_fit, model = model.lack_of_fit, model.model
    check_kind("model", model, SparseModel, "found.model")
    found = [
        _evaluate(model, run, initial, n_samples, bounds or FreeRunBounds(), assessed, n_fitted)
        for run in trajectories_of(runs, partial=True)
    ]
    found = [replace(one, lack_of_fit=lack_of_fit) for one in found]
    return found[0] if len(found) == 1 else replace(max(found, key=lambda e: e.rank), each=found)


def _evaluate(
    model: SparseModel,
    whole: Trajectory,
    initial: Float[np.ndarray, " n_states"] | None,
    n_samples: int | None,
    bounds: FreeRunBounds,
    assessed: Sequence[str] | None,
    n_fitted: int | None,
) -> Evaluation:
    """The evaluation over one record."""
    part, forecasts = whole, None
    if n_fitted is not None:
        check_fitted(whole, n_fitted)
        part = whole.window(n_fitted - 1, whole.n_samples)
        forecasts = partial(forecast_skill, model, whole, n_fitted=n_fitted)
    n_samples = part.n_samples if n_samples is None else min(n_samples, part.n_samples)
    rollout = model.rollout(part, n_samples=n_samples, initial=initial)
    part, columns = part.window(0, n_samples), columns_of(model.states, assessed)
    compared = record_of(part, model.states)
    found = ours = compared.similarity(rollout.states, bounds)
    if assessed is not None:
        ours = record_of(part, assessed).similarity(rollout.states[:, columns], bounds)
    status = Status.LEAVES_DOMAIN if rollout.outside else ours.status
    return Evaluation(
        model=model,
        record=part,
        rollout=rollout,
        compared=compared,
        comparison=replace(ours, status=status, by_state=found.by_state),
        bounds=bounds,
        assessed=columns,
        forecasts=forecasts,
    )


def size_text(ratio: float, form: str = ".3g") -> str:
    """A ratio of sizes; of a run that has left the record's, that it is far over it."""
    if ratio > LEFT:
        return f"over {LEFT:.0f}"
    return f"{ratio:{form}}" if ratio >= NOTHING else "0"


def error_text(error: float) -> str:
    """A relative error in percent, `+1.2 %`, or `0.00 %` for a smaller one."""
    return f"{100.0 * error:+.2g} %" if abs(error) >= 5e-5 else "0.00 %"
