"""Forecasts from the past of a record alone, without a model, which a model must beat.

All of them work at equal steps: samples at other times are interpolated onto such, segment by
segment between gaps, and what is forecast is interpolated back.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise, product
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.gaps import between_gaps, usual_step
from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.signals.attractor import Cycle, find_cycle
from ep2sindy.signals.spectrum import crossing_frequency, dominant_frequency

PERSISTENCE, HARMONICS, AUTOREGRESSION, NEIGHBOURS = (
    "persistence", "harmonics", "autoregression", "neighbours",
)  # fmt: skip
N_STARTS = 40
WORST = 10.0  # error, in standard deviations, that counts for a forecast that has diverged


def check_fitted(record: Trajectory, n_fitted: int) -> None:
    """Raise ValueError for a fitted or a held-out part of too few samples."""
    if not 8 <= n_fitted <= record.n_samples - 4:
        raise ValueError(
            "the fitted part must have eight samples or more, and leave four: "
            f"got n_fitted={n_fitted} for {record.n_samples} samples"
        )


def period_of(run: Trajectory, names: Sequence[str]) -> float:
    """Period of the record, or mean time between crossings; NaN if it holds fewer than two."""
    values = run.columns(names)
    cycle = find_cycle(run.t, values)
    if cycle is None:
        frequency_Hz = max(crossing_frequency(run.t, column) for column in values.T)
    else:
        frequency_Hz = cycle.frequency_Hz
    enough = frequency_Hz * float(run.t[-1] - run.t[0]) >= 2.0
    return 1.0 / frequency_Hz if enough else float("nan")


def spread_starts(
    t: Float[np.ndarray, " samples"], first: int, longest: int, n: int
) -> Int[np.ndarray, " starts"]:
    """At most n starts of forecasts of `longest` samples, evenly spread from a first one on.

    A forecast and the sample before it lie in one segment without a gap, unless none of them does.
    """
    starts = np.arange(min(first, len(t) - longest), len(t) - longest + 1)
    end = np.array(between_gaps(t))[:, 1]
    piece = np.searchsorted(end, starts - 1, side="right")
    inside = starts + longest <= end[piece]
    starts = starts[inside] if inside.any() else starts
    return starts[spread_evenly(len(starts), n)]


def spread_evenly(n_all: int, n: int) -> Int[np.ndarray, " places"]:
    """At most n places among n_all, evenly spread from the first to the last."""
    return np.unique(np.linspace(0, n_all - 1, n).round().astype(np.int64))


def squared_errors(
    forecast: Float[np.ndarray, "starts ahead measured"],
    truth: Float[np.ndarray, "starts ahead measured"],
    scale: Float[np.ndarray, " measured"] | float,
) -> Float[np.ndarray, "starts ahead"]:
    """Mean square error over states, of every start at every horizon, in `scale`."""
    off = np.nan_to_num(np.abs(forecast - truth) / scale, nan=WORST, posinf=WORST)
    return np.square(np.minimum(off, WORST)).mean(axis=2)


def root_mean(squared: Float[np.ndarray, "starts ahead"]) -> Float[np.ndarray, " ahead"]:
    """Root mean square error over starts at every horizon."""
    return np.sqrt(squared.mean(axis=0))


def standard_error(gain: Float[np.ndarray, " starts"], n_free: int) -> float:
    """Standard error of the mean of gains that are correlated from start to start.

    The power of slow variations, which is what a mean is uncertain by, is that of the first
    `n_free` cosines: the ratio to it has Student's distribution with as many degrees of freedom.
    Source: Lazarus, Lewis, Stock & Watson 2018, doi:10.1080/07350015.2018.1506926.
    """
    n = len(gain)
    waves = np.cos(np.pi * np.outer(np.arange(1, n_free + 1), (np.arange(n) + 0.5) / n))
    return float(np.sqrt(2.0 * np.square(waves @ gain).mean()) / n)


def measured_part(run: Trajectory, names: Sequence[str], inputs: Sequence[str]) -> Trajectory:
    """A record's measured states, with the inputs that every baseline may know ahead."""
    return Trajectory(run.t, run.columns(names), names, run.columns(inputs), inputs)


