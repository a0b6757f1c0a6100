"""Equations of one measured signal: a preparation into states, then the one search `discover`.

The states are those that nobody measured, found along with their equations, or, if no such
equations explain the signal to its noise, made of it by smoothing. Several preparations are
compared by forecasts from the past alone; the model is tested on the end of the record.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from ep2sindy.data.coerce import Task
from ep2sindy.data.runs import Run, trajectory_of
from ep2sindy.data.trajectory import Trajectory
from ep2sindy.discovery.discover import discover
from ep2sindy.discovery.method import AnyMethod, Regression, TrajectorySearch
from ep2sindy.discovery.result import Discovery
from ep2sindy.discovery.signal_unknowns import (
    FITTED,
    HiddenStates,
    embed_hidden,
    fit_functions,
    record_of,
    search_hidden,
)
from ep2sindy.estimation.problem import FIRST_MAX_TERMS
from ep2sindy.forecasting.evaluation import Evaluation, evaluate
from ep2sindy.forecasting.forecast import RollingStarts, calibrate, spread_starts
from ep2sindy.forecasting.skill import forecast_skill, horizon_errors
from ep2sindy.forecasting.state_estimation import StateEstimator, tune_estimator
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.relations import relations_of
from ep2sindy.model.comparison import REPEATS, FreeRunBounds
from ep2sindy.model.display import model_lines
from ep2sindy.model.model import SparseModel
from ep2sindy.regression.bootstraps import Bootstraps
from ep2sindy.regression.formulations import WeightedWeak
from ep2sindy.regression.searches import BestSubset
from ep2sindy.runtime.parallel import Once, at_once
from ep2sindy.runtime.progress import SILENT, Progress, as_progress
from ep2sindy.runtime.screen import N_LINES, one_screen, sentences
from ep2sindy.runtime.threads import one_thread
from ep2sindy.signals.embedding import (
    EMBEDDINGS,
    HARMONICS,
    AnyEmbedding,
    Embedded,
    Embedding,
    LogRate,
    Rate,
    embed,
    unexplained,
)
from ep2sindy.signals.trace import Trace, prepare_signal

# Error of forecasts, as a share of that of fewer states, from which more states are taken; starts
# from which it is counted, and draws of each.
CLEARLY, N_TRIED, N_DRAWS_TRIED = 0.8, 20, 20

# Candidates per equation if no equation is known, so that there are few combinations.
DEPTH_OF_BOTH = 2

EXPLAINED = "their equations explain the signal to its noise"

MIN_FITTED = 4.0  # periods that a fitted part must have
MIN_JUDGED = 1.5  # periods that a held-out part must have


@dataclass(frozen=True, eq=False)
class Attempt:
    """A model in the states that one preparation made.

    estimator: of its states along the fitted part. error: of its forecasts up to a period there, in
    standard deviations. share: of the next state's variance that neighbours in these states do not
    explain; None for hidden states, of which there is no next one.
    """

    states: Embedded
    found: Discovery
    estimator: StateEstimator
    error: float
    share: float | None

    @property
    def n_states(self) -> int:
        return self.states.embedding.n_states

    @property
    def text(self) -> str:
        errors = (
            f"{self.n_states} states: forecasts up to a period err by {self.error:.3f} standard "
            "deviations where fitted"
        )
        if self.share is None:
            return errors
        left = f"neighbours leave {100.0 * self.share:.2g} % of the next derivative unexplained"
        return f"{errors}; {left}"


def measure_forecast_error(past: Trace, states: Embedded, estimator: StateEstimator) -> float:
    """Error of forecasts up to a period from starts in the last half of the fitted part."""
    record, longest = complete_states(past, states.run), max(2, round(past.per_period))
    n = record.n_samples
    first = spread_starts(record.t, n // 2, longest, N_TRIED)
    rolling = RollingStarts(estimator, record, first, longest)
    ends = rolling.ends(partial(embed_past, past, states.embedding))
    ahead = rolling.forecast(ends, N_DRAWS_TRIED, seed=0)
    scale = past.x[n // 2 :].std()
    return float(horizon_errors(rolling.measured(ahead), rolling.truth, scale).mean())


def complete_states(signal: Trace, known: Trajectory) -> Trajectory:
    """Samples of the signal as measured, with the other states beside it as far as they are known.

    Where a state is not known, at the beginning or beyond the fitted part, the nearest is taken;
    forecasts there make their own.
    """
    nearest = np.clip(np.searchsorted(known.t, signal.t), 0, known.n_samples - 1)
    states = known.states[nearest].copy()
    states[:, 0] = signal.x
    return replace(known, t=signal.t, states=states, inputs=np.empty((len(signal.t), 0)))


def embed_past(signal: Trace, embedding: Embedding, past: Trajectory) -> Trajectory:
    """The states at a time, made from samples before it alone."""
    own = signal.with_samples(past.t, past.states[:, 0])
    if isinstance(embedding, HiddenStates):  # the estimator fits them itself
        return record_of(own)
    return embedding.embed(own).run


@dataclass(frozen=True)
class SignalSearch:
    """How states of one signal, and their equations, are searched.

    method: of the search in smoothed states. embedding, n_states, harmonics: how states are made.
    degree, functions, function_degree: of the library. held_out: share of the record that judges.
    All are described at `from_one_signal`.
    Raises ValueError for an embedding, a number of states or a share that there is not.
    """

    method: AnyMethod
    embedding: str = "auto"
    n_states: int | str = "auto"
    harmonics: float = HARMONICS
    degree: int = 3
    functions: Sequence[str] = ()
    function_degree: int = 1
    held_out: float = 0.25

    def __post_init__(self) -> None:
        known = ("hidden", *EMBEDDINGS)
        if self.embedding not in ("auto", *known):
            raise ValueError(
                f"embedding must be auto, {' or '.join(known)}: {self.embedding!r} came"
            )
        if isinstance(self.n_states, str) and self.n_states != "auto":
            raise ValueError(f"n_states must be auto or a number: {self.n_states!r} came")
        n_states = 2 if isinstance(self.n_states, str) else self.n_states
        Rate(self.harmonics, n_states)  # refuses settings that no embedding has
        if not 0.0 <= self.held_out < 1.0:
            raise ValueError(
                f"held_out must be a share, 0 or more and below 1: {self.held_out!r} came"
            )

    def find(
        self, signal: Trace, *, seed: int = 0, progress: Progress = SILENT, once: Once = at_once
    ) -> SignalDiscovery:
        """The model that forecasts the fitted part best, and its tests on the rest.

        Fewer states are kept unless more forecast clearly better. once: does each search, or takes
        it from a run that was broken off.
        """
        past = self.fitted_part(signal)
        attempts = self._attempts(past, seed, progress, once)
        best = attempts[0]
        for other in attempts[1:]:
            best = other if other.error < CLEARLY * best.error else best
        return run_on_rest(signal, past, best, attempts, progress=progress)

    def fitted_part(self, signal: Trace) -> Trace:
        """The samples to fit; all of them if the record is too short to hold out a part."""
        n = len(signal.t)
        n_fitted = round((1.0 - self.held_out) * n)
        periods = np.array([n_fitted, n - n_fitted]) / signal.per_period
        enough = periods[0] >= MIN_FITTED and periods[1] >= MIN_JUDGED
        return signal.window(0, n_fitted if enough else n)

    def _attempts(self, past: Trace, seed: int, progress: Progress, once: Once) -> list[Attempt]:
        """One with hidden states if it explains the signal, or else one for every number."""
        # A signal of two states either repeats itself or spirals.
        own = [2] if repeats(past) else [2, 3]
        numbers = own if isinstance(self.n_states, str) else [self.n_states]
        if self.embedding in ("auto", "hidden"):
            libraries = self._hidden_libraries(past, numbers)
            found, explains = search_hidden(past, libraries, self.by_trajectories, progress, once)
            if explains or self.embedding == "hidden":
                states = embed_hidden(past, found, EXPLAINED if explains else "set")
                return [self._attempt(past, states, found, progress)]
        pairs = [once(partial(self._search_smoothed, past, n, seed, progress)) for n in numbers]
        return [self._attempt(past, chosen, found, progress) for chosen, found in pairs]

    def _hidden_libraries(self, past: Trace, numbers: Sequence[int]) -> Iterator[Library]:
        """Of the signal and hidden states, a growth rate or a rate and others; smallest first."""
        natural = LogRate if past.is_positive else Rate
        for n_states in numbers:
            functions = self.functions
            if any(FITTED in text for text in functions):
                functions = self._fit_functions(self._embed(past, n_states))
            for degree in range(min(2, self.degree), self.degree + 1):
                names = natural(n_states=n_states).names(past.name)
                yield self.library(names, functions, degree)

    @property
    def by_trajectories(self) -> TrajectorySearch:
        own = self.method
        return TrajectorySearch(own.max_terms if isinstance(own, TrajectorySearch) else None)

    def _search_smoothed(
        self, past: Trace, n_states: int, seed: int, progress: Progress
    ) -> tuple[Embedded, Discovery]:
        with progress.stage(None, "", f"{n_states} states of the signal"):
            states = self._embed(past, n_states)
        found = discover(
            states.run,
            self.library(states.run.state_names, self._fit_functions(states), self.degree),
            self._method_for(states),
            relations=states.relations,
            terms=states.terms,
            seed=seed,
            progress=progress,
        )
        return states, found

    def _attempt(
        self, past: Trace, states: Embedded, found: Discovery, progress: Progress
    ) -> Attempt:
        with progress.stage(None, "", "forecasts where it was fitted"):
            record = complete_states(past, states.run)
            estimator = tune_estimator(found.model, record, measured=[past.name])
            error = measure_forecast_error(past, states, estimator)
            own = states.embedding
            share = unexplained(past, own) if isinstance(own, AnyEmbedding) else None
        return Attempt(states, found, estimator, error, share)

    def _embed(self, signal: Trace, n_states: int) -> Embedded:
        kind = EMBEDDINGS.get(self.embedding)
        if kind is None:
            return embed(signal, n_states=n_states, harmonics=self.harmonics)
        return kind(self.harmonics, n_states).embed(signal)

    def library(self, names: Sequence[str], functions: Sequence[str], degree: int) -> Library:
        return polynomial(
            names, degree=degree, functions=functions, function_degree=self.function_degree
        )

    def _fit_functions(self, states: Embedded) -> list[str]:
        """The functions, with numbers where they have a `?`."""
        library_of = partial(self.library, states.run.state_names, degree=self.degree)
        misfit = partial(_measure_misfit, self.method, states)
        return fit_functions(self.functions, states.run, library_of, misfit)

    def _method_for(self, states: Embedded) -> AnyMethod:
        """The method; models that are run are judged by the measured signal alone."""
        method, rule = self.method, self.method.selection
        if rule.basis == "runs":
            from ep2sindy.selection.free_run import (
                FreeRunScore,  # loads torch, only for this rule
            )

            if isinstance(rule, FreeRunScore):
                judged = (states.run.state_names[0],)
                method = replace(method, selection=replace(rule, judged=judged))
        return method if states.terms else replace(method, depth=min(method.depth, DEPTH_OF_BOTH))


def repeats(signal: Trace) -> bool:
    """True if most of the signal is one cycle, again and again."""
    return signal.cycle is not None and signal.cycle.share >= REPEATS


def _measure_misfit(method: AnyMethod, states: Embedded, library: Library) -> float:
    """Share of the derivatives that the largest candidates leave, the product over equations.

    Infinite for a library that cannot be used on the states.
    """
    if isinstance(method, TrajectorySearch):
        method = Regression(search=BestSubset(max_terms=method.max_terms or FIRST_MAX_TERMS))
    try:
        task = Task([states.run], library, relations_of(states.relations), states.terms)
        equations = method.search_equations(task, rng=0)
    except ValueError:
        return float("inf")
    fronts = [each.front for each in equations if each.front.equation in states.searched]
    return float(np.prod([min(1.0 - c.r2_train for c in f.candidates) for f in fronts]))


@dataclass(frozen=True, eq=False)
class SignalDiscovery:
    """The model found from one signal, and its tests on the end of the record.

    signal: as prepared. best: the attempt that was chosen among `attempts`, in other numbers of
    states. states: all of the record, the signal as measured. evaluation: of the model over the end
    that was not fitted, or over all of a short record, from a start that was fitted to the samples
    before; with its forecasts if an end was left.
    """

    signal: Trace
    best: Attempt = field(repr=False)
    attempts: Sequence[Attempt] = field(repr=False)
    states: Trajectory
    evaluation: Evaluation = field(repr=False)

    @property
    def discovery(self) -> Discovery:
        return self.best.found

    @property
    def model(self) -> SparseModel:
        return self.best.found.model

    @property
    def is_held_out(self) -> bool:
        return self.evaluation.forecasts is not None

    @property
    def where(self) -> str:
        """What the model was run over, in words."""
        held_out, whole = "its end, which was not fitted", "all of it, too short to hold out"
        return held_out if self.is_held_out else whole

    @property
    def words(self) -> str:
        """How the run went."""
        misfit = "; it does not explain the data" if self.discovery.misfit else ""
        return f"{self.evaluation.text}{misfit}"

    def __repr__(self) -> str:
        states = self.best.states
        head = [
            f"{self.signal.name}: {states.embedding.says} ({states.reason})",
            f"run freely over {self.where}: {self.words}",
        ]
        tail = sentences(self.discovery.note) if self.discovery.note else []
        n_lines = N_LINES - len(head) - len(tail)
        return one_screen([*head, *model_lines(self.model, n_lines=n_lines), *tail])


@one_thread()
def from_one_signal(
    run: Run,
    signal: str | None = None,
    *,
    embedding: str = "auto",
    n_states: int | str = "auto",
    harmonics: float = HARMONICS,
    degree: int = 3,
    functions: Sequence[str] = (),
    function_degree: int = 1,
    method: AnyMethod | None = None,
    decimate: int | str | None = "auto",
    detrend: bool | str = "auto",
    held_out: float = 0.25,
    seed: int = 0,
    progress: Progress | bool = False,
) -> SignalDiscovery:
    """Find states and equations of one measured signal, as `+exp=trace` does.

    run: the record, as `discover` takes it. signal: the variable; None takes the only state.
    embedding: how states are made. "hidden": they are found along with their equations;
    "log_rate", "rate", "delays": by smoothing the signal; "auto": hidden if an exact trajectory of
    such equations explains the signal to its noise, and lives, else by smoothing. n_states: "auto"
    is two, and three as well for a signal that does not repeat itself; of these those that forecast
    best where they were fitted. harmonics: of the period, which the smoother follows. degree,
    functions, function_degree: of the library; a `?` in a function is a number to be fitted, as in
    `sign(?*v)`. method: of the search in smoothed states; None for that of the experiment, which
    selects by free runs. decimate, detrend: see `ep.signals.prepare_signal`. held_out: share at the
    end of the record that is not fitted, for the test.
    Raises ValueError for a signal that does not oscillate, or holds under six periods or under six
    samples a period, and for settings that do not suit it.
    """
    search = SignalSearch(
        method or method_by_runs(), embedding, n_states, harmonics, degree, functions,
        function_degree, held_out,
    )  # fmt: skip
    prepared = prepare_signal(trajectory_of(run), signal, decimate=decimate, detrend=detrend)
    return search.find(prepared, seed=seed, progress=as_progress(progress))


def method_by_runs() -> Regression:
    """The method of `+exp=trace`: many candidates of smoothed states, selected by free runs."""
    from ep2sindy.selection.free_run import FreeRunScore  # loads torch

    bounds = FreeRunBounds(frequency=0.005, amplitude=0.05)  # one state can be held to more
    rule = FreeRunScore(bounds=bounds, n_windows=40, n_starts=8)
    search = BestSubset(max_terms=5, n_best=8)
    return Regression(WeightedWeak(), search, rule, Bootstraps(n=0), depth=8)


def run_on_rest(
    signal: Trace, past: Trace, best: Attempt, attempts: Sequence[Attempt], *,
    progress: Progress,
) -> SignalDiscovery:  # fmt: skip
    """Run the model freely over the held-out part, which it also forecasts when it is asked to.

    The start is fitted to the samples before the held-out part. Without such a part, the whole
    record is compared, from the first of its states.
    """
    known, own, model = best.states.run, best.states.embedding, best.found.model
    whole, n_fitted = complete_states(signal, own.embed(signal).run), len(past.t)
    is_whole, before = n_fitted == len(signal.t), partial(embed_past, signal, own)
    estimator = best.estimator
    if is_whole:
        first, start = int(np.searchsorted(signal.t, known.t[0])), known.states[0]
    else:
        first, fitted = n_fitted - 1, complete_states(past, known)
        estimator = calibrate(estimator, fitted, states_of=before, progress=progress)
        start = estimator.filter(before(fitted)).mean
    measured = whole.window(first, whole.n_samples)
    evaluation = evaluate(best.found, measured, initial=start, judged=[signal.name])
    if not is_whole:
        skill = partial(
            forecast_skill, model, whole, n_fitted=n_fitted, states_of=before,
            estimator=estimator, progress=progress,
        )  # fmt: skip
        evaluation = replace(evaluation, forecasts=skill)
    return SignalDiscovery(signal, best, attempts, whole, evaluation)
