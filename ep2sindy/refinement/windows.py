"""Batches of windows of trajectories, in scaled units, with inputs as cubics in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Float, Int

from ep2sindy.data.gaps import between_gaps, mean_step
from ep2sindy.data.numbers import zero_to_one
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.model.inputs import curve_through
from ep2sindy.model.model import SparseModel
from ep2sindy.runtime.values import locked
from ep2sindy.signals.spectrum import dominant_frequency, power_spectrum, steps_in

PERIODS = 1.5  # default length of a window, in periods of the dominant frequency

MIN_SAMPLES = 5  # fewest samples in a window; fewer do not determine the dynamics


@dataclass(frozen=True, eq=False)
class WindowBatch:
    """Equally long windows of one set of trajectories.

    scale: standard deviation of each state, then rms of each input, in SI.
    step_s: mean time step. steps: (windows, samples - 1) in units of it.
    data: (windows, samples, n_states) in units of scale.
    inputs: (windows, samples - 1, 4, n_inputs), cubics in the elapsed fraction of a step,
    highest power first, in units of scale.
    trajectory, start: (windows,), number of the trajectory and first sample of each window.
    """

    scale: Float[np.ndarray, " variables"]
    step_s: float
    steps: Float[np.ndarray, "windows segments"]
    data: Float[np.ndarray, "windows samples n_states"]
    inputs: Float[np.ndarray, "windows segments 4 n_inputs"]
    trajectory: Int[np.ndarray, " windows"]
    start: Int[np.ndarray, " windows"]

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                object.__setattr__(self, item.name, locked(value.copy()))

    @property
    def multiplicity(self) -> float:
        """Mean number of windows that contain a sample: one, unless windows overlap."""
        window = self.data.shape[1]
        order = np.lexsort((self.start, self.trajectory))
        gaps = np.diff(self.start[order])
        apart = np.diff(self.trajectory[order]) != 0
        covered = window + np.where(apart, window, np.minimum(gaps, window)).sum()
        return float(window * len(order) / covered)


def cut_windows(
    trajectories: Sequence[Trajectory],
    model: SparseModel,
    *,
    n_windows: int,
    window: int,
    rng: np.random.Generator | int,
) -> WindowBatch:
    """Cut `n_windows` windows of `window` samples; fewer if there are not that many positions.

    No window crosses a gap (a step of over ten median steps), unless every position does.
    model: whose states and inputs are cut, with the courses of its inputs.
    Raises ValueError for no trajectory, a window longer than every trajectory or of under five
    samples, or a missing variable.
    """
    rng = np.random.default_rng(rng)
    check_windows(n_windows, window)
    longest = _longest(trajectories)
    if window > longest:
        raise ValueError(
            f"a window must fit into a trajectory, between its gaps: {window} samples were asked "
            f"of at most {longest}; shorten it, or leave it out to have it chosen"
        )
    values = [run.columns([*model.states, *model.inputs]) for run in trajectories]
    joined, n = np.concatenate(values), len(model.states)
    spread, rms = joined[:, :n].std(axis=0), np.sqrt(np.square(joined[:, n:]).mean(axis=0))
    scale = zero_to_one(np.append(spread, rms))
    step_s = mean_step(*(each.t for each in trajectories))
    segments = np.array(
        [(j, *each) for j, run in enumerate(trajectories) for each in between_gaps(run.t)]
    )  # trajectory, first and last sample (exclusive) of every segment without a gap
    lengths = (segments[:, 2] - segments[:, 1]).tolist()
    piece, start = _places(lengths, n_windows, window, rng)
    index, start = segments[piece, 0], start + segments[piece, 1]
    known = [model.courses.get(name) for name in model.inputs]
    cubics = [
        curve_through(each.t, v[:, n:] / scale[n:], known).pieces.transpose(1, 0, 2)
        for each, v in zip(trajectories, values, strict=True)
    ]
    places = list(zip(index, start, strict=True))
    cut = slice(0, window - 1)
    return WindowBatch(
        scale=scale,
        step_s=step_s,
        steps=np.stack([np.diff(trajectories[j].t[k:][:window]) / step_s for j, k in places]),
        data=np.stack([values[j][k:][:window, :n] / scale[:n] for j, k in places]),
        inputs=np.stack([cubics[j][k:][cut] for j, k in places]),
        trajectory=index,
        start=start,
    )


def dominant_window(
    trajectories: Sequence[Trajectory], states: Sequence[str], *, periods: float = PERIODS
) -> int:
    """Length in samples of `periods` periods of the dominant frequency, as far as data allow.

    The frequency is that of the state whose peak holds the largest fraction of its power. The
    length is the median over trajectories, and at most half of the longest segment without a gap.
    Raises ValueError for no trajectory.
    """
    longest, samples = _longest(trajectories), []
    for each in trajectories:
        columns = each.columns(states).T
        sharpest = columns[int(np.argmax([_peak_fraction(each.t, column) for column in columns]))]
        frequency = dominant_frequency(each.t, sharpest)
        if frequency > 0.0:
            samples.append(steps_in(periods, frequency_Hz=frequency, dt_s=each.dt_s))
    wanted = np.median(samples) if samples else longest / 2
    return int(np.clip(round(float(wanted)), min(10, longest), max(longest // 2, 10)))


def _peak_fraction(t: np.ndarray, x: np.ndarray) -> float:
    """Fraction of the power, without the mean, in the highest bin and its neighbours."""
    power = power_spectrum(t, x)[1][1:]
    k = int(np.argmax(power))
    return float(power[max(k - 1, 0) : k + 2].sum() / max(power.sum(), 1e-300))


def check_windows(n_windows: int, window: int | None) -> None:
    """Raise ValueError for no window, or one of too few samples; None is an unknown length."""
    if n_windows < 1 or (window is not None and window < MIN_SAMPLES):
        raise ValueError(
            f"at least one window of {MIN_SAMPLES} samples is needed: n_windows={n_windows}, "
            f"window={window}"
        )


def _longest(trajectories: Sequence[Trajectory]) -> int:
    """Samples in the longest segment without a gap; ValueError for no trajectory."""
    if not trajectories:
        raise ValueError("refinement needs at least one trajectory, got none")
    return max(stop - start for run in trajectories for start, stop in between_gaps(run.t))


def _places(
    lengths: Sequence[int], n_windows: int, window: int, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Segment and first sample of every window, in proportion to the room in the segments."""
    room = np.array([max(n - window + 1, 0) for n in lengths])
    ends = np.minimum(np.round(n_windows * np.cumsum(room) / room.sum()), np.cumsum(room))
    counts = np.minimum(np.diff(ends, prepend=0.0).astype(int), room)
    firsts = [_spread(int(r), int(m), window, rng) for r, m in zip(room, counts, strict=True)]
    return np.repeat(np.arange(len(lengths)), counts), np.concatenate(firsts)


def _spread(room: int, count: int, window: int, rng: np.random.Generator) -> np.ndarray:
    """First samples of windows: disjoint with random gaps if there is room, else evenly spaced."""
    slack = room - 1 - (count - 1) * window
    if count and slack >= 0:
        return np.sort(rng.integers(slack + 1, size=count)) + window * np.arange(count)
    return np.round(np.linspace(0, room - 1, count)).astype(np.int64)
