"""State estimation: states of a model along a record, from its samples and under process noise.

A model follows a record apart from two errors: the noise of the samples, and process noise, a
random move of every state at every step, which stands for all that the model does not describe.
Their sizes are the most likely ones for the record that the model was fitted to. States are then
fitted to samples by the model and under these errors: those of a window before a moment (filtering)
or those of a whole record (smoothing).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from ep2sindy.data.coerce import own_result
from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.data.sensor import Bounds
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.estimation.hidden import with_guess_by
from ep2sindy.estimation.kernels import filter_states
from ep2sindy.estimation.likelihood import (
    FAR,
    FREE_START,
    TrajectoryFit,
    enough_substeps,
    fit_paths,
    linearise,
)
from ep2sindy.estimation.problem import MIN_SAMPLES, EstimationProblem, ScaledRecord, scale_problem
from ep2sindy.estimation.process_noise import LEAST_NOISE, MOST, likely_errors
from ep2sindy.model.model import SparseModel
from ep2sindy.runtime.progress import Progress, as_progress, count_pieces
from ep2sindy.runtime.threads import one_thread
from ep2sindy.signals.spectrum import dominant_frequency

MEMORY_PERIODS = 4.0  # length of the window that a start is fitted to
MIN_MEMORY, MAX_MEMORY = 20, 600  # its length in samples

MAX_FITTED = 3000  # samples from the end of a record that the noise is estimated from
N_PASSES = 3  # states and noise, fitted in turn

# Process noise, in noise of the samples, of the fits that approach the final one. Free states find
# their way to the samples first.
CONTINUATION = (3.0, 0.3, 0.03)


@dataclass(frozen=True, eq=False)
class ModelNoise:
    """Standard deviations of the errors with which a model follows a record, in SI.

    samples: (n_states,), of the samples' noise; NaN for a state that is not measured.
    process: (n_states,), of the process noise of every state in a mean step.
    """

    samples: Float[np.ndarray, " n_states"]
    process: Float[np.ndarray, " n_states"]


@dataclass(frozen=True, eq=False)
class FittedState:
    """The state at the end of a window: most likely value (n_states,) and covariance, in SI."""

    mean: Float[np.ndarray, " n_states"]
    covariance: Float[np.ndarray, "n_states n_states"]


@dataclass(frozen=True, eq=False)
class BandWidths:
    """Widths of forecasts' bands, in widths of the draws' own, by horizon.

    horizons_s: (horizons,), increasing. widths: (horizons, n_states); NaN where no width is known.
    """

    horizons_s: Float[np.ndarray, " horizons"]
    widths: Float[np.ndarray, "horizons n_states"]

    def at(self, ahead_s: Float[np.ndarray, " samples"]) -> Float[np.ndarray, "samples n_states"]:
        """Between horizons, interpolated in their logarithms; farther, that of the longest."""
        at, known = np.log(ahead_s), np.log(self.horizons_s)
        return np.stack([np.interp(at, known, each) for each in self.widths.T], axis=1)


@dataclass(frozen=True, eq=False)
class StateEstimator:
    """A model that can follow records, with the errors that it makes on one.

    The states x of n samples y minimise, with the model's coefficients fixed,

        sum_k ((y_k - x_k) / noise.samples)^2
        + sum_k ((flow of x_k over a step - x_(k+1)) / noise.process)^2,

    which is an iterated Kalman smoother (`estimation.likelihood`). It assumes that both errors are
    white and normal.
    problem: scales and steps of that record, and which states were measured. free: the model's
    coefficients, scaled. n_substeps: Runge-Kutta steps between samples. per_period: samples to a
    period of the record. widths: of the bands of its forecasts.
    Source: Bell 1994, doi:10.1137/0804035.
    """

    model: SparseModel
    problem: EstimationProblem
    free: Float[np.ndarray, " free"]
    n_substeps: int
    per_period: float
    noise: ModelNoise
    widths: BandWidths

    @property
    def measured(self) -> Bool[np.ndarray, " n_states"]:
        """False for states that nobody measured, or that were made from the others."""
        return self.problem.measured

    @property
    def names(self) -> list[str]:
        """The measured states, in the model's order."""
        return [name for name, own in zip(self.model.states, self.measured, strict=True) if own]

    @property
    def memory(self) -> int:
        """Length in samples of the window that a start is fitted to."""
        return int(np.clip(MEMORY_PERIODS * self.per_period, MIN_MEMORY, MAX_MEMORY))

    def filter(self, history: Trajectory) -> FittedState:
        """Fit the states of the last samples of a history, and return the last state.

        history: has the measured states of the model; others that it has only start the fit.
        """
        record = self.problem.record(_select_variables(self.model, history)).end(self.memory)
        fit = self.fit_path(record, record.samples)
        _, mean, covariance = filter_states(*linearise(fit))
        end, scale = fit.path[-1] + mean, self.problem.scale
        if not (np.isfinite(end).all() and np.isfinite(covariance).all()):
            # The model runs away between two samples: they tell no more than a guess does.
            end, covariance = record.samples[-1], FREE_START * np.eye(len(scale))
        return FittedState(scale * end, np.outer(scale, scale) * covariance)

    def follows(self, history: Trajectory) -> bool:
        """Whether the likeliest states come close to the last samples of a history."""
        record = self.problem.record(_select_variables(self.model, history)).end(self.memory)
        n_squares = len(record.samples) * self.measured.sum()
        return bool(self.fit_path(record, record.samples).total < FAR * n_squares)

    def smooth(self, run: Trajectory) -> Trajectory:
        """All states of the model along a run, fitted to the measured ones under the errors.

        Between gaps it starts anew. Segments of under five samples are left out.
        """
        own = _select_variables(self.model, run)
        whole = self.problem.record(own)
        pieces = whole.segments()
        paths = [self.fit_path(piece, piece.samples).path for piece in pieces]
        kept = np.isin(whole.times, np.concatenate([piece.times for piece in pieces]))
        states = np.concatenate(paths) * self.problem.scale
        with own_result("the model does not follow the record"):
            return replace(own, t=own.t[kept], states=states, inputs=own.inputs[kept])

    def with_process_noise(self, factor: float) -> StateEstimator:
        """The same with process noise that is larger by a factor."""
        noise = replace(self.noise, process=factor * self.noise.process)
        return replace(self, noise=noise)

    def scaled_noise(self) -> tuple[np.ndarray, np.ndarray]:
        """Both kinds of noise, scaled; states that are not measured get the mean of the others.

        The noise of the latter only sets how freely the first fits may leave the flow.
        """
        samples, process = (
            each / self.problem.scale for each in (self.noise.samples, self.noise.process)
        )
        return np.where(self.measured, samples, samples[self.measured].mean()), process

    def fit_path(self, record: ScaledRecord, path: Float[np.ndarray, "samples d"]) -> TrajectoryFit:
        """The most likely path near the given one, by way of larger process noise that fades."""
        samples, process = self.scaled_noise()
        fit = _fix(self.problem, [record], [path], self.free, samples)
        fit = replace(fit, n_substeps=self.n_substeps)
        for fraction in (*CONTINUATION, 0.0):
            fit = fit_paths(replace(fit, process_noise=np.maximum(process, fraction * samples)))
        return fit


