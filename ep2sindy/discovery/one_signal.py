"""Equations of one measured signal: its states are found or made, its model is tested on its end.

States that nobody measured are found along with their equations. If no such equations explain the
signal to its noise, states are made of it by smoothing, and the equations searched by rows.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
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
    name_states,
    record_of,
    search_hidden,
)
from ep2sindy.estimation.problem import FIRST_MAX_TERMS
from ep2sindy.forecasting.calibration import calibrate
from ep2sindy.forecasting.rolling import RollingStarts, spread_starts
from ep2sindy.forecasting.skill import ForecastSkill, forecast_skill, horizon_errors
from ep2sindy.forecasting.state_estimation import StateEstimator, tune_estimator
from ep2sindy.library.library import Library, polynomial
from ep2sindy.library.relations import relations_of
from ep2sindy.model.comparison import REPEATS, FreeRunBounds
from ep2sindy.model.display import model_lines
from ep2sindy.model.free_run import FreeCycle, free_run
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
    Chosen,
    Embedded,
    Embedding,
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
NOT_EXPLAINED = (
    "no equations of the signal and states that nobody measured explain it to its noise and live: "
    "states are made by smoothing"
)

MIN_FITTED = 4.0  # periods that a fitted part must have
MIN_JUDGED = 1.5  # periods that a held-out part must have


@dataclass(frozen=True, eq=False)
class Attempt:
    """A model in a number of states.

    estimator: of its states along the fitted part. error: of its forecasts up to a period there, in
    standard deviations. share: of the next state's variance that neighbours in these states do not
    explain; None for hidden states, of which there is no next one.
    """

    chosen: Chosen
    found: Discovery
    estimator: StateEstimator
    error: float
    share: float | None

    @property
    def n_states(self) -> int:
        return self.chosen.embedding.n_states

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


def choose_attempt(attempts: Sequence[Attempt]) -> Attempt:
    """The fewest states, unless more forecast clearly better where they were fitted."""
    best = attempts[0]
    for each in attempts[1:]:
        if each.error < CLEARLY * best.error:
            best = each
    return best


def measure_forecast_error(past: Trace, chosen: Chosen, estimator: StateEstimator) -> float:
    """Error of forecasts up to a period from starts in the last half of the fitted part."""
    record, longest = complete_states(past, chosen), max(2, round(past.per_period))
    n = record.n_samples
    first = spread_starts(record.t, n // 2, longest, N_TRIED)
    rolling = RollingStarts(estimator, record, [past.name], first, longest)
    ahead = rolling.forecast(partial(embed_past, past, chosen.embedding), N_DRAWS_TRIED, seed=0)
    scale = past.x[n // 2 :].std()
    return float(horizon_errors(rolling.measured(ahead), rolling.truth, scale).mean())


def complete_states(signal: Trace, chosen: Chosen) -> Trajectory:
    """Samples of the signal as measured, with the other states beside it as far as they are known.

    Where a state is not known, at the beginning or beyond the fitted part, the nearest is taken;
    forecasts there make their own.
    """
    known = chosen.embedded.run
    nearest = np.clip(np.searchsorted(known.t, signal.t), 0, known.n_samples - 1)
    states = known.states[nearest].copy()
    states[:, 0] = signal.x
    return replace(known, t=signal.t, states=states, inputs=np.empty((len(signal.t), 0)))


def embed_past(signal: Trace, embedding: Embedding, past: Trajectory) -> Trajectory:
    """The states at a time, made from samples before it alone."""
    if isinstance(embedding, HiddenStates):  # the estimator fits them itself
        return record_of(signal.with_samples(past.t, past.states[:, 0]))
    return embedding.embed(signal.with_samples(past.t, past.states[:, 0])).run


@dataclass(frozen=True)
class SignalSearch:
    """How states of one signal, and their equations, are searched.

    method: of the search in smoothed states. embedding, n_states, harmonics: how states are made.
    degree, functions, function_degree: of the library. All are described at `from_one_signal`.
    Raises ValueError for an embedding or a number of states that there is not.
    """

    method: AnyMethod
    embedding: str = "auto"
    n_states: int | str = "auto"
    harmonics: float = HARMONICS
    degree: int = 3
    functions: Sequence[str] = ()
    function_degree: int = 1

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

    def attempts(
        self,
        past: Trace,
        whole: Trace,
        *,
        seed: int = 0,
        progress: Progress = SILENT,
        say: Callable[[str], None] | None = None,
        once: Once = at_once,
    ) -> list[Attempt]:
        """One with hidden states if it explains the signal, or else one for every number.

        past: the part of the whole that is fitted. say: is told why hidden states are given up.
        once: does each search, or takes it from a run that was broken off.
        """
        numbers = self._numbers(whole)
        if self.embedding in ("auto", "hidden"):
            libraries = self._libraries(past, numbers)
            found, explains = search_hidden(past, libraries, self.by_trajectories, progress, once)
            if explains or self.embedding == "hidden":
                chosen = embed_hidden(past, found, EXPLAINED if explains else "set")
                return [self._attempt(past, chosen, found, progress)]
            if say is not None:
                say(NOT_EXPLAINED)
        pairs = [once(partial(self._search_smoothed, past, n, seed, progress)) for n in numbers]
        return [self._attempt(past, chosen, found, progress) for chosen, found in pairs]

    def _numbers(self, signal: Trace) -> list[int]:
        """Numbers of states to try; a signal of two states either repeats itself or spirals."""
        if self.n_states != "auto":
            return [int(self.n_states)]
        return [2] if repeats(signal) else [2, 3]

    def _libraries(self, past: Trace, numbers: Sequence[int]) -> Iterator[Library]:
        """Of the signal and hidden states, the smallest first."""
        for n_states in numbers:
            names, functions = name_states(past, n_states), self.functions
            if any(FITTED in text for text in functions):
                functions = self._fitted_functions(self._embed(past, n_states).embedded)
            for degree in self._degrees:
                yield self.library(names, functions, degree)

    @property
    def _degrees(self) -> range:
        """Of the libraries of hidden states, the smallest first."""
        return range(min(2, self.degree), self.degree + 1)

    @property
    def by_trajectories(self) -> TrajectorySearch:
        own = self.method
        if isinstance(own, TrajectorySearch):
            return TrajectorySearch(max_terms=own.max_terms)
        return TrajectorySearch()

    def _search_smoothed(
        self, past: Trace, n_states: int, seed: int, progress: Progress
    ) -> tuple[Chosen, Discovery]:
        with progress.stage(None, "", f"{n_states} states of the signal"):
            chosen = self._embed(past, n_states)
        return chosen, self._discover(chosen, past.name, seed, progress)

    def _attempt(
        self, past: Trace, chosen: Chosen, found: Discovery, progress: Progress
    ) -> Attempt:
        with progress.stage(None, "", "forecasts where it was fitted"):
            record = complete_states(past, chosen)
            estimator = tune_estimator(found.model, record, measured=[past.name])
            error = measure_forecast_error(past, chosen, estimator)
            own = chosen.embedding
            share = unexplained(past, own) if isinstance(own, AnyEmbedding) else None
        return Attempt(chosen, found, estimator, error, share)

    def _embed(self, signal: Trace, n_states: int) -> Chosen:
        kind = EMBEDDINGS.get(self.embedding)
        own = kind(harmonics=self.harmonics, n_states=n_states) if kind else None
        return embed(signal, own, n_states=n_states, harmonics=self.harmonics)

    def library(
        self, names: Sequence[str], functions: Sequence[str], degree: int | None = None
    ) -> Library:
        return polynomial(
            names,
            degree=self.degree if degree is None else degree,
            functions=functions,
            function_degree=self.function_degree,
        )

    def _fitted_functions(self, known: Embedded) -> list[str]:
        """The functions, with numbers where they have a `?`."""
        library_of = partial(self.library, known.run.state_names)
        return fit_functions(
            self.functions, known.run, library_of, partial(_measure_misfit, self.method, known)
        )

    def _discover(self, chosen: Chosen, signal: str, seed: int, progress: Progress) -> Discovery:
        method, rule, known = self.method, self.method.selection, chosen.embedded
        if rule.basis == "runs":  # the measured signal is judged, not derived states
            from ep2sindy.selection.free_run import (
                FreeRunScore,  # loads torch, only for this rule
            )

            if isinstance(rule, FreeRunScore):
                method = replace(method, selection=replace(rule, judged=(signal,)))
        if not known.terms:
            method = replace(method, depth=min(method.depth, DEPTH_OF_BOTH))
        found = discover(
            known.run,
            self.library(known.run.state_names, self._fitted_functions(known)),
            method,
            relations=known.relations,
            terms=known.terms,
            seed=seed,
            progress=progress,
        )
        # Smoothing has made the states, so intervals would not cover the truth under a misfit.
        return (
            replace(found, model=replace(found.model, covariance=None)) if found.misfit else found
        )


def repeats(signal: Trace) -> bool:
    """True if most of the signal is one cycle, again and again."""
    return signal.cycle is not None and signal.cycle.share >= REPEATS


def _measure_misfit(method: AnyMethod, known: Embedded, library: Library) -> float:
    """Share of the derivatives that the largest candidates leave, the product over equations.

    Infinite for a library that cannot be used on the states.
    """
    if isinstance(method, TrajectorySearch):
        method = Regression(
            WeightedWeak(), BestSubset(max_terms=method.max_terms or FIRST_MAX_TERMS)
        )
    try:
        task = Task([known.run], library, relations_of(known.relations), known.terms)
        equations = method.search_equations(task, rng=0)
    except ValueError:
        return float("inf")
    fronts = [each.front for each in equations if each.front.equation in known.searched]
    return float(np.prod([min(1.0 - c.r2_train for c in f.candidates) for f in fronts]))


def count_fitted(signal: Trace, held_out: float) -> int:
    """Number of samples to fit; all of them if the record is too short to hold out a part."""
    n = len(signal.t)
    n_fitted = round((1.0 - held_out) * n)
    periods = np.array([n_fitted, n - n_fitted]) / signal.per_period
    enough = periods[0] >= MIN_FITTED and periods[1] >= MIN_JUDGED
    return n_fitted if enough else n


@dataclass(frozen=True, eq=False)
class SignalDiscovery:
    """The model found from one signal, and its tests on the end of the record.

    signal: as prepared. best: the attempt that was chosen among `attempts`, in other numbers of
    states. states: all of the record, the signal as measured. measured: the test data, the end that
    was not fitted, or all of a short record. free: the run of the model over them, from a start
    that was fitted to the samples before, and its cycle. skill: of forecasts of the test data; None
    without any.
    """

    signal: Trace
    best: Attempt = field(repr=False)
    attempts: Sequence[Attempt] = field(repr=False)
    states: Trajectory
    measured: Trajectory
    free: FreeCycle
    skill: ForecastSkill | None = field(repr=False)

    @property
    def discovery(self) -> Discovery:
        return self.best.found

    @property
    def model(self) -> SparseModel:
        return self.best.found.model

    def __repr__(self) -> str:
        where = (
            "its end, which was not fitted" if self.skill else "all of it, too short to hold out"
        )
        run, misfit = self.free.run, self.discovery.misfit
        head = [
            f"{self.signal.name}: {self.best.chosen.embedding.says} ({self.best.chosen.reason})",
            f"run freely over {where}: {run.words(seen=not self.skill, misfit=misfit)}",
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
        function_degree,
    )  # fmt: skip
    if not 0.0 <= held_out < 1.0:
        raise ValueError(f"held_out must be a share, 0 or more and below 1: {held_out!r} came")
    watch = as_progress(progress)
    found = prepare_signal(trajectory_of(run), signal, decimate=decimate, detrend=detrend)
    n_fitted = count_fitted(found, held_out)
    attempts = search.attempts(found.window(0, n_fitted), found, seed=seed, progress=watch)
    return evaluate(found, n_fitted, attempts, progress=watch)


def method_by_runs() -> Regression:
    """The method of `+exp=trace`: many candidates of smoothed states, selected by free runs."""
    from ep2sindy.selection.free_run import FreeRunScore  # loads torch

    bounds = FreeRunBounds(frequency=0.005, amplitude=0.05)  # one state can be held to more
    rule = FreeRunScore(bounds=bounds, n_windows=40, n_starts=8)
    search = BestSubset(max_terms=5, n_best=8)
    return Regression(WeightedWeak(), search, rule, Bootstraps(n=0), depth=8)


def evaluate(
    signal: Trace, n_fitted: int, attempts: Sequence[Attempt], *, progress: Progress = SILENT
) -> SignalDiscovery:
    """Run the model freely over the held-out part, and forecast it again and again.

    The start is fitted to the samples before the held-out part. Without such a part, the whole
    record is compared, from the first of its states.
    """
    best = choose_attempt(attempts)
    chosen, model = best.chosen, best.found.model
    whole = complete_states(signal, replace(
        chosen, embedded=chosen.embedding.embed(signal)
    ))  # fmt: skip
    own = [signal.name]
    is_whole, before = n_fitted == len(signal.t), partial(embed_past, signal, chosen.embedding)
    if is_whole:
        first, estimator = int(np.searchsorted(signal.t, chosen.embedded.run.t[0])), best.estimator
        start = chosen.embedded.run.states[0]
    else:
        first, past = n_fitted - 1, complete_states(signal.window(0, n_fitted), chosen)
        with progress.stage(None, "", "width of the forecasts' bands"):
            estimator = calibrate(best.estimator, past, states_of=before)
        start = estimator.filter(before(past)).mean
    measured = whole.window(first, whole.n_samples)
    with progress.stage(None, "", "free run and limit cycle"):
        cycle = FreeCycle.of(free_run(model, measured, initial=start, judged=own))
    if is_whole:
        return SignalDiscovery(signal, best, attempts, whole, measured, cycle, None)
    with progress.stage(None, "start", "forecasts") as advance:
        skill = forecast_skill(
            model, whole, n_fitted=n_fitted, measured=own, states_of=before, estimator=estimator,
            advance=advance,
        )  # fmt: skip
    return SignalDiscovery(signal, best, attempts, whole, measured, cycle, skill)