def baseline_errors(
    run: Trajectory, names: Sequence[str], *, n_fitted: int, longest: int, starts: int = N_STARTS
) -> dict[str, Float[np.ndarray, " ahead"]]:
    """Errors of the forecasts that need no model, by their name: what a model must beat.

    run: its first `n_fitted` samples fit the baselines, the rest is forecast from its own past.
    names: states that are forecast. longest: horizon, in samples. starts: of forecasts, evenly
    spread. Returns root mean square errors (longest,) at every horizon from one sample on, over
    starts and states, in standard deviations of the rest.
    Raises ValueError for parts that are too short.
    """
    check_fitted(run, n_fitted)
    own = measured_part(run, names, run.input_names)
    first = spread_starts(own.t, n_fitted, longest, starts)
    truth = np.stack([own.states[k : k + longest] for k in first])
    scale = zero_to_one(own.states[n_fitted:].std(axis=0))
    baselines = fit_baselines(own.window(0, n_fitted), longest)
    return {
        name: root_mean(squared_errors(go_on(each, own, first, longest), truth, scale))
        for name, each in baselines.items()
    }


def go_on(
    baseline: Baseline, run: Trajectory, first: Int[np.ndarray, " starts"], longest: int
) -> Float[np.ndarray, "starts ahead n_states"]:
    """What a baseline forecasts from every start. run: see `measured_part`."""
    return np.stack(
        [
            baseline.ahead(run.states[:k], run.t[: k + longest], run.inputs[: k + longest])
            for k in first.tolist()
        ]
    )


def fit_baselines(fitted: Trajectory, longest: int) -> dict[str, Baseline]:
    """The baselines that a record allows, by name. longest: horizon, in samples."""
    tried: Mapping[str, Baseline | None] = {
        PERSISTENCE: Persistence(),
        HARMONICS: Harmonics.of(fitted),
        AUTOREGRESSION: Autoregression.of(fitted),
        NEIGHBOURS: Neighbours.of(fitted, longest),
    }
    return {name: baseline for name, baseline in tried.items() if baseline is not None}


@runtime_checkable
class Baseline(Protocol):
    """Interface of the baselines: forecasts of the next samples from the past alone.

    past: (samples, n_states). t and inputs: of the past and of the times to forecast.
    """

    def ahead(
        self, past: Float[np.ndarray, "samples n_states"], t: Float[np.ndarray, " times"],
        inputs: Float[np.ndarray, "times n_inputs"],
    ) -> Float[np.ndarray, "ahead n_states"]: ...  # fmt: skip