@one_thread()
def tune_estimator(
    model: SparseModel,
    run: Trajectory,
    *,
    measured: Sequence[str] | None = None,
    follow: bool = False,
    progress: bool | Progress = False,
) -> StateEstimator:
    """Estimate with what errors a model follows a record, usually the one that it was fitted to.

    run: has the measured states and the inputs of the model. measured: states whose samples count;
    others that the run has were made from them. None means all that it has. Every state may have
    process noise, also one whose equation is known to hold, such as x' = v: the others' errors come
    in through it. follow: guess the other states by a smoother that must follow the spectrum of the
    samples; False does so only where the likeliest smoother, which may take pulses for noise, gives
    states that come nowhere near them. progress: True shows a bar.
    Raises ValueError for a run without an input or of under five samples, or measured states that
    the model lacks.
    """
    names = measured_states(model, run) if measured is None else list(measured)
    if not names or not set(names) <= set(model.states):
        raise ValueError(f"measured must name some of the states {list(model.states)}, got {names}")
    if run.n_samples < MIN_SAMPLES:
        raise ValueError(
            f"a record must have {MIN_SAMPLES} samples or more to tell its noise: got "
            f"{run.n_samples}; pass the record that the model was fitted to, fitted_to=..."
        )
    end = run.window(max(0, run.n_samples - MAX_FITTED), run.n_samples)
    watch = as_progress(progress)
    if not follow:
        estimator = _tune(model, _select_variables(model, end), names, watch)
        if len(measured_states(model, end)) == len(model.states) or estimator.follows(end):
            return estimator
    return _tune(model, _select_variables(model, end, follow=True), names, watch)


def _tune(
    model: SparseModel, own: Trajectory, names: Sequence[str], watch: Progress
) -> StateEstimator:
    """An estimator for a record of all states, which sets their scale."""
    known = {state: [*terms] for state in model.states if (terms := model.terms(state))}
    problem = scale_problem([own], model.library.only(known), measured=names, courses=model.courses)
    paths, free = [record.samples for record in problem.records], _free_of(model, problem)
    # Differences remove what is smooth; those of white noise have a variance of 20.
    differences = np.concatenate([np.diff(path, n=3, axis=0) for path in paths])
    rough = np.sqrt(np.square(differences).mean(axis=0) / 20.0)
    rough = np.clip(rough, LEAST_NOISE, MOST)
    estimator = StateEstimator(
        model=model,
        problem=problem,
        free=free,
        n_substeps=enough_substeps(_fix(problem, problem.records, paths, free, rough)),
        per_period=_count_per_period(own, names),
        noise=_noise_of(problem, rough, 0.1 * rough),
        widths=BandWidths(np.ones(1), np.ones((1, len(model.states)))),
    )
    for _ in count_pieces(watch, range(N_PASSES), "pass", "errors of the model, for forecasts"):
        estimator, paths = _with_likely_noise(estimator, paths)
    return estimator