@dataclass(frozen=True)
class Persistence:
    """The last sample stays."""

    def ahead(self, past: np.ndarray, t: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        return np.repeat(past[-1:], len(t) - len(past), axis=0)


@dataclass(frozen=True, eq=False)
class Harmonics:
    """The mean waveform of a record continues, at the phase that the last period shows."""

    cycle: Cycle

    @staticmethod
    def of(run: Trajectory) -> Harmonics | None:
        """None for a record without a period."""
        cycle = find_cycle(run.t, run.states)
        return None if cycle is None else Harmonics(cycle)

    def ahead(self, past: np.ndarray, t: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        turns, known = 2.0 * np.pi * self.cycle.frequency_Hz, t[: len(past)]
        late = known >= known[-1] - 1.0 / self.cycle.frequency_Hz
        shifts = 2.0 * np.pi * np.arange(72) / 72.0
        spread = np.where(self.cycle.std > 0.0, self.cycle.std, 1.0)
        off = [
            np.square((self.cycle.waveform(turns * known[late] + shift) - past[late]) / spread)
            for shift in shifts
        ]
        best = shifts[int(np.argmin([each.sum() for each in off]))]
        return self.cycle.waveform(turns * t[len(past) :] + best)


# Largest order of an autoregression of one state, and the sum of orders of one of several; samples
# that it is fitted to, from the end of the record.
MAX_ORDER, MAX_ORDERS, MAX_FITTED = 120, 40, 4000
SAMPLES_PER_COEFFICIENT = 5  # fewest, of an autoregression
ROUNDING = 1e-10  # residual, in standard deviations, of a record without noise


@dataclass(frozen=True, eq=False)
class Autoregression:
    """A linear autoregression of all states at once, with their inputs, whose order has least AIC.

    x_k = constant + sum_l coef[l] x_(k-1-l) + sum_l drive[l] u_(k-l), the inputs u being known up
    to the time that is forecast. Of states that are positive throughout, it is one of their
    logarithms if this is likelier, densities being those of the samples in either case.
    step_s: between samples. constant: (n_states,). coef: (order, n_states, n_states). drive:
    (order + 1, n_states, n_inputs).
    least: (n_states,), the lowest samples, of an autoregression of logarithms; None of others.
    """

    step_s: float
    constant: Float[np.ndarray, " n_states"]
    coef: Float[np.ndarray, "order n_states n_states"]
    drive: Float[np.ndarray, "_ n_states n_inputs"]
    least: Float[np.ndarray, " n_states"] | None = None

    @staticmethod
    def of(run: Trajectory) -> Autoregression | None:
        """None for too few samples."""
        d, segments = run.states.shape[1], _even_segments(run, MAX_FITTED)
        most = _largest_order(run, segments)
        if most < 1:
            return None
        (found, cost), least = _fit_autoregression(segments, d, most), run.states.min(axis=0)
        if (least > 0.0).all():
            logs = [np.hstack([np.log(each[:, :d]), each[:, d:]]) for each in segments]
            in_logs, cost_in_logs = _fit_autoregression(logs, d, most)
            # A density of log x is one of x times x.
            if cost_in_logs + 2.0 * sum(float(each[most:, :d].sum()) for each in logs) < cost:
                found = replace(in_logs, least=least)
        return replace(found, step_s=usual_step(run.t))

    @property
    def order(self) -> int:
        return len(self.coef)

    def ahead(self, past: np.ndarray, t: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        grid = _grid_around(t, len(past), self.step_s, self.order)
        if grid[0] < t[0] - 0.5 * self.step_s:
            return np.full((len(t) - len(past), past.shape[1]), np.nan)
        path, drive = _on_grid(grid, t[: len(past)], past), _on_grid(grid, t, inputs)
        if self.least is not None:
            path = np.log(np.where(path > 0.0, path, self.least))
        for k in range(self.order, len(grid)):
            driven = np.einsum("lij,lj->i", self.drive, drive[k - self.order : k + 1][::-1])
            own = np.einsum("lij,lj->i", self.coef, path[k - self.order : k][::-1])
            path[k] = self.constant + own + driven
        if self.least is not None:
            with np.errstate(over="ignore"):  # an unstable one grows without bounds
                path = np.exp(path)
        return _on_grid(t[len(past) :], grid, path)


def _fit_autoregression(
    segments: Sequence[np.ndarray], d: int, most: int
) -> tuple[Autoregression, float]:
    """The autoregression of the order with least AIC, at steps of one, and this criterion.

    segments: (samples, states and inputs). d: number of states. All orders are compared on the
    same rows, by one triangular factor: its columns are ordered by lag.
    """
    values = np.concatenate(segments)
    mean, scale = values.mean(axis=0), zero_to_one(values.std(axis=0))
    scaled = [(each - mean) / scale for each in segments]
    rows, targets = _lagged(scaled, d, most)
    # Columns before the lags, and those of every lag.
    n, first, each = len(rows), 1 + values.shape[1] - d, values.shape[1]
    triangle = np.linalg.qr(np.hstack([rows, targets])).R[:, -d:]
    costs = []
    for order in range(1, most + 1):
        n_columns = first + each * order
        left = triangle[n_columns:].T @ triangle[n_columns:] / n + ROUNDING**2 * np.eye(d)
        costs.append(n * float(np.linalg.slogdet(left)[1]) + 2.0 * d * n_columns)
    order = int(np.argmin(costs)) + 1
    rows, targets = _lagged(scaled, d, order)
    solved = np.linalg.lstsq(rows, targets, rcond=None)[0]
    by_lag = solved[first:].reshape(order, each, d)
    coef = by_lag[:, :d].transpose(0, 2, 1) * scale[:d, None] / scale[:d]
    drive = np.concatenate([solved[1:first][None], by_lag[:, d:]]).transpose(0, 2, 1)
    drive = drive * scale[:d, None] / scale[d:]
    level = mean[:d] - coef.sum(axis=0) @ mean[:d] - drive.sum(axis=0) @ mean[d:]
    constant = scale[:d] * solved[0] + level
    density = 2.0 * n * float(np.log(scale[:d]).sum())
    return Autoregression(1.0, constant, coef, drive), min(costs) + density


def _lagged(segments: Sequence[np.ndarray], d: int, order: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows [1, inputs now, then states and inputs by lag], and the states that follow."""
    rows, targets = [], []
    for values in segments:
        n = len(values) - order
        if n > 0:
            lags = [values[order - lag : order - lag + n] for lag in range(1, order + 1)]
            rows.append(np.hstack([np.ones((n, 1)), values[order:, d:], *lags]))
            targets.append(values[order:, :d])
    return np.concatenate(rows), np.concatenate(targets)


def _largest_order(run: Trajectory, segments: Sequence[np.ndarray]) -> int:
    """Largest order that is tried: two periods, if there are samples enough."""
    frequency_Hz = max(dominant_frequency(run.t, column) for column in run.states.T)
    periods = frequency_Hz * float(run.t[-1] - run.t[0])
    d = run.states.shape[1]
    most = MAX_ORDER if d == 1 else MAX_ORDERS / d
    wanted = 2.0 * run.n_samples / periods if periods >= 1.0 else most
    each = run.values.shape[1]
    lengths = np.array([len(segment) for segment in segments])
    allowed = [
        order
        for order in range(1, int(min(wanted, most)) + 1)
        if np.maximum(lengths - order, 0).sum() >= (SAMPLES_PER_COEFFICIENT - 1) * each * order
    ]
    return max(allowed, default=0)


# Nearest neighbours: numbers of samples that describe a moment, and of moments that are averaged.
DELAYS, NUMBERS = (1, 2, 3, 4, 6, 8, 12), (1, 2, 4, 8, 16, 32)
PER_PERIOD = 8  # delays in a period, next to delays of a sample
N_TRIED, N_HORIZONS = 150, 12  # moments that are forecast to choose among these, and horizons
MAX_KNOWN = 10_000  # moments that are searched for neighbours
LEAST_KNOWN = 20  # fewest


@dataclass(frozen=True, eq=False)
class Neighbours:
    """What followed the moments of a record that were most like the present, on average.

    A moment is described by samples of all states and inputs at equal delays; the number of these,
    the delay, and the number of neighbours have the least error over a period in the record itself,
    for moments whose own time is left out.
    segments: (samples, columns), scaled. n_states: the first columns. mean and scale: of these.
    delay: in steps.
    Source: Lorenz 1969, doi:10.1175/1520-0469(1969)26<636:APARBN>2.0.CO;2; Sugihara & May 1990,
    doi:10.1038/344734a0.
    """

    step_s: float
    segments: Sequence[Float[np.ndarray, "_ columns"]]
    n_states: int
    mean: Float[np.ndarray, " columns"]
    scale: Float[np.ndarray, " columns"]
    n_delays: int = 1
    delay: int = 1
    number: int = 1

    @staticmethod
    def of(run: Trajectory, longest: int) -> Neighbours | None:
        """None for too few samples. longest: horizon of later forecasts, in samples."""
        segments = _even_segments(run, MAX_KNOWN)
        values, d = np.concatenate(segments), run.states.shape[1]
        mean, scale = values.mean(axis=0), zero_to_one(values.std(axis=0))
        scaled = [(each - mean) / scale for each in segments]
        simplest = Neighbours(usual_step(run.t), scaled, d, mean, scale)
        per_period = period_of(run, run.state_names) / simplest.step_s
        apart = int(min(longest, per_period)) if np.isfinite(per_period) else longest
        delays = {1, max(1, round(apart / PER_PERIOD))}
        tried = [(n, delay) for n, delay in product(DELAYS, sorted(delays)) if n > 1 or delay == 1]
        errors = {}
        for n, delay in tried:
            chosen = replace(simplest, n_delays=n, delay=delay)
            for number, error in chosen._errors(max(1, apart), longest).items():
                errors[replace(chosen, number=number)] = error
        return min(errors, key=errors.__getitem__, default=None)

    def ahead(self, past: np.ndarray, t: np.ndarray, inputs: np.ndarray) -> np.ndarray:
        span = self.delay * (self.n_delays - 1) + 1
        grid = _grid_around(t, len(past), self.step_s, span)
        n, none = len(grid) - span, np.full((len(t) - len(past), self.n_states), np.nan)
        moments, place, values = self._moments(n)
        if grid[0] < t[0] - 0.5 * self.step_s or len(place) < self.number:
            return none
        known = np.hstack([_on_grid(grid[:span], t[: len(past)], past),
                           _on_grid(grid[:span], t, inputs)])  # fmt: skip
        now = ((known - self.mean) / self.scale)[:: self.delay].ravel()
        off = np.square(moments - now).sum(axis=1)
        nearest = place[np.argpartition(off, self.number - 1)[: self.number]]
        later = values[nearest[:, None] + np.arange(1, n + 1), : self.n_states].mean(axis=0)
        own = slice(0, self.n_states)
        path = np.vstack([past[-1:], self.mean[own] + self.scale[own] * later])
        return _on_grid(t[len(past) :], grid[span - 1 :], path)

    def _moments(self, longest: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Descriptions of the moments that `longest` samples follow, their places, and samples."""
        back = self.delay * np.arange(self.n_delays)[::-1]
        begins = np.cumsum([0, *map(len, self.segments)])
        place = np.concatenate(
            [np.arange(begin + back[0], end - longest) for begin, end in pairwise(begins)]
        )
        values = np.concatenate(self.segments)
        size = len(back) * values.shape[1]
        return values[place[:, None] - back].reshape(len(place), size), place, values

    def _errors(self, apart: int, longest: int) -> dict[int, float]:
        """Mean square error over horizons up to `apart`, by the number of neighbours."""
        moments, place, values = self._moments(longest)
        tried = spread_evenly(len(place), N_TRIED) if len(place) else np.empty(0, dtype=np.int64)
        steps = 1 + spread_evenly(apart, N_HORIZONS)
        own = self.delay * (self.n_delays - 1) + apart  # steps over which moments share samples
        square = np.square(moments).sum(axis=1)
        off = square[tried, None] + square - 2.0 * moments[tried] @ moments.T
        off[np.abs(place[tried, None] - place) <= own] = np.inf
        usable = [number for number in NUMBERS if number + LEAST_KNOWN <= len(place) - 2 * own - 1]
        if not usable:
            return {}
        nearest = np.argpartition(off, usable[-1] - 1, axis=1)[:, : usable[-1]]
        nearer_first = np.argsort(np.take_along_axis(off, nearest, axis=1), axis=1)
        nearest = np.take_along_axis(nearest, nearer_first, axis=1)
        later = values[place[nearest][..., None] + steps, : self.n_states]
        truth = values[place[tried][:, None] + steps, : self.n_states]
        return {n: float(np.square(later[:, :n].mean(axis=1) - truth).mean()) for n in usable}


# Samples at equal steps.


def _even_segments(run: Trajectory, most: int) -> list[Float[np.ndarray, "_ columns"]]:
    """States and inputs between gaps, at the usual step; the last `most` samples."""
    step_s, found = usual_step(run.t), []
    for start, stop in reversed(between_gaps(run.t)):
        n = min(most, int((run.t[stop - 1] - run.t[start]) / step_s + 1e-6) + 1)
        grid = run.t[stop - 1] - step_s * np.arange(n)[::-1]
        found.append(_on_grid(grid, run.t[start:stop], run.values[start:stop]))
        most -= n
        if most < 1:
            break
    return found[::-1]


def _grid_around(
    t: Float[np.ndarray, " times"], n_past: int, step_s: float, n_before: int
) -> Float[np.ndarray, " points"]:
    """Equal steps up to the end of the past, `n_before` of them, and on until the last time."""
    later = int(np.ceil((t[-1] - t[n_past - 1]) / step_s - 1e-6))
    return t[n_past - 1] + step_s * np.arange(1 - n_before, later + 1)


def _on_grid(
    grid: Float[np.ndarray, " points"],
    t: Float[np.ndarray, " samples"],
    values: Float[np.ndarray, "samples columns"],
) -> Float[np.ndarray, "points columns"]:
    """Samples interpolated to other times; before and after them, the nearest."""
    found = np.empty((len(grid), values.shape[1]))
    for k, column in enumerate(values.T):
        found[:, k] = np.interp(grid, t, column)
    return found