@one_thread()
def estimate_states(
    model: SparseModel, run: Run, *, measured: Sequence[str] | None = None
) -> Trajectory:
    """All states of a model along a record, including those that nobody measured.

    Parameters
    ----------
    model : SparseModel
        The equations.
    run : run
        A record with the inputs and some states of the model.
    measured : sequence of str, optional
        States that were measured. None takes all that the record has.

    Returns
    -------
    Trajectory
        All states of the model at the times of the record.

    Raises
    ------
    ValueError
        If the record has no state of the model, or a state cannot be distinguished from the others.

    Notes
    -----
    The states minimise

        sum_k |(y_k - x_k) / sigma|^2 + sum_k |(F(x_k) - x_(k+1)) / q|^2

    with the flow F of the model over one step (Kalman smoothing, iterated). The noise sigma and the
    process noise q are the likeliest ones for this record.

    Examples
    --------
    >>> full = ep.lotka_volterra().trajectory(noise=0.05, rng=0)
    >>> predators = ep.Trajectory(full.t, full.columns(["y"]), ["y"])
    >>> both = ep.model.estimate_states(ep.lotka_volterra().model, predators)
    >>> off = both.columns(["x"]) - full.columns(["x"])
    >>> bool(off.std() < 0.1 * full.columns(["x"]).std())
    True
    """
    record = trajectory_of(run)
    return tune_estimator(model, record, measured=measured).smooth(record)


def _with_likely_noise(
    estimator: StateEstimator, paths: Sequence[np.ndarray]
) -> tuple[StateEstimator, list[np.ndarray]]:
    """The estimator with the most likely noise about the states, and these states, by segment."""
    records = estimator.problem.records
    paths = [estimator.fit_path(*pair).path for pair in zip(records, paths, strict=True)]
    samples, process = estimator.scaled_noise()
    fit = _fix(estimator.problem, records, paths, estimator.free, samples)
    fit = replace(fit, n_substeps=estimator.n_substeps, process_noise=process)
    likely = _noise_of(estimator.problem, *likely_errors(fit)[:2])
    return replace(estimator, noise=likely), paths


def _fix(
    problem: EstimationProblem,
    records: Sequence[ScaledRecord],
    paths: Sequence[np.ndarray],
    free: np.ndarray,
    noise: np.ndarray,
) -> TrajectoryFit:
    """A fit of these paths, whose coefficients stay as they are. noise: (d,), of the samples.

    Clipped and rounded samples are taken as they are: forecasts are compared with them.
    """
    exact = [replace(each, limits=Bounds(each.samples, each.samples, ())) for each in records]
    problem = replace(problem, records=tuple(exact))
    path, fixed = np.concatenate(paths), np.zeros(len(free), dtype=np.bool_)
    return TrajectoryFit(problem, np.tile(noise, (len(path), 1)), 1.0, path, free, fixed)


def _noise_of(problem: EstimationProblem, samples: np.ndarray, process: np.ndarray) -> ModelNoise:
    shown = np.where(problem.measured, samples, np.nan)
    return ModelNoise(shown * problem.scale, process * problem.scale)


def measured_states(model: SparseModel, run: Trajectory) -> list[str]:
    """States of a model that a run has. Raises ValueError if it has none."""
    found = [name for name in model.states if name in run.state_names]
    if not found:
        raise ValueError(
            f"a record must have some of the model's states {list(model.states)}: it has "
            f"{list(run.state_names)}; name its columns as the model does"
        )
    return found


def _select_variables(model: SparseModel, run: Trajectory, *, follow: bool = False) -> Trajectory:
    """The variables of a run that a model has, in its order; states that it lacks are guessed.

    follow: see `with_guess_by`.
    """
    if len(measured_states(model, run)) < len(model.states):
        run = with_guess_by(model, run, follow=follow)
    return Trajectory(
        t=run.t,
        states=run.columns(model.states),
        state_names=tuple(model.states),
        inputs=run.columns(model.inputs),
        input_names=model.inputs,
        units=run.units,
        clock=run.clock,
    )


def _free_of(model: SparseModel, problem: EstimationProblem) -> Float[np.ndarray, " free"]:
    places = np.array([model.library.index(name) for name in problem.term_names])
    return model.coef[places[problem.column], problem.equation] / problem.to_SI


def _count_per_period(run: Trajectory, measured: Sequence[str]) -> float:
    """Samples to a period of the fastest measured state, or in all if it holds none."""
    frequency_Hz = max(dominant_frequency(run.t, column) for column in run.columns(measured).T)
    return run.n_samples / max(frequency_Hz * run.dt_s * run.n_samples, 1.0)
